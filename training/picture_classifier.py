"""Stage 6, the independent classifier of generated pictures.

python -m unitouch_gen.training.picture_classifier --output runs/picture_classifier
"""

from unitouch_gen.training.classifier import train_classifier

if __name__ == "__main__":
    train_classifier("picture_classifier", "image")
