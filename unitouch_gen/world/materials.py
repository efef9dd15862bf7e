"""The seventeen materials of the world: how each looks, sounds, yields and grips.

Names follow Touch and Go (Yang et al., 2022). The numbers are physically plausible rather than measured: lengths in
millimetres, frequencies in hertz, decay rates in 1/s, colours in linear RGB within [0, 1].
"""

from dataclasses import dataclass

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Material:
    """One material family.

    Attributes:
        name: As in Touch and Go's category list.
        colours: Base albedos an object may take.
        contrast: How strongly the texture's shade modulates the albedo, [0, 1].
        second: Colour mixed in where the shade is negative (mortar, pores, furrows); `None` darkens the base.
        gloss: Weight of the specular highlight, [0, 1].
        fundamental: Lowest modal frequency, Hz.
        inharmonicity: Exponent p of the partials f_i = f_0 i^p (1 is a string, 2 a bar).
        decay: Decay rate of the lowest mode, 1/s; mode i decays i^0.7 times as fast, whatever p.
        noise: Share of grain noise in the sound, [0, 1].
        noise_centre: Centre of the grain noise's band, Hz.
        grains: Mean of the Poisson number of grains that follow the strike, beyond one that always does; those that
            arrive after the sound's end are not heard.
        friction: Coulomb coefficient against a gel.
        density: kg/dm^3, of which things are made of it.
        compliance: 0 for rigid, 1 for as soft as the gel; those of objects lie around it.
        feel: What captions may call it; how rough and hard an object is, they say by its own numbers.
    """

    name: str
    colours: tuple[Colour, ...]
    contrast: float
    second: Colour | None
    gloss: float
    fundamental: float
    inharmonicity: float
    decay: float
    noise: float
    noise_centre: float
    grains: float
    friction: float
    density: float
    compliance: float
    feel: tuple[str, ...]


