"""How fast touches come in against how fast the tiny encoder learns from them, and what the trainer adds to a step."""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import psutil
import torch
import torch.nn.functional as F
from PIL import Image
from torch.nn.attention import SDPBackend, sdpa_kernel

from tests.benchmarks.measuring import Figures, in_own_process, in_turns, ratio_of, seconds_of
from unitouch_gen.models import UniTouchConfig, UniTouchModel, UniTouchProcessor
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.training.batches import ArrayDataset, ShuffledSampler
from unitouch_gen.training.data import DataConfig, columns_of, decoding
from unitouch_gen.training.data.drawn import GROUP
from unitouch_gen.training.losses import symmetric_info_nce
from unitouch_gen.training.recipe import read_recipe, read_section
from unitouch_gen.training.touch import TouchAugmentation, TouchObjective
from unitouch_gen.training.trainer import Trainer, TrainerConfig
from unitouch_gen.training.watching import grid, retrieval
from unitouch_gen.world import FIRST_OBJECT, MATERIAL_NAMES, World

CAMERA = (640, 480)
"""Pixels of a frame, as Touch and Go has them."""

SIDE = 128
"""Of the touches that the tiny encoder sees, pixels."""


def training_figures(repeats: int = 5) -> Figures:
    """Touches a second, and how many times as fast as the encoder learns: decoded once to disk, and at every step.

    On one core, with a process and a thread of its own: on more, both are as many times as fast. Beside that, how many
    times as long a step takes in the trainer as in a bare loop, and how memory grows.
    """
    return {
        **in_own_process(input_figures, repeats),
        "trainer": in_own_process(trainer_figures, repeats),
        "memory": in_own_process(growth_figures, 1000),
    }


def input_figures(repeats: int, batches: int = 2, frames: int = 256) -> Figures:
    """The figures with a single thread, which this process keeps to from then on."""
    torch.set_num_threads(1)
    decoding.THREADS = 1
    recipe = read_recipe("touch")
    batch_size = recipe["trainer"]["batch_size"]
    objective = TouchObjective(_model(), read_section(recipe, "augment", TouchAugmentation))
    pixels = objective.augmented(torch.randint(0, 256, (batch_size, 3, SIDE, SIDE), dtype=torch.uint8))
    with TemporaryDirectory() as folder:
        write_frames(Path(folder) / "frames", frames)
        calls: dict[str, Callable[[], float]] = {
            "learned": partial(seconds_of, _repeat, batches, _learning(objective, pixels))
        }
        for name, stream in (("from_disk", False), ("decoded", True)):
            config = DataConfig(sets=[{"path": f"{folder}/frames", "sensor": "digit"}], stream=stream)
            processor = UniTouchProcessor(image_size=SIDE)
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
    world, noise = World(), torch.Generator().manual_seed(0)
    for rows in torch.arange(count).split(GROUP):
        names = rows % len(MATERIAL_NAMES), FIRST_OBJECT["test"] + rows // len(MATERIAL_NAMES), rows * 0
        touches = world.render(*names, modalities=("touch",), sensors=("digit",)).touch["digit"]
        for number, touch in zip(rows.tolist(), touches, strict=True):
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


# What the trainer adds ------------------------------------------------------------------------------------------------


def trainer_figures(repeats: int, steps: int = 6) -> Figures:
    """Seconds of the processor of a step of the touch stage, in the trainer and in a loop of the step alone.

    The trainer's share of a checkpoint, of which there is one in every `save_every` steps, is counted in.
    """
    torch.set_num_threads(1)
    recipe = read_recipe("touch")
    config = read_section(recipe, "trainer", TrainerConfig).model_copy(update={"steps": steps, "watch_every": 0})
    dataset = _touches(4 * config.batch_size)
    objectives = [TouchObjective(_model(), read_section(recipe, "augment", TouchAugmentation)) for _ in range(2)]
    with TemporaryDirectory() as folder:
        saving: list[float] = []

        def trained() -> float:
            trainer = Trainer(objectives[0], dataset, clock := _Clock(dataset, config), config, Path(folder))
            trainer.fit()
            saving.append(seconds_of(trainer.save))
            return clock.seconds_a_step + saving[-1] / config.save_every

        def bare() -> float:
            clock = _Clock(dataset, config)
            _bare_loop(objectives[1], dataset, clock, config)
            return clock.seconds_a_step

        seconds = in_turns({"trainer": trained, "bare": bare}, repeats)
    return {
        "batch_size": config.batch_size,
        "seconds_a_step": float(np.median(seconds["bare"])),
        "seconds_a_checkpoint": float(np.median(saving)),
        "times_as_long": ratio_of(seconds["trainer"], seconds["bare"]),
    }


