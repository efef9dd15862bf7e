"""Draws one row for each material: a photo, the true touch, and touches imagined from photo, caption and sound.

python samples/x_to_touch_grid.py --output samples/pictures/x_to_touch.png
"""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import torch

import unitouch_gen
from unitouch_gen.world import COLLECTIONS, MATERIAL_NAMES, SAMPLE_RATE, World
from unitouch_gen.world.collections import SPLITS

TITLES = ("photo", "true touch", "from photo", "from caption", "from sound")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--output", type=Path, default=Path("samples/pictures/x_to_touch.png"))
    parser.add_argument(
        "--collection", default="touch_and_go", choices=[n for n, c in COLLECTIONS.items() if c.training]
    )
    parser.add_argument("--object", type=int, default=2, help="number of the held-out object")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()

    collection, count = COLLECTIONS[arguments.collection], len(MATERIAL_NAMES)
    held_out = collection.first_object + SPLITS["test"][0] + arguments.object
    scene = World().render(
        range(count), [held_out] * count, [0] * count,
        senses=("image", "touch", "audio", "text"), sensors=(collection.sensor,), style=collection.style,
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
    # Two materials a row keep the grid short enough for a page.
    width, height = 2 * len(columns), count // 2
    figure, axes = plt.subplots(height, width, figsize=(0.95 * width, 0.97 * height), dpi=110)
    for material, name in enumerate(MATERIAL_NAMES):
        row, half = material % height, material // height
        for number, (images, title) in enumerate(zip(columns, TITLES, strict=True)):
            axis = axes[row, half * len(columns) + number]
            axis.imshow(images[material].permute(1, 2, 0).clamp(0, 1).numpy(), interpolation="nearest")
            axis.set(xticks=[], yticks=[])
            axis.spines[:].set_visible(False)
            if row == 0:
                axis.set_title(title, fontsize=6.5, pad=2)
            if number == 0:
                axis.set_ylabel(name.replace(" ", "\n"), fontsize=6.5, labelpad=2)
    figure.tight_layout(pad=0.2, h_pad=0.2, w_pad=0.2)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(arguments.output)
    print(arguments.output)


if __name__ == "__main__":
    main()
