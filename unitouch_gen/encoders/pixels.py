"""Whatever a user calls an image, as a uint8 or float tensor, and from there as the square an encoder sees."""

import io
import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image, ImageOps, UnidentifiedImageError
from torch import Tensor
from transformers.image_utils import OPENAI_CLIP_MEAN, OPENAI_CLIP_STD

from unitouch_gen.errors import InvalidInputError, InvalidTypeError, check_finite, describe

MIN_SIDE = 8
"""Images with a shorter side than this hold nothing to feel or see, pixels."""

MAX_PIXELS = 64_000_000
"""Images with more pixels than this are taken for decompression bombs."""

ImageInput = Any  # a path, a PIL image, an array or a tensor, or a list of them: too wide for a useful union


def load_images(name: str, images: ImageInput) -> list[Tensor]:
    """Whatever a user passed, as a list of tensors (3, H, W): uint8, or float32 in [0, 1].

    Accepts a path, a PIL image, a numpy array (H, W), (H, W, 1 or 3) or (B, H, W, 1 or 3), a tensor (1 or 3, H, W) or
    (B, 1 or 3, H, W), and lists of them. Integer arrays run from 0 to 255, float arrays from 0 to 1.

    Args:
        name: Of the argument, for the messages.
        images: What came.

    Raises:
        InvalidInputError: If a file is no readable image, is cut short, too small or too large, an array has a wrong
            shape, range or non-finite values, or the list is empty.
        InvalidTypeError: If it is something else altogether.
    """
    if isinstance(images, list | tuple):
        if not images:
            raise InvalidInputError(f"`{name}` is an empty list; pass at least one image.")
        loaded = [image for i, item in enumerate(images) for image in _load(f"{name}[{i}]", item)]
    else:
        loaded = _load(name, images)
    return loaded


def _load(name: str, image: Any) -> list[Tensor]:
    if isinstance(image, str | os.PathLike):
        return [_from_pil(name, _open(name, Path(image)))]
    if isinstance(image, Image.Image):
        return [_from_pil(name, image)]
    if isinstance(image, np.ndarray):
        return _from_array(name, image)
    if isinstance(image, Tensor):
        return _from_tensor(name, image.detach())
    raise InvalidTypeError(
        f"`{name}` is {describe(image)}; pass a path, a PIL image, a numpy array (H, W, 3) or a tensor (3, H, W)."
    )


def _open(name: str, path: Path) -> Image.Image:
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "does not exist"
        raise InvalidInputError(f"`{name}` names {str(path)!r}, which {what}; pass the path of an image file.")
    try:
        with warnings.catch_warnings():  # between one and two times its limit Pillow only warns; ours decides below
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            image = Image.open(io.BytesIO(path.read_bytes()))
        _check_size(f"{name} ({path.name})", *image.size)
        image.load()
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, SyntaxError, EOFError) as error:
        raise InvalidInputError(
            f"`{name}` names {str(path)!r}, which cannot be read as an image ({_reason(error)}); pass a whole PNG, "
            "JPEG or other image file."
        ) from error
    return image


def _reason(error: Exception) -> str:
    if isinstance(error, UnidentifiedImageError):
        return "its contents are of no known image format"
    if isinstance(error, Image.DecompressionBombError):
        return "it would unpack to far too many pixels"
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def _from_pil(name: str, image: Image.Image) -> Tensor:
    _check_size(name, *image.size)
    image = ImageOps.exif_transpose(image)
    if image.mode.startswith("I;16") or image.mode == "I":  # 16-bit greyscale; convert("RGB") would clip it
        values = np.asarray(image, dtype=np.float32) / 65535.0
        return _from_array(name, values)[0]
    if image.mode == "F":
        return _from_array(name, np.asarray(image, dtype=np.float32))[0]
    return torch.from_numpy(np.array(image.convert("RGB"))).permute(2, 0, 1)


def _from_array(name: str, array: np.ndarray) -> list[Tensor]:
    if array.ndim == 2:
        array = array[..., None]
    if array.ndim == 3:
        array = array[None]
    if array.ndim != 4 or array.shape[-1] not in (1, 3):
        raise InvalidInputError(
            f"`{name}` is {describe(array)}; an array has to be (H, W), (H, W, 3) or (B, H, W, 3), with 1 or 3 channels "
            "last."
        )
    if array.dtype == object or array.dtype.kind not in "uifb":
        raise InvalidTypeError(f"`{name}` is {describe(array)}; it has to hold numbers.")
    return _from_tensor(name, torch.from_numpy(np.ascontiguousarray(array)).permute(0, 3, 1, 2))


def _from_tensor(name: str, tensor: Tensor) -> list[Tensor]:
    if tensor.ndim == 3:
        tensor = tensor[None]
    if tensor.ndim != 4 or tensor.shape[1] not in (1, 3) or len(tensor) == 0:
        raise InvalidInputError(
            f"`{name}` is {describe(tensor)}; a tensor has to be (3, H, W) or (B, 3, H, W), with 1 or 3 channels."
        )
    _check_size(name, tensor.shape[3], tensor.shape[2])
    tensor = tensor.cpu()
    if tensor.is_floating_point():
        tensor = check_finite(name, tensor).float()
        top = 1.0
    else:
        top = 255.0
    low, high = tensor.min().item(), tensor.max().item()
    if low < 0 or high > top:
        raise InvalidInputError(
            f"`{name}` holds values from {low:g} to {high:g}; float images run from 0 to 1 and integer images from 0 "
            "to 255."
        )
    tensor = tensor if tensor.is_floating_point() else tensor.to(torch.uint8)
    return list(tensor.expand(-1, 3, -1, -1))


def _check_size(name: str, width: int, height: int) -> None:
    if min(width, height) < MIN_SIDE:
        raise InvalidInputError(
            f"`{name}` is {width} x {height} pixels; images need at least {MIN_SIDE} x {MIN_SIDE}."
        )
    if width * height > MAX_PIXELS:
        raise InvalidInputError(
            f"`{name}` is {width} x {height} pixels, more than {MAX_PIXELS:,}; resize it before passing it."
        )


def centre_square(image: Tensor, size: int) -> Tensor:
    """(3, H, W) uint8 or float -> (3, size, size) float32 in [0, 1]: shorter side resized (bicubic), centre cropped."""
    height, width = image.shape[-2:]
    if (height, width) != (size, size):
        scale = size / min(height, width)
        target = (max(size, round(height * scale)), max(size, round(width * scale)))
        image = F.interpolate(image[None], target, mode="bicubic", antialias=True)[0]
        top, left = (target[0] - size) // 2, (target[1] - size) // 2
        image = image[:, top : top + size, left : left + size]
    return image.float() / 255.0 if image.dtype == torch.uint8 else image.clamp(0.0, 1.0)


def normalise_pixels(raw: Tensor) -> Tensor:
    """[0, 1] -> zero mean and unit variance as CLIP counts them, (..., 3, H, W)."""
    return (raw - _column(OPENAI_CLIP_MEAN, raw)) / _column(OPENAI_CLIP_STD, raw)


def denormalise_pixels(pixel_values: Tensor) -> Tensor:
    """The inverse of `normalise_pixels`."""
    return pixel_values * _column(OPENAI_CLIP_STD, pixel_values) + _column(OPENAI_CLIP_MEAN, pixel_values)


def _column(values: Sequence[float], like: Tensor) -> Tensor:
    return torch.tensor(values, dtype=like.dtype, device=like.device)[:, None, None]
