"""Questions about contacts, with answers that are true of the draws and of what is measured of them."""

import math

from torch import Tensor

from unitouch_gen.world.attributes import ATTRIBUTES
from unitouch_gen.world.captions import HARDNESS_WORDS, ROUGHNESS_WORDS, described, direction_word, word_below
from unitouch_gen.world.draws import Draws
from unitouch_gen.world.materials import MATERIALS, Material
from unitouch_gen.world.scene import YIELD, grasp_margin

QUESTIONS: dict[str, tuple[str, ...]] = {
    "caption": ("Describe it.", "What is seen and felt?", "What can you say of this touch?"),
    "material": ("What is it?", "What is it made of?", "Which material is this?"),
    "feel": ("How does it feel?", "What does the surface feel like?", "How rough and how hard is it?"),
    "place": ("Where is the contact?", "Where does it touch the gel?", "Which part of the gel is touched?"),
    "grain": ("Which way does the grain run?", "What is the direction of the grain?", "How does its grain lie?"),
    "grasp": ("Would a grasp hold?", "Could a gripper lift it by this?", "Will it slip when it is lifted?"),
}
"""Topics, and how each may be asked about."""

UNTOLD = 0.12  # share of the view in contact below which the material cannot be told
PLACE = ("cover", "place x", "place y")
ALL_OVER, CENTRED = 0.9, 0.12  # share above which contact is all over; distance, half views, of a contact in the centre


def answered(draws: Draws, attributes: Tensor, variant: int = 0) -> list[dict[str, tuple[str, str]]]:
    """A question and its answer of each contact and topic; variants ask and describe in other words.

    Args:
        draws: Of N contacts.
        attributes: Theirs under a sensor, or the mean over several, (N, 13); see `ATTRIBUTES`.
        variant: From 0.
    """
    measured = dict(zip(ATTRIBUTES, attributes.T.tolist(), strict=True))
    depth = draws.indentation_depth * (1.0 - YIELD * draws.compliance)
    cover = attributes[:, ATTRIBUTES.index("cover")]
    holds = (grasp_margin(draws.of_material("friction"), draws.weight, depth, cover) > 1.0).tolist()
    captions, found = described(draws, variant), []
    for row in range(len(draws)):
        spec, place = MATERIALS[int(draws.material[row])], (measured[name][row] for name in PLACE)
        asked = {topic: wordings[(row + variant) % len(wordings)] for topic, wordings in QUESTIONS.items()}
        agreed = holds[row] != ("slip" in asked["grasp"])
        answers = {
            "caption": f"{captions[row]}.",
            "material": f"it is {spec.name}." if measured["cover"][row] >= UNTOLD else "that cannot be told.",
            "feel": feel_answer(spec, float(draws.amplitude[row]), float(draws.compliance[row])),
            "place": place_answer(*place),
            "grain": f"it is {direction_word(float(draws.angle[row]))}." if spec.grained else "it has no grain.",
            "grasp": f"{'yes' if agreed else 'no'}, it would {'hold' if holds[row] else 'slip'}.",
        }
        found.append({topic: (asked[topic], answer) for topic, answer in answers.items()})
    return found


def feel_answer(spec: Material, amplitude: float, compliance: float) -> str:
    """Roughness, hardness, a word for the texture, and how its bumps are."""
    roughness = word_below(ROUGHNESS_WORDS, spec.roughness * amplitude)
    bumps = "regular" if spec.regular else "irregular"
    return f"it feels {roughness}, {word_below(HARDNESS_WORDS, compliance)} and {spec.feel[0]}, with {bumps} bumps."


def place_answer(cover: float, x: float, y: float) -> str:
    """Where the middle of the contact lies, in half views; y points down, as in a picture."""
    if cover > ALL_OVER:
        return "all over the view."
    if math.hypot(x, y) < CENTRED:
        return "in the centre."
    return ("to the left.", "to the right.")[x > 0] if abs(x) > abs(y) else ("above.", "below.")[y > 0]


def asked_of(draws: Draws, attributes: Tensor, captions: int = 8) -> list[dict[str, tuple[str, list[str]]]]:
    """A question of each contact and topic, and what is true of it: one answer, or several captions."""
    found = [
        {topic: (question, [answer]) for topic, (question, answer) in one.items()}
        for one in answered(draws, attributes)
    ]
    for variant in range(1, captions):
        for one, caption in zip(found, described(draws, variant), strict=True):
            one["caption"][1].append(f"{caption}.")
    return found
