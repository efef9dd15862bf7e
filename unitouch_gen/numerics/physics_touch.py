"""Error against run time of touch images, over the surface's and the gel's resolution and the options of the gel.

The reference refines both grids four times as far as the finest setting. A contact's surface is one function of
position that a finer grid samples more often (but for the few waves at the base grid's Nyquist limit), so a setting
and its reference show the same contact. The camera sees the mean over a pixel: finer images are averaged down. Three
surfaces in closed form part what the gel's grid costs from what the materials' textures cost.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from unitouch_gen.numerics.physics_row import PhysicsRow, time_calls, with_quartiles
from unitouch_gen.world.draws import Draws, draw
from unitouch_gen.world.gel import (
    DEFAULT_GRID,
    GEL_MARGIN,
    SLOPES,
    SOFT_SHARE,
    GelGrid,
    contact_indentation,
    gel_displacement,
    resample_centre,
)
from unitouch_gen.world.materials import MATERIALS
from unitouch_gen.world.sensors import SENSORS, Sensor, touch_images
from unitouch_gen.world.surfaces import BASE_RESOLUTION, pixel_axis, surfaces, wavenumbers

IMAGE_SIZE = 64
OBJECT = 10
"""Its first sixteen contacts show all five shapes."""

MARGINS = (1.0, 1.125, 1.25, GEL_MARGIN, 1.75)
WIDEST_MARGIN = 1.875
"""The widest that fits a patch for every sensor."""

Heights = Callable[[Draws, int], Tensor]


def world_contacts(count: int = 16) -> Draws:
    """The numbers of `count` contacts of world 0: the i-th is (material i mod 16, object 10, contact i)."""
    index = torch.arange(count)
    return draw(0, index % len(MATERIALS), torch.full_like(index, OBJECT), index)


# Surfaces -----------------------------------------------------------------------------------------------------------


def world_heights(draws: Draws, resolution: int) -> Tensor:
    """The world's own surfaces (N, R, R), mm."""
    return surfaces(0, draws, resolution, coloured=False).height


def waves(draws: Draws, resolution: int) -> Tensor:
    """Three sine waves, smooth everywhere, (N, R, R)."""
    u, v = _pose(draws, resolution)
    wave = 0.2 * torch.sin(2 * math.pi * u / 3.1) + 0.1 * torch.sin(2 * math.pi * v / 1.9)
    return wave + 0.05 * torch.sin(2 * math.pi * (u + v) / 1.7)


def ball(draws: Draws, resolution: int) -> Tensor:
    """A ball of 12 mm, whose rim of contact is a kink in the load, (N, R, R)."""
    u, v = _pose(draws, resolution)
    return (144.0 - u * u - v * v).clamp_min(0.0).sqrt() - 12.0


def cliff(draws: Draws, resolution: int) -> Tensor:
    """A step of 4 mm from one pixel to the next, (N, R, R)."""
    u, _ = _pose(draws, resolution)
    return torch.where(u < 0.0, 0.0, -4.0)


CLOSED_FORMS: dict[str, Heights] = {"waves": waves, "a ball": ball, "a cliff": cliff}


def _pose(draws: Draws, resolution: int) -> tuple[Tensor, Tensor]:
    """Position in each contact's own turned and shifted axes, mm."""
    axis = pixel_axis(resolution)
    x = axis[None, None, :] - draws.shape_offset[:, 0, None, None]
    y = axis[None, :, None] - draws.shape_offset[:, 1, None, None]
    cos, sin = torch.cos(draws.shape_angle)[:, None, None], torch.sin(draws.shape_angle)[:, None, None]
    return cos * x + sin * y, -sin * x + cos * y


# The sweep ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Setting:
    """One way of rendering a touch image; `option`, `value` and `spacing` as in `PhysicsRow`."""

    option: str
    value: str
    spacing: float | None = None
    resolution: int = BASE_RESOLUTION
    grid: GelGrid = DEFAULT_GRID


def refined_together(refinements: Sequence[int]) -> list[Setting]:
    """Both grids refined, with either kind of slopes."""
    return [
        Setting(f"both grids, {slopes} slopes", f"{k}x", 1 / k, k * BASE_RESOLUTION, GelGrid(GEL_MARGIN, k, slopes))
        for slopes in SLOPES
        for k in refinements
    ]


def check_of(reference: int) -> Setting:
    """Half as fine as the reference: its error bounds the reference's own, smaller by the order that is seen."""
    k = reference // 2
    return Setting("half the reference", f"{k}x", resolution=k * BASE_RESOLUTION, grid=GelGrid(refinement=k))


