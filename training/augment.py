"""Augmentations of batches of raw pixels (B, 3, S, S) in [0, 1], each with its own draw for every sample."""

import torch
import torch.nn.functional as F
from torch import Tensor


def shift_pixels(images: Tensor, reach: int) -> Tensor:
    """Moves each image by up to `reach` pixels along both axes; the border is repeated."""
    padded = F.pad(images, (reach,) * 4, mode="replicate")
    size = images.shape[-1]
    top, left = torch.randint(0, 2 * reach + 1, (2, len(images)), device=images.device)
    rows = top[:, None] + torch.arange(size, device=images.device)
    columns = left[:, None] + torch.arange(size, device=images.device)
    batch = torch.arange(len(images), device=images.device)[:, None, None]
    return padded[batch, :, rows[:, :, None], columns[:, None, :]].permute(0, 3, 1, 2)


def jitter_colours(images: Tensor, gain: float, offset: float) -> Tensor:
    """Scales each channel by 1 +- gain and shifts it by +- offset (uniform)."""
    shape = (len(images), 3, 1, 1)
    scale = 1.0 + gain * (2 * torch.rand(shape, device=images.device) - 1)
    shift = offset * (2 * torch.rand(shape, device=images.device) - 1)
    return (images * scale + shift).clamp(0.0, 1.0)


def turn_and_flip(images: Tensor, probability: float) -> Tensor:
    """Turns some images by a multiple of 90 degrees and mirrors half of those: lights from other sides."""
    chosen = torch.rand(len(images), device=images.device) < probability
    quarter = torch.randint(0, 4, (len(images),), device=images.device) * chosen
    mirrored = (torch.rand(len(images), device=images.device) < 0.5) & chosen
    out = images.clone()
    for turns in (1, 2, 3):
        rows = quarter == turns
        out[rows] = torch.rot90(images[rows], turns, dims=(2, 3))
    out[mirrored] = out[mirrored].flip(3)
    return out


def permute_channels(images: Tensor, probability: float) -> Tensor:
    """Exchanges the colours of some images: lights of other colours."""
    chosen = torch.rand(len(images), device=images.device) < probability
    order = torch.rand(len(images), 3, device=images.device).argsort(dim=1)
    order = torch.where(chosen[:, None], order, torch.arange(3, device=images.device))
    return images.gather(1, order[:, :, None, None].expand_as(images))


def blur_some(images: Tensor, probability: float) -> Tensor:
    """Softens some images by a 3 x 3 binomial kernel: softer gels."""
    kernel = torch.tensor([1.0, 2.0, 1.0], device=images.device)
    kernel = (kernel[:, None] * kernel[None, :] / 16).expand(3, 1, 3, 3)
    soft = F.conv2d(F.pad(images, (1, 1, 1, 1), mode="replicate"), kernel, groups=3)
    chosen = torch.rand(len(images), 1, 1, 1, device=images.device) < probability
    return torch.where(chosen, soft, images)


def add_noise(images: Tensor, deviation: float) -> Tensor:
    """Camera noise of up to `deviation`, a level for each image."""
    level = deviation * torch.rand(len(images), 1, 1, 1, device=images.device)
    return (images + level * torch.randn_like(images)).clamp(0.0, 1.0)
