"""From a surface to the displacement of the gel it is pressed into: contact, load, creep and spread in closed form."""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, check_choice, check_integer, check_number
from unitouch_gen.world.surfaces import PATCH_MM, bad_values, convolved, pixel_axis, wavenumbers

GEL_MARGIN = 1.5
"""The gel is solved on a square this many times wider than the camera sees, so its periodic ends stay out of view."""

SOFT_SHARE = 0.5
"""Share of an indentation depth that an object as compliant as the gel takes up itself."""

LARGEST, LONGEST = 1e30, 1e18
"""Bounds on a gel's numbers, and on its lengths (mm), whose squares must fit float32."""

LARGEST_GRID = 2**14
"""Pixels a side; a field of that many takes a gigabyte."""

MOST_CONTACT_STEPS = 1000
"""More change nothing."""

SLOPES = ("central", "spectral")

SAME_GRID = 1.1
"""Grids whose pixels differ by no more than this factor are only interpolated between."""


@dataclass(frozen=True)
class GelGrid:
    """How widely and how finely a gel is solved: what a touch image costs, and how near it comes to its limit.

    Attributes:
        margin: Side of the square that is solved over what the camera sees, >= 1. A surface first touches the gel
            somewhere on this square, so with the margin the depth of a contact may change, too.
        refinement: Pixels of the gel to one of the image, along each side; what they send is averaged.
        slopes: "central" differences, of second order, or "spectral", exact for what the grid can carry. Spectral
            slopes overshoot beside a cliff, where the central ones only smear it.

    Raises:
        InvalidInputError, InvalidTypeError: On a margin that is no number from 1 to 100, a refinement that is no such
            integer, or other slopes.
    """

    margin: float = GEL_MARGIN
    refinement: int = 1
    slopes: str = "central"

    def __post_init__(self) -> None:
        check_number("margin", self.margin, 1.0, 100.0)
        check_integer("refinement", self.refinement, 1, 100)
        check_choice("slopes", self.slopes, SLOPES)

    def layout(self, view: float, resolution: int) -> tuple[int, float, slice]:
        """Pixels a side and side (mm) of the square that is solved, and the rows and columns of it that are seen.

        Args:
            view: Side of what the camera sees, mm.
            resolution: Side of the image, pixels.

        Raises:
            InvalidInputError: If that is too many pixels.
        """
        seen = resolution * self.refinement
        beside = round((self.margin - 1.0) * seen / 2)
        pixels = seen + 2 * beside
        check_integer("margin and refinement: pixels a side", pixels, 1, LARGEST_GRID)
        return pixels, view * pixels / seen, slice(beside, beside + seen)


