"""Draws touch images generated from sounds, with the waveforms beside them.

python samples/sound_to_touch.py samples/inputs/sounds/*.wav
"""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import soundfile
import torch

import unitouch_gen

SOUNDS = Path(__file__).parent / "inputs" / "sounds"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("sounds", type=Path, nargs="*", default=sorted(SOUNDS.glob("*.wav")))
    parser.add_argument("--output", type=Path, default=Path("outputs/sound_to_touch.png"))
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()

    pipe = unitouch_gen.tiny("x-to-touch")
    sensors = pipe.config.sensors
    figure, axes = plt.subplots(
        len(arguments.sounds),
        1 + len(sensors),
        squeeze=False,
        figsize=(3.2 + 1.4 * len(sensors), 1.45 * len(arguments.sounds)),
        width_ratios=[2.2] + [1] * len(sensors),
    )
    for row, file in enumerate(arguments.sounds):
        samples, rate = soundfile.read(file, always_2d=True)
        milliseconds = [1000 * sample / rate for sample in range(len(samples))]
        axes[row, 0].plot(milliseconds, samples.mean(axis=1), linewidth=0.6)
        axes[row, 0].set_title(file.stem, fontsize=8, loc="left", pad=2)
        axes[row, 0].tick_params(labelsize=6)
        axes[row, 0].set_yticks([])
        axes[row, 0].spines[["top", "right", "left"]].set_visible(False)
        generator = torch.Generator().manual_seed(arguments.seed)
        touches = pipe(audio=file, sensor=sensors, generator=generator).images
        for axis, touch, sensor in zip(axes[row, 1:], touches, sensors, strict=True):
            axis.imshow(touch)
            axis.axis("off")
            if row == 0:
                axis.set_title(sensor, fontsize=8, pad=2)
    axes[-1, 0].set_xlabel("ms", fontsize=7)
    figure.tight_layout(pad=0.4)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(arguments.output, dpi=110)
    print(arguments.output)


if __name__ == "__main__":
    main()
