"""The built-in tiny family: where its files are. `unitouch_gen.tiny` makes pipelines of them.

Layout: `joint/` is the space of all four modalities with its processor; `embedding-bank/` holds image embeddings that
stylisation and x-to-touch move others towards; `image-vae/` is the autoencoder of pictures, `touch-vae/` that of touch
images; `touch-to-image/`, `x-to-touch/` and `touch-to-text/` are what only these pipelines have, and their `turbo/` the
LoRA weights of `-turbo` ones; `stylization/` holds only defaults, as its networks are those of `touch-to-image/`.
`picture-classifier/` and `touch-classifier/` name the materials in generated images, `cards/` has the pictures of
model cards, and `family.json` holds figures, what the cards say, seeds, times and recipes. Every tensor is stored once,
in fp16.
"""

from pathlib import Path

FAMILY = Path(__file__).parent
JOINT = FAMILY / "joint"
EMBEDDING_BANK = FAMILY / "embedding-bank"
IMAGE_VAE = FAMILY / "image-vae"
TOUCH_VAE = FAMILY / "touch-vae"
TOUCH_TO_IMAGE, X_TO_TOUCH, TOUCH_TO_TEXT = (FAMILY / of for of in ("touch-to-image", "x-to-touch", "touch-to-text"))
PICTURE_CLASSIFIER = FAMILY / "picture-classifier"
TOUCH_CLASSIFIER = FAMILY / "touch-classifier"
FIGURES = FAMILY / "family.json"
CARDS = FAMILY / "cards"
