"""Tables 2, 3 and 7 of the paper: materials and grasps, zero-shot and by linear probes, and six ways of asking."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.evaluation.contacts import SPLITS, Contacts, EvaluationSet
from unitouch_gen.evaluation.probing import linear_probe, share_right
from unitouch_gen.evaluation.tables import Table
from unitouch_gen.evaluation.zero_shot import PROMPTS, zero_shot_scores

Embed = Callable[[Sequence[str]], Tensor]
"""Unit embeddings (N, D) of texts."""

PROBED = {
    "gel": "untouched gel, probe",
    "statistics": "plain statistics, probe",
    "relief": "statistics of the relief, probe",
    "untrained": "untrained encoder, probe",
    "supervised": "supervised classifier of touches, probe",
    "touch": "touch encoder, probe",
}
"""Rows of linear probes, by features."""

ASKED = {
    "touch": "touch encoder, zero-shot",
    "image": "picture of the contact, zero-shot",
    "outcome": "picture of what came of it, zero-shot",
}
"""Rows of zero-shot classification, by features."""

GRASP_PROMPTS = {"dropped": "the object is falling on the ground", "lifted": "the object is lifted in the air"}
"""Section 4.2 of the paper; by the name of the class."""

TEMPLATES = (
    "this is an image of {}",
    "this is a touch image of {}",
    "this looks like {}",
    "this feels like {}",
    "image of {}",
    "touch of {}",
)
"""The prompts of Table 7 of the paper."""

PAPER_SETS = ("Touch and Go", "ObjectFolder 2.0", "YCB-Slide", "ObjectFolder 1.0", "ObjectFolder Real", "SSVTP")

PAPER = {
    "material": {
        row: dict(zip(PAPER_SETS, shares, strict=False))
        for row, shares in {
            "chance": (5.0, 14.2, 10.0, 14.2, 14.2, 16.6),
            "supervised, probe": (47.1, 70.3, 72.3, 37.5, 54.8, 73.4),
            "VT-CMC on one, probe": (56.5, 74.3, 75.2),
            "SSVTP on one, probe": (47.6, 69.8, 74.8),
            "VT-CMC on all, probe": (49.2, 70.3, 69.5, 33.8, 48.1, 68.5),
            "SSVTP on all, probe": (43.8, 68.9, 67.4, 35.1, 49.7, 66.8),
            "UniTouch, probe": (61.3, 85.4, 78.1, 41.3, 61.2, 77.4),
            "UniTouch, zero-shot": (52.7, 43.5, 66.4, 32.7, 33.2, 60.9),
        }.items()
    },
    "grasp": {
        row: dict(zip(("Feeling of Success", "ObjectFolder 2.0", "ObjectFolder 1.0"), shares, strict=False))
        for row, shares in {
            "chance": (52.3, 52.0, 50.7),
            "supervised, probe": (75.9, 70.1, 68.9),
            "VT-CMC on one, probe": (80.1, 74.8),
            "SSVTP on one, probe": (80.3, 74.0),
            "VT-CMC on all, probe": (66.1, 65.8, 67.2),
            "SSVTP on all, probe": (65.8, 64.2, 65.3),
            "UniTouch, probe": (82.3, 78.1, 75.8),
            "UniTouch, zero-shot": (65.5, 64.3, 64.7),
        }.items()
    },
    "prompts": {
        template: {"Touch and Go": one, "ObjectFolder 2.0": other}
        for template, one, other in zip(
            TEMPLATES, (40.7, 43.8, 49.3, 52.7, 48.8, 51.2), (34.3, 36.8, 41.7, 43.5, 40.3, 40.9), strict=True
        )
    },
}  # fmt: skip


def material_table(sets: Sequence[EvaluationSet], embed: Embed, template: str = PROMPTS["touch"]) -> Table:
    """Table 2: material of held-out touches.

    Args:
        sets: With the label "material", of one or several seeds.
        embed: Of the joint space; classes are asked for by `template`.
        template: What a class is put into.

    Raises:
        InvalidInputError: If a set lacks the label, or has a single class.
    """
    rows = classified(sets, "material", lambda one: embed([template.format(name) for name in one]))
    return Table(
        "material", "Material of touches (Table 2)", "accuracy, %", columns_of(sets), rows,
        notes=[f"Zero-shot asks by {template!r}; probes are fitted to other objects of the same sensor."],
        paper=PAPER["material"], beside=_beside(rows),
    )  # fmt: skip


def grasp_table(sets: Sequence[EvaluationSet], embed: Embed) -> Table:
    """Table 3: whether a grasp holds, of a touch before it, with classes weighed alike, as most hold.

    Args:
        sets: With the label "grasp", of classes "dropped" and "lifted".
        embed: Of the joint space.

    Raises:
        InvalidInputError: If a set lacks the label, has a single class, or has others.
    """
    check_grasps(sets)
    rows = classified(sets, "grasp", lambda names: embed([GRASP_PROMPTS[name] for name in names]), balanced=True)
    return Table(
        "grasp", "Whether a grasp holds (Table 3)", "balanced accuracy, %", columns_of(sets), rows,
        notes=[f"Zero-shot asks by {' and '.join(map(repr, GRASP_PROMPTS.values()))}."],
        paper=PAPER["grasp"], beside=_beside(rows),
    )  # fmt: skip


def prompts_table(sets: Sequence[EvaluationSet], embed: Embed, templates: Sequence[str] = TEMPLATES) -> Table:
    """Table 7: zero-shot materials by several templates.

    Raises:
        InvalidInputError: If a set lacks the label "material".
    """
    rows: dict[str, dict[str, list[float]]] = {}
    for one in sets:
        test, known = labelled(one, "test", "material")
        names, shares = one.classes["material"], {"chance": 1 / len(known.unique())}
        for template in templates:
            predicted = named(test.features["touch"], embed([template.format(name) for name in names]), known)
            shares[template] = share_right(predicted, known)
        for row, share in shares.items():
            rows.setdefault(row, {}).setdefault(one.name, []).append(100.0 * share)
    seen = [("a touch image", "an image"), ("feels", "looks"), ("touch", "image")]
    images = {template: template for template in templates}
    for felt, looked in seen:
        images = {template: image.replace(felt, looked) for template, image in images.items()}
    return Table(
        "prompts", "Six ways to ask (Table 7)", "zero-shot accuracy, %", columns_of(sets), rows, paper=PAPER["prompts"],
        beside={template: [image] for template, image in images.items() if image in rows and image != template},
    )  # fmt: skip


def _beside(rows: Mapping[str, Any]) -> dict[str, list[str]]:
    """Rows of the touch encoder, and what they should be better than: probes of all else, and guesses."""
    guesses, own = ["chance", "majority"], PROBED["touch"]
    others = [row for row in PROBED.values() if row in rows and row != own]
    return {own: [*guesses, *others], ASKED["touch"]: guesses}


def classified(
    sets: Sequence[EvaluationSet], label: str, embed: Embed, *, balanced: bool = False
) -> dict[str, dict[str, list[float]]]:
    """Percentages of right classes of the test split by method, set and seed; see `share_right`."""
    rows: dict[str, dict[str, list[float]]] = {}
    for one in sets:
        (train, fitted), (val, chosen), (test, known) = (labelled(one, split, label) for split in SPLITS)
        found = {"chance": None, "majority": torch.full_like(known, int(torch.bincount(fitted).argmax()))}
        found |= {
            row: linear_probe(
                train.features[name], fitted, val.features[name], chosen, test.features[name], balanced=balanced
            )
            for name, row in PROBED.items()
            if name in test.features
        }
        classes = embed(one.classes[label])
        for name, row in ASKED.items():
            if name in test.features and (name != "outcome" or label == "grasp"):
                found[row] = named(test.features[name], classes, known)
        for row, predicted in found.items():
            right = 1 / len(known.unique()) if predicted is None else share_right(predicted, known, balanced=balanced)
            rows.setdefault(row, {}).setdefault(one.name, []).append(100.0 * right)
    return rows


def named(features: Tensor, classes: Tensor, known: Tensor) -> Tensor:
    """The class (N,) among those that there are whose text is nearest."""
    asked = known.unique()
    return asked[zero_shot_scores(features, classes[asked]).argmax(dim=1)]


def check_labels(sets: Sequence[EvaluationSet], label: str, splits: Sequence[str] = SPLITS) -> None:
    """Refuses sets that a table of a label cannot be of, which takes none of their features; see `labelled`."""
    for one in sets:
        for split in splits:
            labelled(one, split, label)


def check_grasps(sets: Sequence[EvaluationSet]) -> None:
    """The same of "grasp", whose classes have to be those that the paper has prompts for."""
    check_labels(sets, "grasp")
    for one in sets:
        if other := sorted({*one.classes["grasp"]} - {*GRASP_PROMPTS}):
            raise InvalidInputError(
                f"Data set {one.name!r} has grasps that are {', '.join(other)}; call them {' or '.join(GRASP_PROMPTS)}."
            )


def labelled(one: EvaluationSet, split: str, label: str) -> tuple[Contacts, Tensor]:
    """The contacts of a split whose label is known, and the labels.

    Raises:
        InvalidInputError: If there is no such split or label, or there are fewer than two classes.
    """
    if split not in one.splits or label not in one.classes:
        raise InvalidInputError(
            f"Data set {one.name!r} has the labels {', '.join(one.classes) or 'none'} and the splits "
            f"{', '.join(one.splits)}; this table needs {label!r} in a split {split!r}."
        )
    contacts = one.splits[split]
    rows = contacts.labels[label] >= 0
    known = contacts.labels[label][rows]
    if len(known.unique()) < 2:
        count = "a single class" if len(known) else "no class"
        raise InvalidInputError(
            f"Data set {one.name!r} has {count} of {label} in its {split} split; two are the least. Bring more "
            "objects, or say in a column `split` which of them are to train, val and test."
        )
    features = {name: values[rows] for name, values in contacts.features.items()}
    return Contacts(features, {label: known}, contacts.objects[rows]), known


def columns_of(sets: Sequence[EvaluationSet]) -> dict[str, str]:
    """A column for each set, those of a known sensor first."""
    names = {one.name: "in domain" if one.known else "out of domain" for one in sets}
    return dict(sorted(names.items(), key=lambda pair: pair[1] != "in domain"))
