"""Out-of-distribution scores: whether an input is like those that a modality's encoder was trained on.

Distances are Mahalanobis', of features to the nearest class of known inputs (Lee et al., 2018, Eq. 2), and how much
nearer features are to examples of inputs that do not belong (outlier exposure, Hendrycks et al., 2019). Gels at rest
lie among touches that press evenly, so a logistic regression tells them apart, and no distance. Of a text it counts the
tokens that none of its encoder's captions had, which embeddings hide. What people are told of such inputs is here, too.
"""

import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from unitouch_gen.errors import InvalidInputError, UnfamiliarInputWarning

if TYPE_CHECKING:  # models/joint.py imports this file
    from unitouch_gen.models.joint import UniTouchModel
    from unitouch_gen.models.sensors import SensorMatch

UNLIKE, UNTOUCHED = "unlike anything known", "nothing is touched"
"""Why a model abstains from naming an input."""

KNOWN = "known"
"""The group of inputs that an encoder was trained on."""

SCORES: tuple[str, ...] = ("distance", "foreign", "untouched")
"""Out-of-distribution scores: the distance to what is known, how much nearer features are to inputs of another
modality, and how far they lie in the direction of gels at rest."""

SHARE_AT_REST = 5 / 6
"""Of the known inputs that a model abstains from, those that it takes for gels at rest: foreign inputs are told from
known ones with fewer mistakes."""

MOST_UNSEEN = 0.5
"""Share of a text's tokens that no caption had, above which it is unlike any."""

BLUR, WIDE = 14, 8
"""Detail is what a blur over one part in so many of the side leaves out; a picture's wide parts are so many a side."""

SIDE, CELL = 32, 4
"""A touch is compared to its background at so many pixels a side, in cells of so many."""

LEAST_CHANGE = 2.5 / 255
"""By which the cell that changed most differs from the gel at rest where something touches it, of full scale.

Compression alone makes 1 to 2 levels of 255 in recordings of a GelSight; its lightest contacts, with soft sponges, make
no more."""


class Gaussians(nn.Module):
    """Gaussians of one covariance, for the squared Mahalanobis distance to the nearest of their means.

    Args:
        classes: C, of the means.
        width: F, of the features.
    """

    means: Tensor
    whitening: Tensor

    def __init__(self, classes: int, width: int):
        super().__init__()
        self.register_buffer("means", torch.zeros(classes, width))
        self.register_buffer("whitening", torch.zeros(width, width))

    @classmethod
    def of(cls, features: Tensor, labels: Tensor | None = None, shrinkage: float = 0.1) -> Self:
        """Fits them.

        Args:
            features: (N, F).
            labels: Class of each, int64 (N,); one class if left out.
            shrinkage: Share of the covariance, of features in units of their deviation, that is the unit matrix.

        Raises:
            InvalidInputError: If there are no more than one.
        """
        if len(features) < 2:
            raise InvalidInputError(f"`features` are {len(features)}; two are the least that have a covariance.")
        values = features.double()
        labels = torch.zeros(len(values), dtype=torch.long) if labels is None else labels
        names, rows = labels.unique(return_inverse=True)
        means = torch.stack([values[rows == row].mean(dim=0) for row in range(len(names))])
        deviation = values.std(dim=0).clamp_min(1e-6)
        rest = (values - means[rows]) / deviation
        covariance = rest.T @ rest / len(rest)
        width = len(covariance)
        covariance = (1.0 - shrinkage) * covariance + shrinkage * torch.eye(width, dtype=covariance.dtype)
        scale, axes = torch.linalg.eigh(covariance)
        made = cls(len(means), width)
        made.means.copy_(means)
        made.whitening.copy_(axes * scale.rsqrt() / deviation[:, None])
        return made

    def forward(self, features: Tensor) -> Tensor:
        """Squared distance of features (B, F) to the nearest mean, (B,)."""
        means, whitening = self.means.float(), self.whitening.float()
        centre = means.mean(dim=0)  # what is near 0 keeps its digits
        apart = torch.cdist((features.float() - centre) @ whitening, (means - centre) @ whitening)
        return apart.amin(dim=1).square()


class Direction(nn.Module):
    """A direction among features, by which examples that do not belong lie apart.

    Args:
        width: F, of the features.
    """

    centre: Tensor
    weight: Tensor

    def __init__(self, width: int):
        super().__init__()
        self.register_buffer("centre", torch.zeros(width))
        self.register_buffer("weight", torch.zeros(width))

    @classmethod
    def of(cls, centre: Tensor, weight: Tensor) -> Self:
        """Takes a centre (F,) and a direction (F,)."""
        made = cls(len(centre))
        made.centre.copy_(centre)
        made.weight.copy_(weight)
        return made

    def forward(self, features: Tensor) -> Tensor:
        """(features - centre) . weight of features (B, F), (B,)."""
        return (features.float() - self.centre.float()) @ self.weight.float()


