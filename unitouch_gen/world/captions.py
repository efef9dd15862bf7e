"""Captions: one sentence a contact, worded by what the draws say, in a handful of templates."""

from torch import Tensor

from unitouch_gen.world.draws import Draws
from unitouch_gen.world.materials import MATERIALS, SHAPE_NAMES

TEMPLATES: tuple[str, ...] = (
    "a photo of {feel} {colour} {material}, {shape}",
    "{feel} {colour} {material}, {shape}",
    "a picture of {colour} {material} that feels {feel}",
    "this feels like {feel} {material}",
    "{colour} {material}, {size} and {feel}, {shape}",
    "this looks like {colour} {material}",
    "touch of {feel} {material}",
    "{material}",
)

COLOURS: dict[str, tuple[float, float, float]] = {
    "black": (0.08, 0.08, 0.08), "dark grey": (0.25, 0.25, 0.25), "grey": (0.5, 0.5, 0.5), "white": (0.9, 0.9, 0.9),
    "red": (0.75, 0.18, 0.15), "orange": (0.8, 0.5, 0.2), "yellow": (0.9, 0.8, 0.2), "green": (0.3, 0.5, 0.15),
    "teal": (0.25, 0.55, 0.55), "blue": (0.18, 0.3, 0.75), "pink": (0.75, 0.25, 0.45), "brown": (0.4, 0.25, 0.14),
    "beige": (0.78, 0.68, 0.5), "pale blue": (0.62, 0.74, 0.86),
}  # fmt: skip

SHAPES: dict[str, str] = {
    "flat": "a flat face", "edge": "an edge", "corner": "a corner", "bump": "a round bump", "cylinder": "a cylinder",
}  # fmt: skip


def colour_name(rgb: Tensor) -> str:
    """The nearest of the fourteen colour words to a linear RGB triple."""
    value = rgb.tolist()
    return min(COLOURS, key=lambda name: sum((a - b) ** 2 for a, b in zip(COLOURS[name], value, strict=True)))


def captions(draws: Draws) -> list[str]:
    """One caption for each of N contacts."""
    return [_caption(draws, row) for row in range(len(draws))]


def _caption(draws: Draws, row: int) -> str:
    material = MATERIALS[int(draws.material[row])]
    which_template, which_feel = draws.wording[row].tolist()
    scale = draws.scale[row].item()
    return TEMPLATES[int(which_template * len(TEMPLATES))].format(
        material=material.name,
        feel=material.feel[int(which_feel * len(material.feel))],
        colour=colour_name(draws.colour[row]),
        size="fine" if scale < 0.95 else "coarse" if scale > 1.08 else "medium",
        shape=SHAPES[SHAPE_NAMES[int(draws.shape[row])]],
    )
