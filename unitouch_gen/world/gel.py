"""From a surface to the displacement of the gel it is pressed into: contact, load, creep and spread in closed form."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from unitouch_gen.world.grids import PATCH_MM, convolved, pixel_axis, wavenumbers


def gel_square(view: float, resolution: int) -> tuple[int, float]:
    """Pixels a side and side (mm) of the square that is solved for a view of `view` mm and `resolution` pixels.

    It is half as wide again as what the camera sees, so its periodic ends stay out of view.
    """
    pixels = resolution + 2 * round(0.5 * resolution / 2)
    return pixels, view * pixels / resolution


def in_view(field: Tensor, resolution: int) -> Tensor:
    """What the camera sees, (N, S, S), of a field (N, P, P) over the square that is solved."""
    beside = (field.shape[-1] - resolution) // 2
    return field[:, beside : beside + resolution, beside : beside + resolution]


def contact_indentation(height: Tensor, indentation_depth: Tensor) -> Tensor:
    """Indentation (N, R, R) in mm of a surface pushed `indentation_depth` mm beyond its first contact with the gel."""
    return (height - height.amax(dim=(-2, -1), keepdim=True) + indentation_depth[:, None, None]).clamp_min(0.0)


def gel_displacement(
    indentation: Tensor,
    dwell: Tensor,
    *,
    extent: float,
    thickness: float,
    correlation: float,
    relaxation: float,
    stiffness: float = 1.0,
    blur: float = 0.0,
    contact_steps: int = 0,
) -> Tensor:
    """Displacement u (N, R, R), mm, of a gel under an indenter, after times (N,), s.

    The gel obeys relaxation du/dt = p - stiffness (u - correlation^2 laplace u) with u = 0 at contact. Every Fourier
    mode is one decaying exponential, so the solution is exact at any time and stiffness: nothing is stepped. The load
    p saturates at the gel's thickness. u is at most load / stiffness but for the little that a truncated Fourier
    series rings beside a cliff.

    With p the indentation itself, all of a contact is spread over the correlation length. With `contact_steps`, p is
    what keeps the gel at the surface where they touch, p >= 0 and u >= indentation, and only what lies beside is drawn
    along, so that a gel of 1 mm correlation still shows threads.

    Args:
        indentation: How far the rigid surface reaches into the undeformed gel, mm, >= 0, (N, R, R).
        dwell: Time since contact, s, (N,).
        extent, thickness, correlation, blur: Side of the square, thickness of the gel, length over which a displacement
            spreads, and standard deviation of the camera's blur, which is folded into the same transform, mm.
        relaxation: Time constant at unit stiffness, s; 0 for a gel that is settled at once.
        stiffness: Restoring rate relative to the nominal gel, 1e-30 to 1e30.
        contact_steps: Steps toward the load of a gel that follows the surface; 20 come within a percent under a ball.
    """
    load = thickness * -torch.expm1(-indentation / thickness)
    ky, kx = wavenumbers(indentation.shape[-1], extent)
    wavenumber2 = ky**2 + kx**2
    limits = torch.finfo(wavenumber2.dtype)
    spread = 1.0 + correlation**2 * wavenumber2
    rate = (stiffness * spread).clamp_max(limits.max)  # infinity times no time is no time
    if relaxation < limits.tiny:  # which would divide by nothing
        settled = (1.0 / rate).expand(len(dwell), -1, -1)
    else:
        settled = -torch.expm1(-rate * (dwell[:, None, None] / relaxation)) / rate
    response = settled * torch.exp(-0.5 * blur**2 * wavenumber2)
    spectrum = torch.fft.rfft2(load)
    if contact_steps:
        spectrum = spread * torch.fft.rfft2(following_displacement(load, spread, contact_steps))
    return torch.fft.irfft2(spectrum * response, s=load.shape[-2:])


def following_displacement(load: Tensor, spread: Tensor, steps: int) -> Tensor:
    """Displacement (N, R, R), mm, of a gel that lies against a surface where they touch.

    It solves the obstacle problem u >= load and A u >= 0, one of which is an equality everywhere, by ADMM (Boyd et al.
    2011, section 5.1), as A = 1 - correlation^2 laplace is diagonal under the Fourier transform: `spread` holds its
    eigenvalues, (R, R // 2 + 1).
    """
    size = load.shape[-2:]
    rho = 0.4 * spread.max().sqrt()  # near the fastest on balls at all resolutions
    displacement, multiplier, denominator = load, torch.zeros_like(load), spread + rho
    for _ in range(steps):
        spectrum = torch.fft.rfft2((displacement - multiplier).mul_(rho)).div_(denominator)
        multiplier += torch.fft.irfft2(spectrum, s=size)
        displacement = torch.maximum(load, multiplier)
        multiplier -= displacement
    return displacement


def resample_centre(field: Tensor, extent: float, pixels: int) -> Tensor:
    """The central square of `extent` mm of a patch (N, R, R), on `pixels` a side, bilinear.

    A field finer than the new grid is low-passed first, or its shortest waves would fold back into visible ones; but
    where it is finer by a tenth or less (for views of up to 17.6 mm), there is next to nothing to fold.
    """
    ratio = extent / PATCH_MM * field.shape[-1] / pixels  # a new pixel's side in old ones
    if ratio > 1.1:
        field = low_pass(field, ratio)
    axis = pixel_axis(pixels, extent) / (0.5 * PATCH_MM)
    grid = torch.stack(torch.meshgrid(axis, axis, indexing="xy"), dim=-1).expand(len(field), -1, -1, -1)
    return F.grid_sample(field[:, None], grid, mode="bilinear", padding_mode="border", align_corners=False)[:, 0]


def low_pass(field: Tensor, ratio: float) -> Tensor:
    """Each pixel of a field (N, R, R) averaged with those nearer than `ratio` >= 1 pixels, weighted by a triangle.

    Of waves at the Nyquist limit of a grid `ratio` times coarser it keeps about half, of those half beyond it a fifth
    at most; a plane stays a plane.
    """
    reach = math.ceil(ratio) - 1
    weights = 1.0 - torch.arange(-reach, reach + 1).abs() / ratio
    return convolved(field, weights / weights.sum())
