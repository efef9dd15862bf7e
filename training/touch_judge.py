"""Stage 9, the independent judge of generated touches.

python -m unitouch_gen.training.touch_judge --output runs/touch_judge
"""

from unitouch_gen.training.judge import train_judge

if __name__ == "__main__":
    train_judge("touch_judge", "touch")
