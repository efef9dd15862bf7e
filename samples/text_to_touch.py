"""Draws descriptions as every sensor would feel them.

python samples/text_to_touch.py "rough brick" "a smooth metal cylinder"
"""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import torch

import unitouch_gen

TEXTS = ("rough brick", "smooth glass", "woven natural fabric", "coarse gravel")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("texts", nargs="*", default=TEXTS)
    parser.add_argument("--output", type=Path, default=Path("samples/pictures/text_to_touch.png"))
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()

    pipe = unitouch_gen.tiny("x-to-touch")
    sensors = pipe.config.sensors
    rows = len(arguments.texts)
    figure, axes = plt.subplots(rows, len(sensors), squeeze=False, figsize=(1.5 * len(sensors) + 1, 1.5 * rows))
    for row, text in enumerate(arguments.texts):
        touches = pipe(
            text=text,
            sensor=sensors,
            bridge="nearest",
            num_candidates=4,
            # The same noise for every sensor.
            generator=[torch.Generator().manual_seed(arguments.seed + i) for _ in sensors for i in range(4)],
        ).images
        for axis, touch, sensor in zip(axes[row], touches, sensors, strict=True):
            axis.imshow(touch)
            axis.set(xticks=[], yticks=[])
            axis.spines[:].set_visible(False)
            if row == 0:
                axis.set_title(sensor, fontsize=9, pad=3)
        axes[row, 0].set_ylabel("\n".join(text.rsplit(" ", 1)), fontsize=8)
    figure.tight_layout(pad=0.4)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(arguments.output, dpi=110)
    print(arguments.output)


if __name__ == "__main__":
    main()
