"""Draws one row for each material: a photo, the true touch, and touches imagined from photo, caption and sound.

python samples/x_to_touch_grid.py
python samples/x_to_touch_grid.py --output samples/pictures/x_to_touch.png    # the README's
"""

import argparse
from pathlib import Path

import torch

import unitouch_gen
from drawing import draw_grid, save
from unitouch_gen.world import COLLECTION_MATERIALS, COLLECTIONS, SAMPLE_RATE, World
from unitouch_gen.world.collections import SPLITS

TITLES = ("photo", "true touch", "from photo", "from caption", "from sound")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--output", type=Path, default=Path("outputs/x_to_touch.png"))
    parser.add_argument(
        "--collection", default="world_gelsight", choices=[n for n, c in COLLECTIONS.items() if c.training]
    )
    parser.add_argument("--object", type=int, default=2, help="number of the held-out object")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()

    collection, count = COLLECTIONS[arguments.collection], len(COLLECTION_MATERIALS)
    held_out = collection.first_object + SPLITS["test"][0] + arguments.object
    scene = World().render(
        range(count), [held_out] * count, [0] * count,
        modalities=("image", "touch", "audio", "text"), sensors=(collection.sensor,), style=collection.style,
    )  # fmt: skip
    pipe = unitouch_gen.tiny("x-to-touch")

    def imagine(**condition: object) -> torch.Tensor:
        generators = [torch.Generator().manual_seed(arguments.seed) for _ in range(count)]
        return pipe(**condition, sensor=collection.sensor, generator=generators, output_type="pt").images

    columns = [
        scene.image,
        scene.touch[collection.sensor],
        imagine(image=scene.image),
        imagine(text=scene.text, bridge="nearest"),
        imagine(audio=[(sound, SAMPLE_RATE) for sound in scene.audio], bridge="nearest"),
    ]
    rows = list(zip(*columns, strict=True))
    save(draw_grid(rows, labels=COLLECTION_MATERIALS, titles=TITLES, blocks=2), arguments.output)


if __name__ == "__main__":
    main()
