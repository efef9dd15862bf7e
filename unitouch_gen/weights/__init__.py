"""The built-in tiny family: where its files are. `unitouch_gen.tiny` makes pipelines of them.

Layout: `joint/` is the space of all four senses with its processor, `image-vae/` the autoencoder of pictures,
`touch-to-image/` what only that pipeline has, `picture-judge/` the classifier that judges generated pictures, and
`family.json` the figures, seeds, times and recipes. Every tensor is stored once, in fp16.
"""

from pathlib import Path

FAMILY = Path(__file__).parent
JOINT, IMAGE_VAE, TOUCH_TO_IMAGE, PICTURE_JUDGE = (
    FAMILY / name for name in ("joint", "image-vae", "touch-to-image", "picture-judge")
)
FIGURES = FAMILY / "family.json"
