"""Draws the picture of a built-in pipeline's model card: inputs above, and generated images below.

python samples/card_pictures.py --pipeline stylization
for name in touch-to-image stylization x-to-touch; do    # the cards' own
    python samples/card_pictures.py --pipeline $name --output unitouch_gen/weights/cards/$name.jpg
done
"""

import argparse
from pathlib import Path

import torch
from PIL import Image

import unitouch_gen
from drawing import draw_grid, save
from unitouch_gen.cli.loading import DRAWING
from unitouch_gen.examples import example, examples

LABELS = {"image": "photo", "touch": "touch"}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--output", type=Path, default=Path("outputs/card.jpg"))
    parser.add_argument("--pipeline", choices=DRAWING, default="touch-to-image")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()

    names = {"image": list(examples("image")), "touch": list(examples())}
    if arguments.pipeline == "stylization":
        names["image"] = ["brick", "rock", "natural_fabric", "sand"]
        names["touch"] = ["wood", "tile", "rock", "metal"]  # one for each photo
    else:
        del names["touch" if arguments.pipeline.startswith("x-to-touch") else "image"]
    inputs = {}
    for modality, examples_of_it in names.items():
        inputs[modality] = [example(name, modality) for name in examples_of_it]
    titles = [" + ".join(column).replace("_", " ") for column in zip(*names.values(), strict=True)]
    generators = [torch.Generator().manual_seed(arguments.seed + number) for number in range(len(titles))]
    generated = unitouch_gen.tiny(arguments.pipeline)(**inputs, generator=generators).images
    rows = [[Image.open(file) for file in files] for files in inputs.values()]
    labels = [LABELS[modality] for modality in inputs]
    grid = draw_grid([*rows, generated], labels=[*labels, "generated"], titles=titles, size=16)
    save(grid, arguments.output)


if __name__ == "__main__":
    main()
