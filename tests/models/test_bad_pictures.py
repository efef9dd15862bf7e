"""What is no picture is refused before any model runs, by an error that names the argument."""

import contextlib
import io
import random
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.models import UniTouchProcessor
from unitouch_gen.models import images as pixels
from unitouch_gen.models.images import load_images

NOISE = np.random.default_rng(0).integers(0, 256, (24, 20, 3), dtype=np.uint8)


def encoded(suffix: str = "png") -> bytes:
    stream = io.BytesIO()
    Image.fromarray(NOISE).save(stream, suffix)
    return stream.getvalue()


def huge_png(width: int, height: int) -> bytes:
    """A valid PNG header that promises width x height pixels, and one line of data."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(100))) + chunk(b"IEND", b"")
    )


def written(folder: Path, content: bytes, name: str = "picture.png") -> Path:
    (folder / name).write_bytes(content)
    return folder / name


def refused(image: object, match: str, error: type[Exception] = InvalidInputError) -> None:
    with pytest.raises(error, match=match):
        load_images("touch", image)


@pytest.mark.parametrize("content", [b"", b"not an image", b"\x89PNG\r\n\x1a\n", b"GIF89a", bytes(1000)])
def test_a_file_that_is_no_image_is_refused(content: bytes, tmp_path: Path) -> None:
    refused(written(tmp_path, content), r"`touch` names '.*picture.png', which cannot be read as an image")


@pytest.mark.parametrize("suffix", ["png", "jpeg", "tiff", "webp"])
@pytest.mark.parametrize("share", [0.3, 0.7])
def test_a_file_that_is_cut_short_is_refused(suffix: str, share: float, tmp_path: Path) -> None:
    content = encoded(suffix)
    refused(written(tmp_path, content[: int(share * len(content))], f"cut.{suffix}"), "`touch` names .*cannot be read")


def test_an_opened_file_that_is_cut_short_is_refused(tmp_path: Path) -> None:
    with Image.open(written(tmp_path, encoded()[:-200])) as image:
        refused(image, "`touch` is a PIL image that cannot be read")


def test_a_closed_image_is_refused(tmp_path: Path) -> None:
    with Image.open(written(tmp_path, encoded())) as image:
        pass
    refused(image, "`touch` is a PIL image that cannot be read")


@pytest.mark.filterwarnings("ignore::UserWarning")  # Pillow's, about the damage
@pytest.mark.parametrize("suffix", ["png", "jpeg", "gif", "bmp", "tiff", "webp", "ppm", "tga", "ico", "sgi", "dds"])
def test_damaged_files_are_read_or_refused_by_name(suffix: str, tmp_path: Path) -> None:
    whole, dice = encoded(suffix), random.Random(0)
    for _ in range(60):
        damaged = bytearray(whole)
        for _ in range(dice.choice((1, 3, 10))):
            damaged[dice.randrange(min(len(damaged), 400))] = dice.randrange(256)
        file = written(tmp_path, bytes(damaged))
        with contextlib.suppress(InvalidInputError):  # any other kind of error fails the test
            load_images("touch", file)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    refused(tmp_path / "nothing.png", r"`touch` names '.*nothing.png', which does not exist")


def test_a_folder_is_refused(tmp_path: Path) -> None:
    refused(tmp_path, "which is a folder")


@pytest.mark.parametrize("path", ["", "a\0b", "x" * 5000])
def test_a_string_that_is_no_path_is_refused(path: str) -> None:
    refused(path, "`touch` names")


@pytest.mark.parametrize("size", [(1, 1), (7, 100), (100, 7)])
def test_an_image_with_nothing_in_it_is_refused(size: tuple[int, int], tmp_path: Path) -> None:
    image = Image.new("RGB", size)
    image.save(tmp_path / "small.png")
    for given in (image, tmp_path / "small.png", np.asarray(image), torch.zeros(3, size[1], size[0])):
        refused(given, rf"`touch.*{size[0]} x {size[1]} pixels; images need at least 8 x 8")


@pytest.mark.parametrize(("width", "height"), [(9_000, 8_000), (60_000, 60_000)])
def test_a_decompression_bomb_is_refused_unread(width: int, height: int, tmp_path: Path) -> None:
    refused(written(tmp_path, huge_png(width, height)), "`touch.*(more than 64,000,000|far too many pixels)")


def test_an_image_of_more_pixels_than_allowed_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pixels, "MAX_PIXELS", 400)
    for given in (NOISE, Image.fromarray(NOISE), torch.from_numpy(NOISE).permute(2, 0, 1)):
        refused(given, "`touch` is 20 x 24 pixels, more than 400; resize it")


def test_a_strip_that_would_blow_up_when_resized_is_refused() -> None:
    refused(np.zeros((8, 801, 3), np.uint8), "`touch` is 801 x 8 pixels; .*crop it")
    assert load_images("touch", np.zeros((8, 800, 3), np.uint8))[0].shape == (3, 8, 800)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_values_that_are_not_finite_are_refused(bad: float, dtype: type) -> None:
    array = np.zeros((16, 16, 3), dtype)
    array[3, 4, 0] = bad
    refused(array, "`touch` holds 1 of 768 values that are NaN or infinite")
    refused(torch.from_numpy(array).permute(2, 0, 1), "`touch` holds 1 of 768 values")


@pytest.mark.parametrize(
    "image",
    [
        np.full((16, 16, 3), 1.5),
        np.full((16, 16, 3), -0.1),
        np.full((16, 16, 3), 300),
        np.full((16, 16, 3), -1),
        np.full((16, 16, 3), 60_000, np.uint16),
        np.full((16, 16, 3), 2**63, np.uint64),
        np.full((16, 16, 3), 1e300),
        NOISE.astype(np.float32),
        torch.full((3, 16, 16), 255.0),
        torch.full((3, 16, 16), 256),
        Image.fromarray(np.full((16, 16), 99.0, np.float32)),
    ],
)
def test_values_out_of_range_are_refused(image: object) -> None:
    refused(image, "`touch` holds values from .*0 to 1 and integer images from 0 to 255")


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((16, 16, 2)), np.zeros((16, 16, 4)), np.zeros((3, 16, 16)), np.zeros(16), np.zeros((1, 1, 16, 16, 3)),
        np.zeros((0, 16, 16, 3)), torch.zeros(16, 16), torch.zeros(2, 16, 16), torch.zeros(4, 16, 16),
        torch.zeros(16, 16, 3), torch.zeros(1, 1, 3, 16, 16), torch.zeros(0, 3, 16, 16),
    ],
    ids=lambda image: str(tuple(image.shape)),
)  # fmt: skip
def test_a_wrong_shape_is_refused(image: object) -> None:
    refused(image, "`touch` is an? (array|tensor) of shape")


@pytest.mark.parametrize("image", [None, 3, 1.5, b"bytes", {"a": 1}, object(), np.float32(1.0)])
def test_a_wrong_type_is_refused(image: object) -> None:
    refused(image, "`touch` is .*pass a path, a PIL image", InvalidTypeError)


@pytest.mark.parametrize("dtype", [object, complex, "<U1"])
def test_an_array_without_real_numbers_is_refused(dtype: object) -> None:
    refused(np.zeros((16, 16, 3), dtype), "`touch` is an array .*has to hold numbers", InvalidTypeError)


def test_a_complex_tensor_is_refused() -> None:
    refused(torch.zeros(3, 16, 16, dtype=torch.complex64), "`touch` is a tensor .*real numbers", InvalidTypeError)


@pytest.mark.parametrize("empty", [[], ()])
def test_an_empty_list_is_refused(empty: object) -> None:
    refused(empty, "`touch` is an empty list")


def test_the_item_of_a_list_that_is_wrong_is_named(tmp_path: Path) -> None:
    refused([NOISE, tmp_path / "nothing.png"], r"`touch\[1\]` names")


def test_the_processor_names_the_argument_of_the_modality(processor: UniTouchProcessor) -> None:
    with pytest.raises(InvalidTypeError, match="`image`"):
        processor.images(None)
    with pytest.raises(InvalidTypeError, match="`touch`"):
        processor.touch(None)
    with pytest.raises(InvalidTypeError, match="`photo`"):
        processor.raw_images(None, name="photo")
