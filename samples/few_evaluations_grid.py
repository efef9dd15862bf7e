"""Draws one row for each material: a touch, the true picture, and what the model and its student make of one noise.

python samples/few_evaluations_grid.py
python samples/few_evaluations_grid.py --output samples/pictures/few_evaluations.png    # the documentation's
"""

import argparse
from pathlib import Path

import torch

import unitouch_gen
from drawing import draw_grid, flat_contacts, save
from unitouch_gen.world import MATERIAL_NAMES, World

STEPS = (8, 4, 2, 1)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--output", type=Path, default=Path("outputs/few_evaluations.png"))
    parser.add_argument("--object", type=int, default=0, help="which of the held-out objects")
    parser.add_argument("--guidance", type=float, default=9.0, help="guidance scale, from 1 to 9")
    arguments = parser.parse_args()

    world, count = World(), len(MATERIAL_NAMES)
    names = flat_contacts(world, arguments.object)
    scene = world.render(*names, modalities=("image", "touch"), sensors=("gelsight",))
    touches = scene.touch["gelsight"]
    teacher, student = unitouch_gen.tiny("touch-to-image"), unitouch_gen.tiny("touch-to-image-turbo")
    drawn = [
        pipe(
            touches,
            guidance_scale=arguments.guidance,
            num_inference_steps=steps,
            generator=[torch.Generator().manual_seed(seed) for seed in range(count)],
            output_type="pt",
        ).images
        for pipe, steps in ((teacher, 20), *((student, steps) for steps in STEPS))
    ]

    grid = draw_grid(
        [[touches[row], scene.image[row], *(pictures[row] for pictures in drawn)] for row in range(count)],
        labels=MATERIAL_NAMES,
        titles=["touch", "true picture", "20 of two rows", *(f"{steps} of one" for steps in STEPS)],
        blocks=2,
    )
    save(grid, arguments.output)


if __name__ == "__main__":
    main()
