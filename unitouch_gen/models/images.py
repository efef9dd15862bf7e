"""Images from files, PIL, arrays and tensors, and the normalised squares that encoders take."""

import io
import os
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from PIL import ExifTags, Image, ImageCms, ImageOps
from torch import Tensor
from transformers.image_utils import OPENAI_CLIP_MEAN, OPENAI_CLIP_STD

from unitouch_gen.errors import (
    InvalidInputError,
    InvalidTypeError,
    check_file,
    check_finite,
    check_not_empty,
    describe,
    explain_errors,
)
from unitouch_gen.models.formats import content_kind

ImageInput = Any  # a path, a PIL image, an array or a tensor, or a list of them: too wide for a useful union

PNG = b"\x89PNG\r\n\x1a\n"
PNG_CHUNKS = frozenset({b"IHDR", b"PLTE", b"IDAT", b"IEND", b"tRNS", b"eXIf", b"acTL", b"fcTL", b"fdAT"})
"""Chunks that pixels depend on."""

PNG_TEXTS = frozenset({b"tEXt", b"zTXt", b"iTXt"})
ORIENTATION_TEXTS = frozenset({b"Raw profile type exif", b"XML:com.adobe.xmp"})
"""Texts in which older ImageMagick and Adobe store the orientation."""

MOST_PROFILE = 2**26  # largest colour profile, bytes


def load_images(name: str, images: ImageInput) -> list[Tensor]:
    """Images as tensors (3, H, W): uint8, or float32 in [0, 1].

    Accepts a path (image or .npy), a PIL image, a numpy array (H, W), (H, W, 1 or 3) or (B, H, W, 1 or 3),
    a tensor (1 or 3, H, W) or (B, 1 or 3, H, W), and lists of them. Integers run from 0 to 255, floats from 0 to 1.
    Grey files and arrays of 16 bits are scaled by the fewest bits that hold their values, see `_by_range`. Of colour
    files of 16 bits, the upper 8 are read. Files and PIL images are converted by their colour profile, and transparent
    ones are laid over white, as most viewers show them.

    Raises:
        InvalidInputError, InvalidTypeError: If a file is no whole image, one is too small or too large, an array has a
            wrong shape, kind or range, or the list is empty. The message names the argument, `name`, and the item.
    """
    if not isinstance(images, list | tuple):
        return _load(name, images)
    check_not_empty(name, images)
    tensors = list[Tensor]()
    for index, item in enumerate(images):
        tensors += _load(f"{name}[{index}]", item)
    return tensors


def _load(name: str, image: Any) -> list[Tensor]:
    subject = f"`{name}`"
    if isinstance(image, str | os.PathLike):
        image = os.path.expanduser(image)
        check_file(name, image, "an image file")
        subject = f"`{name}` names {image!r}, which"
        image = _read(subject, image)
    if isinstance(image, Image.Image):
        _check_size(name, *image.size)  # before pixels are decoded
        image = _decoded(subject, image)
    pixels = None
    if isinstance(image, np.ndarray) and image.dtype.kind in "uifb":
        pixels = _channels_first(subject, image)
    elif isinstance(image, Tensor) and _is_dense_and_real(image):
        pixels = image.detach()
    if pixels is None:
        wanted = "pass a path, PIL image, array (H, W, 3) or tensor (3, H, W) of real numbers"
        raise InvalidTypeError(f"{subject} is {describe(image)}; {wanted}.")
    pixels = pixels[None] if pixels.ndim == 3 else pixels
    if pixels.ndim != 4 or pixels.shape[1] not in (1, 3) or len(pixels) == 0:
        wanted = "an array has to be (H, W), (H, W, 3) or (B, H, W, 3), a tensor (3, H, W) or (B, 3, H, W)"
        raise InvalidInputError(f"{subject} is {describe(image)}; {wanted}.")
    _check_size(name, pixels.shape[3], pixels.shape[2])
    return list(_in_range(name, pixels.cpu()).expand(-1, 3, -1, -1))


def _is_dense_and_real(tensor: Tensor) -> bool:
    return tensor.layout == torch.strided and not (tensor.is_meta or tensor.is_complex() or tensor.is_quantized)


def _read(subject: str, file: str) -> Image.Image | np.ndarray:
    """The image in a file, not yet decoded, or the array in a .npy file."""
    with _reading_errors(subject):
        content = Path(file).read_bytes()
        if content.startswith(b"\x93NUMPY"):
            return np.load(io.BytesIO(content), allow_pickle=False)
        try:
            if content.startswith(PNG):
                return _open_png(content)
            return Image.open(io.BytesIO(content))
        except Image.UnidentifiedImageError as error:  # its message names a buffer in memory
            raise ValueError(content_kind(content)) from error


