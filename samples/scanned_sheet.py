"""Draws held-out scanned surfaces, one row for each material: photo, touch, and what is made of either.

python samples/scanned_sheet.py
python samples/scanned_sheet.py --surface 1    # others of their surfaces, where a material has several
python samples/scanned_sheet.py --shuffle      # what is made in another order, to be matched by eye; prints the order
"""

import argparse
from pathlib import Path

import torch

import unitouch_gen
from drawing import draw_grid, save
from unitouch_gen.world import FIRST_OBJECT, MATERIAL_NAMES, SENSORS, World
from unitouch_gen.world.draws import SHAPES

TITLES = ("photo", "touch", "touch made of the photo", "picture made of the touch")
OBJECTS, CONTACTS = 24, 5  # of each material that are looked through


def firm_contacts(world: World, number: int) -> tuple[list[int], list[int], list[int]]:
    """Material, object and contact of a firm contact with a flat face of a held-out surface of each material."""
    names = list[tuple[int, int, int]]()
    objects = range(FIRST_OBJECT["test"], FIRST_OBJECT["test"] + OBJECTS)
    for material in range(len(MATERIAL_NAMES)):
        grid = torch.cartesian_prod(torch.tensor([material]), torch.tensor(objects), torch.arange(CONTACTS))
        draws = world.draw(*grid.unbind(1))
        flat = draws.shape == list(SHAPES).index("flat")
        rows = torch.nonzero((draws.surface >= 0) & flat & (draws.indentation_depth > 0.5))[:, 0]
        firm = {int(draws.surface[row]): tuple(grid[row].tolist()) for row in reversed(rows.tolist())}
        if firm:
            names.append(firm[sorted(firm)[number % len(firm)]])
    material, object_, contact = (list(part) for part in zip(*names, strict=True))
    return material, object_, contact


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--output", type=Path, default=Path("outputs/scanned_sheet.png"))
    parser.add_argument("--family", type=Path, help="folder of a family; the built-in one if left out")
    parser.add_argument("--sensor", default="gelsight", choices=sorted(SENSORS))
    parser.add_argument("--surface", type=int, default=0, help="which of the held-out surfaces of each material")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--shuffle", action="store_true", help="draw what is made in another order")
    arguments = parser.parse_args()

    world = World(scanned=1.0)
    names = firm_contacts(world, arguments.surface)
    scene = world.render(*names, modalities=("image", "touch"), sensors=(arguments.sensor,))
    touch, count = scene.touch[arguments.sensor], len(scene.material)
    family = {} if arguments.family is None else {"family": arguments.family}

    def made(pipeline: str, **inputs: object) -> torch.Tensor:
        generators = [torch.Generator().manual_seed(arguments.seed + row) for row in range(count)]
        pipe = unitouch_gen.tiny(pipeline, **family)
        return pipe(**inputs, generator=generators, output_type="pt").images

    columns = [
        scene.image,
        touch,
        made("x-to-touch", image=scene.image, sensor=arguments.sensor),
        made("touch-to-image", touch=touch),
    ]
    labels, titles = [MATERIAL_NAMES[material] for material in scene.material.tolist()], list(TITLES)
    if arguments.shuffle:
        generator = torch.Generator().manual_seed(arguments.seed)
        for column in (2, 3):
            order = torch.randperm(count, generator=generator)
            columns[column] = columns[column][order]
            print(f"{titles[column]}: {', '.join(labels[row] for row in order.tolist())}")
            titles[column] += ", shuffled"
    save(draw_grid(list(zip(*columns, strict=True)), labels=labels, titles=titles, blocks=2), arguments.output)


if __name__ == "__main__":
    main()
