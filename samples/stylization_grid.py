"""Restyles photos by touches: one row for each photo, one column for each touch.

python samples/stylization_grid.py --output samples/pictures/stylization.png
python samples/stylization_grid.py --photos mine.jpg --touches a.png b.png --touch-weight 0.5 --init-strength 0.7
"""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from PIL import Image, ImageOps

import unitouch_gen

INPUTS = Path(__file__).parent / "inputs"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--output", type=Path, default=Path("samples/pictures/stylization.png"))
    parser.add_argument("--photos", type=Path, nargs="+", default=sorted((INPUTS / "photos").glob("*.png")))
    parser.add_argument("--touches", type=Path, nargs="+", default=sorted(INPUTS.glob("*.png"))[:5])
    parser.add_argument("--touch-weight", type=float, default=0.55, help="the paper uses 0.3, which is subtle here")
    parser.add_argument("--mix", default="slerp", choices=("linear", "slerp"))
    parser.add_argument("--init-strength", type=float, help="keep the photo's layout: near 0 all of it, at most 1")
    arguments = parser.parse_args()

    pipe = unitouch_gen.tiny("stylization")
    rows, columns = len(arguments.photos), len(arguments.touches)
    figure, axes = plt.subplots(rows + 1, columns + 1, figsize=(1.2 * (columns + 1), 1.25 * (rows + 1)), squeeze=False)
    for axis in axes.flat:
        axis.set(xticks=[], yticks=[])
        axis.spines[:].set_visible(False)
    for axis, touch in zip(axes[0, 1:], arguments.touches, strict=True):
        axis.imshow(Image.open(touch))
        axis.set_title(touch.stem.replace("_", "\n", 1), fontsize=7, pad=2)
    for row, photo in enumerate(arguments.photos, start=1):
        pictures = pipe(
            photo,
            arguments.touches,
            touch_weight=arguments.touch_weight,
            mix=arguments.mix,
            init_strength=arguments.init_strength,
            # The same noise in every column, so that the touch alone makes the difference.
            generator=[torch.Generator().manual_seed(row) for _ in arguments.touches],
        ).images
        axes[row, 0].imshow(ImageOps.fit(Image.open(photo).convert("RGB"), pictures[0].size))
        axes[row, 0].set_ylabel(photo.stem.replace("_", "\n"), fontsize=7)
        for axis, picture in zip(axes[row, 1:], pictures, strict=True):
            axis.imshow(picture)
    figure.tight_layout(pad=0.3)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(arguments.output, dpi=110)
    print(arguments.output)


if __name__ == "__main__":
    main()
