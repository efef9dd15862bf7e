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
    """Pictures (N, 3, S, S) in [0, 1], a share of them as photos, each with a camera and light of its own.

    Everything is drawn for each name (material, object, contact) and take. The ranges are chosen, not measured: light
    varies by up to a third over the picture, two of five have the soft edge of a shadow, exposure has a deviation of a
    fifth, half are out of focus by up to a hundredth of a side, and three of four are compressed.
    """
    photos = list[Tensor]()
    for name, picture in zip(names, pictures):
        rng = generator(seed, CAMERA_STREAM, *name, take)
        photos.append(_photograph(rng, picture, share))
    return torch.stack(photos)


def _photograph(rng: np.random.Generator, picture: Tensor, share: float) -> Tensor:
    """One picture (3, S, S), as a photo with probability `share`."""
    if rng.uniform() >= share:
        return picture
    size = picture.shape[-1]
    axis = pixel_axis(size, 2.0)
    x = axis[None, :]
    y = axis[:, None]

    # 1. Light: a gradient, a vignette, and the soft edge of a shadow. Daylight in the shadow is bluer.
    turn = rng.uniform(-math.pi, math.pi)
    slope = rng.uniform(0.0, 0.3)
    vignette = rng.uniform(0.0, 0.2)
    light = 1.0 + slope * (math.cos(turn) * x + math.sin(turn) * y) - vignette * 0.5 * (x**2 + y**2)
    light = light.expand(3, -1, -1)
    turn = rng.uniform(-math.pi, math.pi)
    place = rng.uniform(-0.9, 0.9)
    width = rng.uniform(0.02, 0.3)
    darkness = rng.uniform(0.2, 0.6)
    if rng.uniform() < 0.4:
        shadow = torch.sigmoid((math.cos(turn) * x + math.sin(turn) * y - place) / width)
        light = light * (1.0 - darkness * torch.tensor([1.0, 0.95, 0.85])[:, None, None] * shadow)

    # 2. Colours: temperature and tint of the white balance, exposure, saturation and tone.
    warmth = rng.normal(0.0, 0.07)
    green = rng.normal(0.0, 0.03)
    exposure = rng.normal(0.0, 0.2)
    gains = torch.tensor([exposure + warmth, exposure + green, exposure - warmth]).exp()
    linear = picture**2.2 * light * gains[:, None, None].float()
    photo = linear.clamp(1e-6, 1.0) ** (rng.uniform(0.85, 1.2) / 2.2)
    grey = photo.mean(dim=0, keepdim=True)
    photo = grey + rng.uniform(0.7, 1.25) * (photo - grey)

    # 3. The camera: focus, noise and compression.
    if rng.uniform() < 0.5:
        photo = gaussian_blur(photo, rng.uniform(0.002, 0.01) * size)
    noise = torch.from_numpy(rng.standard_normal(tuple(photo.shape), dtype=np.float32))
    photo = (photo + rng.uniform(0.0, 0.025) * noise).clamp(0.0, 1.0)
    if rng.uniform() < 0.75:
        photo = _compressed(photo, int(rng.integers(40, 96)))
    return photo


def _compressed(picture: Tensor, quality: int) -> Tensor:
    """A picture (3, S, S) after JPEG compression."""
    content = io.BytesIO()
    pixels = (picture * 255).round().byte().permute(1, 2, 0).numpy()
    Image.fromarray(pixels).save(content, "JPEG", quality=quality)
    return torch.from_numpy(np.array(Image.open(content))).permute(2, 0, 1) / 255
