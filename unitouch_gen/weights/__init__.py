"""The built-in tiny family: where its files are. `unitouch_gen.tiny` makes pipelines of them.

Layout: `joint/` is the space of all four modalities with its processor, `embedding-bank/` embeddings of pictures that
those of other modalities are moved towards, `image-vae/` the autoencoder of pictures, `touch-to-image/` what only
unCLIP pipelines have, `touch-vae/` the autoencoder of touch images, `x-to-touch/` what only that pipeline has.
`picture-classifier/` and `touch-classifier/` name the materials in generated images, `cards/` has the pictures of
model cards, and `family.json` holds the figures, seeds, times and recipes. Every tensor is stored once, in fp16.
"""

from pathlib import Path

FAMILY = Path(__file__).parent
JOINT, EMBEDDING_BANK, IMAGE_VAE, TOUCH_TO_IMAGE, PICTURE_CLASSIFIER, TOUCH_VAE, X_TO_TOUCH, TOUCH_CLASSIFIER = (
    FAMILY / name
    for name in (
        "joint",
        "embedding-bank",
        "image-vae",
        "touch-to-image",
        "picture-classifier",
        "touch-vae",
        "x-to-touch",
        "touch-classifier",
    )
)
FIGURES = FAMILY / "family.json"
CARDS = FAMILY / "cards"
"""A picture for each pipeline, which `samples/card_pictures.py` draws."""