class OutOfDistribution(nn.Module):
    """Scores of one modality's features, with the thresholds above which a model abstains.

    Args:
        groups: Gaussians of known inputs, `KNOWN`, and of others that do not belong, or the direction of these, by the
            name of their score.
        thresholds: By score, some of `SCORES`.
        vocabulary: Of a text encoder: which of its tokens some caption had, bool (V,).
    """

    vocabulary: Tensor | None

    def __init__(
        self,
        groups: Mapping[str, Gaussians | Direction],
        thresholds: Mapping[str, float],
        vocabulary: Tensor | None = None,
    ):
        super().__init__()
        self.groups, self.thresholds = nn.ModuleDict(groups), dict(thresholds)
        self.register_buffer("vocabulary", vocabulary)

    @classmethod
    def of(
        cls,
        groups: Mapping[str, Gaussians | Direction],
        validation: Tensor,
        share: float,
        vocabulary: Tensor | None = None,
    ) -> Self:
        """Chooses thresholds by known features that nothing was fitted to.

        Args:
            groups, vocabulary: See the class.
            validation: Known features, (N, F).
            share: Of them on which the model abstains, about; `SHARE_AT_REST` of it as "untouched", if there is such a
                score, and the rest of it equally by the others.
        """
        made = cls(groups, {name: 0.0 for name in SCORES if name == "distance" or name in groups}, vocabulary)
        at_rest = SHARE_AT_REST if "untouched" in groups else 0.0
        others = (1.0 - at_rest) / sum(name != "untouched" for name in made.thresholds)
        for scores, name in zip(made(validation).T, made.thresholds, strict=True):
            part = at_rest if name == "untouched" else others
            made.thresholds[name] = scores.quantile(1.0 - share * part).item()
        return made

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor], thresholds: Mapping[str, float]) -> Self:
        """Builds it of what `state_dict` gave.

        Raises:
            InvalidInputError: If one is missing.
        """
        needed = [KNOWN, *(name for name in thresholds if name != "distance")]
        groups: dict[str, Gaussians | Direction] = {
            name: kind(*tensors[key].shape)
            for name in needed
            for kind, key in ((Gaussians, f"groups.{name}.means"), (Direction, f"groups.{name}.weight"))
            if key in tensors
        }
        lacking = [name for name in needed if name not in groups]
        if lacking:
            raise InvalidInputError(f"it lacks `out_of_distribution` of {', '.join(lacking)}, which config.json names.")
        made = cls(groups, thresholds, tensors.get("vocabulary"))
        made.load_state_dict(dict(tensors))
        return made

    def forward(self, features: Tensor) -> Tensor:
        """Scores of features (B, F), (B, S): the larger, the less they belong to what is known."""
        known = self.groups[KNOWN](features)
        scores = []
        for name in self.thresholds:
            if name == "distance":
                scores.append(known)
            else:
                found = self.groups[name](features)
                scores.append(known - found if isinstance(self.groups[name], Gaussians) else found)
        return torch.stack(scores, dim=1)

    def reasons(self, features: Tensor, unseen: Tensor | None = None) -> list[str | None]:
        """Why the model abstains from naming each input; `None` where it does not.

        What looks like a gel at rest is one, whatever else it is unlike. Features that are not finite say nothing.

        Args:
            features: (B, F).
            unseen: Of texts, the share of their tokens that no caption had, (B,).
        """
        rows = self(features) > torch.tensor(list(self.thresholds.values()), device=features.device)
        names = [[name for name, over in zip(self.thresholds, row, strict=True) if over] for row in rows.tolist()]
        strange = [False] * len(names) if unseen is None else (unseen > MOST_UNSEEN).tolist()
        return [
            UNTOUCHED if "untouched" in row else UNLIKE if row or odd else None
            for row, odd in zip(names, strange, strict=True)
        ]


def share_of_unseen(vocabulary: Tensor, input_ids: Tensor, special: Sequence[int]) -> Tensor:
    """Share of each text's tokens that no caption had, its special ones left out, (B,).

    Args:
        vocabulary: Which tokens some caption had, bool (V,).
        input_ids: (B, T).
        special: Tokens that stand for no word.
    """
    words = ~torch.isin(input_ids, torch.tensor(special, device=input_ids.device))
    return (words & ~vocabulary[input_ids]).sum(dim=1) / words.sum(dim=1).clamp_min(1)


