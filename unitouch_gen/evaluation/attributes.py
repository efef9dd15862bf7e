"""Agreement in what can be measured of a contact: read from images by an independent regressor, against the truth."""

from collections.abc import Sequence

import torch
from torch import Tensor

from unitouch_gen.errors import check_tensor
from unitouch_gen.evaluation.controls import Controlled, others

GRAIN, PLACE = ("grain x", "grain y"), ("place x", "place y")
"""Attributes that are two numbers each; see `unitouch_gen.world.ATTRIBUTES`."""

CLEAR = 0.3
"""Length of the pair above which a grain has a direction; 1 is all one way."""

NEAR = 20.0
"""Degrees within which two directions agree; 22 % of all are."""


def attribute_agreement(read: Tensor, truth: Tensor, names: Sequence[str]) -> dict[str, float]:
    """How well values agree with the truth, by attribute.

    Args:
        read: (N, K).
        truth: (N, K), of which some are to have a clear direction.
        names: Of the K attributes.

    Returns:
        Of numbers Pearson's correlation, 0 where one does not vary, as what is drawn from many possible ones may be
        right although it differs; of the direction the share within 20 degrees ("grain within 20") and the median angle
        ("grain degrees"), over contacts that have one; of the place the median distance ("place apart"), half views.

    Raises:
        InvalidInputError, InvalidTypeError: If shapes do not fit.
    """
    check_tensor("truth", truth, "N", len(names))
    check_tensor("read", read, *truth.shape)
    columns = {name: (read[:, column].double(), truth[:, column].double()) for column, name in enumerate(names)}
    found = {
        name: torch.corrcoef(torch.stack(pair))[0, 1].nan_to_num(0.0).item()
        for name, pair in columns.items()
        if name not in (*GRAIN, *PLACE)
    }
    if set(GRAIN) <= set(names):
        (read_x, true_x), (read_y, true_y) = (columns[name] for name in GRAIN)
        clear = true_x.hypot(true_y) > CLEAR
        turned = torch.rad2deg(torch.atan2(read_y, read_x) - torch.atan2(true_y, true_x))[clear] / 2  # a double angle
        apart = ((turned + 90.0) % 180.0 - 90.0).abs()
        found |= {"grain within 20": (apart <= NEAR).double().mean().item(), "grain degrees": apart.median().item()}
    if set(PLACE) <= set(names):
        (read_x, true_x), (read_y, true_y) = (columns[name] for name in PLACE)
        found["place apart"] = (read_x - true_x).hypot(read_y - true_y).median().item()
    return found


def controlled_agreement(
    read: Tensor, truth: Tensor, usual: Tensor, real: Tensor | None, names: Sequence[str]
) -> dict[str, Controlled]:
    """`attribute_agreement` with its controls.

    Args:
        read, truth, names: See there.
        usual: The best that a class can tell, (N, K): `class_means` of the truth of other contacts.
        real: What is read from real images, (N, K): the ceiling; `None` where that is not known.
    """
    sets = [read, usual, read[others(len(read))], *([] if real is None else [real])]
    measured = [attribute_agreement(values, truth, names) for values in sets]
    return {key: Controlled(*(one[key] for one in measured)) for key in measured[0]}
