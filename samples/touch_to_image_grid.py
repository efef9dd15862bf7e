"""Draws one row for each material: a touch, the true picture, and pictures generated from the touch.

python samples/touch_to_image_grid.py
python samples/touch_to_image_grid.py --output samples/pictures/touch_to_image.png    # the README's
"""

import argparse
from pathlib import Path

import torch

import unitouch_gen
from drawing import draw_grid, save
from unitouch_gen.world import COLLECTION_MATERIALS, COLLECTIONS, World
from unitouch_gen.world.collections import SPLITS


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--output", type=Path, default=Path("outputs/touch_to_image.png"))
    parser.add_argument("--collection", default="world_gelsight", choices=sorted(COLLECTIONS))
    parser.add_argument("--object", type=int, default=2, help="number of the held-out object")
    parser.add_argument("--pictures", type=int, default=4, help="pictures generated from each touch")
    arguments = parser.parse_args()

    collection = COLLECTIONS[arguments.collection]
    count = len(COLLECTION_MATERIALS)
    held_out = collection.first_object + SPLITS["test"][0] + arguments.object
    scene = World().render(
        range(count), [held_out] * count, [0] * count,
        modalities=("image", "touch"), sensors=(collection.sensor,), style=collection.style,
    )  # fmt: skip
    touches = scene.touch[collection.sensor]
    pipe = unitouch_gen.tiny("touch-to-image")
    pictures = pipe(
        touches,
        num_images_per_prompt=arguments.pictures,
        generator=[torch.Generator().manual_seed(seed) for seed in range(count * arguments.pictures)],
        output_type="pt",
    ).images.view(count, arguments.pictures, 3, 64, 64)

    grid = draw_grid(
        [[touches[row], scene.image[row], *pictures[row]] for row in range(count)],
        labels=COLLECTION_MATERIALS,
        titles=["touch", "true picture", *["generated"] * arguments.pictures],
        blocks=2,
    )
    save(grid, arguments.output)


if __name__ == "__main__":
    main()