def pixel_statistics(pixels: Tensor) -> Tensor:
    """Mean and spread of each channel's wide parts, and how the channels' detail hangs together, (B, 12).

    Lamps of several colours show each slope in a channel of its own; shades of a picture darken all channels alike.

    Args:
        pixels: In [0, 1], (B, 3, H, W).
    """
    blur = max(3, max(pixels.shape[-2:]) // BLUR | 1)
    around = F.pad(pixels, (blur // 2,) * 4, mode="replicate")
    detail = (pixels - F.avg_pool2d(around, blur, 1)).flatten(2)
    covariance = (detail @ detail.mT / detail.shape[-1]).nan_to_num()
    covariance = covariance + 1e-9 * torch.eye(3, device=pixels.device)
    deviation = covariance.diagonal(dim1=1, dim2=2).sqrt()
    red, green, _ = (covariance / (deviation[:, :, None] * deviation[:, None])).unbind(dim=1)
    correlations = torch.stack([red[:, 1], red[:, 2], green[:, 2]], dim=1)
    axes = torch.linalg.eigvalsh(covariance).clamp_min(1e-9).log()
    wide = F.adaptive_avg_pool2d(pixels, WIDE).flatten(2)
    return torch.cat([pixels.mean(dim=(-2, -1)), wide.std(dim=2), correlations, axes], dim=1)


def is_untouched(touch: Tensor, background: Tensor) -> Tensor:
    """Whether touches hardly differ from their gel at rest, bool (B,); see `change_of`."""
    return change_of(touch, background).amax(dim=(-2, -1)) < LEAST_CHANGE


def change_of(touch: Tensor, background: Tensor) -> Tensor:
    """By how much each cell of touches differs from their gel at rest, of full scale, (B, 8, 8).

    Args:
        touch: In [0, 1], (B, 3, S, S), S at least 8.
        background: Of the same shape, or (1, 3, S, S).
    """
    change = (F.interpolate(touch, (SIDE, SIDE), mode="bilinear", antialias=True)
              - F.interpolate(background, (SIDE, SIDE), mode="bilinear", antialias=True)).abs()  # fmt: skip
    return F.avg_pool2d(change.mean(dim=1), CELL)


# What is said of them -------------------------------------------------------------------------------------------------

Unknown = dict[str, list[str | None]]
"""Why the model abstains from naming each input, by modality; `None` where it does not."""


def names_of(argument: str, count: int) -> list[str]:
    """What to call each of some inputs that came in one argument."""
    return [f"`{argument}`"] if count == 1 else [f"`{argument}[{row}]`" for row in range(count)]


def unfamiliar_touches(
    model: "UniTouchModel",
    matches: "Sequence[SensorMatch]",
    sensor: str | Sequence[str | None] | None,
    names: Sequence[str],
) -> str:
    """One line on the touches that are far from all sensors, by their colours; empty if there is none.

    For models that store no out-of-distribution scores. A sensor that was named is an answer and no doubt.

    Args:
        model: That the touches are for.
        matches: Their sensors.
        sensor: As it was asked for.
        names: What to call each touch.
    """
    if "touch" in model.out_of_distribution or isinstance(sensor, str):
        return ""
    _, bank = model.load("touch")
    asked = sensor or [None] * len(matches)
    distances = [match.distance if name is None else None for match, name in zip(matches, asked, strict=True)]
    rows = bank.unfamiliar(distances)
    if not rows:
        return ""
    far = max(distance for distance in distances if distance is not None)
    return (
        f"{_shown(names, rows)}: unlike the touches of any sensor that this model knows ({far:.2f} of full scale from "
        f"the nearest's mean, where {bank.reach:g} is far), so expect a guess. Is it a touch image?"
    )


def unknown_inputs(unknown: Mapping[str, Sequence[str | None]], names: Mapping[str, Sequence[str]]) -> str:
    """One line on the inputs that the model abstains from naming; empty if there is none.

    Args:
        unknown: Reasons by modality; see `RunReport.unknown`.
        names: What to call each input, by modality.
    """
    parts = []
    for modality, reasons in unknown.items():
        for reason in (UNLIKE, UNTOUCHED):
            if rows := [row for row, found in enumerate(reasons) if found == reason]:
                parts.append(f"{_shown(names[modality], rows)}: {reason}")
    return f"{'; '.join(parts)}. What is made of it is a guess." if parts else ""


def warn_of_unknown(unknown: Unknown) -> None:
    """One warning, which names the user's line, on the inputs that the model abstains from naming."""
    message = unknown_inputs(unknown, {name: names_of(name, len(reasons)) for name, reasons in unknown.items()})
    if message:
        warnings.warn(message, UnfamiliarInputWarning, stacklevel=4)


def _shown(names: Sequence[str], rows: Sequence[int]) -> str:
    """The first three of some names, and how many more there are."""
    shown, more = ", ".join(names[row] for row in rows[:3]), len(rows) - 3
    return f"{shown} and {more} more" if more > 0 else shown
