"""Stiff and extreme cases of the world's physics: gels from soft to rigid, and modes from ringing to over-damped.

Each holds what follows from the equations: a displacement is at most load over stiffness, a struck mode only loses
energy, the touch image of a wave has a closed form. Times and lengths go to both ends of what float32 holds.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import starmap
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from unitouch_gen.numerics.stability import Case, Ended
from unitouch_gen.world.gel import GEL_MARGIN, SLOPES, GelGrid, gel_displacement
from unitouch_gen.world.sensors import SENSORS, shade_gel, touch_images
from unitouch_gen.world.sounds import impulse_response

EXTENT, THICKNESS, CORRELATION, RELAXATION = 24.0, 2.0, 0.22, 0.05
SIZE = 128
STIFFNESSES = (1e-3, 1e-2, 1e-1, 1.0, 1e1, 1e2, 1e3)
DAMPING = (1e-6, 1e-3, 0.1, 0.999999, 1.0, 1.000001, 10.0, 1e3, 1e6)
"""Ratios to the critical damping."""

SETTLED = 1e9
"""Seconds after which nothing moves."""

ROUNDING = 1e-5
"""What transforms of 128 x 128 values, some hundred operations each, lose in float32."""

RINGING = math.log1p(1 / (CORRELATION * math.pi * SIZE / EXTENT) ** 2) / (2 * math.pi)
"""What waves beyond the grid's limit K would add to a cliff of 1: 1 / (pi k (1 + (c k)^2)) from k = K on."""


def world_cases() -> dict[str, list[Case]]:
    """All cases of the world, by group."""
    return {"gels": [*gel_cases(), *touch_cases()], "sounds": [*mode_cases()]}


def held(name: str, because: str, bound: float, ask: Callable[[], Ended]) -> Case:
    """A case of what has to hold, within a bound."""
    return Case(name, ask, bound, because, codes=())


def apart(result: Tensor, exact: Tensor | float) -> Ended:
    """How far a result is from another one, where it is farthest."""
    return Ended(result, float((result - exact).abs().max()))


def beyond(result: Tensor, low: float = 0.0, high: float = 1.0) -> Ended:
    """How far a result leaves a range."""
    return Ended(result, max(low - float(result.min()), float(result.max()) - high, 0.0))


def falling(result: Tensor) -> Ended:
    """How far values along the first dimension ever fall."""
    return Ended(result, max(-float(result.diff(dim=0).min()), 0.0) + 0.0)  # no negative zero


# Gels -----------------------------------------------------------------------------------------------------------------


def level(value: float = 0.0) -> Tensor:
    """A plane, (1, 128, 128)."""
    return torch.full((1, SIZE, SIZE), value)


