"""Images of every kind a user passes, as tensors, and from there as the normalised squares an encoder sees."""

import io
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image, ImageOps
from torch import Tensor
from transformers.image_utils import OPENAI_CLIP_MEAN, OPENAI_CLIP_STD

from unitouch_gen.errors import InvalidInputError, InvalidTypeError, check_finite, describe, first_line
from unitouch_gen.files import check_file

MIN_SIDE, MAX_ASPECT, MAX_PIXELS = 8, 100, 8000**2
"""Smaller images hold nothing to see; longer ones would be blown up beyond memory when their short side is resized;
larger ones are taken for decompression bombs."""

ImageInput = Any  # a path, a PIL image, an array or a tensor, or a list of them: too wide for a useful union


def load_images(name: str, images: ImageInput) -> list[Tensor]:
    """Images as tensors (3, H, W): uint8, or float32 in [0, 1].

    Accepts a path, a PIL image, a numpy array (H, W), (H, W, 1 or 3) or (B, H, W, 1 or 3), a tensor (1 or 3, H, W) or
    (B, 1 or 3, H, W), and lists of them. Integers run from 0 to 255, floats from 0 to 1. Files and PIL images with
    transparency are laid over white, as most viewers show them.

    Raises:
        InvalidInputError, InvalidTypeError: If a file is no whole image, one is too small or too large, an array has a
            wrong shape, kind or range, or the list is empty. The message names the argument, `name`, and the item.
    """
    if isinstance(images, list | tuple):
        if not images:
            raise InvalidInputError(f"`{name}` is an empty list; pass at least one image.")
        return [image for i, item in enumerate(images) for image in _load(f"{name}[{i}]", item)]
    return _load(name, images)


def _load(name: str, image: Any) -> list[Tensor]:
    if isinstance(image, str | os.PathLike):
        check_file(name, image, "an image file")
        with _readable(f"`{name}` names {str(image)!r}, which"), warnings.catch_warnings():
            # Between one and two times its limit Pillow only warns; ours decides below.
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            image = Image.open(io.BytesIO(Path(image).read_bytes()))
    if isinstance(image, Image.Image):
        image = _from_pil(name, image)
    if isinstance(image, np.ndarray):
        image = _from_array(name, np.asarray(image))
    if isinstance(image, Tensor):
        return _from_tensor(name, image.detach())
    raise InvalidTypeError(
        f"`{name}` is {describe(image)}; pass a path, a PIL image, a numpy array (H, W, 3) or a tensor (3, H, W)."
    )


@contextmanager
def _readable(subject: str) -> Iterator[None]:
    """Pillow's plugins raise many kinds of errors on broken files; all of them become one."""
    try:
        yield
    except Exception as error:
        raise InvalidInputError(
            f"{subject} cannot be read as an image ({first_line(error)}); pass a whole PNG, JPEG or other image file."
        ) from error


def _from_pil(name: str, image: Image.Image) -> np.ndarray:
    _check_size(name, *image.size)  # before its pixels are decoded
    with _readable(f"`{name}` is an image that"):
        image = ImageOps.exif_transpose(image)
        image.load()
    if image.mode in ("F", "I") or image.mode.startswith("I;16"):  # convert("RGB") would clip 16-bit greyscale
        return np.asarray(image, np.float32) / (1.0 if image.mode == "F" else 65535.0)
    if image.has_transparency_data:  # convert("RGB") alone would bring out colours that nobody sees
        image = image.convert("LA" if image.mode == "La" else "RGBA").convert("RGBA")
        image = Image.alpha_composite(Image.new("RGBA", image.size, "white"), image)
    return np.array(image.convert("RGB"))


