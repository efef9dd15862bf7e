"""The world's calibrated sensors: their fit to published measurements of real ones, and what it leaves.

    python -m tests.benchmarks --only calibration --calibration FOLDER
        what `unitouch_gen.world.SENSORS` leave of tables and of ball presses, beside controls
    python -m tests.benchmarks.calibration FOLDER
        fits the sensors anew, into unitouch_gen/world/calibrated_sensors.json

The folder holds, by the names in `SOURCES` and `PRESSES`:

- Taxim's tables, and a rendering of it for its background (github.com/Robo-Touch/Taxim, calibs/ and
  results/square_sim.jpg; MIT). A background whose file is missing stays as it is.
- The table and the ball presses of ObjectFolder 2.0 (github.com/rhgao/ObjectFolder, calibs/; CC BY 4.0).
- The untouched DIGIT of TACTO (github.com/facebookresearch/tacto, examples/conf/; MIT).

A table of Taxim's gives, for each bin of a surface's slope (angle to the gel's plane, direction), the change of each
channel as a quadratic polynomial in the pixel's column and row. Its channels are blue, green, red, as OpenCV reads
pictures: so read, facets are lit in the order around a contact in which recordings of these sensors show them.
"""

import argparse
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from scipy.optimize import least_squares, nnls
from torch import Tensor

from tests.benchmarks.measuring import Figures
from tests.helpers.plain_sensor import PLAIN, touch_images
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.files import write_file
from unitouch_gen.world import SENSORS, Sensor
from unitouch_gen.world.gel import gel_square, in_view
from unitouch_gen.world.grids import PATCH_MM, pixel_axis, slopes
from unitouch_gen.world.sensors import NUMBERS, gel_background, gel_indentation, pressed_gel, shade_gel

GREY = 255.0
"""Grey levels to full scale."""

STEEPEST = 60.0
"""Largest angle that is fitted, degrees: beyond it the gel had left the balls that the tables were made with."""

STRIDE = 4
"""One in so many bins of a table is looked at: neighbours are interpolated from each other."""

POSITIONS, TRUSTED = 8, slice(1, 7)
"""Positions a side over the square in the middle of a frame, and those not too near to its rim, where few pressed."""

LIGHTS = 6
BACKDROP = 8
"""Lights of a fitted sensor, and values a side of its background."""


NO_BACKDROP = (((0.0, 0.0), (0.0, 0.0)),) * 3


@dataclass(frozen=True)
class Source:
    """Where a sensor's numbers are from.

    Attributes:
        table: File of polynomials.
        size: Height and width of its frames, pixels.
        turns: Quarter turns, counterclockwise, that bring its frames upright.
        background: File with the untouched gel.
    """

    table: str
    size: tuple[int, int]
    turns: int = 0
    background: str | None = None


SOURCES: dict[str, Source] = {
    "gelsight": Source("taxim_gelsight_polycalib.npz", (480, 640), background="taxim_square_sim.jpg"),
    "gelsight_r15": Source("taxim_gelsight_r15_polycalib.npz", (240, 320)),
    "gelsight_objectfolder": Source("objectfolder_polycalib.npz", (120, 160), background="objectfolder_dataPack.npz"),
    "digit": Source("taxim_digit_polycalib.npz", (240, 320), turns=1, background="tacto_bg_digit_240_320.jpg"),
}

PRESSED, PRESSES = "gelsight_objectfolder", "objectfolder_dataPack.npz"
BALL_RADIUS = 2.0
"""The sensor of which there are frames with a ball pressed into it, their file, and the ball's radius, mm."""


def check_folder(folder: Path) -> None:
    """Refuses a folder without the tables and frames; a background may be missing.

    Raises:
        InvalidInputError: With the names of those that are missing.
    """
    needed = {PRESSES, *(source.table for source in SOURCES.values())}
    missing = sorted(name for name in needed if not (folder / name).is_file())
    if missing:
        raise InvalidInputError(
            f"`calibration` is {str(folder)!r}, which lacks {', '.join(missing)}; tests/benchmarks/calibration.py says "
            "where these are published."
        )


# Tables ---------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Changes:
    """What slopes change in a real sensor's picture.

    Attributes:
        slope_x, slope_y: Slopes of the gel, (N,).
        depth: How far it is displaced there, mm, (N,).
        values: Change of the picture at `POSITIONS` a side, of which `TRUSTED` are kept, (N, 3, P, P), full scale 1.
        held_out: What is not fitted: blocks of slopes, and a quarter of the positions, (N, P, P).
    """

    slope_x: Tensor
    slope_y: Tensor
    depth: Tensor
    values: Tensor
    held_out: Tensor


