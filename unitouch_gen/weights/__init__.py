"""Folders of the built-in tiny family, from which `unitouch_gen.tiny` builds pipelines.

    joint/                     the space of all four modalities, with its processor
    embedding-bank/            image embeddings that stylisation and x-to-touch move others towards
    image-vae/  touch-vae/     the autoencoders of pictures and of touch images
    touch-to-image/  x-to-touch/  touch-to-text/      components that only these pipelines have
        turbo/                 LoRA weights of the `-turbo` pipelines
    stylization/               defaults; its networks are those of touch-to-image/
    picture-classifier/  touch-classifier/            classifiers of the materials in generated images
    cards/                     pictures of model cards
    family.json                figures, texts of the cards, seeds, times and recipes

Every tensor is stored once, in fp16.
"""

from pathlib import Path

FAMILY = Path(__file__).parent
JOINT = FAMILY / "joint"
EMBEDDING_BANK = FAMILY / "embedding-bank"
IMAGE_VAE = FAMILY / "image-vae"
TOUCH_VAE = FAMILY / "touch-vae"
TOUCH_TO_IMAGE = FAMILY / "touch-to-image"
X_TO_TOUCH = FAMILY / "x-to-touch"
TOUCH_TO_TEXT = FAMILY / "touch-to-text"
PICTURE_CLASSIFIER = FAMILY / "picture-classifier"
TOUCH_CLASSIFIER = FAMILY / "touch-classifier"
FIGURES = FAMILY / "family.json"
CARDS = FAMILY / "cards"
