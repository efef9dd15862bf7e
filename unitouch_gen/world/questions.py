"""Questions about contacts, with answers that are true of the draws and of what is measured of them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from torch import Tensor

from unitouch_gen.world import captions
from unitouch_gen.world.attributes import ATTRIBUTES
from unitouch_gen.world.draws import Draws
from unitouch_gen.world.materials import MATERIALS
from unitouch_gen.world.scene import YIELD, grasp_margin


@dataclass(frozen=True)
class Topic:
    """What can be asked about contacts, and what tells answers apart in figures."""

    questions: tuple[str, ...]  # how it may be asked about
    figure: str = ""  # name of the share of answers that are right; none for free text
    words: Mapping[str, str] = field(default_factory=dict)  # in answers, with what each stands for; else materials
    balanced: bool = False  # whether the share is the mean over what is true, however rare


TOPICS: dict[str, Topic] = {
    "caption": Topic(("Describe it.", "What is seen and felt?", "What can you say of this touch?")),
    "material": Topic(("What is it?", "What is it made of?", "Which material is this?"), "material"),
    "feel": Topic(
        ("How does it feel?", "What does the surface feel like?", "How rough and how hard is it?"),
        "hard or soft",
        {word: ("soft", "hard")[word in ("hard", "firm")] for word in captions.HARDNESS_WORDS},
        True,
    ),
    "place": Topic(
        ("Where is the contact?", "Where does it touch the gel?", "Which part of the gel is touched?"),
        "contact place",
        {word: word for word in ("all over", "centre", "left", "right", "above", "below")},
    ),
    "grain": Topic(
        ("Which way does the grain run?", "What is the direction of the grain?", "How does its grain lie?"),
        "grain",
        {word: word for word in captions.DIRECTION_WORDS},
    ),
    "grasp": Topic(
        ("Would a grasp hold?", "Could a gripper lift it by this?", "Will it slip when it is lifted?"),
        "grasp",
        {"hold": "hold", "slip": "slip"},
        True,
    ),
}
"""By name; `answered` says what is true of each."""

UNTOLD = 0.12  # share of the view in contact below which the material cannot be told
ALL_OVER = 0.9  # share of the view above which contact is all over
CENTRED = 0.12  # distance, half views, within which a contact is in the centre


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
    sentences = captions.described(draws, variant)
    found = []
    for row in range(len(draws)):
        spec = MATERIALS[int(draws.material[row])]
        asked = {name: topic.questions[(row + variant) % len(topic.questions)] for name, topic in TOPICS.items()}
        roughness = captions.word_below(captions.ROUGHNESS_WORDS, spec.roughness * float(draws.amplitude[row]))
        hardness = captions.word_below(captions.HARDNESS_WORDS, float(draws.compliance[row]))
        grain = captions.direction_word(float(draws.angle[row]))
        felt = f"it feels {roughness}, {hardness} and {spec.feel[0]}, with "
        felt += "regular bumps." if spec.regular else "irregular bumps."
        if draws.surface[row] >= 0:  # of a scan, only what is measured of it is said
            felt = f"it feels {roughness} and {hardness}."
        agreed = holds[row] != ("slip" in asked["grasp"])
        answers = {
            "caption": f"{sentences[row]}.",
            "material": f"it is {spec.name}." if measured["cover"][row] >= UNTOLD else "that cannot be told.",
            "feel": felt,
            "place": place_answer(*(measured[name][row] for name in ("cover", "place x", "place y"))),
            "grain": f"it is {grain}." if captions.is_grained(draws, row) else "it has no grain.",
            "grasp": f"{'yes' if agreed else 'no'}, it would {'hold' if holds[row] else 'slip'}.",
        }
        found.append({topic: (question, answers[topic]) for topic, question in asked.items()})
    return found


def place_answer(cover: float, x: float, y: float) -> str:
    """Where the middle of the contact lies, in half views; y points down, as in a picture."""
    if cover > ALL_OVER:
        return "all over the view."
    if math.hypot(x, y) < CENTRED:
        return "in the centre."
    return ("to the left.", "to the right.")[x > 0] if abs(x) > abs(y) else ("above.", "below.")[y > 0]


def asked_of(draws: Draws, attributes: Tensor, wordings: int = 8) -> list[dict[str, tuple[str, list[str]]]]:
    """A question of each contact and topic, and what is true of it: one answer, or several captions."""
    first = answered(draws, attributes)
    found = [{topic: (question, [answer]) for topic, (question, answer) in one.items()} for one in first]
    for variant in range(1, wordings):
        for one, caption in zip(found, captions.described(draws, variant), strict=True):
            one["caption"][1].append(f"{caption}.")
    return found