def all_settings(refinements: Sequence[int]) -> list[Setting]:
    """Both grids, either one alone, and the margin on the coarsest."""
    return [
        *refined_together(refinements),
        *(Setting("surface alone", f"{k:g}x", 1 / k, int(k * BASE_RESOLUTION)) for k in (1, 1.5, *refinements[1:])),
        *(Setting("gel alone", f"{k}x", 1 / k, grid=GelGrid(refinement=k)) for k in refinements),
        *(Setting("margin", f"{margin}", grid=GelGrid(margin)) for margin in MARGINS),
    ]


def press_on(height: Tensor, draws: Draws, sensor: Sensor, grid: GelGrid) -> Tensor:
    """Touch images of surfaces (N, R, R), (N, 3, S, S)."""
    return touch_images(height, draws.indentation_depth, draws.dwell, _compliance(draws), sensor, IMAGE_SIZE, grid=grid)


def image_errors(images: Tensor, reference: Tensor, untouched: Tensor) -> tuple[Tensor, Tensor]:
    """Relative RMS error and PSNR (dB) of N images (N, 3, S, S) against their references, both (N,)."""
    rms = (images - reference).square().mean(dim=(1, 2, 3)).sqrt()
    return rms / (reference - untouched).square().mean(dim=(1, 2, 3)).sqrt(), -20 * rms.log10()


def references(
    draws: Draws, heights: Heights, sensors: Sequence[Sensor], refinement: int
) -> list[tuple[Tensor, Tensor]]:
    """For each sensor the images (N, 3, S, S) on grids refined `refinement` times, and that of the untouched gel."""
    grid = GelGrid(refinement=refinement)
    images: list[list[Tensor]] = [[] for _ in sensors]
    for row in range(len(draws)):  # one by one, as a surface of the reference is megabytes
        one = _row(draws, row)
        height = heights(one, refinement * BASE_RESOLUTION)
        for made, sensor in zip(images, sensors, strict=True):
            made.append(press_on(height, one, sensor, grid))
    lifted = replace(_row(draws, 0), indentation_depth=torch.zeros(1))
    level = torch.zeros(1, BASE_RESOLUTION, BASE_RESOLUTION)
    return [
        (torch.cat(made), press_on(level, lifted, sensor, grid)) for made, sensor in zip(images, sensors, strict=True)
    ]


def sweep(
    problems: Mapping[str, Sensor],
    draws: Draws,
    heights: Heights,
    settings: Sequence[Setting],
    reference: int,
    repeats: int,
) -> Iterator[PhysicsRow]:
    """A row for each problem and setting; its seconds are of surface and touch image together.

    Args:
        problems: The sensor of each.
        draws: Of the contacts.
        heights: Makes their surfaces.
        settings: To try.
        reference: How far the reference refines both grids.
        repeats: Timings of each.
    """
    exact = references(draws, heights, list(problems.values()), reference)
    made = {resolution: heights(draws, resolution) for resolution in {setting.resolution for setting in settings}}
    making = time_calls({resolution: _later(heights, draws, resolution) for resolution in made}, repeats)
    for (problem, sensor), (target, untouched) in zip(problems.items(), exact, strict=True):
        rows: dict[Setting, PhysicsRow] = {}
        calls = {}
        for setting in settings:
            row = PhysicsRow(problem, setting.option, setting.value, setting.spacing)
            call = _later(press_on, made[setting.resolution], draws, sensor, setting.grid)
            try:
                rows[setting] = with_quartiles(row, *image_errors(call(), target, untouched))
            except (ValueError, RuntimeError) as error:
                rows[setting] = replace(row, failed=True, reason=str(error))
            else:
                calls[setting] = call
        for setting, taken in time_calls(calls, repeats).items():
            least, median = (a + b for a, b in zip(making[setting.resolution], taken, strict=True))
            rows[setting] = replace(rows[setting], seconds=least / len(draws), seconds_median=median / len(draws))
        yield from rows.values()


def touch_rows(
    contacts: int = 16,
    sensors: Sequence[str] = tuple(SENSORS),
    refinements: Sequence[int] = (1, 2, 4),
    *,
    repeats: int = 3,
) -> Iterator[PhysicsRow]:
    """Rows of the world's own contacts on each sensor, then of the surfaces in closed form on the first."""
    draws, reference = world_contacts(contacts), 4 * refinements[-1]
    problems = {f"touch of {name}": SENSORS[name] for name in sensors}
    settings = [*all_settings(refinements), check_of(reference)]
    yield from sweep(problems, draws, world_heights, settings, reference, repeats)
    first = sensors[0]
    settings = [*refined_together(refinements), check_of(reference)]
    for name, heights in CLOSED_FORMS.items():
        yield from sweep({f"{name} under {first}": SENSORS[first]}, draws, heights, settings, reference, repeats)