def _from_array(name: str, array: np.ndarray) -> Tensor:
    if array.dtype.kind not in "uifb":
        raise InvalidTypeError(f"`{name}` is {describe(array)}; it has to hold numbers.")
    pixels = array[..., None] if array.ndim == 2 else array
    if pixels.ndim not in (3, 4) or pixels.shape[-1] not in (1, 3):
        wanted = "an array has to be (H, W), (H, W, 3) or (B, H, W, 3), with 1 or 3 channels last"
        raise InvalidInputError(f"`{name}` is {describe(array)}; {wanted}.")
    dtype = np.float64 if array.itemsize > 8 else array.dtype.newbyteorder("=")  # torch knows no other long floats
    return torch.from_numpy(np.require(pixels, dtype, ["C", "W"])).movedim(-1, -3)


def _from_tensor(name: str, tensor: Tensor) -> list[Tensor]:
    if tensor.layout != torch.strided or tensor.is_meta or tensor.is_complex() or tensor.is_quantized:
        raise InvalidTypeError(f"`{name}` is {describe(tensor)}; it has to be dense and hold real numbers.")
    tensor = tensor[None] if tensor.ndim == 3 else tensor
    if tensor.ndim != 4 or tensor.shape[1] not in (1, 3) or len(tensor) == 0:
        wanted = "a tensor has to be (3, H, W) or (B, 3, H, W), with 1 or 3 channels"
        raise InvalidInputError(f"`{name}` is {describe(tensor)}; {wanted}.")
    _check_size(name, tensor.shape[3], tensor.shape[2])
    tensor = tensor.cpu()
    if tensor.is_floating_point() or tensor.dtype == torch.bool:
        tensor, top = check_finite(name, tensor).float(), 1.0
    else:
        tensor, top = tensor if tensor.dtype == torch.uint8 else tensor.long(), 255.0  # torch orders no wider unsigned
    low, high = tensor.min().item(), tensor.max().item()
    if low < 0 or high > top:
        found = f"`{name}` holds values from {low:g} to {high:g}"
        raise InvalidInputError(f"{found}; float images run from 0 to 1 and integer images from 0 to 255.")
    return list((tensor if tensor.is_floating_point() else tensor.to(torch.uint8)).expand(-1, 3, -1, -1))


def _check_size(name: str, width: int, height: int) -> None:
    short, long = sorted((width, height))
    if short < MIN_SIDE or long > MAX_ASPECT * short or width * height > MAX_PIXELS:
        raise InvalidInputError(
            f"`{name}` is {width} x {height} pixels; images need at least {MIN_SIDE} x {MIN_SIDE} and at most "
            f"{MAX_PIXELS:,}, and one side may be {MAX_ASPECT} times the other. Crop or resize it."
        )


def centre_rectangle(image: Tensor, height: int, width: int) -> Tensor:
    """(3, H, W) uint8 or float -> (3, height, width) float32 in [0, 1]: resized (bicubic) to cover, centre cropped."""
    rows, columns = image.shape[-2:]
    if (rows, columns) != (height, width):
        # Rounded down, as CLIP's processors do; exact along the side that fits.
        by_height = rows * width <= columns * height
        target = (height, columns * height // rows) if by_height else (rows * width // columns, width)
        image = F.interpolate(image[None], target, mode="bicubic", antialias=True)[0]
        top, left = (target[0] - height) // 2, (target[1] - width) // 2
        image = image[:, top : top + height, left : left + width]
    return image.float() / 255.0 if image.dtype == torch.uint8 else image.clamp(0.0, 1.0)


def normalise_pixels(raw: Tensor) -> Tensor:
    """[0, 1] -> zero mean and unit variance by CLIP's statistics, (..., 3, H, W)."""
    mean, deviation = raw.new_tensor([OPENAI_CLIP_MEAN, OPENAI_CLIP_STD])[..., None, None]
    return (raw - mean) / deviation


def denormalise_pixels(pixel_values: Tensor) -> Tensor:
    """The inverse of `normalise_pixels`."""
    mean, deviation = pixel_values.new_tensor([OPENAI_CLIP_MEAN, OPENAI_CLIP_STD])[..., None, None]
    return pixel_values * deviation + mean
