"""The five camera-based tactile sensors of the world, three to train on and two never seen in training."""

from dataclasses import dataclass

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Sensor:
    """Gel, lights and camera of one sensor.

    Attributes:
        name: Lower case, as users type it.
        field_of_view: Side of the square of gel that the camera sees, mm.
        thickness: Of the gel, mm; no contact can displace it further.
        correlation: Length over which the gel spreads a displacement, mm.
        relaxation: Time constant of the gel's creep, s.
        azimuths: Directions of the lights around the gel, degrees.
        elevation: Of the lights above the gel's plane, degrees.
        colours: Linear RGB of each light.
        falloff: How much nearer pixels get more of a light, relative, [0, 1].
        gain: Brightness gained by a facet that turns fully toward a light.
        background: Per RGB channel: value at the centre and slopes along x, y, x^2 + y^2 and x y over [-1, 1].
        blur: Of the camera, mm (standard deviation).
        marker_pitch: Spacing of printed markers, mm; 0 for a plain gel.
        marker_radius: Of one marker, mm.
        noise: Standard deviation of the camera's noise, in units of full scale.
    """

    name: str
    field_of_view: float
    thickness: float
    correlation: float
    relaxation: float
    azimuths: tuple[float, ...]
    elevation: float
    colours: tuple[Colour, ...]
    falloff: float
    gain: float
    background: tuple[tuple[float, float, float, float, float], ...]
    blur: float
    marker_pitch: float
    marker_radius: float
    noise: float


SENSORS: dict[str, Sensor] = {
    sensor.name: sensor
    for sensor in (
        # Johnson & Adelson's retrographic sensor: three coloured lights, soft gel, a warm uneven background.
        Sensor(
            "gelsight", 16.0, 2.0, 0.22, 0.05, (90.0, 210.0, 330.0), 30.0,
            ((0.15, 1.0, 0.25), (0.25, 0.3, 1.0), (1.0, 0.25, 0.35)), 0.25, 0.85,
            ((0.50, -0.10, 0.02, -0.08, 0.0), (0.49, -0.06, -0.05, -0.06, 0.0), (0.42, 0.12, 0.02, -0.08, 0.0)),
            0.10, 0.0, 0.0, 0.012,
        ),
        # DIGIT: three lights at the sides, low contrast, a strongly coloured background.
        Sensor(
            "digit", 15.0, 1.6, 0.28, 0.08, (120.0, 0.0, 240.0), 24.0,
            ((1.0, 0.2, 0.15), (0.2, 0.95, 0.2), (0.15, 0.25, 1.0)), 0.45, 0.75,
            ((0.33, -0.16, -0.14, -0.06, 0.05), (0.32, 0.18, 0.05, -0.05, 0.06), (0.34, -0.10, 0.18, -0.04, -0.06)),
            0.14, 0.0, 0.0, 0.016,
        ),
        # Taxim's calibrated simulation of a GelSight: even, clean, a cool grey background.
        Sensor(
            "taxim", 16.0, 2.0, 0.18, 0.02, (60.0, 180.0, 300.0), 34.0,
            ((0.95, 0.25, 0.25), (0.25, 0.95, 0.30), (0.25, 0.30, 1.0)), 0.15, 0.90,
            ((0.56, 0.02, 0.00, -0.03, 0.0), (0.60, 0.00, 0.02, -0.03, 0.0), (0.66, 0.00, -0.02, -0.03, 0.0)),
            0.08, 0.0, 0.0, 0.004,
        ),
        # GelSlim (unseen): thin finger, paler lights, printed markers, a greenish vignetted background.
        Sensor(
            "gelslim", 17.0, 1.8, 0.30, 0.06, (100.0, 215.0, 325.0), 27.0,
            ((0.35, 0.95, 0.40), (0.30, 0.40, 0.90), (0.95, 0.45, 0.40)), 0.35, 0.80,
            ((0.38, 0.03, -0.04, -0.12, 0.0), (0.46, 0.02, -0.05, -0.12, 0.0), (0.40, 0.05, 0.04, -0.12, 0.0)),
            0.15, 2.9, 0.33, 0.014,
        ),
        # TACTO (unseen): a rasteriser's DIGIT, hard gel, saturated lights, no camera noise.
        Sensor(
            "tacto", 15.0, 1.4, 0.15, 0.01, (110.0, 350.0, 230.0), 26.0,
            ((1.0, 0.12, 0.10), (0.10, 1.0, 0.12), (0.10, 0.12, 1.0)), 0.40, 0.85,
            ((0.42, -0.10, -0.12, 0.02, 0.0), (0.36, 0.14, 0.03, 0.02, 0.0), (0.46, -0.06, 0.12, 0.02, 0.0)),
            0.06, 0.0, 0.0, 0.002,
        ),
    )
}  # fmt: skip

TRAINING_SENSORS: tuple[str, ...] = ("gelsight", "digit", "taxim")
UNSEEN_SENSORS: tuple[str, ...] = ("gelslim", "tacto")
