"""Captions of contacts, which describe by true words how a contact looks and feels.

Most captions name the material, the others describe how it feels. None begins as the prompts of zero-shot
classification do ("this feels like"), so that these are held out.
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
"""Words, each with the bound below which it is used: of the heights' standard deviation, mm, and of compliance."""

DIRECTION_WORDS: tuple[str, ...] = tuple(
    f"running {words}" for words in ("from side to side", "down to the right", "up and down", "up to the right")
)
"""At 0, 45, 90 and 135 degrees in the picture; y points down."""


def described(draws: Draws, variant: int = 0) -> list[str]:
    """One caption for each contact; each variant is another true caption."""
    return [sentence(draws, row, variant) for row in range(len(draws))]


def sentence(draws: Draws, row: int, variant: int) -> str:
    """The caption of one contact: roughness, hardness, colour, then the material or a noun, then grain and shape.

    Each part may be left out at random.
    """
    spec = MATERIALS[int(draws.material[row])]
    a, b = draws.wording[row].double().tolist()
    a = a + 0.618033989 * variant
    b = b + 0.569840291 * variant
    chances = iter([(a * 9973.0 + b * 7919.0 * (k + 1) + 0.754877666 * k * k) % 1.0 for k in range(20)])

    def choose(words: tuple[str, ...] | list[str]) -> str:
        return words[int(next(chances) * len(words))]

    is_short = variant > 0 and next(chances) < 0.3  # names the material and nothing else
    roughness = word_below(ROUGHNESS_WORDS, spec.roughness * float(draws.amplitude[row]))
    hardness = word_below(HARDNESS_WORDS, float(draws.compliance[row]))
    adjectives = [roughness, hardness, colour_name(draws.colour[row])]
    is_scanned = bool(draws.surface[row] >= 0)
    if not is_scanned:  # the regularity and scale of a scan are not measured
        for word in ("regular" if spec.regular else "irregular", scale_word(float(draws.scale[row]))):
            if word and next(chances) < 0.5:
                adjectives.append(word)
    adjectives = [word for word in adjectives if next(chances) < 0.75]
    names_material = next(chances) < 0.6 or is_scanned
    if not is_scanned and (not names_material or next(chances) < 0.3):
        adjectives.append(choose(spec.feel))
    noun = spec.name if names_material else choose(NOUNS)
    if is_short and names_material:
        return choose(BEGINNINGS) + noun
    tail = list[str]()
    if is_grained(draws, row) and next(chances) < 0.6:
        tail.append(direction_word(float(draws.angle[row])))
    if next(chances) < 0.7:
        shape = list(SHAPES)[int(draws.shape[row])]
        tail.append(choose(SHAPE_WORDS[shape]))
    head = choose(BEGINNINGS) + " ".join([*adjectives, noun])
    return ", ".join([head, *tail])


def scale_word(scale: float) -> str:
    """The word for a factor on lengths of the relief; none if it is about 1."""
    if scale < 0.85:
        return "fine"
    return "coarse" if scale > 1.2 else ""


def is_grained(draws: Draws, row: int) -> bool:
    """Whether a contact's relief has a direction; that of a scan is measured, others are the material's."""
    if draws.surface[row] >= 0:
        return bool(draws.grained[row])
    return MATERIALS[int(draws.material[row])].grained


def colour_name(rgb: Tensor) -> str:
    """The nearest of the fourteen colour words to a linear RGB triple."""
    value = rgb.tolist()

    def squared_distance(name: str) -> float:
        return sum((a - b) ** 2 for a, b in zip(COLOURS[name], value, strict=True))

    return min(COLOURS, key=squared_distance)


def word_below(words: dict[str, float], value: float) -> str:
    """The first word whose bound is above a value."""
    return next(word for word, bound in words.items() if value < bound)


def direction_word(angle: float) -> str:
    """The words for the direction of a grain in the picture, radians."""
    return DIRECTION_WORDS[round((angle % math.pi) / (math.pi / 4)) % 4]
