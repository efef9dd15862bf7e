"""Stage 9, the classifier that names the material in a touch image.

python -m unitouch_gen.training.touch_classifier --output runs/touch_classifier
"""

from unitouch_gen.training.picture_classifier import ClassifierRecipe, main
from unitouch_gen.training.stages import run

if __name__ == "__main__":
    run("touch_classifier", ClassifierRecipe, main)
