"""The relief behind a touch of an unknown sensor, up to its scale: uncalibrated photometric stereo.

Whatever the lamps of a camera-based sensor, each channel's detail is about a linear function of the slopes of what
presses into its gel. Among all pairs of weighted sums of the channels, the slopes of a surface are the pair without
curl (integrability; Yuille and Snow, "Shape and albedo from multiple images using integrability", CVPR 1997). Which
side is up is guessed: a gel is brightest near its lamps, which light the slopes that face them, and peaks are more
common than holes.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

RELIEF_CHANNELS = 3  # two slopes and a height


def relief(pixel_values: Tensor) -> Tensor:
    """Slopes along x and y and heights of what a sensor touches, in units of about their deviation.

    Detail alone: what is wider than about a sixth of the view is left out, and so is contrast. An untouched gel gives
    values near 0, as no pair of sums has less curl there than noise has.

    Args:
        pixel_values: Normalised touches, float32 or float64 (B, C, H, W), H and W at least 4. One channel shows one
            slope at most, and both outputs are shares of that.

    Returns:
        (B, 3, H, W) within +-6; that heights rise toward the sensor is a guess, right in most touches.
    """
    rows, columns = (_local_lines(side, pixel_values) for side in pixel_values.shape[-2:])
    smooth = rows @ pixel_values @ columns.T  # what lamps and gel make of it before anything small presses into it
    detail = pixel_values - smooth
    height, width = detail.shape[-2:]
    with torch.no_grad():
        mixture, trust = _without_curl(F.avg_pool2d(F.pad(detail, (1,) * 4, mode="replicate"), 3, 1))
    slopes = (mixture @ detail.flatten(2)).unflatten(2, (height, width)) * trust
    heights = _heights(slopes)
    with torch.no_grad():
        up = torch.where(_uprightness(smooth, detail, slopes, heights) < 0.0, -1.0, 1.0)[:, None, None, None]
    unit = max(height, width) / 128.0
    # 1.3 and 7.0 are the deviations of slopes and heights in views of 128 pixels.
    found = torch.cat([slopes / (1.3 * unit), heights[:, None] / (7.0 * unit**2)], dim=1)
    return (up * found).clamp(-6.0, 6.0)


class BesideRelief(nn.Module):
    """A touch, faint, beside its relief, (B, C, H, W) -> (B, C + 3, H, W).

    Slopes and heights are what touches of one contact under two sensors share.
    """

    def forward(self, pixel_values: Tensor) -> Tensor:
        with torch.autocast(pixel_values.device.type, enabled=False):
            seen = relief(pixel_values.float()).to(pixel_values.dtype)
        return torch.cat([0.15 * pixel_values, seen], dim=1)


def _local_lines(side: int, like: Tensor) -> Tensor:
    """The matrix (side, side) that smooths by a line fitted around each place: a ramp stays itself up to the rim.

    Weights are Gaussian, with a deviation of 6 % of the view.
    """
    place = torch.arange(side, device=like.device, dtype=like.dtype)
    away = place[None, :] - place[:, None]
    weight = torch.exp(-0.5 * (away / max(0.06 * side, 1.0)) ** 2)
    none, once, twice = ((weight * away**power).sum(dim=1, keepdim=True) for power in range(3))
    return weight * (twice - away * once) / (none * twice - once**2)


def _without_curl(detail: Tensor) -> tuple[Tensor, Tensor]:
    """The sums of channels (B, 2, C) with the least curl for their energy, and a weight (B, 1, 1, 1): 0 for noise.

    With gradients a = d/dx and b = d/dy of the channels, sums p and q of them have the curl b.p - a.q. Over all pixels
    its square is a quadratic form of (p, q), as is the energy |a.p|^2 + |b.p|^2 + |a.q|^2 + |b.q|^2: the least ratio
    is a generalised eigenvalue. It is 0 for slopes and a half for white noise.
    """
    channels = detail.shape[1]
    detail = torch.nan_to_num(detail, posinf=0.0, neginf=0.0).clamp(-1e4, 1e4)  # squares of more would overflow
    along = (detail[..., 1:-1, 2:] - detail[..., 1:-1, :-2]).flatten(2) / 2.0
    down = (detail[..., 2:, 1:-1] - detail[..., :-2, 1:-1]).flatten(2) / 2.0
    both = torch.cat([along, down], dim=1)
    products = both @ both.mT / both.shape[-1]
    aa = products[:, :channels, :channels]
    ab = products[:, :channels, channels:]
    bb = products[:, channels:, channels:]
    noise = 2e-3 * (aa + bb).diagonal(dim1=1, dim2=2).mean(dim=1) + 5e-6  # of the gradients: a share, and the least
    eye = noise[:, None, None] * torch.eye(channels).to(detail)
    whiten = torch.linalg.inv(torch.linalg.cholesky(aa + bb + eye))  # of the energy of one sum
    blocks = ((bb + eye / 2.0, -ab.mT), (-ab, aa + eye / 2.0))  # of the curl, with the half that noise has
    curl = torch.cat([torch.cat([whiten @ block @ whiten.mT for block in row], dim=2) for row in blocks], dim=1)
    least, sums = torch.linalg.eigh(curl)
    mixture = sums[:, :, 0].unflatten(1, (2, channels)) @ whiten
    return mixture, (1.0 - 2.0 * least[:, :1, None, None]).clamp_min(0.0)


def _uprightness(smooth: Tensor, detail: Tensor, slopes: Tensor, heights: Tensor) -> Tensor:
    """Above 0 where heights seem to rise toward the sensor, (B,)."""
    shaded = detail.flatten(2) @ slopes.flatten(2).mT  # how each channel follows the slopes, (B, C, 2)
    rises = (smooth[..., -1] - smooth[..., 0]).mean(2), (smooth[..., -1, :] - smooth[..., 0, :]).mean(2)
    glow = torch.stack(rises, dim=2)
    skewness = heights.pow(3).mean(dim=(1, 2)) / heights.square().mean(dim=(1, 2)).clamp_min(1e-9) ** 1.5
    # Gels are brightest near their lamps; what rises toward a lamp faces away from it, and darkens.
    return skewness - 1.5 * F.cosine_similarity(shaded.flatten(1), glow.flatten(1), dim=1)


def _heights(slopes: Tensor) -> Tensor:
    """Heights (B, H, W) whose slopes come nearest to (B, 2, H, W), by cosines, in which rims do not wrap around.

    Waves of fewer than three halves over the view are left out: slopes add up to anything there.
    """
    height, width = slopes.shape[-2:]
    cos_y, sin_y, waves_y = _waves(height, slopes)
    cos_x, sin_x, waves_x = _waves(width, slopes)
    kx = waves_x[None, :]
    ky = waves_y[:, None]
    square = (kx**2 + ky**2).clamp_min(1e-6)
    found = -(cos_y @ slopes[:, 0] @ sin_x.T * kx + sin_y @ slopes[:, 1] @ cos_x.T * ky) / square
    coarsest = (3.0 * math.pi) ** 2 * (1.0 / width**2 + 1.0 / height**2) / 2.0
    return cos_y.T @ (found * (1.0 - torch.exp(-square / coarsest))) @ cos_x


def _waves(side: int, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Orthonormal cosines and sines (side, side), a row a wave, and their wavenumbers, radians a pixel."""
    waves = math.pi / side * torch.arange(side, device=like.device, dtype=like.dtype)
    phases = waves[:, None] * (torch.arange(side, device=like.device, dtype=like.dtype) + 0.5)
    scale = torch.full((side, 1), math.sqrt(2.0 / side), device=like.device, dtype=like.dtype)
    scale[0] = math.sqrt(1.0 / side)
    return scale * phases.cos(), scale * phases.sin(), waves
