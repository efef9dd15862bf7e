"""The relief of each material: what covers a body, built from noise, cells, lattices and grooves.

Every field is a function of position in millimetres, so a finer grid samples the same surface more often: the noise
is drawn on one base grid and interpolated, at the finer grid's pixel centres, by zero-padding its spectrum.
"""

import math

import numpy as np
import torch
from torch import Tensor

from unitouch_gen.world.draws import RELIEF_STREAM, Draws, generator
from unitouch_gen.world.grids import PATCH_MM, pixel_axis, wavenumbers

TAU = 2 * math.pi
BASE_RESOLUTION = 128  # pixels a side of the grid on which noise is drawn

Relief = tuple[Tensor, Tensor]
"""Height, mm, and a shade in about [-1, 1] that colours it, both (N, R, R). Positive shade keeps the object's base
colour; negative shade mixes in the material's second colour."""


class Fields:
    """Positions, noise and cells of some contacts with one material, which reliefs are built from.

    Attributes:
        x, y: Position along and across the object's grain, mm, each (N, R, R).
        scale, amplitude: The object's factors on lengths and on heights, (N, 1, 1).
    """

    def __init__(self, seed: int, draws: Draws, rows: Tensor, resolution: int):
        axis = pixel_axis(resolution)
        names = draws.names()
        base = (BASE_RESOLUTION, BASE_RESOLUTION)
        self.angle, self.scale, self.amplitude, self.cell_seed = (
            values[rows][:, None, None] for values in (draws.angle, draws.scale, draws.amplitude, draws.cell_seed)
        )
        self.x, self.y = turned(axis[None, None, :], axis[None, :, None], draws.angle[rows], draws.offset[rows])
        streams = [generator(seed, RELIEF_STREAM, *names[row]) for row in rows.tolist()]
        white = np.stack([stream.standard_normal(base, dtype=np.float32) for stream in streams])
        self.spectrum = torch.fft.rfft2(torch.from_numpy(white))  # of each contact's unit white noise

    def noise(self, wavelength: float, width: float = 0.35, stretch: float = 1.0, shift: int = 0) -> Tensor:
        """Unit-variance noise, (N, R, R), around one wavelength in mm, which the object's scale multiplies.

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
        # The variance follows from the spectrum (Parseval), so it does not depend on the grid.
        power = spectrum.abs().square()
        variance = (2 * power.sum(dim=(-2, -1)) - power[..., 0].sum(-1)) / BASE_RESOLUTION**4
        return field / variance.clamp_min(1e-12).sqrt()[:, None, None]

    def cells(self, size: float, at: tuple[Tensor, Tensor] | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Worley cells of a mean side of `size` mm, which the object's scale multiplies, at its positions or others.

        Only the 3 x 3 squares around a pixel are searched. The second nearest seed lies outside of them for about one
        pixel in 10,000, whose second distance then comes out too long (by up to 0.2 cells).

        Returns:
            Distances to the nearest and second nearest seed, in cells, and a uniform number in [0, 1) of the nearest.
        """
        u, v = (position / (size * self.scale) for position in at or (self.x, self.y))
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
                distance = ((i + 0.5 + (a - 0.5) - u) ** 2 + (j + 0.5 + (b - 0.5) - v) ** 2).sqrt()
                second = torch.minimum(second, torch.maximum(first, distance))
                label = torch.where(distance < first, a, label)
                first = torch.minimum(first, distance)
        return first, second, label


def turned(x: Tensor, y: Tensor, angle: Tensor, offset: Tensor) -> tuple[Tensor, Tensor]:
    """Positions (N, R, R) in a frame turned by angles (N,), of x (1, 1, R) and y (1, R, 1) moved by offsets (N, 2)."""
    cos = torch.cos(angle)[:, None, None]
    sin = torch.sin(angle)[:, None, None]
    x = x + offset[:, 0, None, None]
    y = y + offset[:, 1, None, None]
    return cos * x + sin * y, -sin * x + cos * y


