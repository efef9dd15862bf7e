"""Stage 9, the classifier that names the material in a touch image.

python -m unitouch_gen.training.touch_classifier --output runs/touch_classifier
"""

from functools import partial

from unitouch_gen.training import picture_classifier
from unitouch_gen.training.stages import run

main = partial(picture_classifier.main, modality="touch")

if __name__ == "__main__":
    run("touch_classifier", picture_classifier.ClassifierRecipe, main)
