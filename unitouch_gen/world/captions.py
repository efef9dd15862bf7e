"""Captions of contacts: what is seen and felt of them, in words that are true of the draws.

Most name the material, the others say how it feels. None begins as the prompts of zero-shot classification do ("this
feels like"), so that these are held out.
"""

import math

from torch import Tensor

from unitouch_gen.world.draws import SHAPES, Draws
from unitouch_gen.world.materials import MATERIALS
from unitouch_gen.world.textures import TextureLibrary

BEGINNINGS: tuple[str, ...] = ("", "", "a photo of ", "a picture of ", "a close view of ", "here is ", "the skin of ")

NOUNS: tuple[str, ...] = ("surface", "material", "thing", "object", "piece")

COLOURS: dict[str, tuple[float, float, float]] = {
    "black": (0.08, 0.08, 0.08), "dark grey": (0.25, 0.25, 0.25), "grey": (0.5, 0.5, 0.5), "white": (0.9, 0.9, 0.9),
    "red": (0.75, 0.18, 0.15), "orange": (0.8, 0.5, 0.2), "yellow": (0.9, 0.8, 0.2), "green": (0.3, 0.5, 0.15),
    "teal": (0.25, 0.55, 0.55), "blue": (0.18, 0.3, 0.75), "pink": (0.75, 0.25, 0.45), "brown": (0.4, 0.25, 0.14),
    "beige": (0.78, 0.68, 0.5), "pale blue": (0.62, 0.74, 0.86),
}  # fmt: skip

SHAPE_WORDS: dict[str, tuple[str, ...]] = {
    "flat": ("a flat face", "flat all over"), "ball": ("round like a ball", "a small ball"),
    "rod": ("a rod", "round like a pen"), "blob": ("shaped like a fruit", "a round lump"),
    "edge": ("a straight edge", "ending in an edge"), "corner": ("a corner", "ending in a corner"),
    "box": ("a small block", "with flat sides"), "coin": ("a disc", "like a coin"), "ring": ("a ring", "a round rim"),
}  # fmt: skip

GRAINED: tuple[str, ...] = ("wood", "metal", "natural fabric", "tree", "grass")
"""Materials whose relief has a direction, that of their grain."""

REGULAR: tuple[str, ...] = ("plastic", "brick", "tile", "synthetic fabric", "natural fabric", "rubber")
"""Materials whose relief repeats."""

ROUGHNESS_WORDS: dict[str, float] = {"smooth": 0.05, "slightly rough": 0.15, "rough": 0.35, "bumpy": math.inf}
"""And the standard deviation of heights, mm, below which they are said."""

HARDNESS_WORDS: dict[str, float] = {"hard": 0.1, "firm": 0.28, "yielding": 0.5, "soft": math.inf}
"""And the compliance, from 0, rigid, to 1, as soft as the gel, below which they are said."""

DIRECTION_WORDS = (
    "running from side to side", "running down to the right", "running up and down", "running up to the right"
)  # fmt: skip

ROUGHNESS: dict[str, float] = {
    "concrete": 0.19, "plastic": 0.096, "glass": 0.02, "wood": 0.09, "metal": 0.07, "brick": 0.33, "tile": 0.28,
    "leather": 0.105, "synthetic fabric": 0.065, "natural fabric": 0.18, "rubber": 0.31, "paper": 0.29, "tree": 0.44,
    "grass": 0.34, "gravel": 0.48, "sand": 0.105, "rock": 0.32,
}  # fmt: skip
"""Standard deviation of each relief at amplitude 1, mm: the median over objects."""

NAMED = 0.6
"""Share of captions that name the material; the others say how it feels."""

SHORT = 0.3
"""Share of the variants beyond the first that say what a thing is, and no more."""


def described(draws: Draws, textures: TextureLibrary | None = None, variant: int = 0) -> list[str]:
    """One sentence a contact; each variant is another one, as true of it."""
    return [_described(draws, row, textures, variant) for row in range(len(draws))]


def colour_name(rgb: Tensor) -> str:
    """The nearest of the fourteen colour words to a linear RGB triple."""
    value = rgb.tolist()
    return min(COLOURS, key=lambda name: sum((a - b) ** 2 for a, b in zip(COLOURS[name], value, strict=True)))


def word_below(words: dict[str, float], value: float) -> str:
    """The first word whose bound a value is below."""
    return next(word for word, most in words.items() if value < most)


def direction_word(angle: float) -> str:
    """For the direction of a grain in the picture, radians, whose y points down."""
    return DIRECTION_WORDS[round((angle % math.pi) / (math.pi / 4)) % 4]


def _described(draws: Draws, row: int, textures: TextureLibrary | None, variant: int) -> str:
    spec = MATERIALS[int(draws.material[row])]
    scanned = int(draws.texture[row]) >= 0
    seeds = iter(_numbers(draws.wording[row], variant))
    short = variant > 0 and next(seeds) < SHORT

    def one(choices: tuple[str, ...]) -> str:
        return choices[int(next(seeds) * len(choices))]

    colour: Tensor = draws.colour[row]
    if scanned:
        assert textures is not None
        deviation, regular, size = float(draws.relief[row]), "", float(draws.texture_side[row]) / 35.0
        colour = textures.textures[int(draws.texture[row])].colour
    else:
        deviation = ROUGHNESS[spec.name] * float(draws.amplitude[row])
        regular, size = "regular" if spec.name in REGULAR else "irregular", float(draws.scale[row])
    fine = "fine" if size < 0.85 else "coarse" if size > 1.2 else ""
    compliance = float(draws.compliance[row])
    said = [word_below(ROUGHNESS_WORDS, deviation), word_below(HARDNESS_WORDS, compliance), colour_name(colour)]
    said += [word for word in (regular, fine) if word and next(seeds) < 0.5]
    kept = [word for word in said if next(seeds) < 0.75]
    named = next(seeds) < NAMED
    if not scanned and (not named or next(seeds) < 0.3):
        kept.append(one(spec.feel))
    noun = spec.name if named else one(NOUNS)
    if short and named:
        return one(BEGINNINGS) + noun
    tail = []
    if not scanned and spec.name in GRAINED and next(seeds) < 0.6:
        tail.append(direction_word(float(draws.angle[row])))
    if next(seeds) < 0.7:
        tail.append(one(SHAPE_WORDS[list(SHAPES)[int(draws.shape[row])]]))
    return ", ".join([one(BEGINNINGS) + " ".join([*kept, noun]), *tail])


def _numbers(seed: Tensor, variant: int) -> list[float]:
    """Twenty numbers in [0, 1) from a contact's two."""
    a, b = seed.double().tolist()
    a, b = a + 0.618033989 * variant, b + 0.569840291 * variant
    return [(a * 9973.0 + b * 7919.0 * (k + 1) + 0.754877666 * k * k) % 1.0 for k in range(20)]