def growth_figures(steps: int, batch_size: int = 2, every: int = 100, settled: int = 200) -> Figures:
    """Memory of a run with checkpoints and looks at held-out touches, at two of its steps.

    Args:
        steps: Of the run.
        batch_size: Touches a step.
        every: Steps between checkpoints, and between looks.
        settled: The earlier of the steps; the later is the last one.
    """
    torch.set_num_threads(1)
    recipe = read_recipe("touch")
    config = read_section(recipe, "trainer", TrainerConfig).model_copy(
        update={"steps": steps, "batch_size": batch_size, "save_every": every, "watch_every": every}
    )
    objective = TouchObjective(_model(), read_section(recipe, "augment", TouchAugmentation))
    dataset, megabytes = _touches(64), dict[int, float]()
    held = dataset[list(range(32))]

    def watch() -> dict[str, float | Image.Image]:
        touch = objective.trained(normalise_pixels(held["touch"].float() / 255), held["sensor"])
        return {**retrieval(touch, held["image_embeds"]), "touches": grid(held["touch"][:8] / 255)}

    def indices_of(step: int) -> list[int]:
        if step in (settled, steps - 1):  # the first time: some are read again, for the means of batches
            megabytes.setdefault(step, psutil.Process().memory_info().rss / 1e6)
        return [(step * batch_size + row) % len(dataset) for row in range(batch_size)]

    with TemporaryDirectory() as folder:
        Trainer(objective, dataset, indices_of, config, Path(folder), watch=watch).fit()
    before, after = megabytes.values()
    return {"steps": steps, "from": settled, "megabytes": before, "growth": after / before - 1.0}


class _Clock:
    """The indices of steps, one after another, and how long they took: from the first call to the last.

    In seconds of the processor, which a busy machine disturbs least. Calls for what was read before do not count.
    """

    def __init__(self, dataset: ArrayDataset, config: TrainerConfig):
        self.sampler = ShuffledSampler(len(dataset), config.batch_size)
        self.called: dict[int, float] = {}

    def __call__(self, step: int) -> list[int]:
        self.called.setdefault(step, time.process_time())
        return self.sampler(step)

    @property
    def seconds_a_step(self) -> float:
        return (max(self.called.values()) - min(self.called.values())) / (len(self.called) - 1)


def _touches(count: int) -> ArrayDataset:
    """Noise in the form of touches, with embeddings and sensors."""
    rng = np.random.default_rng(0)
    return ArrayDataset(
        touch=rng.integers(0, 256, (count, 3, SIDE, SIDE), dtype=np.uint8),
        image_embeds=rng.standard_normal((count, 128), dtype=np.float32),
        sensor=np.zeros(count, dtype=np.int64),
        shown=np.ones(count, dtype=np.float32),
    )


def _bare_loop(
    objective: TouchObjective, dataset: ArrayDataset, indices_of: Callable[[int], list[int]], config: TrainerConfig
) -> None:
    """What a step consists of: forward, backward, clipping, AdamW, and the average of the weights."""
    assert config.steps is not None
    weights = list(objective.trained.parameters())
    optimizer = torch.optim.AdamW(weights, lr=1e-5, weight_decay=config.weight_decay)
    average = [weight.detach().clone() for weight in weights]
    objective.train()
    for step in range(config.steps):
        batch = dataset[indices_of(step)]
        with torch.autocast("cpu", torch.bfloat16), sdpa_kernel(SDPBackend.MATH):
            loss = objective(batch)["loss"]
        loss.backward()
        torch.nn.utils.clip_grad_norm_(weights, config.grad_clip)
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        with torch.no_grad():
            torch._foreach_lerp_(average, weights, 1.0 - config.ema_decay)
        loss.item()


def _repeat(count: int, call: Callable[[int], object]) -> None:
    for step in range(count):
        call(step)
