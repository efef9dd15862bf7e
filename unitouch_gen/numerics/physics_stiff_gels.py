"""Stiff and extreme gels: six decades of stiffness and more, presses from none to far beyond full, cliffs and spikes.

Times and lengths go to both ends of what float32 holds; what no gel or surface can be has to be refused.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor

from unitouch_gen.numerics.physics_case import apart, at_most, in_range, rising
from unitouch_gen.numerics.stability import Case, refused
from unitouch_gen.world.gel import GelGrid, gel_displacement
from unitouch_gen.world.scene import Style
from unitouch_gen.world.sensors import SENSORS, contact_share, gel_background, touch_images
from unitouch_gen.world.surfaces import pictures

EXTENT, THICKNESS, CORRELATION, RELAXATION = 24.0, 2.0, 0.22, 0.05
DECADES = (1e-3, 1e-2, 1e-1, 1.0, 1e1, 1e2, 1e3)
ROUNDING = 1e-5
"""What float32 may lose on the way."""

RINGING = 1e-3
"""Share of a gel's thickness by which a truncated Fourier series may ring beyond its ends beside a cliff."""


def level(value: float = 0.0, size: int = 128) -> Tensor:
    """A plane, (1, size, size)."""
    return torch.full((1, size, size), value)


def cliff(size: int = 128, step: float = 10.0) -> Tensor:
    """A wall as tall as `step` in the middle, (1, size, size)."""
    field = level(0.0, size)
    field[..., size // 2 :] = step
    return field


def spike(size: int = 128, step: float = 10.0) -> Tensor:
    """One pixel as tall as `step`, (1, size, size)."""
    field = level(0.0, size)
    field[0, size // 2, size // 2] = step
    return field


def sink(indentation: Tensor, dwell: float = 0.5, **gel: Any) -> Tensor:
    """Displacement of a gel with some numbers changed."""
    settings = {"extent": EXTENT, "thickness": THICKNESS, "correlation": CORRELATION, "relaxation": RELAXATION} | gel
    return gel_displacement(indentation, torch.full((len(indentation),), dwell), **settings)


def load(indentation: Tensor) -> Tensor:
    """What presses on the gel, mm: the saturated indentation."""
    return THICKNESS * -torch.expm1(-indentation / THICKNESS)


def steepest() -> Tensor:
    """Cliff, spike, full press and none, (4, 128, 128)."""
    return torch.cat([cliff(), spike(), level(10.0), level()])


def sunk_share(stiffness: float) -> Tensor:
    """Largest displacement over thickness / stiffness, at the steepest loads and at short, usual and long times."""
    settled = [sink(steepest(), dwell, stiffness=stiffness).abs().max() for dwell in (1e-6, 0.1, 1e9)]
    return torch.stack(settled).max() * stiffness / THICKNESS


def gel_cases() -> Iterator[Case]:
    """Stiffness, time, relaxation and the lengths over which a gel spreads and a camera blurs."""
    for stiffness in DECADES:
        yield Case(
            f"gel stiffness {stiffness:g}",
            "sinks by at most load / stiffness",
            lambda k=stiffness: at_most(sunk_share(k), 1.0 + ROUNDING),  # type: ignore[misc]
        )
    settled, pushed = 1e9, steepest()

    def times_stiffness() -> Tensor:
        return torch.stack([k * sink(level(1.0), settled, stiffness=k)[0] for k in DECADES])

    def over_time() -> Tensor:
        return torch.stack([sink(cliff(), dwell).mean() for dwell in (0.0, 1e-6, 1e-3, 0.1, 1.0, 1e3, 1e6)])

    def spread(length: float) -> Tensor:
        return sink(cliff(), settled, correlation=length)

    mean = load(cliff()).mean().expand(1, 128, 128)
    at_once = "sinks to where it settles"
    for name, expected, run in (
        ("flat press at all stiffnesses", "sinks by load / stiffness",
         lambda: apart(times_stiffness(), load(level(1.0)), ROUNDING)),
        ("stiffness 1e30", "does not sink", lambda: apart(sink(pushed, stiffness=1e30), 0 * pushed, 1e-29)),
        ("stiffness 1e-30", "sinks by load x time / relaxation",
         lambda: apart(sink(level(1.0), stiffness=1e-30) / 10.0, load(level(1.0)), ROUNDING)),
        ("dwell 0 s", "has not moved", lambda: apart(sink(pushed, 0.0), 0 * pushed)),
        ("dwell 0 s, stiffness 1e30", "has not moved", lambda: apart(sink(pushed, 0.0, stiffness=1e30), 0 * pushed)),
        ("dwell 1e6 s", at_once, lambda: apart(sink(pushed, 1e6), sink(pushed, settled), ROUNDING)),
        ("dwell without end", at_once, lambda: apart(sink(pushed, math.inf), sink(pushed, settled), ROUNDING)),
        ("dwell from none to 1e6 s", "sinks ever deeper", lambda: rising(over_time())),
        ("relaxation 0 s", at_once, lambda: apart(sink(pushed, relaxation=0.0), sink(pushed, settled), ROUNDING)),
        ("relaxation 0 s, dwell 0 s", "is finite and within the gel",
         lambda: in_range(sink(pushed, 0.0, relaxation=0.0), -RINGING * THICKNESS, THICKNESS * (1 + ROUNDING))),
        ("relaxation 1e-320 s", at_once,
         lambda: apart(sink(pushed, relaxation=1e-320), sink(pushed, settled), ROUNDING)),
        ("relaxation 1e30 s", "does not sink", lambda: apart(sink(pushed, relaxation=1e30), 0 * pushed, 1e-29)),
        ("correlation 0 mm", "sinks by the load, pixel by pixel",
         lambda: apart(sink(pushed, settled, correlation=0.0), load(pushed), ROUNDING)),
        ("correlation 1e6 mm", "sinks evenly by the mean load", lambda: apart(spread(1e6), mean, ROUNDING)),
        ("correlation 1e18 mm", "sinks evenly by the mean load", lambda: apart(spread(1e18), mean, ROUNDING)),
        ("correlation 1e18 mm, dwell 0 s", "has not moved",
         lambda: apart(sink(pushed, 0.0, correlation=1e18), 0 * pushed)),
        ("blur 1e18 mm", "sinks evenly by the mean load",
         lambda: apart(sink(cliff(), settled, blur=1e18), mean, ROUNDING)),
        ("thickness 1e-30 mm", "sinks by no more than it is thick",
         lambda: at_most(sink(pushed, settled, thickness=1e-30).abs().max() / 1e-30, 1 + RINGING)),
        ("cliff of 10 mm", "rings below zero by at most 0.1 % of the gel",
         lambda: at_most(-sink(cliff()).min() / THICKNESS, RINGING)),
        ("spike of one pixel", "sinks alike on all sides",
         lambda: apart(sink(spike()), sink(spike()).transpose(1, 2), ROUNDING)),
    ):  # fmt: skip
        yield Case(name, expected, run)


# Touch images -------------------------------------------------------------------------------------------------------


def feel(height: Tensor, press: float = 1.0, dwell: float = 0.5, sensor: str = "gelsight", **options: Any) -> Tensor:
    """The touch image of a hard surface."""
    depth, waited, softness = (torch.full((len(height),), value) for value in (press, dwell, 0.0))
    return touch_images(height, depth, waited, softness, SENSORS[sensor], 64, **options)


def touching(height: Tensor, press: float) -> Tensor:
    """Share of the view in contact."""
    return contact_share(height, torch.tensor([press]), torch.zeros(1), SENSORS["gelsight"], 64)


def rough(seed: int = 0) -> Tensor:
    """White noise between 0 and 1 mm, (1, 128, 128)."""
    return torch.rand(1, 128, 128, generator=torch.Generator().manual_seed(seed))


def press_cases() -> Iterator[Case]:
    """Depths from none to far beyond the gel, and surfaces with the steepest slopes."""
    untouched, none = gel_background(SENSORS["gelsight"], 64).clamp(0.0, 1.0), "shows the untouched gel, bit by bit"
    steps = torch.tensor([-1.0, 0.0, 1.0]).repeat(43)[:128]
    saw = 1e3 * (steps[:, None] * steps[None, :])[None]
    deep = (0.0, 0.01, 0.1, 0.5, 1.0, 2.0, 10.0, 1e3, 1e30)
    presses = torch.tensor([-1.0, 0.0, 0.2, 0.6, 1.0, 1e6])
    for name, expected, run in (
        ("press of 0 mm", none, lambda: apart(feel(rough(), 0.0)[0], untouched)),
        ("press of -1 mm", none, lambda: apart(feel(rough(), -1.0)[0], untouched)),
        ("press of 0 mm under markers", "shows the same gel whatever is above it",
         lambda: apart(feel(rough(), 0.0, sensor="gelslim"), feel(cliff(), 0.0, sensor="gelslim"))),
        ("no time to sink", none, lambda: apart(feel(rough(), 1.0, 0.0)[0], untouched)),
        ("press from 0 to 1e30 mm", "sinks ever deeper, by no more than the gel",
         lambda: rising(torch.stack([sink(level(depth)).mean() for depth in deep]))),
        ("press beyond the gel", "sinks by its thickness",
         lambda: apart(sink(level(1e3), 1e9), level(THICKNESS), ROUNDING)),
        ("press of 1e30 mm on a cliff", "is finite and in [0, 1]", lambda: in_range(feel(cliff(), 1e30))),
        ("contact from none to all", "covers ever more of the gel",
         lambda: rising(torch.cat([touching(rough(), float(press)) for press in presses]))),
        ("flat surface of zeros", "shows no slopes", lambda: apart(feel(level())[0], untouched, ROUNDING)),
        ("cliff of 10 mm seen", "is finite and in [0, 1]", lambda: in_range(feel(cliff()))),
        ("spike of one pixel seen", "is finite and in [0, 1]", lambda: in_range(feel(spike()))),
        ("saw teeth of 2 m", "is finite and in [0, 1]", lambda: in_range(feel(saw))),
        ("cliff of 1e14 mm", "is finite and in [0, 1]", lambda: in_range(feel(cliff(step=1e14), 50.0))),
        ("cliff with spectral slopes", "is finite and in [0, 1]",
         lambda: in_range(feel(cliff(), grid=GelGrid(refinement=2, slopes="spectral")))),
        ("picture of a cliff of 1e14 mm", "is finite and in [0, 1]", lambda: in_range(look(cliff(step=1e14)))),
    ):  # fmt: skip
        yield Case(name, expected, run)


def look(height: Tensor) -> Tensor:
    """The picture of a white glossy surface under a slanting lamp."""
    white, lamp = torch.ones(1, 3, *height.shape[1:]), torch.tensor([[0.6, 0.0, 0.8]])
    return pictures(height, white, torch.ones_like(height), lamp, torch.ones(1), 64, torch.ones(3))


def refused_gels() -> Iterator[Case]:
    """What no gel or surface can be."""
    for value in (math.nan, math.inf, -math.inf):
        hole = rough()
        hole[0, 60, 60] = value
        calls: dict[str, Callable[[], Any]] = {
            f"a height of {value}": lambda h=hole: feel(h),  # type: ignore[misc]
            f"a height of {value} in a picture": lambda h=hole: look(h),  # type: ignore[misc]
        }
        for name, call in calls.items():
            yield refused(name, call, "height")
    for name, call, named in (
        ("press of NaN", lambda: feel(rough(), math.nan), "indentation_depth"),
        ("press without end", lambda: feel(rough(), math.inf), "indentation_depth"),
        ("dwell of NaN", lambda: feel(rough(), dwell=math.nan), "dwell"),
        ("dwell of -1 s", lambda: sink(rough(), -1.0), "dwell"),
        ("indentation of -1 mm", lambda: sink(level(-1.0)), "indentation"),
        ("stiffness 0", lambda: sink(rough(), stiffness=0.0), "stiffness"),
        ("stiffness of NaN", lambda: sink(rough(), stiffness=math.nan), "stiffness"),
        ("thickness 0", lambda: sink(rough(), thickness=0.0), "thickness"),
        ("style with a depth of NaN", lambda: Style(indentation_depth=math.nan), "indentation_depth"),
        ("style with a negative cast", lambda: Style(cast=(1.0, -1.0, 1.0)), "cast"),
        ("margin below 1", lambda: GelGrid(margin=0.5), "margin"),
    ):
        yield refused(name, call, named)
