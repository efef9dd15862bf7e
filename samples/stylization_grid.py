"""Restyles photos by touches: one row for each photo, one column for each touch.

python samples/stylization_grid.py
python samples/stylization_grid.py --output samples/pictures/stylization.jpg    # the README's
python samples/stylization_grid.py --photos mine.jpg --touches a.png b.png --touch-weight 0.5 --layout 8
"""

import argparse
from pathlib import Path

import torch
from PIL import Image

import unitouch_gen
from drawing import draw_grid, save

INPUTS = Path(__file__).parent / "inputs"
# Half of them are of scanned surfaces.
PHOTOS = [INPUTS / "photos" / f"{name}.png" for name in ("brick", "rock", "natural_fabric", "sand")]
TOUCHES = [
    INPUTS / f"{name}.png"
    for name in ("digit_wood", "gelsight_rock", "gelsight_tile", "gelsight_r15_metal", "gelsight_brick")
]


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--output", type=Path, default=Path("outputs/stylization.png"))
    parser.add_argument("--photos", type=Path, nargs="+", default=PHOTOS)
    parser.add_argument("--touches", type=Path, nargs="+", default=TOUCHES)
    parser.add_argument("--touch-weight", type=float, default=0.7, help="weight of the touch in the mix")
    parser.add_argument(
        "--layout", type=int, default=14, help="cells along a side of the grid that keeps the photo's layout"
    )
    arguments = parser.parse_args()

    pipe = unitouch_gen.tiny("stylization")
    rows = [[None, *(Image.open(touch) for touch in arguments.touches)]]
    for number, photo in enumerate(arguments.photos, start=1):
        pictures = pipe(
            photo,
            arguments.touches,
            touch_weight=arguments.touch_weight,
            layout=arguments.layout,
            # The same noise in every column, so that only the touch is different.
            generator=[torch.Generator().manual_seed(number) for _ in arguments.touches],
        ).images
        rows.append([Image.open(photo), *pictures])
    labels = ["", *map(name_of, arguments.photos)]
    titles = ["", *map(name_of, arguments.touches)]
    save(draw_grid(rows, labels=labels, titles=titles, side=192, size=24), arguments.output)


def name_of(file: Path) -> str:
    return file.stem.replace("_", " ")


if __name__ == "__main__":
    main()
