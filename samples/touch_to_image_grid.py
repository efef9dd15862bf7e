"""Draws one row for each material, drawn or scanned: a touch, the true picture, and pictures generated from the touch.

python samples/touch_to_image_grid.py
python samples/touch_to_image_grid.py --output samples/pictures/touch_to_image.jpg    # the README's
"""

import argparse
from pathlib import Path

import torch

import unitouch_gen
from drawing import draw_grid, flat_contacts, labels_of, save
from unitouch_gen.world import MATERIAL_NAMES, SENSORS, World


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--output", type=Path, default=Path("outputs/touch_to_image.png"))
    parser.add_argument("--sensor", default="gelsight", choices=sorted(SENSORS))
    parser.add_argument("--object", type=int, default=0, help="number of the held-out object")
    parser.add_argument("--pictures", type=int, default=4, help="pictures generated from each touch")
    arguments = parser.parse_args()

    world = World(scanned=0.5)
    count = len(MATERIAL_NAMES)
    contacts = flat_contacts(world, arguments.object)
    scene = world.render(*contacts, modalities=("image", "touch"), sensors=(arguments.sensor,))
    touches = scene.touch[arguments.sensor]
    pipe = unitouch_gen.tiny("touch-to-image")
    pictures = pipe(
        touches,
        num_images_per_prompt=arguments.pictures,
        generator=[torch.Generator().manual_seed(seed) for seed in range(count * arguments.pictures)],
        output_type="pt",
    ).images.unflatten(0, (count, arguments.pictures))

    grid = draw_grid(
        [[touches[row], scene.image[row], *pictures[row]] for row in range(count)],
        labels=labels_of(scene),
        titles=["touch", "true picture", *["generated"] * arguments.pictures],
        blocks=2,
    )
    save(grid, arguments.output)


if __name__ == "__main__":
    main()
