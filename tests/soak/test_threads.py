"""Threads that share pipelines: every picture is the one that its call would make alone."""

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from threading import Barrier
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

import unitouch_gen
from unitouch_gen import weights

pytestmark = pytest.mark.skipif(
    not (weights.JOINT / "model.safetensors").exists(), reason="built-in weights are not there"
)

THREADS = 8
NAMES = ("touch-to-image", "stylization", "x-to-touch")
INPUTS = "samples/inputs/"


def halve_guidance(pipe: Any, step: int, timestep: torch.Tensor, tensors: dict[str, torch.Tensor]) -> dict:
    """A callback that keeps a state of the call on the pipeline, as diffusers' users do."""
    pipe._guidance_scale = max(1.5, pipe._guidance_scale / 2)
    return {}


def calls() -> list[tuple[str, dict[str, Any]]]:
    """Pipelines by name with the arguments of a call: 24 that differ in inputs, guidance, solvers and steps."""
    found: list[tuple[str, dict[str, Any]]] = []
    conditions = (
        {"text": "rough brick"},
        {"audio": INPUTS + "sounds/metal.wav"},
        {"image": INPUTS + "photos/brick.png", "num_candidates": 2},
        {"touch": INPUTS + "digit_wood.png", "sensor": "digit"},
    )
    for number in range(8):
        guidance = {"guidance_scale": (1.0, 9.0, 3.0, 7.5)[number % 4]}
        touch = INPUTS + ("gelsight_brick.png", "digit_wood.png")[number % 2]
        words = {"prompt": f"a photo of wood, number {number}"} if number % 3 == 0 else {}
        changes = {"callback_on_step_end": halve_guidance} if number % 4 == 1 else {}
        found.append(("touch-to-image", {"touch": touch, "num_inference_steps": 3, **guidance, **words, **changes}))
        mixed = {"touch_weight": 0.1 * number, "num_inference_steps": 2 + number % 3, **guidance}
        found.append(("stylization", {"image": INPUTS + "photos/wood.png", "touch": touch, **mixed}))
        steps = {"num_inference_steps": 3, "solver": ("unipc", "dpm++2m", "ddim")[number % 3]}
        steps = {"tolerance": 0.1} if number == 3 else steps
        found.append(("x-to-touch", {**conditions[number % 4], **guidance, **steps}))
    return found


CALLS = calls()


def load(**settings: Any) -> dict[str, Any]:
    pipes = {name: unitouch_gen.tiny(name, **settings) for name in NAMES}
    for pipe in pipes.values():
        pipe.set_progress_bar_config(disable=True)
    return pipes


def picture(pipes: Mapping[str, Any], number: int) -> np.ndarray:
    name, arguments = CALLS[number]
    candidates = arguments.get("num_candidates", 1)
    generators = [torch.Generator().manual_seed(number + row) for row in range(candidates)]
    return pipes[name](**arguments, generator=generators, output_type="np").images


@pytest.fixture(scope="module")
def alone() -> Callable[[int], np.ndarray]:
    """The picture of a call that nothing runs beside."""
    pipes = load()
    return cache(partial(picture, pipes))


@pytest.fixture(autouse=True)
def torch_as_it_was() -> Iterator[None]:
    before = (nn.Module.register_parameter, nn.init.normal_, torch.get_default_dtype(), torch.empty)
    yield
    assert (nn.Module.register_parameter, nn.init.normal_, torch.get_default_dtype(), torch.empty) == before


def race(pipes: Mapping[str, Any] | None, alone: Callable[[int], np.ndarray], count: int = len(CALLS)) -> int:
    """Holds `count` calls of each of eight threads, which begin at once, to the pictures made alone, and counts them.

    Args:
        pipes: That the threads share, or `None` where each loads its own.
    """
    start = Barrier(THREADS)

    def work(thread: int) -> list[tuple[int, np.ndarray]]:
        start.wait()
        own = load() if pipes is None else pipes
        order = [(5 * thread + turn) % len(CALLS) for turn in range(count)]
        return [(number, picture(own, number)) for number in order]

    with ThreadPoolExecutor(THREADS) as pool:
        found = [item for items in pool.map(work, range(THREADS)) for item in items]
    for number, made in found:
        np.testing.assert_allclose(made, alone(number), rtol=0, atol=1e-5, err_msg=f"call {number}")
    return len(found)


def test_pipelines_whose_encoders_nobody_has_used_yet(alone, record_property):
    record_property("calls", race(load(), alone, 1))


@pytest.mark.slow
def test_pipelines_that_every_thread_loads_for_itself(alone, record_property):
    record_property("calls", race(None, alone, 1))


@pytest.mark.slow
def test_pipelines_that_have_worked_before(alone, record_property):
    pipes = load()
    for number in range(len(CALLS)):
        picture(pipes, number)
    record_property("calls", race(pipes, alone))


@pytest.mark.slow
def test_pipelines_that_free_encoders_while_others_use_them(alone, record_property):
    record_property("calls", race(load(low_memory=True), alone))


@pytest.mark.slow
def test_pipelines_while_another_thread_loads_networks_of_half_precision(alone, record_property):
    pipes = load()
    with ThreadPoolExecutor(1) as loader:
        loads = loader.submit(lambda: [load(dtype=torch.bfloat16) for _ in range(10)])
        record_property("calls", race(pipes, alone))
        loads.result()
