"""Captions of contacts: what is seen and felt of them, in words that are true of the draws.

Most name the material, the others say how it feels. None begins as the prompts of zero-shot classification do ("this
feels like"), so that these are held out.
"""

import math

from torch import Tensor

from unitouch_gen.world.draws import SHAPES, Draws
from unitouch_gen.world.materials import MATERIALS

BEGINNINGS: tuple[str, ...] = ("", "", "a photo of ", "a picture of ", "a close view of ", "here is ", "the skin of ")

NOUNS: tuple[str, ...] = ("surface", "material", "thing", "object", "piece")

COLOURS: dict[str, tuple[float, float, float]] = {
    "black": (0.08, 0.08, 0.08),
    "dark grey": (0.25, 0.25, 0.25),
    "grey": (0.5, 0.5, 0.5),
    "white": (0.9, 0.9, 0.9),
    "red": (0.75, 0.18, 0.15),
    "orange": (0.8, 0.5, 0.2),
    "yellow": (0.9, 0.8, 0.2),
    "green": (0.3, 0.5, 0.15),
    "teal": (0.25, 0.55, 0.55),
    "blue": (0.18, 0.3, 0.75),
    "pink": (0.75, 0.25, 0.45),
    "brown": (0.4, 0.25, 0.14),
    "beige": (0.78, 0.68, 0.5),
    "pale blue": (0.62, 0.74, 0.86),
}

SHAPE_WORDS: dict[str, tuple[str, ...]] = {
    "flat": ("a flat face", "flat all over"),
    "ball": ("round like a ball", "a small ball"),
    "rod": ("a rod", "round like a pen"),
    "blob": ("shaped like a fruit", "a round lump"),
    "edge": ("a straight edge", "ending in an edge"),
    "corner": ("a corner", "ending in a corner"),
    "box": ("a small block", "with flat sides"),
    "coin": ("a disc", "like a coin"),
    "ring": ("a ring", "a round rim"),
}

ROUGHNESS_WORDS: dict[str, float] = {"smooth": 0.05, "slightly rough": 0.15, "rough": 0.35, "bumpy": math.inf}
HARDNESS_WORDS: dict[str, float] = {"hard": 0.1, "firm": 0.28, "yielding": 0.5, "soft": math.inf}
"""And the standard deviation of heights, mm, and the compliance, below which they are said."""

DIRECTION_WORDS: tuple[str, ...] = tuple(
    f"running {words}" for words in ("from side to side", "down to the right", "up and down", "up to the right")
)
"""At 0, 45, 90 and 135 degrees in the picture, whose y points down."""


def described(draws: Draws, variant: int = 0) -> list[str]:
    """One sentence a contact; each variant is another one, as true of it."""
    return [sentence(draws, row, variant) for row in range(len(draws))]


def sentence(draws: Draws, row: int, variant: int) -> str:
    """Roughness, hardness and colour, some of them left out, before the material or a noun; then grain and shape."""
    spec = MATERIALS[int(draws.material[row])]
    a, b = draws.wording[row].double().tolist()
    a = a + 0.618033989 * variant
    b = b + 0.569840291 * variant
    chances = iter([(a * 9973.0 + b * 7919.0 * (k + 1) + 0.754877666 * k * k) % 1.0 for k in range(20)])

    def one(choices: tuple[str, ...] | list[str]) -> str:
        return choices[int(next(chances) * len(choices))]

    short = variant > 0 and next(chances) < 0.3  # what a thing is, and no more
    roughness = word_below(ROUGHNESS_WORDS, spec.roughness * float(draws.amplitude[row]))
    hardness = word_below(HARDNESS_WORDS, float(draws.compliance[row]))
    scale = float(draws.scale[row])
    fine = "fine" if scale < 0.85 else "coarse" if scale > 1.2 else ""
    said = [roughness, hardness, colour_name(draws.colour[row])]
    scanned = bool(draws.surface[row] >= 0)
    if not scanned:  # of a scan, only what is measured of it is said
        said += [word for word in ("regular" if spec.regular else "irregular", fine) if word and next(chances) < 0.5]
    kept = [word for word in said if next(chances) < 0.75]
    named = next(chances) < 0.6 or scanned
    if not scanned and (not named or next(chances) < 0.3):
        kept.append(one(spec.feel))
    noun = spec.name if named else one(NOUNS)
    if short and named:
        return one(BEGINNINGS) + noun
    tail = []
    if is_grained(draws, row) and next(chances) < 0.6:
        tail.append(direction_word(float(draws.angle[row])))
    if next(chances) < 0.7:
        tail.append(one(SHAPE_WORDS[list(SHAPES)[int(draws.shape[row])]]))
    return ", ".join([one(BEGINNINGS) + " ".join([*kept, noun]), *tail])


def is_grained(draws: Draws, row: int) -> bool:
    """Whether a contact's relief has a direction: by its material, or as its scan has."""
    if draws.surface[row] >= 0:
        return bool(draws.grained[row])
    return MATERIALS[int(draws.material[row])].grained


def colour_name(rgb: Tensor) -> str:
    """The nearest of the fourteen colour words to a linear RGB triple."""
    value = rgb.tolist()
    return min(COLOURS, key=lambda name: sum((a - b) ** 2 for a, b in zip(COLOURS[name], value, strict=True)))


def word_below(words: dict[str, float], value: float) -> str:
    """The first word whose bound a value is below."""
    return next(word for word, most in words.items() if value < most)


def direction_word(angle: float) -> str:
    """For the direction of a grain in the picture, radians."""
    return DIRECTION_WORDS[round((angle % math.pi) / (math.pi / 4)) % 4]
