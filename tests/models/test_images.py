"""Pictures of every accepted kind become the same pixels, squared as CLIP's own processor does; others are refused."""

import contextlib
import io
import random
import struct
import warnings
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from transformers import CLIPImageProcessorPil
from transformers.image_utils import OPENAI_CLIP_MEAN, OPENAI_CLIP_STD

from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.models import UniTouchProcessor
from unitouch_gen.models import images as pixels
from unitouch_gen.models.images import centre_rectangle, denormalise_pixels, load_images, normalise_pixels


def smooth(height: int, width: int, seed: int = 0) -> np.ndarray:
    """A smooth random picture, uint8 (H, W, 3)."""
    small = np.random.default_rng(seed).integers(0, 256, (5, 5, 3), dtype=np.uint8)
    return np.asarray(Image.fromarray(small).resize((width, height), Image.Resampling.BICUBIC))


PICTURE = smooth(32, 32)
TENSOR = torch.from_numpy(PICTURE.copy()).permute(2, 0, 1)

KINDS = {
    "PIL": Image.fromarray(PICTURE),
    "uint8 array": PICTURE,
    "int64 array": PICTURE.astype(np.int64),
    "uint16 array": PICTURE.astype(np.uint16),
    "float32 array": (PICTURE / 255).astype(np.float32),
    "float64 array": PICTURE / 255,
    "long double array": (PICTURE / 255).astype(np.longdouble),
    "big-endian array": (PICTURE / 255).astype(">f4"),
    "array of another order": np.asfortranarray(PICTURE),
    "mirrored view": PICTURE[:, ::-1].copy()[:, ::-1],
    "uint8 tensor": TENSOR,
    "int32 tensor": TENSOR.int(),
    "float tensor": TENSOR / 255,
    "tensor with gradient": (TENSOR / 255).requires_grad_(),
    "batch array": PICTURE[None],
    "batch tensor": TENSOR[None] / 255,
    "list": [PICTURE],
    "tuple": (TENSOR,),
}


def expected() -> torch.Tensor:
    return torch.from_numpy(PICTURE / 255).permute(2, 0, 1)[None].float()


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_gives_the_same_pixels(kind: str, processor: UniTouchProcessor) -> None:
    pixels = processor.raw_images(KINDS[kind])
    assert pixels.dtype == torch.float32
    torch.testing.assert_close(pixels, expected(), rtol=0, atol=1e-6)


@pytest.mark.parametrize("suffix", ["png", "bmp", "tiff", "webp"])
def test_a_path_gives_the_same_pixels(suffix: str, processor: UniTouchProcessor, tmp_path: Path) -> None:
    file = tmp_path / f"picture.{suffix}"
    Image.fromarray(PICTURE).save(file, lossless=True)
    for path in (file, str(file)):
        torch.testing.assert_close(processor.raw_images(path), expected(), rtol=0, atol=1e-6)


def test_an_opened_file_gives_the_same_pixels(processor: UniTouchProcessor, tmp_path: Path) -> None:
    Image.fromarray(PICTURE).save(tmp_path / "picture.png")
    with Image.open(tmp_path / "picture.png") as image:
        torch.testing.assert_close(processor.raw_images(image), expected(), rtol=0, atol=1e-6)


def test_low_precision_floats_give_nearly_the_same_pixels(processor: UniTouchProcessor) -> None:
    for low in ((PICTURE / 255).astype(np.float16), (TENSOR / 255).bfloat16()):
        torch.testing.assert_close(processor.raw_images(low), expected(), rtol=0, atol=1 / 255)


def test_a_list_of_many_kinds_is_one_batch_in_order(processor: UniTouchProcessor) -> None:
    other = smooth(40, 50, seed=1)
    batch = processor.raw_images([PICTURE, Image.fromarray(other), TENSOR[None].expand(2, -1, -1, -1)])
    assert batch.shape == (4, 3, 32, 32)
    torch.testing.assert_close(batch[1:2], processor.raw_images(other))
    torch.testing.assert_close(batch[3:], expected(), rtol=0, atol=1e-6)


def test_what_came_is_left_as_it_was(processor: UniTouchProcessor) -> None:
    for given in (PICTURE.copy(), TENSOR.clone() / 255):
        before = given.copy() if isinstance(given, np.ndarray) else given.clone()
        processor.images(given).zero_()
        processor.raw_images(given).zero_()
        assert (before == given).all()


def test_a_read_only_array_warns_of_nothing(processor: UniTouchProcessor) -> None:
    array = PICTURE.copy()
    array.flags.writeable = False
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        processor.raw_images(array)


