"""How fast touches are read, decoded and augmented, against how fast the tiny touch encoder learns from them."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image

from tests.benchmarks.measuring import Figures, in_own_process, in_turns, ratio_of, seconds_of
from unitouch_gen.models import UniTouchConfig, UniTouchModel, UniTouchProcessor
from unitouch_gen.training.batches import ArrayDataset, ShuffledSampler
from unitouch_gen.training.data import DataConfig, columns_of, decoding
from unitouch_gen.training.losses import symmetric_info_nce
from unitouch_gen.training.recipe import read_recipe, read_section
from unitouch_gen.training.touch import TouchAugmentation, TouchObjective
from unitouch_gen.world import World

CAMERA = (640, 480)
"""Pixels of a frame, as Touch and Go has them."""


def training_figures(repeats: int = 7) -> Figures:
    """Touches a second, and how many times as fast as the encoder learns: decoded once to disk, and at every step.

    On one core, with a process and a thread of its own: on more, both are as many times as fast.
    """
    return in_own_process(input_figures, repeats)


def input_figures(repeats: int, batches: int = 2, frames: int = 256) -> Figures:
    """The figures with a single thread, which this process keeps to from then on."""
    torch.set_num_threads(1)
    decoding.THREADS = 1
    recipe = read_recipe("touch")
    batch_size = recipe["trainer"]["batch_size"]
    objective = TouchObjective(_model(), read_section(recipe, "augment", TouchAugmentation))
    pixels = objective.augmented(torch.randint(0, 256, (batch_size, 3, 64, 64), dtype=torch.uint8))
    with TemporaryDirectory() as folder:
        write_frames(Path(folder) / "frames", frames)
        calls: dict[str, Callable[[], float]] = {
            "learned": partial(seconds_of, _repeat, batches, _learning(objective, pixels))
        }
        for name, stream in (("from_disk", False), ("decoded", True)):
            config = DataConfig(sets=[{"path": f"{folder}/frames", "sensor": "digit"}], stream=stream)
            processor = UniTouchProcessor(image_size=64)
            splits = columns_of(config.sources(), Path(folder) / "cache", config, processor, ["touch"])
            dataset = ArrayDataset(touch=[split.touch for split in splits])
            indices_of = ShuffledSampler(frames, batch_size)
            calls[name] = partial(seconds_of, _repeat, batches, _feeding(objective, dataset, indices_of))
        seconds = in_turns(calls, repeats)
    rate = {name: batches * batch_size / float(np.median(seen)) for name, seen in seconds.items()}
    ratios = {name: ratio_of(seconds["learned"], seconds[name]) for name in ("from_disk", "decoded")}
    return {"batch_size": batch_size, "touches_per_second": rate, **ratios}


def write_frames(folder: Path, count: int) -> None:
    """Touches of the world as a camera writes them, with its noise: JPEG files of 50 kB, as those of real sensors."""
    folder.mkdir(parents=True)
    rows = torch.arange(count)
    scene = World().render(rows % 16, 600 + rows // 16, rows * 0, modalities=("touch",), sensors=("digit",))
    noise = torch.Generator().manual_seed(0)
    for number, touch in enumerate(scene.touch["digit"]):
        pixels = F.interpolate(touch[None], CAMERA[::-1], mode="bicubic")[0].permute(1, 2, 0)
        pixels = (pixels + 0.004 * torch.randn(pixels.shape, generator=noise)).clamp(0, 1)
        Image.fromarray((255 * pixels).byte().numpy()).save(folder / f"{number}.jpg", quality=95)


def _model() -> UniTouchModel:
    """A fresh touch encoder of the tiny family's size."""
    recipe = read_recipe("image_text")
    torch.manual_seed(0)
    return UniTouchModel(read_section(recipe, "model", UniTouchConfig), modalities=("touch",))


def _learning(objective: TouchObjective, pixels: torch.Tensor) -> Callable[[int], None]:
    """A step of training, with the precision of the recipe."""
    optimizer = torch.optim.AdamW(objective.trained.parameters(), lr=1e-3)
    sensor = torch.zeros(len(pixels), dtype=torch.int64)

    def learn(step: int) -> None:
        with torch.autocast("cpu", torch.bfloat16):
            touch = objective.trained(pixels, sensor)
            loss = symmetric_info_nce(touch, torch.randn(touch.shape), objective.temperature)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()

    return learn


def _feeding(
    objective: TouchObjective, dataset: ArrayDataset, indices_of: Callable[[int], list[int]]
) -> Callable[[int], torch.Tensor]:
    """A batch as the encoder gets it."""
    return lambda step: objective.augmented(dataset[indices_of(step)]["touch"])


def _repeat(count: int, call: Callable[[int], object]) -> None:
    for step in range(count):
        call(step)