@contextmanager
def _reading_errors(subject: str) -> Iterator[None]:
    """Turns whatever Pillow's plugins raise on broken files into an `InvalidInputError`."""
    problem = f"{subject} cannot be read as an image"
    with (
        explain_errors(problem, "pass a whole PNG, JPEG or other image file", Exception),
        explain_errors(problem, "pass a smaller one", Image.DecompressionBombError),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # `_check_size` is stricter
        warnings.filterwarnings("ignore", module=r"PIL\.TiffImagePlugin")  # warnings on broken EXIF
        yield


def _open_png(content: bytes) -> Image.Image:
    """Opens a PNG without chunks that are no part of the picture. Pillow refuses texts beyond 1 MB.

    Image tools store their graphs of nodes in texts. The two texts in which some tools store the orientation are kept.
    """
    kept = [PNG]
    profile: bytes | None = None
    position = len(PNG)
    while position < len(content):
        length = int.from_bytes(content[position : position + 4])
        kind = content[position + 4 : position + 8]
        data = content[position + 8 : position + 8 + length]
        chunk = content[position : position + 12 + length]
        position += len(chunk)
        is_damaged = chunk[8 + length :] != zlib.crc32(kind + data).to_bytes(4)
        keyword, _, compressed = data.partition(b"\0")
        is_orientation = kind in PNG_TEXTS and keyword in ORIENTATION_TEXTS
        if is_damaged or kind in PNG_CHUNKS or is_orientation:
            kept.append(chunk)  # Pillow judges damaged chunks
        elif kind == b"iCCP":
            with suppress(zlib.error):  # a broken profile is left out
                profile = zlib.decompressobj().decompress(compressed[1:], MOST_PROFILE)
    image = Image.open(io.BytesIO(b"".join(kept)))
    if profile:
        image.info["icc_profile"] = profile
    return image


def _decoded(subject: str, image: Any) -> np.ndarray:
    """Pixels of a PIL image: uint8 (H, W, 3), or float32 (H, W) for grey images of more than 8 bits."""
    with _reading_errors(subject):
        is_sequence = getattr(image, "n_frames", 1) > 1 and image.format != "MPO"  # further frames of MPO are previews
        if is_sequence and image.tell() == 0:
            warnings.warn(f"{subject} has {image.n_frames} frames; its first one is used.", stacklevel=2)
        if _is_misread_tiff(image):
            kind = "a TIFF of more than 8 bits, of planes or with white as zero"
            raise InvalidInputError(f"{subject} is {kind}, which Pillow misreads; save it as PNG.")
        image = _upright(image)
        if image.mode == "F":
            return np.asarray(image)
        if image.mode == "I" or image.mode.startswith("I;16"):  # convert("RGB") would clip 16-bit greyscale
            return _by_range(subject, np.asarray(image))
        profile = image.info.get("icc_profile")
        if image.has_transparency_data:  # convert("RGB") alone would show the colours of transparent pixels
            image = image.convert("LA" if image.mode == "La" else "RGBA").convert("RGBA")
            image = Image.alpha_composite(Image.new("RGBA", image.size, "white"), image)
        if image.mode not in ("L", "CMYK"):
            image = image.convert("RGB")
        if profile:
            with suppress(ImageCms.PyCMSError, OSError):  # viewers ignore a profile that is broken or of another mode
                source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
                srgb = ImageCms.createProfile("sRGB")
                image = ImageCms.profileToProfile(image, source, srgb, outputMode="RGB")
        return np.array(image.convert("RGB"))


def _is_misread_tiff(image: Any) -> bool:
    """Whether an image is a TIFF of more than 8 bits that is stored by planes or has white as zero."""
    tags = getattr(image, "tag_v2", {})
    bits_per_sample = tags.get(258, (8,))[0]
    white_is_zero = tags.get(262) == 0
    by_planes = tags.get(284) == 2
    return bits_per_sample > 8 and (white_is_zero or by_planes)


def _upright(image: Any) -> Any:
    """An image turned by its EXIF orientation; as it is stored if EXIF is broken, as viewers show it."""
    if image.format != "TIFF":  # a TIFF's own tags hold the orientation
        image.load()  # so that errors below are about EXIF
        try:
            image.getexif().get(ExifTags.Base.Orientation)
        except Exception:  # Pillow's reader raises errors of many kinds
            return image
    return ImageOps.exif_transpose(image)


def _by_range(subject: str, values: np.ndarray) -> np.ndarray:
    """Integers as uint8, or float32 in [0, 1], scaled by the fewest of 8, 10, 12, 14 or 16 bits that hold them.

    Those out of this range stay as they are, and are refused.
    """
    high = int(values.max())
    if int(values.min()) < 0 or high >= 1 << 16:
        return values.astype(np.int64)
    bits = min(bits for bits in (8, 10, 12, 14, 16) if high < 1 << bits)
    full_scale = 2**bits - 1
    if bits < 16:
        warnings.warn(f"{subject} holds values up to {high}; full scale is taken to be {full_scale}.", stacklevel=2)
    if bits == 8:
        return values.astype(np.uint8)
    return (values / full_scale).astype(np.float32)


def _channels_first(subject: str, array: np.ndarray) -> Tensor:
    """An array (..., H, W, C) as a tensor (..., C, H, W) that shares no memory with it."""
    pixels = array[..., None] if array.ndim == 2 else array
    has_16_bits = array.dtype.kind in "ui" and array.dtype.itemsize == 2
    if has_16_bits and array.size and array.max() > 255:
        pixels = _by_range(subject, pixels)
    elif array.dtype != np.uint8:
        pixels = pixels.astype(np.float64 if array.dtype.kind in "fb" else np.int64)
    tensor = torch.from_numpy(pixels.copy())
    return tensor.movedim(-1, -3) if tensor.ndim > 2 else tensor


def _in_range(name: str, pixels: Tensor) -> Tensor:
    """Pixels as uint8, or float32 in [0, 1]; raises for values outside of their range."""
    if pixels.dtype == torch.uint8:
        return pixels
    are_integers = not (pixels.is_floating_point() or pixels.dtype == torch.bool)
    values = pixels.long() if are_integers else check_finite(name, pixels).float()
    low = values.min().item()
    high = values.max().item()
    if low < 0 or high > (255 if are_integers else 1):
        raise InvalidInputError(
            f"`{name}` holds values from {low:g} to {high:g}; float images run from 0 to 1 and integer images from "
            "0 to 255, or to 65535 in grey images of 16 bits."
        )
    return values.byte() if are_integers else values


def _check_size(name: str, width: int, height: int) -> None:
    """Raises for images too small to show anything, and for long ones, which grow when the short side is resized."""
    short, long = sorted((width, height))
    if short < 8 or long > 100 * short or width * height > 8000**2:
        raise InvalidInputError(
            f"`{name}` is {width} x {height} pixels; images need at least 8 x 8 and at most 64,000,000, and one side "
            "may be 100 times the other. Crop or resize it."
        )


def centre_rectangle(image: Tensor, height: int, width: int) -> Tensor:
    """(3, H, W) uint8 or float -> (3, height, width) float32 in [0, 1]: resized (bicubic) to cover, centre cropped."""
    rows, columns = image.shape[-2:]
    if (rows, columns) != (height, width):
        # Rounded down, as CLIP's processors do; exact along the side that fits.
        if rows * width <= columns * height:
            resized_height = height
            resized_width = columns * height // rows
        else:
            resized_height = rows * width // columns
            resized_width = width
        image = F.interpolate(image[None], (resized_height, resized_width), mode="bicubic", antialias=True)[0]
        top = (resized_height - height) // 2
        left = (resized_width - width) // 2
        image = image[:, top : top + height, left : left + width]
    if image.dtype == torch.uint8:
        return image.float() / 255.0
    return image.clamp(0.0, 1.0)


def normalise_pixels(raw: Tensor) -> Tensor:
    """Pixels in [0, 1] -> zero mean and unit variance by CLIP's statistics, (..., 3, H, W)."""
    mean, deviation = raw.new_tensor([OPENAI_CLIP_MEAN, OPENAI_CLIP_STD])[..., None, None]
    return (raw - mean) / deviation


def denormalise_pixels(pixel_values: Tensor) -> Tensor:
    """The inverse of `normalise_pixels`."""
    mean, deviation = pixel_values.new_tensor([OPENAI_CLIP_MEAN, OPENAI_CLIP_STD])[..., None, None]
    return pixel_values * deviation + mean


def local_mean(pixels: Tensor, reach: int) -> Tensor:
    """Box filter: the mean over (2 reach + 1)^2 pixels around each of (B, C, H, W); borders are replicated.

    Cumulative sums take a fifth of the time of an average pool.
    """
    side = 2 * reach + 1
    padded = F.pad(pixels, (reach + 1, reach) * 2, mode="replicate")
    sums = padded.float().cumsum(dim=-1)
    row_sums = sums[..., side:] - sums[..., :-side]
    sums = row_sums.cumsum(dim=-2)
    box_sums = sums[..., side:, :] - sums[..., :-side, :]
    return (box_sums / side**2).to(pixels.dtype)
