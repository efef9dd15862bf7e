"""The relief behind a touch of an unknown sensor, up to scale, by uncalibrated photometric stereo.

Whatever the lamps of a camera-based sensor, each channel's detail is about a linear function of the slopes of what
presses into its gel. Among all pairs of weighted sums of the channels, the slopes of a surface are the pair without
curl (integrability; Yuille and Snow, "Shape and albedo from multiple images using integrability", CVPR 1997). The sign
of the heights is a guess: a gel is brightest near its lamps, which light the slopes that face them, and peaks are more
common than holes.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

RELIEF_CHANNELS = 3  # two slopes and a height


def relief(pixel_values: Tensor) -> Tensor:
    """Slopes along x and y and heights of what a sensor touches, in units of about their deviation.

    The relief has detail only: structure wider than about a sixth of the view is left out, and so is contrast. An
    untouched gel gives values near 0, since no pair of sums has less curl there than noise has.

    Args:
        pixel_values: Normalised touches, float32 or float64 (B, C, H, W), H and W at least 4. One channel shows one
            slope at most, and both outputs are shares of that.

    Returns:
        (B, 3, H, W) within +-6. Their sign, heights that rise toward the sensor, is a guess that is mostly right.
    """
    height, width = pixel_values.shape[-2:]
    smooth_rows = _local_lines(height, pixel_values)
    smooth_columns = _local_lines(width, pixel_values)
    smooth = smooth_rows @ pixel_values @ smooth_columns.T  # shading by lamps and gel
    detail = pixel_values - smooth
    with torch.no_grad():
        padded = F.pad(detail, (1, 1, 1, 1), mode="replicate")
        mixture, trust = _without_curl(F.avg_pool2d(padded, kernel_size=3, stride=1))
    slopes = (mixture @ detail.flatten(2)).unflatten(2, (height, width)) * trust
    heights = _heights(slopes)
    with torch.no_grad():
        uprightness = _uprightness(smooth, detail, slopes, heights)
        sign = torch.where(uprightness < 0.0, -1.0, 1.0)[:, None, None, None]
    unit = max(height, width) / 128.0
    # 1.3 and 7.0 are the deviations of slopes and heights in views of 128 pixels.
    scaled = torch.cat([slopes / (1.3 * unit), heights[:, None] / (7.0 * unit**2)], dim=1)
    return (sign * scaled).clamp(-6.0, 6.0)


class ConcatRelief(nn.Module):
    """A touch, scaled by 0.15, and its relief, (B, C, H, W) -> (B, C + 3, H, W).

    Two touches of one contact by different sensors have the same slopes and heights.
    """

    def forward(self, pixel_values: Tensor) -> Tensor:
        with torch.autocast(pixel_values.device.type, enabled=False):
            shape = relief(pixel_values.float()).to(pixel_values.dtype)
        return torch.cat([0.15 * pixel_values, shape], dim=1)


def _local_lines(side: int, like: Tensor) -> Tensor:
    """The matrix (side, side) that smooths by a line fitted around each place, so that ramps stay as they are.

    Weights are Gaussian, with a deviation of 6 % of the view.
    """
    place = torch.arange(side, device=like.device, dtype=like.dtype)
    offset = place[None, :] - place[:, None]
    weight = torch.exp(-0.5 * (offset / max(0.06 * side, 1.0)) ** 2)
    moment_0 = weight.sum(dim=1, keepdim=True)
    moment_1 = (weight * offset).sum(dim=1, keepdim=True)
    moment_2 = (weight * offset**2).sum(dim=1, keepdim=True)
    return weight * (moment_2 - offset * moment_1) / (moment_0 * moment_2 - moment_1**2)


def _without_curl(detail: Tensor) -> tuple[Tensor, Tensor]:
    """The sums of channels (B, 2, C) with the least curl for their energy, and a weight (B, 1, 1, 1), 0 for noise.

    With gradients a = d/dx and b = d/dy of the channels, sums p and q of them have the curl b.p - a.q. Over all pixels
    its square is a quadratic form of (p, q), as is the energy |a.p|^2 + |b.p|^2 + |a.q|^2 + |b.q|^2: the least ratio
    is a generalised eigenvalue. It is 0 for slopes and a half for white noise.
    """
    channels = detail.shape[1]
    detail = torch.nan_to_num(detail, posinf=0.0, neginf=0.0).clamp(-1e4, 1e4)  # squares of more would overflow
    a = (detail[..., 1:-1, 2:] - detail[..., 1:-1, :-2]).flatten(2) / 2.0
    b = (detail[..., 2:, 1:-1] - detail[..., :-2, 1:-1]).flatten(2) / 2.0
    gradients = torch.cat([a, b], dim=1)
    products = gradients @ gradients.mT / gradients.shape[-1]
    aa = products[:, :channels, :channels]
    ab = products[:, :channels, channels:]
    bb = products[:, channels:, channels:]
    # The noise of the gradients is taken to be a share of their energy, and at least 5e-6.
    noise = 2e-3 * (aa + bb).diagonal(dim1=1, dim2=2).mean(dim=1) + 5e-6
    eye = noise[:, None, None] * torch.eye(channels).to(detail)
    whiten = torch.linalg.inv(torch.linalg.cholesky(aa + bb + eye))  # whitens the energy of one sum

    def whitened(block: Tensor) -> Tensor:
        return whiten @ block @ whiten.mT

    # The quadratic form of the curl; half of the noise's energy is curl.
    rows_p = torch.cat([whitened(bb + eye / 2.0), whitened(-ab.mT)], dim=2)
    rows_q = torch.cat([whitened(-ab), whitened(aa + eye / 2.0)], dim=2)
    eigenvalues, eigenvectors = torch.linalg.eigh(torch.cat([rows_p, rows_q], dim=1))
    mixture = eigenvectors[:, :, 0].unflatten(1, (2, channels)) @ whiten
    trust = (1.0 - 2.0 * eigenvalues[:, :1, None, None]).clamp_min(0.0)
    return mixture, trust


def _uprightness(smooth: Tensor, detail: Tensor, slopes: Tensor, heights: Tensor) -> Tensor:
    """Above 0 where heights seem to rise toward the sensor, (B,)."""
    shading = detail.flatten(2) @ slopes.flatten(2).mT  # correlation of each channel with the slopes, (B, C, 2)
    rise_x = (smooth[..., -1] - smooth[..., 0]).mean(2)
    rise_y = (smooth[..., -1, :] - smooth[..., 0, :]).mean(2)
    glow = torch.stack([rise_x, rise_y], dim=2)  # towards the brighter side, (B, C, 2)
    skewness = heights.pow(3).mean(dim=(1, 2)) / heights.square().mean(dim=(1, 2)).clamp_min(1e-9) ** 1.5
    # Gels are brightest near their lamps. A surface that rises toward a lamp faces away from it and is darker.
    return skewness - 1.5 * F.cosine_similarity(shading.flatten(1), glow.flatten(1), dim=1)


def _heights(slopes: Tensor) -> Tensor:
    """Heights (B, H, W) whose slopes come nearest to `slopes` (B, 2, H, W) in the least-squares sense.

    They are sums of cosines, so opposite borders need not match. Waves of fewer than three halves over the view are
    left out, where errors of the slopes add up.
    """
    height, width = slopes.shape[-2:]
    cos_y, sin_y, waves_y = _waves(height, slopes)
    cos_x, sin_x, waves_x = _waves(width, slopes)
    kx = waves_x[None, :]
    ky = waves_y[:, None]
    square = (kx**2 + ky**2).clamp_min(1e-6)
    from_x = cos_y @ slopes[:, 0] @ sin_x.T * kx
    from_y = sin_y @ slopes[:, 1] @ cos_x.T * ky
    coefficients = -(from_x + from_y) / square
    coarsest = (3.0 * math.pi) ** 2 * (1.0 / width**2 + 1.0 / height**2) / 2.0
    high_pass = 1.0 - torch.exp(-square / coarsest)
    return cos_y.T @ (coefficients * high_pass) @ cos_x


def _waves(side: int, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Orthonormal cosines and sines (side, side), one wave a row, and their wavenumbers (side,), radians a pixel."""
    waves = math.pi / side * torch.arange(side, device=like.device, dtype=like.dtype)
    phases = waves[:, None] * (torch.arange(side, device=like.device, dtype=like.dtype) + 0.5)
    scale = torch.full((side, 1), math.sqrt(2.0 / side), device=like.device, dtype=like.dtype)
    scale[0] = math.sqrt(1.0 / side)
    return scale * phases.cos(), scale * phases.sin(), waves