MATERIALS: tuple[Material, ...] = (
    Material(
        "concrete", ((0.50, 0.50, 0.48), (0.42, 0.43, 0.44), (0.58, 0.56, 0.52)), 0.35, None, 0.0,
        260.0, 1.6, 130.0, 0.25, 1500.0, 6, 0.8, 2.3, 0.0, ("gritty", "pitted"),
    ),
    Material(
        "plastic", ((0.85, 0.15, 0.15), (0.15, 0.35, 0.85), (0.95, 0.80, 0.15), (0.9, 0.9, 0.92)), 0.06, None, 0.5,
        850.0, 1.2, 75.0, 0.03, 2500.0, 2, 0.45, 1.1, 0.1, ("dimpled", "moulded"),
    ),
    Material(
        "glass", ((0.55, 0.78, 0.76), (0.62, 0.74, 0.86), (0.70, 0.82, 0.72)), 0.10, None, 1.0,
        2300.0, 1.7, 14.0, 0.0, 4000.0, 1, 0.35, 2.5, 0.0, ("slick", "flawless"),
    ),
    Material(
        "wood", ((0.55, 0.36, 0.18), (0.70, 0.50, 0.28), (0.38, 0.23, 0.12)), 0.55, (0.25, 0.14, 0.06), 0.1,
        480.0, 1.4, 52.0, 0.04, 1200.0, 2, 0.5, 0.65, 0.05, ("grained", "fibrous"),
    ),
    Material(
        "metal", ((0.62, 0.63, 0.66), (0.70, 0.62, 0.45), (0.45, 0.47, 0.52)), 0.45, None, 0.9,
        1350.0, 1.9, 4.0, 0.0, 5000.0, 1, 0.4, 7.0, 0.0, ("brushed", "cool"),
    ),
    Material(
        "brick", ((0.62, 0.24, 0.16), (0.55, 0.30, 0.22), (0.70, 0.36, 0.22)), 0.8, (0.68, 0.64, 0.58), 0.0,
        720.0, 1.5, 150.0, 0.15, 3000.0, 4, 0.75, 1.9, 0.0, ("jointed",),
    ),
    Material(
        "tile", ((0.85, 0.86, 0.82), (0.30, 0.55, 0.62), (0.80, 0.62, 0.50), (0.25, 0.30, 0.45)), 0.9,
        (0.40, 0.39, 0.37), 0.8,
        1750.0, 1.6, 32.0, 0.02, 3500.0, 2, 0.4, 2.2, 0.0, ("gridded", "glazed"),
    ),
    Material(
        "leather", ((0.30, 0.17, 0.10), (0.12, 0.10, 0.10), (0.55, 0.30, 0.16)), 0.55, None, 0.25,
        150.0, 1.3, 190.0, 0.10, 700.0, 4, 0.6, 0.9, 0.45, ("pebbled", "supple", "creased"),
    ),
    Material(
        "synthetic fabric", ((0.15, 0.20, 0.55), (0.75, 0.20, 0.45), (0.10, 0.55, 0.50), (0.20, 0.20, 0.22)), 0.5,
        None, 0.3,
        110.0, 1.1, 260.0, 0.85, 5200.0, 60, 0.4, 0.4, 0.5, ("finely woven", "thin", "even"),
    ),
    Material(
        "natural fabric", ((0.80, 0.74, 0.62), (0.62, 0.52, 0.40), (0.55, 0.60, 0.66)), 0.55, None, 0.0,
        90.0, 1.1, 300.0, 0.80, 1900.0, 25, 0.6, 0.4, 0.6, ("coarsely woven", "ribbed"),
    ),
    Material(
        "rubber", ((0.08, 0.08, 0.09), (0.16, 0.15, 0.15), (0.45, 0.12, 0.10)), 0.55, None, 0.1,
        75.0, 1.2, 60.0, 0.02, 500.0, 2, 1.0, 1.2, 0.4, ("studded", "springy", "grippy"),
    ),
    Material(
        "paper", ((0.93, 0.92, 0.88), (0.86, 0.78, 0.62), (0.90, 0.86, 0.90)), 0.20, None, 0.0,
        420.0, 1.3, 330.0, 0.75, 3300.0, 9, 0.5, 0.7, 0.2, ("crumpled", "thin", "folded"),
    ),
    Material(
        "tree", ((0.34, 0.25, 0.18), (0.42, 0.36, 0.30), (0.28, 0.22, 0.17)), 0.8, (0.10, 0.07, 0.05), 0.0,
        210.0, 1.5, 95.0, 0.35, 900.0, 8, 0.8, 0.8, 0.1, ("furrowed", "ridged"),
    ),
    Material(
        "grass", ((0.22, 0.48, 0.12), (0.35, 0.52, 0.16), (0.48, 0.50, 0.18)), 0.75, (0.08, 0.16, 0.05), 0.05,
        60.0, 1.1, 350.0, 0.95, 3900.0, 18, 0.55, 0.3, 0.7, ("bladed", "tangled"),
    ),
    Material(
        "gravel", ((0.52, 0.50, 0.47), (0.45, 0.42, 0.40), (0.60, 0.55, 0.48)), 0.7, (0.16, 0.14, 0.12), 0.1,
        2600.0, 1.3, 110.0, 0.55, 4600.0, 14, 0.7, 2.5, 0.1, ("lumpy", "loose"),
    ),
    Material(
        "sand", ((0.80, 0.68, 0.46), (0.72, 0.58, 0.38), (0.86, 0.78, 0.62)), 0.30, None, 0.0,
        65.0, 1.2, 280.0, 0.95, 6400.0, 200, 0.55, 1.6, 0.3, ("grainy", "loose", "rippled"),
    ),
    Material(
        "rock", ((0.46, 0.44, 0.42), (0.56, 0.46, 0.35), (0.24, 0.24, 0.26), (0.50, 0.36, 0.30)), 0.65, None, 0.05,
        1150.0, 1.8, 70.0, 0.08, 2200.0, 3, 0.75, 2.7, 0.0, ("craggy", "cracked"),
    ),
)  # fmt: skip

MATERIAL_NAMES: tuple[str, ...] = tuple(material.name for material in MATERIALS)
