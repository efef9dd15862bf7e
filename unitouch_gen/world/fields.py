"""Scalar fields on a square patch of surface: coordinates, band-limited noise and cells, batched over objects.

Every field is a function of position in millimetres, so a finer grid samples the same surface more often: the noise
is drawn on one base grid and interpolated, at the finer grid's pixel centres, by zero-padding its spectrum.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

PATCH_MM = 32.0
"""Side of the square patch that one picture shows, mm."""

BASE_RESOLUTION = 128
"""Pixels a side of the grid on which noise is drawn."""


def pixel_axis(resolution: int, extent: float = PATCH_MM) -> Tensor:
    """Centres of `resolution` pixels over `extent` mm, with zero in the middle."""
    return ((torch.arange(resolution, dtype=torch.float32) + 0.5) / resolution - 0.5) * extent


def wavenumbers(resolution: int, extent: float = PATCH_MM) -> tuple[Tensor, Tensor]:
    """Angular wavenumbers (ky (n, 1), kx (1, n // 2 + 1)) of a real FFT over `extent` mm, rad/mm."""
    step = extent / resolution
    ky = 2 * math.pi * torch.fft.fftfreq(resolution, d=step)
    kx = 2 * math.pi * torch.fft.rfftfreq(resolution, d=step)
    return ky[:, None], kx[None, :]


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
