"""Draws touch images generated from descriptions, for every sensor.

python samples/text_to_touch.py
python samples/text_to_touch.py "rough brick" "a smooth metal cylinder"
"""

import argparse
from pathlib import Path

import torch

import unitouch_gen
from drawing import draw_grid, save

TEXTS = ("rough brick", "smooth glass", "woven natural fabric", "coarse gravel")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("texts", nargs="*", default=TEXTS)
    parser.add_argument("--output", type=Path, default=Path("outputs/text_to_touch.png"))
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()

    pipe = unitouch_gen.tiny("x-to-touch")
    sensors = pipe.config.sensors
    rows = []
    for text in arguments.texts:
        generators = [torch.Generator().manual_seed(arguments.seed) for _ in sensors]  # the same noise for all sensors
        rows.append(pipe(text=text, sensor=sensors, generator=generators).images)
    save(draw_grid(rows, labels=arguments.texts, titles=sensors, side=192, size=24), arguments.output)


if __name__ == "__main__":
    main()
