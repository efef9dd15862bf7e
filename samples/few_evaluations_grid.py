"""Draws one row for each material: what comes in, the true image, and what a model and its student make of one noise.

python samples/few_evaluations_grid.py
python samples/few_evaluations_grid.py --pipeline x-to-touch --output samples/pictures/few_evaluations_touch.png
"""

import argparse
from pathlib import Path

import torch

import unitouch_gen
from drawing import draw_grid, flat_contacts, save
from unitouch_gen.world import MATERIAL_NAMES, World

STEPS = (8, 4, 2, 1)

GUIDANCE = {"touch-to-image": 9.0, "x-to-touch": None}
"""The paper's, and the pipelines' own."""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--output", type=Path, default=Path("outputs/few_evaluations.png"))
    parser.add_argument("--pipeline", choices=GUIDANCE, default="touch-to-image")
    parser.add_argument("--object", type=int, default=0, help="which of the held-out objects")
    parser.add_argument("--guidance", type=float, help="guidance scale, from 1 to 9")
    arguments = parser.parse_args()

    world, count, name = World(), len(MATERIAL_NAMES), arguments.pipeline
    names = flat_contacts(world, arguments.object)
    scene = world.render(*names, modalities=("image", "touch"), sensors=("gelsight",))
    touches = scene.touch["gelsight"]
    given, true = (touches, scene.image) if name == "touch-to-image" else (scene.image, touches)
    inputs = {"touch": touches} if name == "touch-to-image" else {"image": scene.image, "sensor": "gelsight"}
    teacher, student = unitouch_gen.tiny(name), unitouch_gen.tiny(f"{name}-turbo")
    drawn = [
        pipe(
            **inputs,
            guidance_scale=arguments.guidance or GUIDANCE[name],
            num_inference_steps=steps,
            generator=[torch.Generator().manual_seed(seed) for seed in range(count)],
            output_type="pt",
        ).images
        for pipe, steps in ((teacher, 20), *((student, steps) for steps in STEPS))
    ]

    kinds = ("touch", "true picture") if name == "touch-to-image" else ("photo", "true touch")
    grid = draw_grid(
        [[given[row], true[row], *(images[row] for images in drawn)] for row in range(count)],
        labels=MATERIAL_NAMES,
        titles=[*kinds, "20 of two rows", *(f"{steps} of one" for steps in STEPS)],
        blocks=2,
    )
    save(grid, arguments.output)


if __name__ == "__main__":
    main()
