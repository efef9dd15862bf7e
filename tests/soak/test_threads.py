"""Threads that share pipelines: every picture is the one that its call would make alone."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from threading import Barrier
from typing import Any

import numpy as np
import pytest
import torch

import unitouch_gen
from unitouch_gen import example

THREADS = 6


def halve_guidance(pipe: Any, step: int, timestep: torch.Tensor, tensors: dict[str, torch.Tensor]) -> dict:
    """A callback that keeps a state of the call on the pipeline, as diffusers' users do."""
    pipe._guidance_scale = max(1.5, pipe._guidance_scale / 2)
    return {}


TOUCH, PHOTO = {"touch": example("brick")}, {"image": example("wood", "image")}
CALLS: list[tuple[str, dict[str, Any]]] = [
    ("touch-to-image", {**TOUCH, "guidance_scale": 1.0}),
    ("touch-to-image", {**TOUCH, "guidance_scale": 9.0, "callback_on_step_end": halve_guidance}),
    ("touch-to-image", {"touch": example("digit_wood"), "prompt": "a photo of wood", "guidance_scale": 3.0}),
    ("stylization", {**PHOTO, **TOUCH, "touch_weight": 0.2}),
    ("stylization", {**PHOTO, "touch": example("digit_wood"), "num_inference_steps": 4}),
    ("x-to-touch", {"text": "rough brick", "solver": "dpm++2m"}),
    ("x-to-touch", {"audio": example("metal", "audio"), "guidance_scale": 7.5}),
    ("x-to-touch", PHOTO),
    ("x-to-touch", {"touch": example("digit_wood"), "sensor": "digit", "solver": "ddim"}),
]


def load() -> dict[str, Any]:
    pipes = {name: unitouch_gen.tiny(name) for name in ("touch-to-image", "stylization", "x-to-touch")}
    for pipe in pipes.values():
        pipe.set_progress_bar_config(disable=True)
    return pipes


def picture(pipes: dict[str, Any], number: int) -> np.ndarray:
    name, arguments = CALLS[number]
    generator = torch.Generator().manual_seed(number)
    return pipes[name](**{"num_inference_steps": 3, **arguments}, generator=generator, output_type="np").images


@pytest.fixture(scope="module")
def alone() -> Callable[[int], np.ndarray]:
    """The picture of a call that nothing runs beside."""
    return cache(partial(picture, load()))


@pytest.mark.parametrize("rounds", [1, pytest.param(9, marks=pytest.mark.slow)])
def test_threads_get_what_serial_calls_get(alone, rounds):
    """Of pipelines whose encoders nobody has used yet, by calls that begin at once."""
    pipes, start = load(), Barrier(THREADS)

    def work(thread: int) -> list[tuple[int, np.ndarray]]:
        start.wait()
        order = [(5 * thread + turn) % len(CALLS) for turn in range(rounds)]
        return [(number, picture(pipes, number)) for number in order]

    with ThreadPoolExecutor(THREADS) as pool:
        found = [item for items in pool.map(work, range(THREADS)) for item in items]
    for number, made in found:
        np.testing.assert_allclose(made, alone(number), rtol=0, atol=1e-5, err_msg=f"call {number}")