# PIL modes --------------------------------------------------------------------------------------------------------


def grey(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(values.astype(np.float32))[None, None].expand(1, 3, -1, -1)


@pytest.mark.parametrize("mode", ["RGBA", "CMYK", "RGBX"])
def test_colour_modes_keep_their_colours(mode: str, processor: UniTouchProcessor) -> None:
    torch.testing.assert_close(
        processor.raw_images(Image.fromarray(PICTURE).convert(mode)), expected(), rtol=0, atol=1.01 / 255
    )


def over_white(colour: np.ndarray, alpha: np.ndarray) -> torch.Tensor:
    """a c + (1 - a) for colours (32, 32, 3) and alphas (32, 32), both uint8."""
    share = alpha[..., None] / 255
    return torch.from_numpy(share * colour / 255 + 1 - share).float().permute(2, 0, 1)[None]


ALPHA = smooth(32, 32, seed=2)[..., 0]


@pytest.mark.parametrize("mode", ["RGBA", "RGBa", "LA", "La"])
@pytest.mark.parametrize("modality", ["image", "touch"])
def test_transparency_is_laid_over_white(mode: str, modality: str, processor: UniTouchProcessor) -> None:
    colour = PICTURE if mode.startswith("RGB") else PICTURE[..., :1].repeat(3, axis=2)
    image = Image.fromarray(np.dstack([colour, ALPHA]), "RGBA").convert("LA" if mode == "La" else "RGBA").convert(mode)
    pixels = (processor.images if modality == "image" else processor.touch)(image)
    torch.testing.assert_close(denormalise_pixels(pixels), over_white(colour, ALPHA), rtol=0, atol=2.01 / 255)


@pytest.mark.parametrize("suffix", ["png", "webp", "tiff"])
def test_the_colour_of_what_is_transparent_is_not_seen(
    suffix: str, processor: UniTouchProcessor, tmp_path: Path
) -> None:
    clear = np.dstack([PICTURE, np.zeros((32, 32), np.uint8)])
    Image.fromarray(clear).save(tmp_path / f"clear.{suffix}")
    assert torch.equal(processor.raw_images(tmp_path / f"clear.{suffix}"), torch.ones(1, 3, 32, 32))


def test_the_transparent_colour_of_a_palette_is_white(processor: UniTouchProcessor, tmp_path: Path) -> None:
    palette = Image.new("P", (32, 32))
    palette.putpalette([0, 0, 0, 255, 0, 0])
    palette.putdata([(x + y) % 2 for y in range(32) for x in range(32)])
    palette.save(tmp_path / "palette.png", transparency=0)
    colours = np.array([[255, 255, 255], [255, 0, 0]])[np.indices((32, 32)).sum(axis=0) % 2]
    expected = torch.from_numpy(colours / 255).float().permute(2, 0, 1)[None]
    torch.testing.assert_close(processor.raw_images(tmp_path / "palette.png"), expected, rtol=0, atol=1e-6)


def test_a_palette_is_looked_up(processor: UniTouchProcessor) -> None:
    palette = Image.new("P", (32, 32))
    palette.putpalette([0, 0, 0, 255, 0, 0, 51, 102, 153])
    palette.putdata([(x + y) % 3 for y in range(32) for x in range(32)])
    table = np.array([[0, 0, 0], [255, 0, 0], [51, 102, 153]]) / 255
    looked_up = torch.from_numpy(table[np.indices((32, 32)).sum(axis=0) % 3]).float().permute(2, 0, 1)[None]
    torch.testing.assert_close(processor.raw_images(palette), looked_up, rtol=0, atol=1e-6)


def test_grey_is_the_same_in_all_channels(processor: UniTouchProcessor) -> None:
    image = Image.fromarray(PICTURE).convert("L")
    torch.testing.assert_close(processor.raw_images(image), grey(np.asarray(image) / 255), rtol=0, atol=1e-6)
    torch.testing.assert_close(
        processor.raw_images(np.asarray(image)), grey(np.asarray(image) / 255), rtol=0, atol=1e-6
    )


def test_one_channel_of_a_tensor_is_grey(processor: UniTouchProcessor) -> None:
    torch.testing.assert_close(processor.raw_images(TENSOR[:1]), grey(PICTURE[..., 0] / 255), rtol=0, atol=1e-6)


def test_sixteen_bits_are_scaled_not_clipped(processor: UniTouchProcessor, tmp_path: Path) -> None:
    deep = np.linspace(0, 65535, 32 * 32).reshape(32, 32).astype(np.uint16)
    Image.fromarray(deep).save(tmp_path / "deep.png")
    torch.testing.assert_close(processor.raw_images(tmp_path / "deep.png"), grey(deep / 65535), rtol=0, atol=1e-5)


def test_a_bilevel_image_and_a_boolean_array_are_black_and_white(processor: UniTouchProcessor) -> None:
    mask = PICTURE[..., 0] > 128
    for given in (Image.fromarray(mask), mask, torch.from_numpy(mask)[None]):
        torch.testing.assert_close(processor.raw_images(given), grey(mask), rtol=0, atol=0)


# By EXIF's own table: which visual edges the stored row 0 and column 0 are.
STORED = {
    1: PICTURE,  # top, left
    2: PICTURE[:, ::-1],  # top, right
    3: PICTURE[::-1, ::-1],  # bottom, right
    4: PICTURE[::-1],  # bottom, left
    5: PICTURE.transpose(1, 0, 2),  # left, top
    6: PICTURE.transpose(1, 0, 2)[::-1],  # right, top
    7: PICTURE.transpose(1, 0, 2)[::-1, ::-1],  # right, bottom
    8: PICTURE.transpose(1, 0, 2)[:, ::-1],  # left, bottom
}


@pytest.mark.parametrize("orientation", STORED)
def test_a_camera_held_sideways_is_turned_back(orientation: int, processor: UniTouchProcessor, tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(np.ascontiguousarray(STORED[orientation])).save(tmp_path / "turned.png", exif=exif)
    torch.testing.assert_close(processor.raw_images(tmp_path / "turned.png"), expected(), rtol=0, atol=1e-6)


# Squares and normalisation ----------------------------------------------------------------------------------------

SIZES = [(48, 80), (100, 151), (97, 32), (32, 32), (300, 225), (37, 53), (20, 31), (129, 128), (33, 32), (16, 600)]


@pytest.mark.parametrize(("height", "width"), SIZES)
@pytest.mark.parametrize("kind", ["uint8", "float"])
def test_squares_are_those_of_clips_processor(height: int, width: int, kind: str) -> None:
    picture = smooth(height, width)
    clip = CLIPImageProcessorPil(size={"shortest_edge": 32}, crop_size=32)
    reference = clip(Image.fromarray(picture), return_tensors="pt").pixel_values[0]
    given = picture if kind == "uint8" else picture / 255
    square = centre_rectangle(load_images("image", given)[0], 32, 32)
    torch.testing.assert_close(square, denormalise_pixels(reference), rtol=0, atol=2 / 255)


def test_pixel_values_are_those_of_clips_processor(processor: UniTouchProcessor) -> None:
    clip = CLIPImageProcessorPil(size={"shortest_edge": 32}, crop_size=32)
    torch.testing.assert_close(
        processor.images(PICTURE), clip(PICTURE, return_tensors="pt").pixel_values, rtol=1e-5, atol=1e-5
    )


def test_a_sharp_float_picture_stays_in_range() -> None:
    checks = torch.from_numpy(np.indices((50, 50)).sum(axis=0) % 2).float().expand(3, -1, -1)  # bicubic overshoots here
    square = centre_rectangle(checks, 32, 32)
    assert square.min() >= 0.0
    assert square.max() <= 1.0


def test_touch_is_prepared_as_pictures_are(processor: UniTouchProcessor) -> None:
    assert torch.equal(processor.touch(PICTURE), processor.images(PICTURE))


def test_normalisation_is_undone() -> None:
    raw = torch.rand(2, 3, 8, 8)
    torch.testing.assert_close(denormalise_pixels(normalise_pixels(raw)), raw)


def test_normalisation_is_by_clips_mean_and_deviation() -> None:
    raw = torch.tensor(OPENAI_CLIP_MEAN)[:, None, None] + torch.tensor(OPENAI_CLIP_STD)[:, None, None]
    torch.testing.assert_close(normalise_pixels(raw), torch.ones(3, 1, 1))


# What is no picture ---------------------------------------------------------------------------------------------------

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


def test_a_matrix_is_an_array() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PendingDeprecationWarning)  # numpy's, of its matrix
        (image,) = load_images("image", np.matrix(np.full((16, 16), 0.5)))
    assert image.shape == (3, 16, 16) and (image == 0.5).all()


def test_a_masked_array_is_refused_if_something_is_missing() -> None:
    array = np.ma.masked_array(np.full((16, 16), 0.5), mask=np.eye(16))
    with pytest.raises(InvalidInputError, match=r"`image` is .*masked"):
        load_images("image", array)
    assert (load_images("image", array.filled(0.0))[0][0].diagonal() == 0.0).all()


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
