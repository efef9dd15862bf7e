"""Stage 7, the autoencoder of touch images.

python -m unitouch_gen.training.touch_vae --output runs/touch_vae
"""

from functools import partial

from unitouch_gen.training import image_vae
from unitouch_gen.training.stages import run

main = partial(image_vae.main, modality="touch")

if __name__ == "__main__":
    run("touch_vae", image_vae.AutoencoderRecipe, main)
