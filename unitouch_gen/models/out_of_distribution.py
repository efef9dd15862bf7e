"""Touches that the touch encoder does not know, by the relative Mahalanobis distance.

It is the distance to the nearest class of known touches, less that to pictures in the place of touches (Ren et al.,
2021, "A simple fix to Mahalanobis distance for improving near-OOD detection"). Touches of sensors drawn anew lie as far
from the known ones as photos do; how much nearer they are to photos tells them apart.
"""

import warnings
from collections.abc import Mapping, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from unitouch_gen.errors import UnfamiliarInputWarning
from unitouch_gen.models.images import denormalise_pixels, local_mean

UNLIKE, UNTOUCHED = "unlike anything known", "nothing is touched"  # why a model abstains from naming a touch


class Gaussians(nn.Module):
    """The squared Mahalanobis distance to the nearest of C means (C, F) (Lee et al., 2018, Eq. 2), (B, F) -> (B,).

    W W^T of the `whitening` W (F, F) is the inverse of the covariance that all share.
    """

    means: Tensor
    whitening: Tensor

    def __init__(self, means: Tensor, whitening: Tensor):
        super().__init__()
        self.register_buffer("means", means)
        self.register_buffer("whitening", whitening)

    def forward(self, features: Tensor) -> Tensor:
        means, whitening = self.means.float(), self.whitening.float()
        centre = means.mean(dim=0)  # distances keep their digits near 0
        apart = torch.cdist((features.float() - centre) @ whitening, (means - centre) @ whitening)
        return apart.amin(dim=1).square()


class RelativeDistance(nn.Module):
    """How much farther the `touch_statistics` of touches lie from known ones than from pictures, (B, F) -> (B,)."""

    def __init__(self, known: Gaussians, foreign: Gaussians):
        super().__init__()
        self.groups = nn.ModuleDict({"known": known, "foreign": foreign})

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor]) -> "RelativeDistance":
        """Builds it from the state dict of a joint space."""
        groups = (f"out_of_distribution.touch.groups.{group}" for group in ("known", "foreign"))
        return cls(*(Gaussians(tensors[f"{group}.means"], tensors[f"{group}.whitening"]) for group in groups))

    def forward(self, statistics: Tensor) -> Tensor:
        return self.groups["known"](statistics) - self.groups["foreign"](statistics)


@torch.no_grad()
def touch_statistics(patches: Tensor, pixel_values: Tensor) -> Tensor:
    """What `RelativeDistance` compares, (B, width + 12).

    An encoder that overlooks differences between sensors overlooks what tells a photo from a touch. So these are the
    mean patch in front of its first block, and of the pixels: mean and spread of each channel's wide parts, and how the
    channels' detail correlates. Lamps of several colours show each slope in a channel of its own; shades of a picture
    darken all channels alike.

    Args:
        patches: Output of the touch encoder's stem, (B, width, h, w).
        pixel_values: Normalised touches, (B, 3, H, W).
    """
    pixels = denormalise_pixels(pixel_values.float())
    reach = max(1, max(pixels.shape[-2:]) // 28)  # a window of 7 % of the longer side
    detail = (pixels - local_mean(pixels, reach)).flatten(2)
    covariance = (detail @ detail.mT / detail.shape[-1]).nan_to_num() + 1e-9 * torch.eye(3).to(pixels)
    deviation = covariance.diagonal(dim1=1, dim2=2).sqrt()
    red, green, _ = (covariance / (deviation[:, :, None] * deviation[:, None])).unbind(dim=1)
    correlations = torch.stack([red[:, 1], red[:, 2], green[:, 2]], dim=1)
    axes = torch.linalg.eigvalsh(covariance).clamp_min(1e-9).log()
    wide = F.adaptive_avg_pool2d(pixels, 8).flatten(2).std(dim=2)
    of_pixels = torch.cat([pixels.mean(dim=(-2, -1)), wide, correlations, axes], dim=1)
    return torch.cat([patches.float().mean(dim=(-2, -1)), of_pixels.to(patches.device)], dim=1)


def warn_of_unknown(reasons: Sequence[str | None], stacklevel: int) -> None:
    """One warning on the touches that a model abstains from; by the stack level it names the user's line."""
    rows = [row for row, reason in enumerate(reasons) if reason]
    named = "; ".join(f"`touch{f'[{row}]' * (len(reasons) > 1)}`: {reasons[row]}" for row in rows[:3])
    more = f" and {len(rows) - 3} more" if len(rows) > 3 else ""
    warnings.warn(f"{named}{more}. What is made of it is a guess.", UnfamiliarInputWarning, stacklevel=stacklevel)
