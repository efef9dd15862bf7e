"""Grids of pixels over squares of millimetres: positions, wavenumbers, slopes, convolution."""

import math

import torch
from torch import Tensor

PATCH_MM = 32.0  # side of the square patch that one picture shows


def pixel_axis(resolution: int, extent: float = PATCH_MM) -> Tensor:
    """Centres of `resolution` pixels over `extent` mm, with zero in the middle."""
    centres = (torch.arange(resolution, dtype=torch.float32) + 0.5) / resolution
    return (centres - 0.5) * extent


def wavenumbers(resolution: int, extent: float = PATCH_MM) -> tuple[Tensor, Tensor]:
    """Angular wavenumbers (ky (n, 1), kx (1, n // 2 + 1)) of a real FFT over `extent` mm, rad/mm."""
    step = extent / resolution
    ky = 2 * math.pi * torch.fft.fftfreq(resolution, d=step)
    kx = 2 * math.pi * torch.fft.rfftfreq(resolution, d=step)
    return ky[:, None], kx[None, :]


def slopes(height: Tensor, pixel: float) -> tuple[Tensor, Tensor]:
    """Central differences along x and y of a periodic field (N, R, R) with pixels of `pixel` mm."""
    along_x = (height.roll(-1, dims=-1) - height.roll(1, dims=-1)) / (2 * pixel)
    along_y = (height.roll(-1, dims=-2) - height.roll(1, dims=-2)) / (2 * pixel)
    return along_x, along_y


def convolved(field: Tensor, weights: Tensor) -> Tensor:
    """Rows and columns of a field (N, R, R) convolved with an odd number of symmetric weights; borders are replicated.

    Two matrix products take a fraction of the time of a one-channel convolution on a CPU.
    """
    size = field.shape[-1]
    reach = len(weights) // 2
    banded = torch.zeros(size + 2 * reach, size)
    for offset, weight in enumerate(weights.tolist()):
        banded.diagonal(-offset).fill_(weight)
    matrix = banded[reach : size + reach].clone()
    matrix[0] += banded[:reach].sum(dim=0)
    matrix[-1] += banded[size + reach :].sum(dim=0)
    return matrix.T @ (field @ matrix)
