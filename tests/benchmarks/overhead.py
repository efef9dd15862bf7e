"""Time that a pipeline spends outside of its networks: checks, solver, progress bar, pictures from tensors."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial, wraps
from typing import Any

import torch

from tests.benchmarks import Figures
from tests.benchmarks.turns import in_turns, spread_of
from unitouch_gen.models.joint import MODALITIES, UniTouchModel
from unitouch_gen.pipelines.tiny import tiny
from unitouch_gen.world import World
from unitouch_gen.world.collections import SPLITS

STEPS = 20


def overhead_figures(repeats: int = 9) -> Figures:
    """Share of a run of 20 steps, one picture or touch, that is spent outside of the networks, of each pipeline.

    Args:
        repeats: Timed calls of each pipeline, which take turns, after a first one that is not counted.
    """
    touch = World().render([5], [SPLITS["test"][0]], [0], modalities=("touch",)).touch["gelsight"]
    pipes: dict[str, tuple[Any, dict[str, Any]]] = {
        "touch_to_image": (tiny("touch-to-image"), {"touch": touch}),
        "x_to_touch": (tiny("x-to-touch"), {"text": "rough brick"}),
    }
    for pipe, _ in pipes.values():
        pipe.set_progress_bar_config(disable=True)
    calls = {
        name: partial(share_outside, pipe, **request, num_inference_steps=STEPS)
        for name, (pipe, request) in pipes.items()
    }
    shares = in_turns(calls, repeats)
    return {
        "steps": STEPS,
        "repeats": repeats,
        **{name: spread_of(each) for name, each in shares.items()},
    }


def share_outside(pipe: Any, **request: Any) -> float:
    """Share of one call's time that no network of the pipeline was running."""
    with clock_of(networks(pipe)) as clock:
        started = time.perf_counter()
        pipe(**request, generator=torch.Generator().manual_seed(0))
        total = time.perf_counter() - started
    return 1.0 - clock.seconds / total


def networks(pipe: Any) -> list[tuple[type, str]]:
    """Classes of a pipeline's networks, and the methods by which they run."""
    found: list[tuple[type, str]] = [(UniTouchModel, f"get_{modality}_features") for modality in MODALITIES]
    for name, method in (("unet", "forward"), ("vae", "decode"), ("text_encoder", "forward")):
        if getattr(pipe, name, None) is not None:
            found.append((type(getattr(pipe, name)), method))
    return found


class Clock:
    """Seconds in functions that it watches; one that another one calls counts once."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self.depth = 0

    def watched(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """The same function, with its time taken."""

        @wraps(function)
        def run(*args: Any, **kwargs: Any) -> Any:
            self.depth += 1
            started = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                self.depth -= 1
                if self.depth == 0:
                    self.seconds += time.perf_counter() - started

        return run


@contextmanager
def clock_of(methods: list[tuple[type, str]]) -> Iterator[Clock]:
    """A clock that runs in these methods until the end of the block.

    They are replaced in their classes: a hook on a network would keep pipelines from leaving work out of it.
    """
    clock = Clock()
    before = [(kind, name, kind.__dict__.get(name)) for kind, name in methods]
    try:
        for kind, name in methods:
            setattr(kind, name, clock.watched(getattr(kind, name)))
        yield clock
    finally:
        for kind, name, method in before:
            if method is None:  # it is inherited
                delattr(kind, name)
            else:
                setattr(kind, name, method)