def zero_pad_spectrum(spectrum: Tensor, resolution: int) -> Tensor:
    """Spectrum (..., n, n // 2 + 1) of a real field, laid into that of a grid of `resolution` >= n pixels.

    Both grids sample the centres of their pixels on the same square. The finer grid's first centre is nearer to the
    rim, so each wave's phase is turned by that distance.
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
    # A Weyl sequence on the plastic number's powers, folded once. Float32 rounds what is folded, which leaves steps of
    # about 1e-4, but the same way each time: for integers |i|, |j| < 512 the numbers repeat and fill [0, 1) evenly.
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


def relief(material: str, f: Fields) -> Relief:
    """What covers bodies of a material: height, mm, and shade."""
    match material:
        case "concrete":  # a fine grain, and round holes that air has left, one in two cells
            grain = f.noise(1.2, 0.4)
            distance, _, label = f.cells(2.9)
            hole = smooth_step((0.10 + 0.3 * label - distance) / 0.06) * (label > 0.45)
            return f.amplitude * (0.05 * grain - 0.55 * hole), 0.5 * grain - 1.5 * hole
        case "plastic":  # bumps on a hexagonal lattice
            period = 2.4 * f.scale
            a = TAU * f.x / period
            b = TAU * (0.5 * f.x + 0.866 * f.y) / period
            lattice = (torch.cos(a) + torch.cos(b) + torch.cos(a - b)) / 3.0  # three waves at 120 degrees
            return f.amplitude * 0.32 * smooth_step(lattice), 0.6 * lattice
        case "glass":  # a swell that is next to nothing
            swell = f.noise(14.0, 0.3)
            return f.amplitude * 0.02 * swell, swell
        case "wood":  # annual rings, drifting, and pores along the grain
            drift = f.noise(9.0, 0.3, stretch=3.0)
            phase = torch.frac((f.y + 0.7 * drift) / (2.0 * f.scale) + 512.0)
            rings = 1.0 - 2.0 * torch.minimum(phase / 0.8, (1.0 - phase) / 0.2)  # late wood ends sharply
            pores = smooth_step((f.noise(0.9, 0.3, stretch=7.0, shift=1) - 1.0) / 0.5)
            return f.amplitude * (0.12 * rings - 0.20 * pores), 0.7 * rings - 0.8 * pores
        case "metal":  # brushed
            scratches = f.noise(0.75, 0.25, stretch=60.0)
            return f.amplitude * 0.07 * scratches, 0.7 * scratches
        case "brick":  # courses, each moved by half a brick, with mortar between
            grain = f.noise(1.3, 0.5)
            course = 6.5 * f.scale
            row = torch.floor(f.y / course + 0.5)
            bed = groove(f.y, course, 1.1)
            head = groove(f.x + 0.5 * row * 2.1 * course, 2.1 * course, 1.1)
            joint = torch.maximum(bed, head)
            height = f.amplitude * (0.13 * grain * (1.0 - 0.7 * joint) - 0.9 * joint)
            return height, 0.35 * grain * (1.0 - joint) + 0.4 - 2.0 * joint
        case "tile":  # a grid of joints under glaze
            period = 4.6 * f.scale
            joint = torch.maximum(groove(f.x, period, 0.7), groove(f.y, period, 0.7))
            glaze = f.noise(9.0, 0.3)
            return f.amplitude * (-0.75 * joint + 0.02 * glaze), 0.3 + 0.08 * glaze - 1.6 * joint
        case "leather":  # pebbles between furrows
            first, second, _ = f.cells(1.8)
            pebble = smooth_step((second - first) / 0.35)
            return f.amplitude * (0.26 * pebble + 0.03 * f.noise(4.0)), pebble - 0.6
        case "synthetic fabric":  # a plain weave: warp and weft take turns on top
            period = 1.5 * f.scale
            a = math.pi * f.x / period
            b = math.pi * f.y / period
            over = torch.sin(a) * torch.sin(b) > 0
            weave = torch.where(
                over, torch.cos(a).abs() * 0.35 + torch.sin(b).abs(), torch.cos(b).abs() * 0.35 + torch.sin(a).abs()
            )
            return f.amplitude * 0.20 * weave, weave - 0.75
        case "natural fabric":  # ribs of twisted yarn
            period = 3.0 * f.scale
            wobble = 0.30 * f.noise(6.0, 0.35)
            rib = torch.sin(TAU * (f.y + wobble) / period)
            twist = torch.sin(TAU * (f.x + 0.55 * f.y + wobble) / (0.5 * period))
            yarn = 0.75 * rib + 0.55 * twist * (0.6 + 0.4 * rib) + 0.12 * f.noise(0.9, shift=1)
            return f.amplitude * 0.30 * yarn, 0.8 * yarn
        case "rubber":  # studs on a diagonal grid
            period = 4.2 * f.scale
            a = TAU * (f.x + f.y) / (1.414 * period)
            b = TAU * (f.x - f.y) / (1.414 * period)
            stud = torch.sigmoid(10.0 * (torch.sin(a) * torch.sin(b) - 0.12))
            return f.amplitude * 0.75 * stud, 1.2 * stud - 0.6
        case "paper":  # crumpled: |noise| folds the sheet along its zero lines
            fold = f.noise(8.0, 0.28)
            crease = f.noise(6.0, 0.28, shift=1)
            facets = -torch.minimum(fold.abs(), crease.abs())
            return f.amplitude * 0.75 * facets, 0.9 + 1.6 * facets + 0.1 * f.noise(0.9)
        case "tree":  # plates of bark between furrows
            plates = f.noise(4.2, 0.3, stretch=3.2)
            ridge = 1.0 - 2.0 * torch.exp(-((plates / 0.42) ** 2))
            fibre = f.noise(1.2, 0.4, stretch=3.0, shift=1)
            return f.amplitude * (0.6 * ridge + 0.12 * fibre), 0.7 * ridge + 0.25 * fibre
        case "grass":  # three layers of blades
            top = torch.full_like(f.x, -1.0)
            for layer, (turn, period) in enumerate(((0.0, 2.7), (0.42, 3.4), (-0.38, 4.0))):
                bend = 1.1 * f.noise(11.0, 0.3, shift=layer)
                across = math.cos(turn) * f.y + math.sin(turn) * f.x + bend
                phase = (torch.frac(across / (period * f.scale) + 512.0) - 0.5) * period * f.scale
                blade = 1.0 - (phase.abs() / 0.55) ** 2
                top = torch.maximum(top, blade.clamp_min(-1.0) - 0.3 * layer)
            return f.amplitude * 0.6 * top.clamp_min(-0.6), 1.2 * top.clamp_min(-0.7)
        case "gravel":  # round stones
            first, second, label = f.cells(4.2)
            stone = (1.0 - (first / 0.72) ** 2).clamp_min(0.0).sqrt() * smooth_step((second - first) / 0.30)
            height = stone * (0.75 + 0.45 * label)
            return f.amplitude * (1.3 * height + 0.05 * f.noise(1.5)), 1.5 * stone - 0.8 + 0.5 * (label - 0.5)
        case "sand":  # grains, and ripples
            first, _, label = f.cells(0.85)
            grain = (1.0 - (first / 0.7) ** 2).clamp_min(0.0) * (0.5 + 0.5 * label)
            ripple = torch.sin(TAU * (f.y + 0.8 * f.noise(10.0, 0.3, shift=1)) / (6.5 * f.scale))
            return f.amplitude * (0.26 * grain + 0.12 * ripple), 0.9 * grain - 0.4 + 0.35 * ripple
        case "rock":  # broken faces, each at a height of its own
            swell = f.noise(6.0, 0.4)
            grain = f.noise(1.8, 0.9, shift=1)
            bent = f.x + 0.9 * f.scale * swell, f.y + 0.9 * f.scale * f.noise(6.0, 0.4, shift=2)
            first, second, label = f.cells(4.5, at=bent)
            face = smooth_step((second - first) / 0.18)
            height = 0.9 * (label - 0.5) * face - 0.3 * (1.0 - face) + 0.2 * swell + 0.07 * grain
            return f.amplitude * height, 0.9 * (label - 0.4) * face - 0.9 * (1.0 - face) + 0.35 * grain
        case _:
            raise KeyError(material)
