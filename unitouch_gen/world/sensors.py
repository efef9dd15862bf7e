"""Camera-based tactile sensors: models of real ones, and random ones.

The sensors in `SENSORS` follow published measurements of real ones. `calibrated_sensors.json` has their sources and
licences, and groups their values by origin: `published` by a source, `measured` on its frames, `fitted` to its
calibration table and frames, or `guessed`, where there is no source. `settings` are of rendering.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from unitouch_gen.errors import check_integer, check_number
from unitouch_gen.world.draws import DRAWN_SENSOR_STREAM, generator, log_uniform

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Sensor:
    """Gel, lights and camera of one sensor: lengths in mm, angles in degrees, times in s."""

    name: str  # lower case, as users type it
    field_of_view: float  # side of the square of gel in the camera's view
    thickness: float  # of the gel, and largest displacement
    correlation: float  # length over which the gel spreads a displacement
    relaxation: float  # time constant of the gel's creep
    azimuths: tuple[float, ...]  # direction of each light around the gel
    elevation: tuple[float, ...]  # angle of each light above the gel's plane
    colours: tuple[Colour, ...]  # linear RGB of each light
    falloff: float  # gain of a light at the border next to it over the middle, share, [0, 1]
    gain: float  # brightness change of a facet that is turned fully toward a light
    backdrop: tuple[tuple[tuple[float, ...], ...], ...]  # the untouched gel on a coarse grid, (3, h, w) values
    blur: float  # standard deviation of the camera's blur
    noise: float  # standard deviation of the camera's noise, in units of full scale
    marker_pitch: float = 0.0  # spacing of printed markers; 0 for a plain gel
    marker_radius: float = 0.0
    marker_ink: float = 0.6  # share of the light that a marker takes
    gradients: tuple[tuple[float, float], ...] = ()  # gain of each light toward the border, along x and y
    tint: Colour = (0.0, 0.0, 0.0)  # gain of each channel for each mm of displacement
    contact_steps: int = 0  # of ADMM, see `gel_displacement`; 0 spreads all of a contact
    gamma: float = 1.0  # exponent of the camera's response
    dome: float = 0.0  # bulge of the gel, its middle over the border of the view


NUMBERS = Path(__file__).with_name("calibrated_sensors.json")


def frozen(value: Any) -> Any:
    """Nested lists as tuples."""
    return tuple(map(frozen, value)) if isinstance(value, list) else value


def calibrated(name: str, entry: dict[str, Any]) -> Sensor:
    """The sensor of an entry of `calibrated_sensors.json`. Values are in its groups, the dictionaries of an entry."""
    values: dict[str, Any] = {}
    for group in entry.values():
        if isinstance(group, dict):
            values |= {field: frozen(value) for field, value in group.items()}
    return Sensor(name, **values)


SENSORS: dict[str, Sensor] = {
    name: calibrated(name, entry) for name, entry in json.loads(NUMBERS.read_text(encoding="utf-8")).items()
}
"""The sensors of `calibrated_sensors.json` by name; docs/world.md has a table of them."""


def draw_sensor(seed: int, number: int, *, near: float | None = None) -> Sensor:
    """Random sensor `number` of a world, the same at each call.

    Args:
        seed: Of the world.
        number: Of the sensor, >= 0.
        near: Side of a view, mm, up to 100, from which the sensor's own differs by at most an eighth. If it is left
            out, the view is random.

    Returns:
        A sensor with two to six lights, white to saturated, 10 to 60 degrees above a gel of 0.8 to 4 mm, flat or
        bulging. Its camera has a view of 10 to 20 mm and a random background; a quarter of the sensors have markers. In
        two thirds the gel follows the surface where they touch, in the others it spreads all contact.

    Raises:
        InvalidInputError, InvalidTypeError: If a number is negative, no integer, or a view is out of range.
    """
    check_integer("seed", seed, 0)
    check_integer("number", number, 0)
    if near is not None:
        check_number("near", near, 1.0, 100.0)
    rng = generator(seed, DRAWN_SENSOR_STREAM, number)
    lights = int(rng.choice([2, 3, 3, 3, 4, 6]))
    azimuths = rng.uniform(0.0, 360.0) + 360.0 / lights * (np.arange(lights) + rng.uniform(-0.3, 0.3, lights))
    saturation = rng.uniform() ** 0.6
    hues = rng.uniform() + (np.arange(lights) + rng.uniform(-0.15, 0.15, lights)) / lights
    colours = _rgb(rng.permutation(hues), saturation * rng.uniform(0.7, 1.0, lights))
    colours = colours * rng.uniform(0.6, 1.0, (lights, 1))
    random_view = log_uniform(rng, 10.0, 20.0)
    view_factor = float(rng.uniform(0.88, 1.125))
    view = random_view if near is None else near * view_factor
    follows = rng.uniform() < 0.65
    uneven = rng.uniform(0.0, 0.5)
    pitch = float(rng.uniform(1.2, 3.2)) if rng.uniform() < 0.25 else 0.0
    return Sensor(
        f"drawn_{number}",
        field_of_view=view,
        thickness=float(rng.uniform(0.8, 4.0)),
        correlation=log_uniform(rng, 0.1, 0.3) if follows else log_uniform(rng, 0.06, 0.25),
        relaxation=float(rng.uniform(0.01, 0.1)),
        azimuths=frozen(azimuths.tolist()),
        elevation=frozen((rng.uniform(12.0, 55.0) + rng.uniform(-5.0, 5.0, lights).clip(-2.0)).tolist()),
        colours=frozen(colours.tolist()),
        falloff=float(rng.uniform(0.0, 0.6)),
        gain=log_uniform(rng, 0.45, 1.3) * min(1.0, 3.0 / lights),
        blur=float(rng.uniform(0.0, 0.2)) * view / 16.0,
        noise=log_uniform(rng, 0.001, 0.02),
        marker_pitch=pitch,
        marker_radius=pitch * float(rng.uniform(0.1, 0.3)),
        marker_ink=float(rng.uniform(0.3, 0.95)),
        backdrop=frozen(_backdrop(rng, azimuths, colours).tolist()),
        gradients=frozen((uneven * rng.uniform(-1.0, 1.0, (lights, 2))).tolist()),
        tint=frozen(rng.uniform(-0.03, 0.03, 3).tolist()),
        contact_steps=8 if follows else 0,  # within a few percent of more, in half the time
        gamma=log_uniform(rng, 0.7, 1.4),
        dome=float(rng.uniform(0.0, 1.0)) if rng.uniform() < 0.35 else 0.0,
    )


def _rgb(hue: np.ndarray, saturation: np.ndarray) -> np.ndarray:
    """Colours (N, 3) of hues, in turns, and saturations, both (N,)."""
    turns = (hue[:, None] + np.array([0.0, 2.0, 1.0]) / 3.0) % 1.0
    pure = np.clip(np.abs(turns * 6.0 - 3.0) - 1.0, 0.0, 1.0)
    return 1.0 - saturation[:, None] * (1.0 - pure)


def _backdrop(rng: np.random.Generator, azimuths: np.ndarray, colours: np.ndarray) -> np.ndarray:
    """A random untouched gel (3, 12, 12): a base colour, a glow from each light and in the middle, a vignette."""
    axis = (np.arange(12) + 0.5) / 12 * 2.0 - 1.0
    x = axis[None, :]
    y = axis[:, None]
    field = rng.uniform(0.25, 0.65) * rng.uniform(0.7, 1.3, (3, 1, 1)) * np.ones((3, 12, 12))
    glow = rng.uniform(0.0, 0.45)
    for azimuth, colour in zip(np.radians(azimuths), colours, strict=True):
        radius = rng.uniform(0.4, 1.3)
        width = rng.uniform(0.4, 1.2)
        distance2 = (x - radius * np.cos(azimuth)) ** 2 + (y - radius * np.sin(azimuth)) ** 2
        lobe = np.exp(-distance2 / width**2)
        field = field + glow * rng.uniform(0.3, 1.0) * (colour - 0.4)[:, None, None] * lobe
    centre_x = rng.uniform(-0.3, 0.3)
    centre_y = rng.uniform(-0.3, 0.3)
    width = rng.uniform(0.4, 1.2)
    middle = np.exp(-((x - centre_x) ** 2 + (y - centre_y) ** 2) / width**2)
    field = field + rng.uniform(-0.25, 0.3, (3, 1, 1)) * middle
    field = field * (1.0 - rng.uniform(0.0, 0.35) * (x**2 + y**2))
    if rng.uniform() < 0.2:  # dark edges on some sides
        shade = rng.uniform(0.2, 0.8)
        for edge in (field[:, 0], field[:, -1], field[:, :, 0], field[:, :, -1]):
            if rng.uniform() < 0.6:
                edge *= shade
    return np.clip(field, 0.04, 0.92).astype(np.float32)
