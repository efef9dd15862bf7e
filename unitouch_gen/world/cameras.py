"""Pictures as a person takes them: uneven light, shadows, colour casts, exposure, blur, noise and JPEG."""

import io
import math

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from unitouch_gen.world.attributes import gaussian_blur
from unitouch_gen.world.draws import CAMERA_STREAM, generator
from unitouch_gen.world.grids import pixel_axis


def photographed(
    seed: int, names: list[tuple[int, int, int]], pictures: Tensor, share: float = 1.0, take: int = 0
) -> Tensor:
    """Pictures (N, 3, S, S) in [0, 1], of which a share is taken by a camera and under a light of its own.

    Everything is drawn for each name (material, object, contact) and take. The ranges are chosen, not measured: light
    varies by up to a third over the picture, two of five have the soft edge of a shadow, exposure has a deviation of a
    fifth, half are out of focus by up to a hundredth of a side, and three of four are compressed.
    """
    return torch.stack(
        [
            _photograph(generator(seed, CAMERA_STREAM, *name, take), picture, share)
            for name, picture in zip(names, pictures)
        ]
    )


def _photograph(rng: np.random.Generator, picture: Tensor, share: float) -> Tensor:
    if rng.uniform() >= share:
        return picture
    size = picture.shape[-1]
    axis = pixel_axis(size, 2.0)
    x = axis[None, :]
    y = axis[:, None]

    # 1. Light: a gradient, a vignette, and the soft edge of a shadow, in which daylight is bluer.
    turn = rng.uniform(-math.pi, math.pi)
    slope = rng.uniform(0.0, 0.3)
    vignette = rng.uniform(0.0, 0.2)
    light = 1.0 + slope * (math.cos(turn) * x + math.sin(turn) * y) - vignette * 0.5 * (x**2 + y**2)
    light = light.expand(3, -1, -1)
    turn, place, width, dark = (
        rng.uniform(*ends) for ends in ((-math.pi, math.pi), (-0.9, 0.9), (0.02, 0.3), (0.2, 0.6))
    )
    if rng.uniform() < 0.4:
        shadow = torch.sigmoid((math.cos(turn) * x + math.sin(turn) * y - place) / width)
        light = light * (1.0 - dark * torch.tensor([1.0, 0.95, 0.85])[:, None, None] * shadow)

    # 2. Colours: temperature and tint of the white balance, exposure, saturation and tone.
    warmth = rng.normal(0.0, 0.07)
    green = rng.normal(0.0, 0.03)
    exposure = rng.normal(0.0, 0.2)
    gains = torch.tensor([exposure + warmth, exposure + green, exposure - warmth]).exp()
    linear = picture**2.2 * light * gains[:, None, None].float()
    seen = linear.clamp(1e-6, 1.0) ** (rng.uniform(0.85, 1.2) / 2.2)
    grey = seen.mean(dim=0, keepdim=True)
    seen = grey + rng.uniform(0.7, 1.25) * (seen - grey)

    # 3. The camera: focus, noise and compression.
    if rng.uniform() < 0.5:
        seen = gaussian_blur(seen, rng.uniform(0.002, 0.01) * size)
    noise = torch.from_numpy(rng.standard_normal(tuple(seen.shape), dtype=np.float32))
    seen = (seen + rng.uniform(0.0, 0.025) * noise).clamp(0.0, 1.0)
    if rng.uniform() < 0.75:
        seen = _compressed(seen, int(rng.integers(40, 96)))
    return seen


def _compressed(picture: Tensor, quality: int) -> Tensor:
    """What JPEG leaves of a picture (3, S, S)."""
    content = io.BytesIO()
    pixels = (picture * 255).round().byte().permute(1, 2, 0).numpy()
    Image.fromarray(pixels).save(content, "JPEG", quality=quality)
    return torch.from_numpy(np.array(Image.open(content))).permute(2, 0, 1) / 255
