"""The built-in tiny family: where its files are. `unitouch_gen.tiny` makes pipelines of them.

Layout: `joint/` is the space of all four modalities with its processor, `embedding-bank/` embeddings of pictures that
those of other modalities are moved towards by two pipelines; `image-vae/` the autoencoder of pictures,
`touch-vae/` that of touch images; `touch-to-image/`, `x-to-touch/` and `touch-to-text/` are what only pipelines of this
kind have, and their `turbo/` the LoRA weights of `-turbo` ones; `stylization/` has the defaults of stylisation over the
first of these. `picture-classifier/` and `touch-classifier/` name the materials in generated images, `cards/` has the
pictures of model cards, and `family.json` holds figures, what the cards say, seeds, times and recipes. Every tensor is
stored once, in fp16.
"""

from pathlib import Path

FAMILY = Path(__file__).parent
JOINT, EMBEDDING_BANK = FAMILY / "joint", FAMILY / "embedding-bank"
IMAGE_VAE, TOUCH_VAE = FAMILY / "image-vae", FAMILY / "touch-vae"
TOUCH_TO_IMAGE, X_TO_TOUCH, TOUCH_TO_TEXT = (FAMILY / of for of in ("touch-to-image", "x-to-touch", "touch-to-text"))
PICTURE_CLASSIFIER, TOUCH_CLASSIFIER = FAMILY / "picture-classifier", FAMILY / "touch-classifier"
FIGURES = FAMILY / "family.json"
CARDS = FAMILY / "cards"
"""A picture for each pipeline, which `samples/card_pictures.py` draws."""
