"""Questions about contacts, with answers that are true by their draws and measured attributes."""

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
    """A topic of questions, and how its answers are scored."""

    questions: tuple[str, ...]  # wordings of the question
    figure: str = ""  # name of the accuracy in reports; empty for free text, which is not scored
    words: Mapping[str, str] = field(default_factory=dict)  # words of answers and their classes; materials if empty
    balanced: bool = False  # whether the accuracy is the mean over the true classes


TOPICS: dict[str, Topic] = {
    "caption": Topic(("Describe it.", "What is seen and felt?", "What can you say of this touch?")),
    "material": Topic(("What is it?", "What is it made of?", "Which material is this?"), figure="material"),
    "feel": Topic(
        ("How does it feel?", "What does the surface feel like?", "How rough and how hard is it?"),
        figure="hard or soft",
        words={"hard": "hard", "firm": "hard", "yielding": "soft", "soft": "soft"},
        balanced=True,
    ),
    "place": Topic(
        ("Where is the contact?", "Where does it touch the gel?", "Which part of the gel is touched?"),
        figure="contact place",
        words={word: word for word in ("all over", "centre", "left", "right", "above", "below")},
    ),
    "grain": Topic(
        ("Which way does the grain run?", "What is the direction of the grain?", "How does its grain lie?"),
        figure="grain",
        words={word: word for word in captions.DIRECTION_WORDS},
    ),
    "grasp": Topic(
        ("Would a grasp hold?", "Could a gripper lift it by this?", "Will it slip when it is lifted?"),
        figure="grasp",
        words={"hold": "hold", "slip": "slip"},
        balanced=True,
    ),
}
"""Topics by name; `answered` has the true answers."""

UNTOLD = 0.12  # share of the view in contact below which the answer to "material" is that it cannot be told
ALL_OVER = 0.9  # share of the view above which contact is all over
CENTRED = 0.12  # distance, half views, within which a contact is in the centre


def answered(draws: Draws, attributes: Tensor, variant: int = 0) -> list[dict[str, tuple[str, str]]]:
    """A question and its true answer, by topic, for each contact.

    Args:
        draws: Of N contacts.
        attributes: Of the contacts, under one sensor or the mean over several, (N, 13); see `ATTRIBUTES`.
        variant: Number of the wording, >= 0.
    """
    measured = dict(zip(ATTRIBUTES, attributes.T.tolist(), strict=True))
    depth = draws.indentation_depth * (1.0 - YIELD * draws.compliance)
    cover = attributes[:, ATTRIBUTES.index("cover")]
    holds = (grasp_margin(draws.of_material("friction"), draws.weight, depth, cover) > 1.0).tolist()
    sentences = captions.described(draws, variant)
    rows = []
    for row in range(len(draws)):
        spec = MATERIALS[int(draws.material[row])]
        questions = {name: topic.questions[(row + variant) % len(topic.questions)] for name, topic in TOPICS.items()}
        answers = {
            "caption": f"{sentences[row]}.",
            "material": f"it is {spec.name}." if measured["cover"][row] >= UNTOLD else "that cannot be told.",
            "feel": feel_answer(draws, row),
            "place": place_answer(measured["cover"][row], measured["place x"][row], measured["place y"][row]),
            "grain": grain_answer(draws, row),
            "grasp": grasp_answer(questions["grasp"], holds[row]),
        }
        rows.append({topic: (question, answers[topic]) for topic, question in questions.items()})
    return rows


def feel_answer(draws: Draws, row: int) -> str:
    """Roughness and hardness and, of a drawn surface, the material's words; those of a scan are not measured."""
    spec = MATERIALS[int(draws.material[row])]
    roughness = captions.word_below(captions.ROUGHNESS_WORDS, spec.roughness * float(draws.amplitude[row]))
    hardness = captions.word_below(captions.HARDNESS_WORDS, float(draws.compliance[row]))
    if draws.surface[row] >= 0:
        return f"it feels {roughness} and {hardness}."
    bumps = "regular bumps" if spec.regular else "irregular bumps"
    return f"it feels {roughness}, {hardness} and {spec.feel[0]}, with {bumps}."


def place_answer(cover: float, x: float, y: float) -> str:
    """The place of the middle of the contact, in half views; y points down, as in a picture."""
    if cover > ALL_OVER:
        return "all over the view."
    if math.hypot(x, y) < CENTRED:
        return "in the centre."
    if abs(x) > abs(y):
        return "to the right." if x > 0 else "to the left."
    return "below." if y > 0 else "above."


def grain_answer(draws: Draws, row: int) -> str:
    """The direction of the grain, if there is one."""
    if not captions.is_grained(draws, row):
        return "it has no grain."
    return f"it is {captions.direction_word(float(draws.angle[row]))}."


def grasp_answer(question: str, holds: bool) -> str:
    """Whether a grasp would hold, after yes or no to the question whether it would hold or slip."""
    agrees = holds != ("slip" in question)
    return f"{'yes' if agrees else 'no'}, it would {'hold' if holds else 'slip'}."


def asked_of(draws: Draws, attributes: Tensor, wordings: int = 8) -> list[dict[str, tuple[str, list[str]]]]:
    """A question and its true answers, by topic, for each contact: one answer, or `wordings` captions."""
    rows: list[dict[str, tuple[str, list[str]]]] = []
    for by_topic in answered(draws, attributes):
        rows.append({topic: (question, [answer]) for topic, (question, answer) in by_topic.items()})
    for variant in range(1, wordings):
        for row, caption in zip(rows, captions.described(draws, variant), strict=True):
            _, answers = row["caption"]
            answers.append(f"{caption}.")
    return rows