def read_table(file: Path) -> np.ndarray:
    """Coefficients (angles, directions, 6, RGB) of x^2, y^2, x y, x, y and 1, in grey levels."""
    with np.load(file) as table:
        return np.stack([table[f"grad_{channel}"] for channel in "bgr"], axis=-1)


def table_changes(table: np.ndarray, source: Source) -> Changes:
    """A table at some of its bins and positions, upright."""
    bins, (height, width) = len(table), source.size
    angles = np.arange(1, int(STEEPEST / 90.0 * (bins - 1)), STRIDE)
    directions = np.arange(0, bins - 1, STRIDE)
    angle = (angles + 0.5) * (np.pi / 2) / (bins - 1)
    direction = (directions + 0.5) * (2 * np.pi) / (bins - 1) - np.pi
    axis = pixel_axis(POSITIONS, 2.0)[TRUSTED].double().numpy()
    x, y = np.meshgrid(axis, axis)
    for _ in range(source.turns):  # upright to as recorded: what was at the left is below now
        x, y, direction = -y, x, direction - np.pi / 2
    column, row = 0.5 * (width + height * x) - 0.5, 0.5 * (height + height * y) - 0.5
    basis = np.stack([column**2, row**2, column * row, column, row, np.ones_like(row)])
    values = np.einsum("adkc,kij->adcij", table[np.ix_(angles, directions)], basis) / GREY
    block = np.arange(len(angles))[:, None] // 3 + 2 * (np.arange(len(directions))[None, :] // 3)
    place = np.add.outer(np.arange(len(axis)), np.arange(len(axis)))
    held_out = (block % 4 == 0).reshape(-1, 1, 1) | (place % 4 == 0)[None]
    slope = np.tan(angle)[:, None] * np.stack([np.cos(direction), np.sin(direction)])[:, None, :]
    depth = BALL_RADIUS * np.cos(angle)[:, None] + 0 * direction  # the ball was pressed in nearly to its middle
    return Changes(
        *(torch.from_numpy(part.reshape(-1)).float() for part in (*slope, depth)),
        torch.from_numpy(values.reshape(-1, *values.shape[2:])).float(),
        torch.from_numpy(held_out),
    )


def sensor_changes(sensor: Sensor, real: Changes, *, clip: bool = True) -> Tensor:
    """What slopes and depths change in a sensor's picture at the positions of `Changes`, (N, 3, P, P)."""
    fields = (each[:, None, None].expand(-1, POSITIONS, POSITIONS) for each in (real.slope_x, real.slope_y, real.depth))
    slope_x, slope_y, depth = fields
    pressed, untouched = shade_gel(slope_x, slope_y, sensor, depth), gel_background(sensor, POSITIONS)
    if clip:
        pressed, untouched = pressed.clamp(0.0, 1.0), untouched.clamp(0.0, 1.0)
    return (pressed - untouched)[:, :, TRUSTED, TRUSTED]


def rms(values: Tensor, where: Tensor | None = None) -> float:
    """Root mean square in grey levels of (N, 3, P, P), or of where (N, P, P) says."""
    if where is not None:
        values = values.movedim(1, -1)[where]
    return GREY * values.double().square().mean().sqrt().item()


def table_residual(found: Tensor, real: Changes) -> Figures:
    """RMS of the difference in grey levels, and as a share of the table's own, in fitted and held-out bins."""
    parts = {"fitted": ~real.held_out, "held_out": real.held_out}
    own = {part: rms(real.values, where) for part, where in parts.items()}
    left = {part: rms(found - real.values, where) for part, where in parts.items()}
    return {part: {"grey_levels": left[part], "share": left[part] / own[part]} for part in parts}


# Fits -----------------------------------------------------------------------------------------------------------------