DEFAULT_GRID = GelGrid()


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
    """Displacement u (mm) of a gel under an indenter, after a time.

    The gel obeys relaxation du/dt = p - stiffness (u - correlation^2 laplace u) with u = 0 at contact. Every Fourier
    mode is one decaying exponential, so the solution is exact at any time and stiffness: nothing is stepped. The load
    p saturates at the gel's thickness.

    With p the indentation itself, all of a contact is spread over the correlation length. With `contact_steps`, p is
    what keeps the gel at the surface where they touch, p >= 0 and u >= indentation, and only what lies beside is drawn
    along, so that a gel of 1 mm correlation still shows threads.

    Args:
        indentation: How far the rigid surface reaches into the undeformed gel, mm, >= 0, (N, R, R).
        dwell: Time since contact, s, (N,).
        extent: Side of the square, mm.
        thickness: Thickness of the gel, mm.
        correlation: Length over which a displacement spreads, mm.
        relaxation: Time constant at unit stiffness, s; 0 for a gel that is settled at once.
        stiffness: Restoring rate relative to the nominal gel, 1e-30 to 1e30.
        blur: Camera blur (standard deviation, mm) folded into the same transform.
        contact_steps: Steps toward the load of a gel that follows the surface; 20 come within a percent under a ball.

    Returns:
        Displacement at `dwell`, mm, (N, R, R); at most load / stiffness but for the little that a truncated Fourier
        series rings beside a cliff.

    Raises:
        InvalidInputError: On a number that is not finite or out of range, or an indentation or dwell that is negative.
    """
    for label, value, low, high in (
        ("thickness", thickness, 1 / LARGEST, LARGEST),
        ("stiffness", stiffness, 1 / LARGEST, LARGEST),
        ("relaxation", relaxation, 0.0, LARGEST),
        ("extent", extent, 1e-15, LONGEST),
        ("correlation", correlation, 0.0, LONGEST),
        ("blur", blur, 0.0, LONGEST),
    ):
        check_number(label, value, low, high)
    check_integer("contact_steps", contact_steps, 0, MOST_CONTACT_STEPS)
    least, most = torch.aminmax(indentation)  # NaN goes through, and no comparison with it holds
    if not (least >= 0.0 and most < math.inf):
        raise InvalidInputError(
            f"`indentation` runs from {least} to {most}; it has to be finite and at least 0 (0 where nothing touches)."
        )
    if not bool((dwell >= 0.0).all()):
        raise InvalidInputError(
            f"`dwell` holds {bad_values(dwell >= 0.0)} that are NaN or negative; pass times of at least 0 s."
        )
    load = thickness * -torch.expm1(-indentation / thickness)
    ky, kx = wavenumbers(indentation.shape[-1], extent)
    wavenumber2 = ky**2 + kx**2
    limits = torch.finfo(wavenumber2.dtype)
    rate = (stiffness * (1.0 + correlation**2 * wavenumber2)).clamp_max(limits.max)  # infinity times no time is no time
    if relaxation < limits.tiny:  # which would divide by nothing
        settled = (1.0 / rate).expand(len(dwell), -1, -1)
    else:
        settled = -torch.expm1(-rate * (dwell[:, None, None] / relaxation)) / rate
    response = settled * torch.exp(-0.5 * blur**2 * wavenumber2)
    spectrum = torch.fft.rfft2(load)
    if contact_steps:
        spread = 1.0 + correlation**2 * wavenumber2
        spectrum = spread * torch.fft.rfft2(following_displacement(load, spread, contact_steps))
    resolution = indentation.shape[-1]
    return torch.fft.irfft2(spectrum * response, s=(resolution, resolution))


def following_displacement(load: Tensor, spread: Tensor, steps: int) -> Tensor:
    """Displacement (N, R, R), mm, of a gel that lies against a surface where they touch.

    u >= load and A u >= 0, one of which is an equality everywhere.

    ADMM (Boyd et al. 2011, section 5.1) on the obstacle problem, with A diagonal under the Fourier transform.

    Args:
        load: How far the surface reaches into the gel, mm, >= 0, (N, R, R).
        spread: Eigenvalues of A = 1 - correlation^2 laplace, (R, R // 2 + 1).
        steps: Steps of the method.
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


def contact_indentation(height: Tensor, indentation_depth: Tensor, compliance: Tensor) -> Tensor:
    """Indentation (N, R, R) in mm of a surface pushed `indentation_depth` mm beyond its first contact with the gel."""
    depth = (indentation_depth * (1.0 - SOFT_SHARE * compliance))[:, None, None]
    return (height - height.amax(dim=(-2, -1), keepdim=True) + depth).clamp_min(0.0)


def resample_centre(field: Tensor, extent: float, pixels: int) -> Tensor:
    """The central square of `extent` mm of a patch (N, R, R), on `pixels` a side, bilinear.

    A field finer than the new grid by more than `SAME_GRID` is low-passed first, or its shortest waves would fold back
    into visible ones. Below that (in a default world, for views of up to 17.6 mm) there is next to nothing to fold.
    """
    ratio = extent / PATCH_MM * field.shape[-1] / pixels  # a new pixel's side in old ones
    if ratio > SAME_GRID:
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
    weights = weights / weights.sum()
    return convolved(field, weights)
