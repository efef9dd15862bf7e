"""Table 4 of the paper: pictures, sounds and captions of the same object, found by a touch."""

from collections import defaultdict
from collections.abc import Sequence

import torch

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.evaluation.contacts import EvaluationSet
from unitouch_gen.evaluation.controls import class_means, others
from unitouch_gen.evaluation.retrieval import CORRELATED, correlated, mean_average_precision
from unitouch_gen.evaluation.tables import Table

FOUND = {"image": "picture", "audio": "sound", "text": "caption"}

OWN = "touch encoder"
"""The row that is the model's."""

PAPER = {
    row: dict(zip(("touch to vision", "touch to audio", "touch to text"), values, strict=True))
    for row, values in {
        "chance": (1.0, 1.0, 1.0),
        "CCA": (17.8, 15.7, 16.8),
        "PLSCA": (16.8, 15.9, 18.2),
        "DSCMR": (26.5, 19.6, 22.7),
        "DAR": (32.3, 27.8, 31.9),
        "UniTouch, zero-shot": (41.9, 37.9, 38.0),
    }.items()
}


def retrieval_table(sets: Sequence[EvaluationSet]) -> Table:
    """Mean average precision of contacts of the same object, by touches of objects that nothing was fitted to.

    CCA and PLSCA are fitted to pairs of the training split: to plain statistics of touches, and to the touch encoder's
    embeddings, each with the frozen embeddings of the other modality.

    Raises:
        InvalidInputError: If no set has another modality than touch.
    """
    check_modalities(sets)
    rows: dict[str, dict[str, list[float]]] = {}
    seeds = list(dict.fromkeys(one.seed for one in sets))
    for seed in seeds:
        for known in (True, False):
            of_group = [one for one in sets if one.seed == seed and one.known == known]
            found: dict[tuple[str, str], list[float]] = defaultdict(list)
            for one in of_group:
                for modality in (name for name in FOUND if name in one.splits["test"].features):
                    for row, value in _of_set(one, modality).items():
                        found[row, _column(modality, known)].append(100.0 * value)
            for (row, column), values in found.items():
                rows.setdefault(row, {}).setdefault(column, []).append(sum(values) / len(values))
    columns = {_column(modality, known): "" for known in (True, False) for modality in FOUND}
    return Table(
        "retrieval", "Pictures, sounds and captions found by touch (Table 4)", "mean average precision, %",
        {column: "" for column in columns if any(column in row for row in rows.values())}, rows, paper=PAPER,
        beside={OWN: [row for row in rows if row != OWN]},
        notes=["All contacts of an object count as right; no object is in two splits.",
               "Means over sets of sensors that the model knows, in domain, and of others.",
               "The class mean is told each contact's material: it says what a word of it would find."],
    )  # fmt: skip


def check_modalities(sets: Sequence[EvaluationSet]) -> None:
    """Refuses sets of which none has another modality than touch; it takes the names of features alone."""
    if not any(name in one.splits["test"].features for one in sets for name in FOUND):
        raise InvalidInputError(
            "No data set has pictures, sounds or captions that the model knows beside its touches; pass one that has."
        )


def _column(modality: str, known: bool) -> str:
    return f"{FOUND[modality]}, {'in' if known else 'out of'} domain"


def _of_set(one: EvaluationSet, modality: str) -> dict[str, float]:
    train, test = one.splits.get("train"), one.splits["test"]
    touch, other, objects = test.features["touch"], test.features[modality], test.objects

    def precision(queries: torch.Tensor, gallery: torch.Tensor = other) -> float:
        return mean_average_precision(queries, gallery, objects, objects)

    found = {"chance (another contact's touch)": precision(touch[others(len(touch))])}
    if "material" in test.labels and bool((test.labels["material"] >= 0).all()):  # known of every contact
        found["class mean"] = precision(class_means(touch, test.labels["material"]))
    for name, what in (("statistics", "plain statistics"), ("touch", "touch encoder")):
        if train is not None and name in train.features and modality in train.features:
            known = train.features[name], train.features[modality]
            for method in CORRELATED:
                found[f"{method} of {what}, supervised"] = precision(
                    *correlated(method, *known, test.features[name], other)
                )
    found[OWN] = precision(touch)
    return found
