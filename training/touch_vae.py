"""Stage 6, the autoencoder of touch images.

python -m unitouch_gen.training.touch_vae --output runs/touch_vae
"""

from unitouch_gen.training.image_vae import AutoencoderRecipe, main
from unitouch_gen.training.stages import run

if __name__ == "__main__":
    run("touch_vae", AutoencoderRecipe, main)