def cliff(height: float = 10.0) -> Tensor:
    """A wall in the middle, (1, 128, 128)."""
    return torch.cat([level()[..., : SIZE // 2], level(height)[..., SIZE // 2 :]], dim=-1)


def spike() -> Tensor:
    """One pixel as tall as 10 mm, (1, 128, 128)."""
    field = level()
    field[0, SIZE // 2, SIZE // 2] = 10.0
    return field


def sink(indentation: Tensor, dwell: float = SETTLED, **gel: Any) -> Tensor:
    """Displacement of a gel with some numbers changed."""
    settings = {"extent": EXTENT, "thickness": THICKNESS, "correlation": CORRELATION, "relaxation": RELAXATION} | gel
    return gel_displacement(indentation, torch.full((len(indentation),), dwell), **settings)


def gel_cases() -> Iterator[Case]:
    """Stiffness, time, relaxation and the lengths over which a gel spreads and a camera blurs."""
    steepest = torch.cat([cliff(), spike(), level(10.0), level()])
    still, load = torch.zeros_like(steepest), THICKNESS * -torch.expm1(-steepest / THICKNESS)
    flat, mean = THICKNESS * -math.expm1(-1 / THICKNESS), load[0].mean()
    evenly, at_once, unmoved = "sinks evenly by the mean load", "sinks to where it settles", "has not moved"
    at_most, within = "sinks by at most load / stiffness", "stays within the gel but for its ringing"

    def sunk_shares(stiffness: float) -> Ended:
        sunk = [sink(steepest, dwell, stiffness=stiffness) for dwell in (1e-6, 0.1, SETTLED)]
        return beyond(torch.stack(sunk).abs() * stiffness / THICKNESS)

    for stiffness in STIFFNESSES:
        yield held(f"gel stiffness {stiffness:g}", at_most, ROUNDING, partial(sunk_shares, stiffness))
    yield from starmap(held, [
        ("flat indentation at all stiffnesses", "sinks by load / stiffness", ROUNDING,
         lambda: apart(torch.cat([k * sink(level(1.0), stiffness=k) for k in STIFFNESSES]), flat)),
        ("stiffness 1e30", at_most, 1e-29, lambda: apart(sink(steepest, stiffness=1e30), still)),
        ("stiffness 1e-30", "sinks by load x time / relaxation", ROUNDING,
         lambda: apart(sink(level(1.0), 0.5, stiffness=1e-30) / 10.0, flat)),
        ("dwell 0 s, stiffness 1e30", unmoved, 0.0, lambda: apart(sink(steepest, 0.0, stiffness=1e30), still)),
        ("dwell without end", at_once, ROUNDING, lambda: apart(sink(steepest, math.inf), sink(steepest))),
        ("relaxation 0 s", at_once, ROUNDING, lambda: apart(sink(steepest, 0.5, relaxation=0.0), sink(steepest))),
        ("relaxation 0 s, dwell 0 s", within, RINGING,
         lambda: beyond(sink(steepest, 0.0, relaxation=0.0) / THICKNESS)),
        ("relaxation 1e-320 s", at_once, ROUNDING,
         lambda: apart(sink(steepest, 0.5, relaxation=1e-320), sink(steepest))),
        ("relaxation 1e30 s", "sinks by at most load x time / relaxation", 1e-29,
         lambda: apart(sink(steepest, 0.5, relaxation=1e30), still)),
        ("correlation 0 mm", "sinks by the load, pixel by pixel", ROUNDING,
         lambda: apart(sink(steepest, correlation=0.0), load)),
        ("correlation 1e18 mm", evenly, ROUNDING, lambda: apart(sink(cliff(), correlation=1e18), mean)),
        ("correlation 1e18 mm, dwell 0 s", unmoved, 0.0,
         lambda: apart(sink(steepest, 0.0, correlation=1e18), still)),
        ("blur 1e18 mm", evenly, ROUNDING, lambda: apart(sink(cliff(), blur=1e18), mean)),
        ("thickness 1e-30 mm", within, RINGING, lambda: beyond(sink(steepest, thickness=1e-30) / 1e-30)),
        ("cliff of 10 mm", within, RINGING, lambda: beyond(sink(cliff(), 0.5) / THICKNESS)),
        ("depth from 0 to 1e30 mm", "sinks ever deeper", 0.0, lambda: falling(torch.stack(
            [sink(level(depth), 0.5).mean() for depth in (0.0, 0.01, 0.1, 0.5, 1.0, 2.0, 10.0, 1e3, 1e30)]))),
        ("depth beyond the gel", "sinks by its thickness", ROUNDING, lambda: apart(sink(level(1e3)), THICKNESS)),
    ])  # fmt: skip


# Touch images ---------------------------------------------------------------------------------------------------------


def touch_cases() -> Iterator[Case]:
    """A wave on ever finer grids."""
    pixel = SENSOR.field_of_view / 64
    for slopes in SLOPES:
        for refinement in (1, 2, 4):
            # Of central differences (k h)^2 / 6, of linear interpolation / 12, of the mean over a pixel / 24.
            bound = (WAVE * pixel / refinement) ** 2 * (1 / 6 + 1 / 12 + 1 / 24)
            ask = partial(wave_touched, refinement, slopes)
            yield held(f"a wave, {refinement}x, {slopes} slopes", "second order in the grid", bound, ask)


WAVE = 2 * math.pi * 8 / EXTENT
"""Wave number of eight periods on a gel, 1/mm."""

SENSOR = replace(
    SENSORS["gelsight"], field_of_view=EXTENT / GEL_MARGIN, dome=0.0, contact_steps=0, tint=(0.0, 0.0, 0.0),
    backdrop=(((0.5,),),) * 3,
)  # fmt: skip
"""The lights of a GelSight over a flat gel that spreads all contact, on which the wave is periodic."""


def wave_touched(refinement: int, slopes: str) -> Ended:
    """A load T (0.4 + 0.2 cos k x), which is a constant and one mode with its own decay and blur, as a touch image."""
    sensor, dwell = SENSOR, 0.1
    rate = 1 + (sensor.correlation * WAVE) ** 2
    height = sensor.thickness * 0.2 * -math.expm1(-rate * dwell / sensor.relaxation) / rate
    height *= math.exp(-0.5 * (sensor.blur * WAVE) ** 2)
    x = ((torch.arange(1024) + 0.5) / 1024 - 0.5) * sensor.field_of_view
    slope = (-height * WAVE * torch.sin(WAVE * x)).expand(1, 1024, 1024)
    exact = F.avg_pool2d(shade_gel(slope, torch.zeros_like(slope), sensor).clamp(0.0, 1.0), 16)

    axis = ((torch.arange(SIZE * refinement) + 0.5) / (SIZE * refinement) - 0.5) * 32.0
    pressed = -sensor.thickness * torch.log1p(-(0.4 + 0.2 * torch.cos(WAVE * axis)))
    deepest = -sensor.thickness * math.log1p(-0.6)
    grid = GelGrid(refinement=refinement, slopes=slopes)
    depth, time = torch.tensor([deepest]), torch.tensor([dwell])
    image = touch_images(pressed.expand(1, len(axis), -1), depth, time, torch.zeros(1), sensor, 64, grid=grid)
    contrast = (exact - exact.mean(dim=(2, 3), keepdim=True)).norm()
    return Ended(image, ((image - exact).norm() / contrast).item())


# Sounds ---------------------------------------------------------------------------------------------------------------


def energy(ratio: float) -> Tensor:
    """q'^2 + w^2 q^2 of a mode struck at t = 0, over its first energy, at 400 times up to 0.3 s, float64."""
    w = torch.tensor([2000.0], dtype=torch.float64)
    times = torch.linspace(1e-6, 0.3, 400, dtype=torch.float64)
    with torch.enable_grad():
        times.requires_grad_()
        response = impulse_response(w, ratio * w, times)  # w q
        (speed,) = torch.autograd.grad(response.sum(), times)  # w q', and q'(0) = 1
    return (response.detach() ** 2 + (speed / w) ** 2).detach()


def mode_cases() -> Iterator[Case]:
    """Damping from none to far beyond the critical, and frequencies at both ends of float32."""
    digits = 1e-12  # of float64, after some thousand operations
    extreme, w = torch.tensor([[1e-6], [1.0], [1e5], [1e12], [1e18]]), torch.tensor([[1e3]])
    long, swing = torch.tensor([0.0, 1e-9, 1e-3, 1.0, 1e6]), "swing by at most the strike"
    for ratio in DAMPING:
        ask = partial(lambda ratio: falling(-torch.cat([torch.ones(1), energy(ratio)])), ratio)
        yield held(f"mode at {ratio} of critical damping", "never gains energy", digits, ask)
    yield from starmap(held, [
        ("mode without damping", "keeps its energy", digits, lambda: apart(energy(0.0), 1.0)),
        ("frequencies from 1e-6 to 1e18 rad/s", swing, ROUNDING,
         lambda: beyond(impulse_response(extreme, 0 * extreme, long), -1.0)),
        ("dampings from 1e-6 to 1e18 1/s", swing, ROUNDING, lambda: beyond(impulse_response(w, extreme, long), -1.0)),
    ])  # fmt: skip