def fit_lights(real: Changes, sensor: Sensor, lights: int = LIGHTS, starts: int = 3) -> Sensor:
    """The sensor with its lights fitted to what is not held out: directions, elevations, gradients and colours.

    But for the clipping colours enter linearly, so first they follow from the rest by non-negative least squares
    (variable projection), from several directions; the best of these is then polished as a whole.
    """
    kept = ~real.held_out
    target = real.values.movedim(1, -1)[kept].double().numpy()  # (M, 3)

    def changes(lit: Sensor, clip: bool) -> np.ndarray:
        found = sensor_changes(lit, real, clip=clip)
        return found.movedim(1, -1)[kept].double().numpy()

    def parts(numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        azimuths, elevations = np.degrees(numbers[: 2 * lights]).reshape(2, -1)
        return azimuths, elevations, numbers[2 * lights :].reshape(-1, 2) - 1.0

    depth = real.depth[:, None, None].expand(kept.shape)[kept].double().numpy()

    def colours_of(numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Colours and tint (L + 1, 3) that fit best, and what they leave (M, 3)."""
        each = []
        for first in range(0, lights, 3):  # three lights at a time, each in a channel of its own
            some = [part[first : first + 3] for part in parts(numbers)]
            pure = with_lights(replace(sensor, backdrop=NO_BACKDROP), *some, np.eye(3)[: len(some[0])])
            each.append(changes(pure, clip=False)[:, : len(some[0])])
        basis = np.column_stack([*each, depth, -depth])  # (M, L + 2): lights add, a tint may take away
        factor = np.linalg.cholesky(basis.T @ basis + 1e-4 * np.eye(lights + 2)).T
        right = np.linalg.solve(factor.T, basis.T @ target)
        weights = np.stack([nnls(factor, column)[0] for column in right.T], axis=1)
        return np.vstack([weights[:lights], weights[lights] - weights[lights + 1]]), basis @ weights - target

    found = []
    for start in range(starts):
        # No number is near 0, as the steps of differences are shares of them.
        azimuths = 2 * np.pi * (1.0 + (np.arange(lights) + start / starts) / lights)
        first = np.concatenate([azimuths, np.repeat([0.5, 1.0], [lights, 2 * lights])])
        low, high = (np.repeat(ends, [lights, lights, 2 * lights]) for ends in ([0.0, 0.0, 0.5], [20.0, 1.4, 1.5]))
        found.append(
            least_squares(
                lambda numbers: colours_of(numbers)[1].ravel(),
                first, bounds=(low, high), diff_step=1e-3, x_scale=0.1, max_nfev=60,
            )
        )  # fmt: skip
    best = min(found, key=lambda each: each.cost).x

    def whole(numbers: np.ndarray) -> Sensor:
        colours = numbers[4 * lights :].reshape(-1, 3) - 1.0
        return with_lights(sensor, *parts(numbers[: 4 * lights]), colours[:lights], colours[lights])

    first = np.concatenate([best, 1.0 + colours_of(best)[0].ravel()])
    low = np.concatenate([low, np.repeat([1.0, 0.5], [3 * lights, 3])])
    high = np.concatenate([high, np.repeat([5.0, 1.5], [3 * lights, 3])])
    polished = least_squares(
        lambda numbers: (changes(whole(numbers), clip=True) - target).ravel(),
        np.clip(first, low + 1e-6, high - 1e-6), bounds=(low, high), diff_step=1e-3, x_scale=0.1, max_nfev=30,
    )  # fmt: skip
    return whole(polished.x)


def with_lights(
    sensor: Sensor,
    azimuths: np.ndarray,
    elevations: np.ndarray,
    gradients: np.ndarray,
    colours: np.ndarray,
    tint: np.ndarray | None = None,
) -> Sensor:
    """The sensor under other lights, whose strongest channel is 1 at a gain that makes up for it."""
    gain = max(float(colours.max()), 1e-6)
    return replace(
        sensor,
        azimuths=tuple((azimuths % 360.0).tolist()),
        elevation=tuple(elevations.tolist()),
        gradients=tuple(map(tuple, gradients.tolist())),
        colours=tuple(map(tuple, (colours / gain).tolist())),
        gain=gain,
        tint=tuple(tint.tolist()) if tint is not None else (0.0, 0.0, 0.0),
        falloff=0.0,
    )


def read_background(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """The untouched gel, the square in the middle of a frame (S, S, RGB), full scale 1, and which pixels show it."""
    if file.suffix == ".npz":
        with np.load(file) as pack:
            picture = pack["f0"][..., ::-1]  # as OpenCV read it
    else:
        picture = np.asarray(Image.open(file).convert("RGB"))
    picture = middle(picture).astype(np.float64) / GREY
    seen = np.ones(picture.shape[:2], bool)
    if file.name.endswith("_sim.jpg"):  # a square of 140 of 480 pixels was pressed in the middle, and its rim is lit
        away = np.maximum(*np.abs(np.mgrid[: len(seen), : len(seen)] + 0.5 - len(seen) / 2))
        seen = (away < 45) | (away > 150)
    return picture, seen


def middle(frame: np.ndarray) -> np.ndarray:
    """The square in the middle of a frame (H, W, ...)."""
    side = min(frame.shape[:2])
    top, left = ((extent - side) // 2 for extent in frame.shape[:2])
    return frame[top : top + side, left : left + side]


def fit_backdrop(picture: np.ndarray, seen: np.ndarray, side: int = BACKDROP) -> Any:
    """Values (3, side, side) whose interpolation is nearest to the pixels that are seen of a picture (S, S, 3)."""
    grids = torch.eye(side**2).view(1, -1, side, side)
    basis = F.interpolate(grids, picture.shape[:2], mode="bicubic", align_corners=False)[0].numpy()
    bends = np.diff(np.eye(side), 2, axis=0)  # a little stiffness fills in what is hidden
    stiff = (
        0.1 * np.sqrt(seen.size) / side * np.concatenate([np.kron(np.eye(side), bends), np.kron(bends, np.eye(side))])
    )
    rows = np.concatenate([basis[:, seen].T.astype(np.float64), stiff])
    values, *_ = np.linalg.lstsq(rows, np.concatenate([picture[seen], np.zeros((len(stiff), 3))]), rcond=None)
    planes = values.T.reshape(3, side, side).round(3)
    return tuple(tuple(map(tuple, plane)) for plane in planes.tolist())


# Ball presses ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Presses:
    """Frames of a ball that was pressed into a gel.

    Attributes:
        change: Frame less the untouched gel, the square in the middle, (N, 3, S, S), full scale 1.
        centres: Column and row of the ball in that square, relative to its side, from -0.5 to 0.5, (N, 2).
        held_out: Frames that the gel is not fitted to, (N,).
    """

    change: Tensor
    centres: Tensor
    held_out: Tensor


def read_presses(file: Path) -> Presses:
    """The frames of one calibration."""
    with np.load(file) as pack:
        change = pack["imgs"][..., ::-1].astype(np.float32) - pack["f0"][..., ::-1].astype(np.float32)
        centres = torch.from_numpy(pack["touch_center"]).float()
    height, width = change.shape[1:3]
    centres = (centres + 0.5 - 0.5 * torch.tensor([width, height])) / height
    square = np.stack([middle(frame) for frame in change]) / GREY
    held_out = torch.arange(len(square)) % 2 == 1
    return Presses(torch.from_numpy(square).movedim(-1, 1), centres, held_out)


def ball_heights(centres: Tensor, view: float, radius: float = BALL_RADIUS, resolution: int = 384) -> Tensor:
    """Heights (N, R, R), mm, of a ball at each of N places in a view of so many mm."""
    axis = pixel_axis(resolution, PATCH_MM)
    x, y = (axis[None] - view * centre[:, None] for centre in centres.unbind(1))
    off = x[:, None, :] ** 2 + y[:, :, None] ** 2
    return (radius**2 - off).clamp_min(0.0).sqrt() - radius * (off >= radius**2)


def rendered_presses(sensor: Sensor, presses: Presses, depth: float) -> Tensor:
    """What the ball changes in the sensor's picture, (N, 3, S, S)."""
    count, side = len(presses.centres), presses.change.shape[-1]
    heights, full = ball_heights(presses.centres, sensor.field_of_view), torch.ones(count)
    images = touch_images(heights, depth * full, 10.0 * full, sensor, side)
    return images - gel_background(sensor, side).clamp(0.0, 1.0)


def table_presses(table: np.ndarray, sensor: Sensor, presses: Presses, depth: float) -> Tensor:
    """What a table makes of the slopes of a sensor's gel under the ball, (N, 3, S, S); upright tables alone."""
    side = presses.change.shape[-1]
    heights, full = ball_heights(presses.centres, sensor.field_of_view), torch.full((len(presses.centres),), depth)
    displacement = pressed_gel(gel_indentation(heights, full, sensor, side), 10.0 + 0.0 * full, sensor, side)
    pairs = slopes(displacement, gel_square(sensor.field_of_view, side)[1] / displacement.shape[-1])
    slope_x, slope_y = (in_view(field, side).double().numpy() for field in pairs)
    last = len(table) - 1
    angle = (np.arctan(np.hypot(slope_x, slope_y)) / (np.pi / 2) * last).astype(int)
    direction = ((np.arctan2(slope_y, slope_x) + np.pi) / (2 * np.pi) * last).astype(int)
    row, column = np.mgrid[:side, :side].astype(np.float64)
    column = column + 0.5 * (SOURCES[PRESSED].size[1] - side)  # of the whole frame
    basis = np.stack([column**2, row**2, column * row, column, row, np.ones_like(row)])
    change = np.einsum("nijkc,kij->ncij", table[angle, direction], basis) / GREY
    change[np.broadcast_to((angle == 0)[:, None], change.shape)] = 0.0  # untouched
    return torch.from_numpy(change).float()


def press_residual(found: Tensor, presses: Presses) -> Figures:
    """RMS of the difference in grey levels, as a share of the frames' own, and correlation, on frames held out."""
    ours, real = found[presses.held_out], presses.change[presses.held_out]
    both = torch.stack([ours.flatten(1), real.flatten(1)])
    alike = F.cosine_similarity(*(both - both.mean(dim=2, keepdim=True)), dim=1)
    return {
        "grey_levels": rms(ours - real), "share": rms(ours - real) / rms(real), "correlation": alike.mean().item()
    }  # fmt: skip


def nearest_depth(render: Callable[[float], Tensor], presses: Presses) -> tuple[float, Tensor]:
    """The depth, mm, at which presses are nearest to frames not held out, and these presses: no frame tells its own."""
    few = replace(presses, held_out=~presses.held_out)
    depths = np.linspace(0.2, 2.4, 12).tolist()
    depth = min(depths, key=lambda each: press_residual(render(each), few)["grey_levels"])
    return depth, render(depth)


# Figures --------------------------------------------------------------------------------------------------------------


def calibration_figures(folder: Path) -> Figures:
    """What each calibrated sensor, the guessed one of its name, and no change at all leave of tables and ball presses.

    Tables leave nothing of themselves. Of ball presses, what a table makes of the slopes of our gel stands beside.
    """
    tables: Figures = {}
    for name, source in SOURCES.items():
        real = table_changes(read_table(folder / source.table), source)
        left = {
            "calibrated": sensor_changes(SENSORS[name], real),
            "guessed": sensor_changes(PLAIN, real),
            "no change": torch.zeros_like(real.values),
        }
        tables[name] = {what: table_residual(found, real) for what, found in left.items()}
    presses, source, sensor = read_presses(folder / PRESSES), SOURCES[PRESSED], SENSORS[PRESSED]
    guessed = replace(PLAIN, field_of_view=sensor.field_of_view)
    table = read_table(folder / source.table)
    balls: Figures = {"held_out_frames": int(presses.held_out.sum())}
    renders: dict[str, Callable[[float], Tensor]] = {
        "calibrated": lambda depth: rendered_presses(sensor, presses, depth),
        "table": lambda depth: table_presses(table, sensor, presses, depth),
        "guessed": lambda depth: rendered_presses(guessed, presses, depth),
    }
    for what, render in renders.items():
        depth, found = nearest_depth(render, presses)
        balls[what] = {"depth": depth, **press_residual(found, presses)}
    return {"tables": tables, "balls": balls}


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.calibration")
    parser.add_argument("folder", type=Path, help="folder of tables, frames and backgrounds")
    folder = parser.parse_args().folder
    try:
        check_folder(folder)
    except InvalidInputError as error:
        parser.error(str(error))
    numbers = json.loads(NUMBERS.read_text())
    for name, source in SOURCES.items():
        fitted = dict(numbers[name]["fitted"])
        sensor = SENSORS[name]
        if source.background and (folder / source.background).is_file():
            sensor = replace(sensor, backdrop=fit_backdrop(*read_background(folder / source.background)))
        real = table_changes(read_table(folder / source.table), source)
        sensor = fit_lights(real, sensor)
        print(name, table_residual(sensor_changes(sensor, real), real), flush=True)
        numbers[name]["fitted"] = {field: rounded(getattr(sensor, field)) for field in fitted}
    write_file("sensors", NUMBERS, formatted(numbers))


def rounded(value: Any) -> Any:
    """Numbers to four digits after the point."""
    return json.loads(json.dumps(value), parse_float=lambda digits: round(float(digits), 4))


def formatted(numbers: dict[str, Any]) -> str:
    """JSON with one line for each value of a sensor, and for each channel of a background."""
    entries = []
    for name, entry in numbers.items():
        parts = []
        for key, value in entry.items():
            if isinstance(value, dict):
                rows = [f'      "{field}": {json.dumps(each)}' for field, each in value.items()]
                rows = [row.replace("]], [[", "]],\n        [[") for row in rows]
                parts.append(f'    "{key}": {{\n' + ",\n".join(rows) + "\n    }" if rows else f'    "{key}": {{}}')
            else:
                parts.append(f'    "{key}": {json.dumps(value)}')
        entries.append(f'  "{name}": {{\n' + ",\n".join(parts) + "\n  }")
    return "{\n" + ",\n".join(entries) + "\n}\n"


if __name__ == "__main__":
    main()
