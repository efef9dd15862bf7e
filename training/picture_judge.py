"""Stage 6, the independent judge of generated pictures.

python -m unitouch_gen.training.picture_judge --output runs/picture_judge
"""

from unitouch_gen.training.judge import train_judge

if __name__ == "__main__":
    train_judge("picture_judge", "image")
