"""Surfaces: what covers a body, as a height field and an albedo, and pictures of them.

Every field is a function of position in millimetres, so a finer grid samples the same surface more often: the noise
is drawn on one base grid and interpolated, at the finer grid's pixel centres, by zero-padding its spectrum.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.world.bodies import BODIES
from unitouch_gen.world.draws import (
    PATCH_MM,
    RELIEF_STREAM,
    SHAPES,
    TINGE,
    Draws,
    generator,
)
from unitouch_gen.world.materials import MATERIALS
from unitouch_gen.world.textures import TextureLibrary

BASE_RESOLUTION = 128
"""Pixels a side of the grid on which noise is drawn."""

HEIGHT_LIMIT = 1e15
"""Heights have to stay below this, mm: the squares of their slopes must fit float32."""

DEEPEST_GROUND = -8.0
"""Height of what lies behind a body, mm."""

TOP = 0.9
"""Quantile of a relief that lies level with its body."""

SKY, LAMP = 0.38, 0.72
"""Light on a surface from all around, and from the lamp where the surface faces it."""

HIGHLIGHT, SQUARINGS = 0.35, 4
"""Brightness of the highlight on a surface of full gloss, and how often its cube is squared: the exponent (Blinn) is
48, and a power that is no small integer takes several times as long."""

BEHIND = (0.20, 0.21, 0.24)
"""Linear RGB of what shows behind an object."""

GAMMA = 1.8
"""Gamma of the pictures. Like the numbers above it is chosen for materials to look apart, not measured."""

Relief = tuple[Tensor, Tensor]
"""Height, mm, and a shade in about [-1, 1] that colours it, both (N, R, R)."""

TAU = 2 * math.pi


# Grids ----------------------------------------------------------------------------------------------------------------


def pixel_axis(resolution: int, extent: float = PATCH_MM) -> Tensor:
    """Centres of `resolution` pixels over `extent` mm, with zero in the middle."""
    return ((torch.arange(resolution, dtype=torch.float32) + 0.5) / resolution - 0.5) * extent


def wavenumbers(resolution: int, extent: float = PATCH_MM) -> tuple[Tensor, Tensor]:
    """Angular wavenumbers (ky (n, 1), kx (1, n // 2 + 1)) of a real FFT over `extent` mm, rad/mm."""
    step = extent / resolution
    ky = 2 * math.pi * torch.fft.fftfreq(resolution, d=step)
    kx = 2 * math.pi * torch.fft.rfftfreq(resolution, d=step)
    return ky[:, None], kx[None, :]


def convolved(field: Tensor, weights: Tensor) -> Tensor:
    """Each row and then each column of a field (N, R, R) convolved with an odd number of symmetric weights; its rim
    repeats.

    By two matrix products: on a CPU a fraction of what a convolution of one channel takes.
    """
    size, reach = field.shape[-1], len(weights) // 2
    banded = torch.zeros(size + 2 * reach, size, dtype=field.dtype, device=field.device)
    for offset, weight in enumerate(weights.tolist()):
        banded.diagonal(-offset).fill_(weight)
    matrix = banded[reach : size + reach].clone()
    matrix[0] += banded[:reach].sum(dim=0)
    matrix[-1] += banded[size + reach :].sum(dim=0)
    return matrix.T @ (field @ matrix)


def slopes(height: Tensor, pixel: float) -> tuple[Tensor, Tensor]:
    """Central differences along x and y of a periodic field (N, R, R) with pixels of `pixel` mm."""
    along_x = (height.roll(-1, dims=-1) - height.roll(1, dims=-1)) / (2 * pixel)
    along_y = (height.roll(-1, dims=-2) - height.roll(1, dims=-2)) / (2 * pixel)
    return along_x, along_y


def spectral_slopes(height: Tensor, extent: float) -> tuple[Tensor, Tensor]:
    """Derivatives along x and y of the trigonometric interpolant of a periodic field (N, R, R) over `extent` mm."""
    resolution = height.shape[-1]
    ky, kx = (wave.clone() for wave in wavenumbers(resolution, extent))
    if resolution % 2 == 0:
        ky[resolution // 2], kx[:, -1] = 0.0, 0.0  # an odd derivative has no real part at the Nyquist limit
    spectrum = torch.fft.rfft2(height)
    along_x, along_y = (torch.fft.irfft2(1j * k * spectrum, s=(resolution, resolution)) for k in (kx, ky))
    return along_x, along_y


def bad_values(good: Tensor) -> str:
    """How many of a tensor's values are not good, for messages."""
    return f"{int((~good).sum())} of {good.numel()} values"


def check_heights(height: Tensor) -> None:
    """Refuses surfaces that are not finite or too tall for float32.

    Raises:
        InvalidInputError: With the number of offending pixels.
    """
    low, high = torch.aminmax(height)  # one pass over memory, a twentieth of what `isfinite` takes
    if not (low > -HEIGHT_LIMIT and high < HEIGHT_LIMIT):
        raise InvalidInputError(
            f"`height` holds {bad_values(height.abs() < HEIGHT_LIMIT)} that are NaN, infinite or beyond "
            f"{HEIGHT_LIMIT:g} mm; a surface has to be finite everywhere."
        )


# Noise and cells ------------------------------------------------------------------------------------------------------


def zero_pad_spectrum(spectrum: Tensor, resolution: int) -> Tensor:
    """Spectrum (..., n, n // 2 + 1) of a real field, laid into that of a grid of `resolution` >= n pixels.

    Both grids sample the centres of their pixels on the same square. The finer grid's first centre is nearer to the
    rim, so each wave's phase is turned by that distance; without it the field would move against everything else that
    is drawn at pixel centres.
    """
    n = spectrum.shape[-2]
    if resolution == n:
        return spectrum
    half = n // 2
    first = 0.5 * n / resolution - 0.5  # the finer grid's first centre, in coarse pixels from the coarse grid's
    dtype = spectrum.real.dtype
    phase = 2 * math.pi * first * (torch.fft.fftfreq(n, dtype=dtype)[:, None] + torch.fft.rfftfreq(n, dtype=dtype))
    spectrum = spectrum * torch.polar(torch.ones_like(phase), phase)
    padded = spectrum.new_zeros(*spectrum.shape[:-2], resolution, resolution // 2 + 1)
    padded[..., :half, :half] = spectrum[..., :half, :half]
    padded[..., -half + 1 :, :half] = spectrum[..., -half + 1 :, :half]  # the Nyquist row and column are left out
    return padded * (resolution / n) ** 2


def white_spectrum(seed: int, material: Tensor, object_: Tensor, contact: Tensor) -> Tensor:
    """Spectrum (N, n, n // 2 + 1) of each contact's unit white noise on the base grid."""
    n = BASE_RESOLUTION
    names = zip(material.tolist(), object_.tolist(), contact.tolist(), strict=True)
    noise = [generator(seed, RELIEF_STREAM, *name).standard_normal((n, n), dtype=np.float32) for name in names]
    return torch.fft.rfft2(torch.from_numpy(np.stack(noise)))


@dataclass
class Fields:
    """What a texture is built from, for N surfaces of one material.

    Attributes:
        x, y: Position along and across the object's grain, mm, each (N, R, R).
        angle: Direction of the grain, radians, (N, 1, 1).
        scale: Each object's factor on lengths, (N, 1, 1).
        amplitude: Each object's factor on heights, (N, 1, 1).
        spectrum: Spectrum of the white noise of the contact, (N, n, n // 2 + 1).
        cell_seed: Integer that seeds each object's cells, (N, 1, 1).
    """

    x: Tensor
    y: Tensor
    angle: Tensor
    scale: Tensor
    amplitude: Tensor
    spectrum: Tensor
    cell_seed: Tensor

    def noise(self, wavelength: float, width: float = 0.35, stretch: float = 1.0, shift: int = 0) -> Tensor:
        """Unit-variance noise around one wavelength, (N, R, R).

        Args:
            wavelength: Centre of the band, mm; the object's scale multiplies it.
            width: Standard deviation of the band in log-wavenumber.
            stretch: How many times longer the features are along the grain than across it.
            shift: Picks another realisation from the same white noise, by a cyclic shift.
        """
        base = self.spectrum.shape[-2]
        ky, kx = wavenumbers(base)
        along = kx * torch.cos(self.angle) + ky * torch.sin(self.angle)
        across = -kx * torch.sin(self.angle) + ky * torch.cos(self.angle)
        radius = torch.sqrt((along * stretch) ** 2 + across**2).clamp_min(1e-6)
        centre = 2 * math.pi / (wavelength * self.scale)
        gain = torch.exp(-0.5 * (torch.log(radius / centre) / width) ** 2)
        gain[..., 0, 0] = 0.0
        spectrum = self.spectrum * gain
        if shift:
            phase = shift * PATCH_MM * (0.37 * kx + 0.23 * ky)
            spectrum = spectrum * torch.polar(torch.ones_like(phase), phase)
        resolution = self.x.shape[-1]
        field = torch.fft.irfft2(zero_pad_spectrum(spectrum, resolution), s=(resolution, resolution))
        # The variance follows from the spectrum (Parseval), so it does not depend on the grid.
        power = spectrum.abs().square()
        variance = (2 * power.sum(dim=(-2, -1)) - power[..., 0].sum(-1)) / base**4
        return field / variance.clamp_min(1e-12).sqrt()[:, None, None]

    def cells(self, size: float, jitter: float = 1.0) -> tuple[Tensor, Tensor, Tensor]:
        """Worley cells: distances to the nearest and second nearest seed, in cells, and the nearest's own number.

        Only the 3 x 3 squares around a pixel are searched. At full jitter the second nearest seed lies outside of them
        for about one pixel in 10,000, whose second distance then comes out too long (by up to 0.2 cells); no such
        pixel was found for the nearest.

        Args:
            size: Mean side of a cell, mm; the object's scale multiplies it.
            jitter: 0 puts the seeds on a lattice, 1 anywhere in their square.

        Returns:
            First distance, second distance and a uniform number in [0, 1) of the nearest cell, each (N, R, R).
        """
        u, v = self.x / (size * self.scale), self.y / (size * self.scale)
        column, row = torch.floor(u), torch.floor(v)
        first = torch.full_like(u, 9.0)
        second = torch.full_like(u, 9.0)
        label = torch.zeros_like(u)
        for dy in (-1, 0, 1):
            for dx in (-1, 0, 1):
                i, j = column + dx, row + dy
                a = hash_unit(i, j, self.cell_seed)
                b = hash_unit(j, i, self.cell_seed + 17)
                distance = ((i + 0.5 + jitter * (a - 0.5) - u) ** 2 + (j + 0.5 + jitter * (b - 0.5) - v) ** 2).sqrt()
                second = torch.minimum(second, torch.maximum(first, distance))
                label = torch.where(distance < first, a, label)
                first = torch.minimum(first, distance)
        return first, second, label


def hash_unit(i: Tensor, j: Tensor, seed: Tensor) -> Tensor:
    """A uniform number in [0, 1) from two integers held in float tensors; equal inputs give equal numbers."""
    # A Weyl sequence on the plastic number's powers, folded once. Float32 rounds what is folded, which leaves steps of
    # about 1e-4, but the same way each time: for integers |i|, |j| < 512 the numbers repeat and fill [0, 1) evenly.
    value = torch.frac((i + 512.0) * 0.7548776662 + (j + 512.0) * 0.5698402910 + seed * 0.1031)
    return torch.frac((value + 0.3183) * (value + 33.33) * 41.7)


# One relief for each material -----------------------------------------------------------------------------------------
# Positive shade keeps the object's base colour; negative shade mixes in the material's second colour.


def smooth_step(x: Tensor) -> Tensor:
    """Cubic step from 0 at x <= 0 to 1 at x >= 1."""
    x = x.clamp(0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def groove(x: Tensor, period: Tensor, width: float) -> Tensor:
    """1 on a line repeated every `period` mm, falling smoothly to 0 at `width` mm from it."""
    distance = torch.abs(torch.frac(x / period + 512.0) - 0.5) * period
    return 1.0 - smooth_step(distance / width)


def concrete(f: Fields) -> Relief:
    grain = f.noise(1.2, 0.4)
    distance, _, label = f.cells(2.9)  # round holes that air has left, one in two cells
    hole = smooth_step((0.10 + 0.3 * label - distance) / 0.06) * (label > 0.45)
    return f.amplitude * (0.05 * grain - 0.55 * hole), 0.5 * grain - 1.5 * hole


def plastic(f: Fields) -> Relief:
    period = 2.4 * f.scale
    a, b = TAU * f.x / period, TAU * (0.5 * f.x + 0.866 * f.y) / period
    lattice = (torch.cos(a) + torch.cos(b) + torch.cos(a - b)) / 3.0  # three waves at 120 degrees: hexagonal
    return f.amplitude * 0.32 * smooth_step(lattice), 0.6 * lattice


def glass(f: Fields) -> Relief:
    swell = f.noise(14.0, 0.3)
    return f.amplitude * 0.02 * swell, swell


def wood(f: Fields) -> Relief:
    drift = f.noise(9.0, 0.3, stretch=3.0)
    phase = torch.frac((f.y + 0.7 * drift) / (2.0 * f.scale) + 512.0)
    rings = 1.0 - 2.0 * torch.minimum(phase / 0.8, (1.0 - phase) / 0.2)  # late wood ends sharply
    pores = smooth_step((f.noise(0.9, 0.3, stretch=7.0, shift=1) - 1.0) / 0.5)
    return f.amplitude * (0.12 * rings - 0.20 * pores), 0.7 * rings - 0.8 * pores


def metal(f: Fields) -> Relief:
    scratches = f.noise(0.75, 0.25, stretch=60.0)
    return f.amplitude * 0.07 * scratches, 0.7 * scratches


def brick(f: Fields) -> Relief:
    grain = f.noise(1.3, 0.5)
    course = 6.5 * f.scale
    row = torch.floor(f.y / course + 0.5)
    bed = groove(f.y, course, 1.1)
    head = groove(f.x + 0.5 * row * 2.1 * course, 2.1 * course, 1.1)
    joint = torch.maximum(bed, head)
    height = f.amplitude * (0.13 * grain * (1.0 - 0.7 * joint) - 0.9 * joint)
    return height, 0.35 * grain * (1.0 - joint) + 0.4 - 2.0 * joint


def tile(f: Fields) -> Relief:
    period = 4.6 * f.scale
    joint = torch.maximum(groove(f.x, period, 0.7), groove(f.y, period, 0.7))
    glaze = f.noise(9.0, 0.3)
    return f.amplitude * (-0.75 * joint + 0.02 * glaze), 0.3 + 0.08 * glaze - 1.6 * joint


def leather(f: Fields) -> Relief:
    first, second, _ = f.cells(1.8)
    pebble = smooth_step((second - first) / 0.35)
    return f.amplitude * (0.26 * pebble + 0.03 * f.noise(4.0)), pebble - 0.6


def synthetic_fabric(f: Fields) -> Relief:
    period = 1.5 * f.scale
    a, b = math.pi * f.x / period, math.pi * f.y / period
    over = torch.sin(a) * torch.sin(b) > 0  # plain weave: warp and weft take turns on top
    weave = torch.where(
        over, torch.cos(a).abs() * 0.35 + torch.sin(b).abs(), torch.cos(b).abs() * 0.35 + torch.sin(a).abs()
    )
    return f.amplitude * 0.20 * weave, weave - 0.75


def natural_fabric(f: Fields) -> Relief:
    period = 3.0 * f.scale
    wobble = 0.30 * f.noise(6.0, 0.35)
    rib = torch.sin(TAU * (f.y + wobble) / period)
    twist = torch.sin(TAU * (f.x + 0.55 * f.y + wobble) / (0.5 * period))
    yarn = 0.75 * rib + 0.55 * twist * (0.6 + 0.4 * rib) + 0.12 * f.noise(0.9, shift=1)
    return f.amplitude * 0.30 * yarn, 0.8 * yarn


def rubber(f: Fields) -> Relief:
    period = 4.2 * f.scale
    a, b = TAU * (f.x + f.y) / (1.414 * period), TAU * (f.x - f.y) / (1.414 * period)
    stud = torch.sigmoid(10.0 * (torch.sin(a) * torch.sin(b) - 0.12))
    return f.amplitude * 0.75 * stud, 1.2 * stud - 0.6


def paper(f: Fields) -> Relief:
    fold, crease = f.noise(8.0, 0.28), f.noise(6.0, 0.28, shift=1)
    facets = -torch.minimum(fold.abs(), crease.abs())  # |noise| folds the sheet along its zero lines
    return f.amplitude * 0.75 * facets, 0.9 + 1.6 * facets + 0.1 * f.noise(0.9)


def tree(f: Fields) -> Relief:
    plates = f.noise(4.2, 0.3, stretch=3.2)
    ridge = 1.0 - 2.0 * torch.exp(-((plates / 0.42) ** 2))
    fibre = f.noise(1.2, 0.4, stretch=3.0, shift=1)
    return f.amplitude * (0.6 * ridge + 0.12 * fibre), 0.7 * ridge + 0.25 * fibre


def grass(f: Fields) -> Relief:
    top = torch.full_like(f.x, -1.0)
    for layer, (turn, period) in enumerate(((0.0, 2.7), (0.42, 3.4), (-0.38, 4.0))):
        bend = 1.1 * f.noise(11.0, 0.3, shift=layer)
        across = math.cos(turn) * f.y + math.sin(turn) * f.x + bend
        phase = (torch.frac(across / (period * f.scale) + 512.0) - 0.5) * period * f.scale
        blade = 1.0 - (phase.abs() / 0.55) ** 2
        top = torch.maximum(top, blade.clamp_min(-1.0) - 0.3 * layer)
    return f.amplitude * 0.6 * top.clamp_min(-0.6), 1.2 * top.clamp_min(-0.7)


def gravel(f: Fields) -> Relief:
    first, second, label = f.cells(4.2)
    stone = (1.0 - (first / 0.72) ** 2).clamp_min(0.0).sqrt() * smooth_step((second - first) / 0.30)
    height = stone * (0.75 + 0.45 * label)
    return f.amplitude * (1.3 * height + 0.05 * f.noise(1.5)), 1.5 * stone - 0.8 + 0.5 * (label - 0.5)


def sand(f: Fields) -> Relief:
    first, _, label = f.cells(0.85)
    grain = (1.0 - (first / 0.7) ** 2).clamp_min(0.0) * (0.5 + 0.5 * label)
    ripple = torch.sin(TAU * (f.y + 0.8 * f.noise(10.0, 0.3, shift=1)) / (6.5 * f.scale))
    return f.amplitude * (0.26 * grain + 0.12 * ripple), 0.9 * grain - 0.4 + 0.35 * ripple


def rock(f: Fields) -> Relief:
    swell, grain = f.noise(6.0, 0.4), f.noise(1.8, 0.9, shift=1)
    bent = replace(f, x=f.x + 0.9 * f.scale * swell, y=f.y + 0.9 * f.scale * f.noise(6.0, 0.4, shift=2))
    first, second, label = bent.cells(4.5)
    face = smooth_step((second - first) / 0.18)  # broken faces, each at a height of its own
    height = 0.9 * (label - 0.5) * face - 0.3 * (1.0 - face) + 0.2 * swell + 0.07 * grain
    return f.amplitude * height, 0.9 * (label - 0.4) * face - 0.9 * (1.0 - face) + 0.35 * grain


TEXTURES: dict[str, Callable[[Fields], Relief]] = {
    texture.__name__.replace("_", " "): texture
    for texture in (
        concrete, plastic, glass, wood, metal, brick, tile, leather, synthetic_fabric, natural_fabric, rubber, paper,
        tree, grass, gravel, sand, rock,
    )
}  # fmt: skip
"""By the name of the material."""


# Bodies and colours ---------------------------------------------------------------------------------------------------


@dataclass
class Surfaces:
    """N square patches of surface.

    Attributes:
        height: Height toward the sensor and the camera, mm, (N, R, R); the top of the body is near 0.
        albedo: Linear RGB reflectance in [0, 1], (N, 3, R, R); `None` where only shapes were asked for.
        body: 1 where there is an object, 0 where the background shows behind it, (N, R, R).
    """

    height: Tensor
    albedo: Tensor | None
    body: Tensor


def surfaces(
    seed: int, draws: Draws, resolution: int, textures: TextureLibrary | None = None, *, coloured: bool = True
) -> Surfaces:
    """Builds the patches of N contacts at `resolution` pixels a side, without colours if nobody will see them."""
    count = len(draws)
    axis = pixel_axis(resolution)
    x, y = axis[None, None, :], axis[None, :, None]
    height = _bodies(draws, x, y)
    body = (height > DEEPEST_GROUND).float()
    height = height + draws.tilt[:, 0, None, None] * x + draws.tilt[:, 1, None, None] * y
    relief = torch.zeros(count, resolution, resolution)
    albedo = draws.colour[:, :, None, None].expand(-1, -1, resolution, resolution).clone() if coloured else None
    for index in draws.material[draws.texture < 0].unique().tolist():
        rows = torch.nonzero((draws.material == index) & (draws.texture < 0))[:, 0]
        relief[rows], colours = coloured_relief(seed, draws, index, rows, axis)
        if albedo is not None:
            albedo[rows] = colours()
    u, v = _turned(x, y, draws.angle, draws.offset)
    for row in torch.nonzero(draws.texture >= 0)[:, 0].tolist():
        assert textures is not None  # as there is none to draw without
        one = slice(row, row + 1)
        heights, colour = textures.textures[int(draws.texture[row])].patches(u[one], v[one], draws.texture_side[one])
        relief[one] = heights * draws.relief[one, None, None]
        if albedo is not None:
            # A scan has its own colours, of which an object's are a shade.
            shade, tinge = 0.65 + 0.7 * draws.shade[one, :1], 1.0 + TINGE * (2.0 * draws.shade[one] - 1.0)
            albedo[one] = (colour * (shade * tinge)[..., None, None]).clamp(0.0, 1.0)
    level = relief.flatten(1)[:, ::7].quantile(TOP, dim=1)[:, None, None]
    height = torch.where(body > 0, height + relief - level, DEEPEST_GROUND).clamp_min(DEEPEST_GROUND)
    return Surfaces(height, albedo, body)


def _turned(x: Tensor, y: Tensor, angle: Tensor, offset: Tensor) -> tuple[Tensor, Tensor]:
    cos, sin = torch.cos(angle)[:, None, None], torch.sin(angle)[:, None, None]
    x, y = x + offset[:, 0, None, None], y + offset[:, 1, None, None]
    return cos * x + sin * y, -sin * x + cos * y


def _bodies(draws: Draws, x: Tensor, y: Tensor) -> Tensor:
    """Heights (N, R, R) of the bodies at x (1, 1, R) and y (1, R, 1), `NOTHING` beside them."""
    u, v = _turned(x, y, draws.shape_angle, -draws.shape_offset)
    height = torch.zeros_like(u)
    for index, name in enumerate(SHAPES):
        rows = torch.nonzero(draws.shape == index)[:, 0]
        if len(rows) and name in BODIES:
            numbers = draws.proportions[rows, :, None, None]
            height[rows] = BODIES[name](u[rows], v[rows], draws.shape_radius[rows, None, None], numbers)
    return height


def coloured_relief(
    seed: int, draws: Draws, material: int, rows: Tensor, axis: Tensor
) -> tuple[Tensor, Callable[[], Tensor]]:
    """Relief (n, R, R) of some contacts with one material, mm, and what makes the albedo (n, 3, R, R) to it."""
    relief, shade = TEXTURES[MATERIALS[material].name](_fields(seed, draws, rows, axis))
    second, contrast = MATERIALS[material].second, MATERIALS[material].contrast
    return relief, partial(_albedo, second, contrast, draws.colour[rows], shade)


def _fields(seed: int, draws: Draws, rows: Tensor, axis: Tensor) -> Fields:
    def column(values: Tensor) -> Tensor:
        return values[rows][:, None, None]

    angle = column(draws.angle)
    x = axis[None, None, :] + column(draws.offset[:, 0])
    y = axis[None, :, None] + column(draws.offset[:, 1])
    return Fields(
        x=torch.cos(angle) * x + torch.sin(angle) * y,
        y=-torch.sin(angle) * x + torch.cos(angle) * y,
        angle=angle,
        scale=column(draws.scale),
        amplitude=column(draws.amplitude),
        spectrum=white_spectrum(seed, draws.material[rows], draws.object[rows], draws.contact[rows]),
        cell_seed=column(draws.cell_seed),
    )


def _albedo(second: tuple[float, float, float] | None, contrast: float, colour: Tensor, shade: Tensor) -> Tensor:
    """(N, 3, R, R): the base colour, mixed toward the second (or toward black) where the shade is negative."""
    base = colour[:, :, None, None]
    shade = shade.clamp(-1.2, 1.2)[:, None]
    dark = 0.35 * base if second is None else torch.tensor(second)[None, :, None, None].expand_as(base)
    below = contrast * (0.5 - 0.5 * shade).clamp(0.0, 1.0)
    return (base * (1.0 - below) + dark * below + 0.08 * contrast * shade.clamp_min(0.0)).clamp(0.0, 1.0)


# Pictures -------------------------------------------------------------------------------------------------------------


def pictures(
    height: Tensor,
    albedo: Tensor,
    body: Tensor,
    light: Tensor,
    gloss: Tensor,
    resolution: int,
    white: Tensor,
    side: Tensor | None = None,
) -> Tensor:
    """Pictures of N surfaces from straight above under one lamp and a sky.

    Args:
        height: mm, (N, R, R).
        albedo: Linear RGB, (N, 3, R, R).
        body: 1 on the object, 0 on what lies behind it, (N, R, R).
        light: Unit vectors toward the lamp, (N, 3).
        gloss: Weight of the highlight, (N,).
        resolution: Side of the picture, pixels; R must be a multiple of it.
        white: White balance of the camera, factors on RGB, (3,) or (N, 3).
        side: Of what it sees about the middle of the surface, mm, (N,); all of it when left out.

    Returns:
        sRGB-like pictures in [0, 1], (N, 3, resolution, resolution).

    Raises:
        InvalidInputError: On heights that are not finite.
    """
    check_heights(height)
    padded = F.pad(height[:, None], (1, 1, 1, 1), mode="replicate")[:, 0]
    slope_x, slope_y = (field[:, 1:-1, 1:-1] for field in slopes(padded, PATCH_MM / height.shape[-1]))
    normal = torch.rsqrt(1.0 + slope_x**2 + slope_y**2)
    lx, ly, lz = (component[:, None, None] for component in light.unbind(1))
    lambert = ((lz - lx * slope_x - ly * slope_y) * normal).clamp_min(0.0)
    # Blinn's half vector between lamp and camera (0, 0, 1).
    half = torch.rsqrt(2.0 + 2.0 * lz)
    facing = (((1.0 + lz) - lx * slope_x - ly * slope_y) * normal * half).clamp(0.0, 1.0)
    for _ in range(SQUARINGS):
        facing = facing.square()
    highlight = gloss[:, None, None] * facing**3
    lit = albedo * (SKY + LAMP * lambert)[:, None]  # three channels, so what follows writes in place
    lit += HIGHLIGHT * highlight[:, None]
    behind = torch.tensor(BEHIND)[None, :, None, None]
    linear = torch.lerp(behind, lit, body[:, None]).mul_(white[..., None, None]).clamp_(0.0, 1.0)
    if side is not None:
        nearer = (side / PATCH_MM)[:, None, None] * torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
        grid = F.affine_grid(nearer, list(linear.shape), align_corners=False)
        linear = F.grid_sample(linear, grid, align_corners=False)
    return F.avg_pool2d(linear, height.shape[-1] // resolution).clamp_min(1e-6) ** (1 / GAMMA)
