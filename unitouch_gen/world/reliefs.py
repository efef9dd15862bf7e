"""The relief of each material, which covers a body, built from noise, cells, lattices and grooves.

Every field is a function of position in millimetres, so a finer grid samples the same surface more often. The noise is
drawn on one base grid, and interpolated at the pixel centres of a finer grid by zero-padding its spectrum.
"""

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from unitouch_gen.world.draws import RELIEF_STREAM, Draws, generator
from unitouch_gen.world.grids import PATCH_MM, pixel_axis, wavenumbers

TAU = 2 * math.pi
BASE_RESOLUTION = 128  # pixels along a side of the grid on which noise is drawn

Relief = tuple[Tensor, Tensor]
"""Height, mm, and a shade of about [-1, 1] for colours, both (N, R, R).

Positive shade keeps the object's base colour; negative shade mixes in the material's second colour.
"""


class Fields:
    """Positions, noise and cells for the reliefs of contacts with one material.

    Attributes:
        x, y: Position along and across the object's grain, mm, each (N, R, R).
        scale, amplitude: The object's factors on lengths and on heights, (N, 1, 1).
        angle, cell_seed: Direction of the grain, radians, and the seed of cells, (N, 1, 1).
        spectrum: Of each contact's unit white noise.
    """

    def __init__(self, seed: int, draws: Draws, rows: Tensor, resolution: int):
        self.angle = draws.angle[rows][:, None, None]
        self.scale = draws.scale[rows][:, None, None]
        self.amplitude = draws.amplitude[rows][:, None, None]
        self.cell_seed = draws.cell_seed[rows][:, None, None]
        axis = pixel_axis(resolution)
        self.x, self.y = turned(axis[None, None, :], axis[None, :, None], draws.angle[rows], draws.offset[rows])
        names = draws.names()
        streams = [generator(seed, RELIEF_STREAM, *names[row]) for row in rows.tolist()]
        shape = (BASE_RESOLUTION, BASE_RESOLUTION)
        white_noise = np.stack([stream.standard_normal(shape, dtype=np.float32) for stream in streams])
        self.spectrum = torch.fft.rfft2(torch.from_numpy(white_noise))

    def noise(self, wavelength: float, width: float = 0.35, stretch: float = 1.0, shift: int = 0) -> Tensor:
        """Unit-variance noise, (N, R, R), around one wavelength in mm, multiplied by the object's scale.

        `width` is the standard deviation of the band in log-wavenumber. Features are `stretch` times longer along the
        grain than across it. A `shift` picks another realisation from the same white noise, by a cyclic shift.
        """
        ky, kx = wavenumbers(BASE_RESOLUTION)
        along = kx * torch.cos(self.angle) + ky * torch.sin(self.angle)
        across = -kx * torch.sin(self.angle) + ky * torch.cos(self.angle)
        radius = torch.sqrt((along * stretch) ** 2 + across**2).clamp_min(1e-6)
        centre = TAU / (wavelength * self.scale)
        gain = torch.exp(-0.5 * (torch.log(radius / centre) / width) ** 2)
        gain[..., 0, 0] = 0.0
        spectrum = self.spectrum * gain
        if shift:
            phase = shift * PATCH_MM * (0.37 * kx + 0.23 * ky)
            spectrum = spectrum * torch.polar(torch.ones_like(phase), phase)
        resolution = self.x.shape[-1]
        field = torch.fft.irfft2(zero_pad_spectrum(spectrum, resolution), s=(resolution, resolution))
        # The variance is computed from the spectrum (Parseval), so it does not depend on the grid.
        power = spectrum.abs().square()
        variance = (2 * power.sum(dim=(-2, -1)) - power[..., 0].sum(-1)) / BASE_RESOLUTION**4
        return field / variance.clamp_min(1e-12).sqrt()[:, None, None]

    def cells(self, size: float, at: tuple[Tensor, Tensor] | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Worley cells of a mean side of `size` mm, multiplied by the object's scale, at its positions or others.

        Only the 3 x 3 squares around a pixel are searched. For about one pixel in 10,000 the second nearest seed lies
        outside of them, and its distance is up to 0.2 cells too long.

        Returns:
            Distances to the nearest and second nearest seed, in cells, and a uniform number in [0, 1) of the nearest.
        """
        x, y = at or (self.x, self.y)
        u = x / (size * self.scale)
        v = y / (size * self.scale)
        column = torch.floor(u)
        row = torch.floor(v)
        first = torch.full_like(u, 9.0)
        second = torch.full_like(u, 9.0)
        label = torch.zeros_like(u)
        for dy in (-1, 0, 1):
            for dx in (-1, 0, 1):
                i = column + dx
                j = row + dy
                a = hash_unit(i, j, self.cell_seed)
                b = hash_unit(j, i, self.cell_seed + 17)
                offset_u = i + 0.5 + (a - 0.5) - u
                offset_v = j + 0.5 + (b - 0.5) - v
                distance = (offset_u**2 + offset_v**2).sqrt()
                second = torch.minimum(second, torch.maximum(first, distance))
                label = torch.where(distance < first, a, label)
                first = torch.minimum(first, distance)
        return first, second, label


def turned(x: Tensor, y: Tensor, angle: Tensor, offset: Tensor) -> tuple[Tensor, Tensor]:
    """Positions (N, R, R) of x (1, 1, R) and y (1, R, 1), moved by offsets (N, 2), in frames turned by angles (N,)."""
    cos = torch.cos(angle)[:, None, None]
    sin = torch.sin(angle)[:, None, None]
    x = x + offset[:, 0, None, None]
    y = y + offset[:, 1, None, None]
    return cos * x + sin * y, -sin * x + cos * y


def zero_pad_spectrum(spectrum: Tensor, resolution: int) -> Tensor:
    """Spectrum (..., n, n // 2 + 1) of a real field, zero-padded to that of a grid of `resolution` >= n pixels.

    Both grids sample the centres of their pixels on the same square. The finer grid's first centre is nearer to the
    border, so each wave's phase is shifted by that distance.
    """
    n = spectrum.shape[-2]
    if resolution == n:
        return spectrum
    half = n // 2
    first = 0.5 * n / resolution - 0.5  # the finer grid's first centre, in coarse pixels from the coarse grid's
    dtype = spectrum.real.dtype
    phase = TAU * first * (torch.fft.fftfreq(n, dtype=dtype)[:, None] + torch.fft.rfftfreq(n, dtype=dtype))
    spectrum = spectrum * torch.polar(torch.ones_like(phase), phase)
    padded = spectrum.new_zeros(*spectrum.shape[:-2], resolution, resolution // 2 + 1)
    padded[..., :half, :half] = spectrum[..., :half, :half]
    padded[..., -half + 1 :, :half] = spectrum[..., -half + 1 :, :half]  # the Nyquist row and column are left out
    return padded * (resolution / n) ** 2


def hash_unit(i: Tensor, j: Tensor, seed: Tensor) -> Tensor:
    """A uniform number in [0, 1) from two integers held in float tensors; equal inputs give equal numbers."""
    # A Weyl sequence on powers of the plastic number, folded once. Float32 rounding leaves steps of about 1e-4, which
    # are the same at each call. For integers |i|, |j| < 512 the numbers fill [0, 1) evenly.
    value = torch.frac((i + 512.0) * 0.7548776662 + (j + 512.0) * 0.5698402910 + seed * 0.1031)
    return torch.frac((value + 0.3183) * (value + 33.33) * 41.7)


def smooth_step(x: Tensor) -> Tensor:
    """Cubic step from 0 at x <= 0 to 1 at x >= 1."""
    x = x.clamp(0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def groove(x: Tensor, period: Tensor, width: float) -> Tensor:
    """1 on a line repeated every `period` mm, falling smoothly to 0 at `width` mm from it."""
    distance = torch.abs(torch.frac(x / period + 512.0) - 0.5) * period
    return 1.0 - smooth_step(distance / width)


# Materials ------------------------------------------------------------------------------------------------------------


def _concrete(f: Fields) -> Relief:
    """A fine grain, and round holes left by air in one of two cells."""
    grain = f.noise(1.2, 0.4)
    distance, _, label = f.cells(2.9)
    hole = smooth_step((0.10 + 0.3 * label - distance) / 0.06) * (label > 0.45)
    return f.amplitude * (0.05 * grain - 0.55 * hole), 0.5 * grain - 1.5 * hole


def _plastic(f: Fields) -> Relief:
    """Bumps on a hexagonal lattice."""
    period = 2.4 * f.scale
    a = TAU * f.x / period
    b = TAU * (0.5 * f.x + 0.866 * f.y) / period
    lattice = (torch.cos(a) + torch.cos(b) + torch.cos(a - b)) / 3.0  # three waves at 120 degrees
    return f.amplitude * 0.32 * smooth_step(lattice), 0.6 * lattice


def _glass(f: Fields) -> Relief:
    """A faint swell."""
    swell = f.noise(14.0, 0.3)
    return f.amplitude * 0.02 * swell, swell


def _wood(f: Fields) -> Relief:
    """Annual rings, drifting, and pores along the grain."""
    drift = f.noise(9.0, 0.3, stretch=3.0)
    phase = torch.frac((f.y + 0.7 * drift) / (2.0 * f.scale) + 512.0)
    rings = 1.0 - 2.0 * torch.minimum(phase / 0.8, (1.0 - phase) / 0.2)  # late wood ends sharply
    pores = smooth_step((f.noise(0.9, 0.3, stretch=7.0, shift=1) - 1.0) / 0.5)
    return f.amplitude * (0.12 * rings - 0.20 * pores), 0.7 * rings - 0.8 * pores


def _metal(f: Fields) -> Relief:
    """Brushed: scratches along the grain."""
    scratches = f.noise(0.75, 0.25, stretch=60.0)
    return f.amplitude * 0.07 * scratches, 0.7 * scratches


def _brick(f: Fields) -> Relief:
    """Courses, each moved by half a brick, with mortar between them."""
    grain = f.noise(1.3, 0.5)
    course = 6.5 * f.scale
    row = torch.floor(f.y / course + 0.5)
    bed = groove(f.y, course, 1.1)
    head = groove(f.x + 0.5 * row * 2.1 * course, 2.1 * course, 1.1)
    joint = torch.maximum(bed, head)
    height = f.amplitude * (0.13 * grain * (1.0 - 0.7 * joint) - 0.9 * joint)
    return height, 0.35 * grain * (1.0 - joint) + 0.4 - 2.0 * joint


def _tile(f: Fields) -> Relief:
    """A grid of joints under a glaze."""
    period = 4.6 * f.scale
    joint = torch.maximum(groove(f.x, period, 0.7), groove(f.y, period, 0.7))
    glaze = f.noise(9.0, 0.3)
    return f.amplitude * (-0.75 * joint + 0.02 * glaze), 0.3 + 0.08 * glaze - 1.6 * joint


def _leather(f: Fields) -> Relief:
    """Pebbles between furrows."""
    first, second, _ = f.cells(1.8)
    pebble = smooth_step((second - first) / 0.35)
    return f.amplitude * (0.26 * pebble + 0.03 * f.noise(4.0)), pebble - 0.6


def _synthetic_fabric(f: Fields) -> Relief:
    """A plain weave: warp and weft alternate on top."""
    period = 1.5 * f.scale
    a = math.pi * f.x / period
    b = math.pi * f.y / period
    warp = torch.cos(a).abs() * 0.35 + torch.sin(b).abs()
    weft = torch.cos(b).abs() * 0.35 + torch.sin(a).abs()
    weave = torch.where(torch.sin(a) * torch.sin(b) > 0, warp, weft)
    return f.amplitude * 0.20 * weave, weave - 0.75


def _natural_fabric(f: Fields) -> Relief:
    """Ribs of twisted yarn."""
    period = 3.0 * f.scale
    wobble = 0.30 * f.noise(6.0, 0.35)
    rib = torch.sin(TAU * (f.y + wobble) / period)
    twist = torch.sin(TAU * (f.x + 0.55 * f.y + wobble) / (0.5 * period))
    yarn = 0.75 * rib + 0.55 * twist * (0.6 + 0.4 * rib) + 0.12 * f.noise(0.9, shift=1)
    return f.amplitude * 0.30 * yarn, 0.8 * yarn


def _rubber(f: Fields) -> Relief:
    """Studs on a diagonal grid."""
    period = 4.2 * f.scale
    a = TAU * (f.x + f.y) / (1.414 * period)
    b = TAU * (f.x - f.y) / (1.414 * period)
    stud = torch.sigmoid(10.0 * (torch.sin(a) * torch.sin(b) - 0.12))
    return f.amplitude * 0.75 * stud, 1.2 * stud - 0.6


def _paper(f: Fields) -> Relief:
    """Crumpled: |noise| folds the sheet along its zero lines."""
    fold = f.noise(8.0, 0.28)
    crease = f.noise(6.0, 0.28, shift=1)
    facets = -torch.minimum(fold.abs(), crease.abs())
    return f.amplitude * 0.75 * facets, 0.9 + 1.6 * facets + 0.1 * f.noise(0.9)


def _tree(f: Fields) -> Relief:
    """Plates of bark between furrows."""
    plates = f.noise(4.2, 0.3, stretch=3.2)
    ridge = 1.0 - 2.0 * torch.exp(-((plates / 0.42) ** 2))
    fibre = f.noise(1.2, 0.4, stretch=3.0, shift=1)
    return f.amplitude * (0.6 * ridge + 0.12 * fibre), 0.7 * ridge + 0.25 * fibre


def _grass(f: Fields) -> Relief:
    """Three layers of blades."""
    top = torch.full_like(f.x, -1.0)
    for layer, (turn, period) in enumerate(((0.0, 2.7), (0.42, 3.4), (-0.38, 4.0))):
        bend = 1.1 * f.noise(11.0, 0.3, shift=layer)
        across = math.cos(turn) * f.y + math.sin(turn) * f.x + bend
        phase = (torch.frac(across / (period * f.scale) + 512.0) - 0.5) * period * f.scale
        blade = 1.0 - (phase.abs() / 0.55) ** 2
        top = torch.maximum(top, blade.clamp_min(-1.0) - 0.3 * layer)
    return f.amplitude * 0.6 * top.clamp_min(-0.6), 1.2 * top.clamp_min(-0.7)


def _gravel(f: Fields) -> Relief:
    """Round stones."""
    first, second, label = f.cells(4.2)
    stone = (1.0 - (first / 0.72) ** 2).clamp_min(0.0).sqrt() * smooth_step((second - first) / 0.30)
    height = stone * (0.75 + 0.45 * label)
    return f.amplitude * (1.3 * height + 0.05 * f.noise(1.5)), 1.5 * stone - 0.8 + 0.5 * (label - 0.5)


def _sand(f: Fields) -> Relief:
    """Grains and ripples."""
    first, _, label = f.cells(0.85)
    grain = (1.0 - (first / 0.7) ** 2).clamp_min(0.0) * (0.5 + 0.5 * label)
    ripple = torch.sin(TAU * (f.y + 0.8 * f.noise(10.0, 0.3, shift=1)) / (6.5 * f.scale))
    return f.amplitude * (0.26 * grain + 0.12 * ripple), 0.9 * grain - 0.4 + 0.35 * ripple


def _rock(f: Fields) -> Relief:
    """Broken faces, each at a height of its own."""
    swell = f.noise(6.0, 0.4)
    grain = f.noise(1.8, 0.9, shift=1)
    bent_x = f.x + 0.9 * f.scale * swell
    bent_y = f.y + 0.9 * f.scale * f.noise(6.0, 0.4, shift=2)
    first, second, label = f.cells(4.5, at=(bent_x, bent_y))
    face = smooth_step((second - first) / 0.18)
    height = 0.9 * (label - 0.5) * face - 0.3 * (1.0 - face) + 0.2 * swell + 0.07 * grain
    return f.amplitude * height, 0.9 * (label - 0.4) * face - 0.9 * (1.0 - face) + 0.35 * grain


RELIEFS: dict[str, Callable[[Fields], Relief]] = {
    "concrete": _concrete,
    "plastic": _plastic,
    "glass": _glass,
    "wood": _wood,
    "metal": _metal,
    "brick": _brick,
    "tile": _tile,
    "leather": _leather,
    "synthetic fabric": _synthetic_fabric,
    "natural fabric": _natural_fabric,
    "rubber": _rubber,
    "paper": _paper,
    "tree": _tree,
    "grass": _grass,
    "gravel": _gravel,
    "sand": _sand,
    "rock": _rock,
}
"""Functions from fields to the relief of a material, by its name."""


def relief(material: str, fields: Fields) -> Relief:
    """The relief of a material: height, mm, and shade."""
    return RELIEFS[material](fields)