# The gel's own options ----------------------------------------------------------------------------------------------


def margin_rows(
    contacts: int = 16, sensors: Sequence[str] = tuple(SENSORS), *, repeats: int = 3
) -> Iterator[PhysicsRow]:
    """What the periodic ends of the gel cost, by its margin, on one grid and at one depth of contact.

    A narrower gel may also be touched first at another place; here its depth makes up for that, so that what remains
    is what comes in over the ends. Seconds are of the touch image without its surface.
    """
    draws = world_contacts(contacts)
    height = world_heights(draws, BASE_RESOLUTION)
    for name in sensors:
        sensor, widest = SENSORS[name], GelGrid(WIDEST_MARGIN)
        target = press_on(height, draws, sensor, widest)
        untouched = press_on(
            torch.zeros_like(height[:1]), replace(_row(draws, 0), indentation_depth=torch.zeros(1)), sensor, widest
        )
        calls = {}
        for margin in MARGINS:
            lower = _summit(height, sensor, widest) - _summit(height, sensor, GelGrid(margin))
            depth = draws.indentation_depth - lower / (1.0 - SOFT_SHARE * _compliance(draws))
            calls[margin] = _later(press_on, height, replace(draws, indentation_depth=depth), sensor, GelGrid(margin))
        seconds = time_calls(calls, repeats)
        for margin, call in calls.items():
            row = PhysicsRow(f"touch of {name}, same depth", "margin", f"{margin}")
            least, median = (value / len(draws) for value in seconds[margin])
            yield replace(
                with_quartiles(row, *image_errors(call(), target, untouched)), seconds=least, seconds_median=median
            )


def solver_rows(contacts: int = 16, sensor: str = "gelsight", *, repeats: int = 3) -> list[PhysicsRow]:
    """The gel's displacement alone: the blur folded into its transform or in one of its own, and its precision."""
    draws, spec = world_contacts(contacts), SENSORS[sensor]
    pixels, extent, _ = GelGrid().layout(spec.field_of_view, IMAGE_SIZE)
    height = resample_centre(world_heights(draws, BASE_RESOLUTION), extent, pixels)
    pressed = contact_indentation(height, draws.indentation_depth, _compliance(draws))

    def solve(dtype: torch.dtype, blur: float) -> Tensor:
        return gel_displacement(
            pressed.to(dtype),
            draws.dwell.to(dtype),
            extent=extent,
            thickness=spec.thickness,
            correlation=spec.correlation,
            relaxation=spec.relaxation,
            blur=blur,
        )

    def solve_then_blur() -> Tensor:
        ky, kx = wavenumbers(pixels, extent)
        gain = torch.exp(-0.5 * spec.blur**2 * (ky**2 + kx**2))
        return torch.fft.irfft2(torch.fft.rfft2(solve(torch.float32, 0.0)) * gain, s=(pixels, pixels))

    target = solve(torch.float64, spec.blur)
    calls = {
        "blur folded in, float32": _later(solve, torch.float32, spec.blur),
        "blur folded in, float64": _later(solve, torch.float64, spec.blur),
        "blur by itself, float32": solve_then_blur,
    }
    seconds = time_calls(calls, repeats)
    rows = []
    for value, call in calls.items():
        error = (call() - target).square().mean(dim=(1, 2)).sqrt() / target.square().mean(dim=(1, 2)).sqrt()
        least, median = (value / len(draws) for value in seconds[value])
        row = PhysicsRow(f"displacement of {sensor}", "solver", value, seconds=least, seconds_median=median)
        rows.append(with_quartiles(row, error))
    return rows


def _later(call: Callable[..., Tensor], *arguments: object) -> Callable[[], Tensor]:
    return lambda: call(*arguments)


def _row(draws: Draws, row: int) -> Draws:
    return Draws(**{name: values[row : row + 1] for name, values in vars(draws).items()})


def _compliance(draws: Draws) -> Tensor:
    return torch.tensor([MATERIALS[index].compliance for index in draws.material.tolist()])


def _summit(height: Tensor, sensor: Sensor, grid: GelGrid) -> Tensor:
    """Where on the gel's square a surface comes first, mm, (N,)."""
    pixels, extent, _ = grid.layout(sensor.field_of_view, IMAGE_SIZE)
    return resample_centre(height, extent, pixels).amax(dim=(1, 2))
