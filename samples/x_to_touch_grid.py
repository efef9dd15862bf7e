"""Draws one row for each material: a photo, the true touch, and touches generated from photo, caption and sound.

Every second material is scanned, as far as there are scans.

python samples/x_to_touch_grid.py
python samples/x_to_touch_grid.py --output samples/pictures/x_to_touch.jpg    # the README's
"""

import argparse
from pathlib import Path

import torch

import unitouch_gen
from drawing import draw_grid, flat_contacts, labels_of, save
from unitouch_gen.world import MATERIAL_NAMES, SAMPLE_RATE, SENSORS, World

TITLES = ("photo", "true touch", "from photo", "from caption", "from sound")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--output", type=Path, default=Path("outputs/x_to_touch.png"))
    parser.add_argument("--sensor", default="gelsight", choices=sorted(SENSORS))
    parser.add_argument("--object", type=int, default=0, help="number of the held-out object")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()

    world = World(scanned=0.5)
    count = len(MATERIAL_NAMES)
    contacts = flat_contacts(world, arguments.object)
    scene = world.render(*contacts, modalities=("image", "touch", "audio", "text"), sensors=(arguments.sensor,))
    pipe = unitouch_gen.tiny("x-to-touch")

    def generate(**condition: object) -> torch.Tensor:
        generators = [torch.Generator().manual_seed(arguments.seed) for _ in range(count)]
        return pipe(**condition, sensor=arguments.sensor, generator=generators, output_type="pt").images

    columns = [
        scene.image,
        scene.touch[arguments.sensor],
        generate(image=scene.image),
        generate(text=scene.text),
        generate(audio=[(sound, SAMPLE_RATE) for sound in scene.audio]),
    ]
    rows = list(zip(*columns, strict=True))
    save(draw_grid(rows, labels=labels_of(scene), titles=TITLES, blocks=2), arguments.output)


if __name__ == "__main__":
    main()
