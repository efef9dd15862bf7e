"""Draws one row for each material: a touch, the true picture, and pictures generated from the touch.

python samples/touch_to_image_grid.py --output samples/pictures/touch_to_image.png
"""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import torch

import unitouch_gen
from unitouch_gen.world import COLLECTIONS, MATERIAL_NAMES, World
from unitouch_gen.world.collections import SPLITS


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--output", type=Path, default=Path("samples/pictures/touch_to_image.png"))
    parser.add_argument("--collection", default="touch_and_go", choices=sorted(COLLECTIONS))
    parser.add_argument("--object", type=int, default=2, help="number of the held-out object")
    parser.add_argument("--pictures", type=int, default=4, help="pictures generated from each touch")
    arguments = parser.parse_args()

    collection = COLLECTIONS[arguments.collection]
    count = len(MATERIAL_NAMES)
    held_out = collection.first_object + SPLITS["test"][0] + arguments.object
    scene = World().render(
        range(count), [held_out] * count, [0] * count,
        senses=("image", "touch"), sensors=(collection.sensor,), style=collection.style,
    )  # fmt: skip
    touches = scene.touch[collection.sensor]
    pipe = unitouch_gen.tiny("touch-to-image")
    pictures = pipe(
        touches,
        num_images_per_prompt=arguments.pictures,
        generator=[torch.Generator().manual_seed(seed) for seed in range(count * arguments.pictures)],
        output_type="pt",
    ).images.view(count, arguments.pictures, 3, 64, 64)

    # Two materials a row keep the grid short enough for a page.
    columns = 2 + arguments.pictures
    figure, axes = plt.subplots(count // 2, 2 * columns, figsize=(2 * columns * 0.9, count // 2 * 0.92), dpi=100)
    for material, name in enumerate(MATERIAL_NAMES):
        row, half = material % (count // 2), material // (count // 2)
        tiles = [touches[material], scene.image[material], *pictures[material]]
        titles = ["touch", "true picture", *["generated"] * arguments.pictures]
        for column, (tile, title) in enumerate(zip(tiles, titles, strict=True)):
            axis = axes[row, half * columns + column]
            axis.imshow(tile.permute(1, 2, 0).numpy(), interpolation="nearest")
            axis.set(xticks=[], yticks=[])
            axis.spines[:].set_visible(False)
            if row == 0:
                axis.set_title(title, fontsize=6, pad=2)
            if column == 0:
                axis.set_ylabel(name.replace(" ", "\n"), fontsize=6, labelpad=2)
    figure.tight_layout(pad=0.2, h_pad=0.2, w_pad=0.2)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(arguments.output)
    print(arguments.output)


if __name__ == "__main__":
    main()
