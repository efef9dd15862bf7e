"""Stage 9, the independent classifier of generated touches.

python -m unitouch_gen.training.touch_classifier --output runs/touch_classifier
"""

from unitouch_gen.training.classifier import train_classifier

if __name__ == "__main__":
    train_classifier("touch_classifier", "touch")
