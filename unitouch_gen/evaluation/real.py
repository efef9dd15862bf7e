"""What can be read off touches of real objects, beside what needs no training at all."""

from collections.abc import Mapping
from statistics import mean

import numpy as np
from torch import Tensor

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.evaluation.classification import PROBED
from unitouch_gen.evaluation.contacts import EvaluationSet
from unitouch_gen.evaluation.probing import check_probed, object_probes
from unitouch_gen.evaluation.tables import Table


def real_table(one: EvaluationSet, beside: Mapping[str, str] | None = None) -> Table:
    """Balanced accuracy of every label by ridge probes, each object predicted from the others; and their mean.

    Args:
        one: Its contacts are in the split "test"; those count of which every label is known.
        beside: Rows of more encoders, by the names of their features.

    Raises:
        InvalidInputError: If it has no labels, or one of a single class or object.
    """
    truth, objects, known = labelled_alike(one)
    contacts, columns = one.splits["test"], [*truth, *(["mean"] if len(truth) > 1 else [])]
    chance = {name: 100.0 / len(np.unique(labels)) for name, labels in truth.items()}
    rows = {"chance": {name: [share] for name, share in {**chance, "mean": mean(chance.values())}.items()}}
    deviations = []
    for name, row in {**PROBED, **(beside or {})}.items():
        if each := contacts.by_seed(name) if name in PROBED else [contacts.features[name]]:
            found = [object_probes(features.double().numpy()[known], truth, objects) for features in each]
            rows[row] = {column: [100.0 * one[column] for one in found] for column in columns}
            deviations.append(f"{row} {100 * mean(one['deviation'] for one in found):.1f}")
    return Table(
        "real", f"Labels of {one.name}", "balanced accuracy, %", dict.fromkeys(columns, ""), rows,
        notes=[f"{known.sum()} of {len(known)} touches, which have every label, of {len(np.unique(objects))} objects, "
               "each predicted from the others.",
               f"Deviations of the mean over draws of objects: {', '.join(deviations)}."],
        beside={PROBED["touch"]: [row for row in rows if row != PROBED["touch"]]},
    )  # fmt: skip


def labelled_alike(one: EvaluationSet) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """The labels by name, int64 (K,), and the objects (K,), of touches of which every label is known, and which they
    are, (N,); it takes none of the features.

    Raises:
        InvalidInputError: If there are none, or a label has a single class, or they a single object.
    """
    contacts = one.splits["test"]
    known = np.array([bool(row) and min(row) >= 0 for row in zip(*map(Tensor.tolist, contacts.labels.values()))])
    if not known.any():
        raise InvalidInputError(
            f"Data set {one.name!r} has no touch of which every label is known, of {', '.join(one.classes) or 'none'}; "
            "name labels in columns of its table."
        )
    truth = {name: labels.numpy()[known] for name, labels in contacts.labels.items()}
    objects = contacts.objects.numpy()[known]
    for name, labels in truth.items():
        check_probed(labels, objects, f"Data set {one.name!r} has {name}")
    return truth, objects, known
