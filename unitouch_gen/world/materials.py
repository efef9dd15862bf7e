"""The seventeen materials of the world: their looks, sounds, compliance, friction and words.

Names follow Touch and Go (Yang et al., 2022). The numbers, in `materials.json`, are physically plausible rather than
measured: lengths in millimetres, frequencies in hertz, decay rates in 1/s, colours in linear RGB within [0, 1].
"""

import json
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Material:
    """One material family."""

    name: str  # as in Touch and Go's category list
    colours: list[list[float]]  # base albedos of objects
    contrast: float  # modulation of the albedo by the relief's shade, [0, 1]
    second: list[float] | None  # colour mixed in where the shade is negative (mortar, pores); `None` darkens the base
    gloss: float  # weight of the specular highlight, [0, 1]
    fundamental: float  # lowest modal frequency, Hz
    inharmonicity: float  # exponent p of the partials f_i = f_0 i^p (1 is a string, 2 a bar)
    decay: float  # rate of the lowest mode, 1/s; mode i decays i^0.7 times as fast, whatever p
    noise: float  # share of grain noise in the sound, [0, 1]
    noise_centre: float  # centre of the grain noise's band, Hz
    grains: int  # mean number of grains (Poisson) that follow the strike, beyond one that always does
    friction: float  # Coulomb coefficient against a gel
    density: float  # kg/dm^3, of things made of it
    compliance: float  # 0 for rigid, 1 for as soft as the gel; objects vary around it
    field: float  # assumed side of scans, mm, the median over objects
    roughness: float  # standard deviation of the relief at amplitude 1, mm, the median over objects
    regular: bool  # whether the relief repeats
    grained: bool  # whether the relief has a direction, that of its grain
    feel: list[str]  # further words of captions


def read_materials() -> tuple[Material, ...]:
    """The materials of `materials.json`."""
    text = Path(__file__).with_name("materials.json").read_text(encoding="utf-8")
    return tuple(Material(name, **numbers) for name, numbers in json.loads(text).items())


MATERIALS: tuple[Material, ...] = read_materials()

MATERIAL_NAMES: tuple[str, ...] = tuple(material.name for material in MATERIALS)
