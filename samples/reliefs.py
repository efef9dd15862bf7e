"""Draws touches above the heights that are estimated from them, without knowing their sensors.

python samples/reliefs.py --output outputs/reliefs.png
"""

import argparse
from pathlib import Path

from PIL import Image

from drawing import draw_grid, save
from unitouch_gen.models.relief import relief
from unitouch_gen.pipelines.tiny import joint_space

INPUTS = Path(__file__).parent / "inputs"
CONTRAST = 6.0
"""Deviations of heights between black and white."""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--output", type=Path, default=Path("outputs/reliefs.png"))
    parser.add_argument("--touches", type=Path, nargs="+", default=sorted(INPUTS.glob("*.png")))
    arguments = parser.parse_args()

    _, processor = joint_space()
    touches = [Image.open(touch) for touch in arguments.touches]
    heights = relief(processor.touch(touches))[:, 2:].expand(-1, 3, -1, -1) / CONTRAST + 0.5
    titles = [touch.stem.replace("_", " ") for touch in arguments.touches]
    save(draw_grid([touches, list(heights)], labels=["touch", "heights"], titles=titles), arguments.output)


if __name__ == "__main__":
    main()
