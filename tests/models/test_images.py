"""Pictures of every accepted kind become the same pixels, squared as CLIP's own processor does; others are refused."""

import io
import struct
import zlib
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageCms
from transformers import CLIPImageProcessorPil

from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.models import UniTouchProcessor
from unitouch_gen.models.images import denormalise_pixels, load_images, normalise_pixels


def smooth(height: int, width: int, seed: int = 0) -> np.ndarray:
    """A smooth random picture, uint8 (H, W, 3)."""
    small = np.random.default_rng(seed).integers(0, 256, (5, 5, 3), dtype=np.uint8)
    return np.asarray(Image.fromarray(small).resize((width, height), Image.Resampling.BICUBIC))


PICTURE, ALPHA = smooth(32, 32), smooth(32, 32, seed=2)[..., 0]
TENSOR = torch.from_numpy(PICTURE.copy()).permute(2, 0, 1)
NOISE = np.random.default_rng(0).integers(0, 256, (24, 20, 3), dtype=np.uint8)


def pixels_of(values: np.ndarray) -> torch.Tensor:
    """Values (H, W) or (H, W, 3) in [0, 1] as a batch."""
    values = np.broadcast_to(values if values.ndim == 3 else values[..., None], (*values.shape[:2], 3))
    return torch.from_numpy(values.astype(np.float32)).permute(2, 0, 1)[None]


KINDS = {
    "PIL": Image.fromarray(PICTURE),
    "uint8 array": PICTURE,
    "uint16 array": PICTURE.astype(np.uint16),
    "float64 array": PICTURE / 255,
    "big-endian array": (PICTURE / 255).astype(">f4"),
    "mirrored view": PICTURE[:, ::-1].copy()[:, ::-1],
    "int32 tensor": TENSOR.int(),
    "tensor with gradient": (TENSOR / 255).requires_grad_(),
    "batch tensor": TENSOR[None] / 255,
}


def test_every_kind_gives_the_same_pixels(processor: UniTouchProcessor) -> None:
    for kind, given in KINDS.items():
        found = processor.raw_images(given)
        assert found.dtype == torch.float32
        torch.testing.assert_close(found, pixels_of(PICTURE / 255), rtol=0, atol=1e-6, msg=kind)


def test_a_list_of_many_kinds_is_one_batch_in_order(processor: UniTouchProcessor, tmp_path: Path) -> None:
    other, file = smooth(40, 50, seed=1), tmp_path / "picture.png"
    Image.fromarray(PICTURE).save(file)
    batch = processor.raw_images([PICTURE, Image.fromarray(other), TENSOR[None], str(file), Image.open(file)])
    assert batch.shape == (5, 3, 32, 32)
    torch.testing.assert_close(batch[1:2], processor.raw_images(other))
    torch.testing.assert_close(batch[2:], pixels_of(PICTURE / 255).expand(3, -1, -1, -1), rtol=0, atol=1e-6)


def test_squares_are_those_of_clips_processor(processor: UniTouchProcessor) -> None:
    clip = CLIPImageProcessorPil(size={"shortest_edge": 32}, crop_size=32)
    for height, width in ((48, 80), (100, 151), (97, 32), (300, 225), (20, 31), (33, 32), (16, 600)):
        picture = smooth(height, width)
        reference = denormalise_pixels(clip(Image.fromarray(picture), return_tensors="pt").pixel_values)
        for given in (picture, picture / 255):
            values = processor.images(given)
            torch.testing.assert_close(denormalise_pixels(values), reference, rtol=0, atol=2 / 255)
            torch.testing.assert_close(normalise_pixels(denormalise_pixels(values)), values, rtol=1e-5, atol=1e-5)


# PIL modes ------------------------------------------------------------------------------------------------------------


def test_transparency_is_laid_over_white(processor: UniTouchProcessor) -> None:
    share = ALPHA[..., None] / 255
    for mode in ("RGBA", "RGBa", "LA", "La"):
        colour = PICTURE if mode.startswith("RGB") else PICTURE[..., :1].repeat(3, axis=2)
        image = Image.fromarray(np.dstack([colour, ALPHA]), "RGBA").convert("LA" if mode == "La" else "RGBA")
        found = denormalise_pixels(processor.touch(image.convert(mode)))
        expected = pixels_of(share * colour / 255 + 1 - share)
        torch.testing.assert_close(found, expected, rtol=0, atol=2.01 / 255, msg=mode)


def test_a_palette_is_looked_up_and_its_transparent_colour_is_white(processor, tmp_path: Path) -> None:
    palette = Image.new("P", (32, 32))
    palette.putpalette([0, 0, 0, 255, 0, 0, 51, 102, 153])
    palette.putdata([(x + y) % 3 for y in range(32) for x in range(32)])
    for file in (files := [tmp_path / "palette.png", tmp_path / "palette.gif"]):
        palette.save(file, transparency=0)
    table = np.array([[255] * 3, [255, 0, 0], [51, 102, 153]]) / 255
    expected = pixels_of(table[np.indices((32, 32)).sum(axis=0) % 3])
    torch.testing.assert_close(processor.raw_images(files), expected.expand(2, -1, -1, -1), rtol=0, atol=1e-6)


def test_colours_are_those_of_the_profile(processor: UniTouchProcessor, tmp_path: Path) -> None:
    """Of one whose red and green are exchanged; sRGB's own and a broken one change nothing."""
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    renamed = srgb.replace("sRGB".encode("utf-16-be"), "mine".encode("utf-16-be"))
    exchanged = renamed.replace(b"rXYZ", b"....").replace(b"gXYZ", b"rXYZ").replace(b"....", b"gXYZ")
    for profile, order in ((srgb, [0, 1, 2]), (renamed, [0, 1, 2]), (exchanged, [1, 0, 2]), (b"junk", [0, 1, 2])):
        Image.fromarray(PICTURE).save(tmp_path / "a.png", icc_profile=profile)
        found = processor.raw_images(tmp_path / "a.png")
        torch.testing.assert_close(found, pixels_of(PICTURE[..., order] / 255), rtol=0, atol=1.01 / 255)


def test_grey_bilevel_and_deep_images_are_the_same_in_all_channels(processor: UniTouchProcessor, tmp_path) -> None:
    grey, mask = PICTURE[..., 0], PICTURE[..., 0] > 128
    deep = np.linspace(0, 65535, 32 * 32).reshape(32, 32).astype(np.uint16)
    Image.fromarray(deep).save(tmp_path / "deep.png")
    expected = [(grey / 255, [Image.fromarray(grey), grey, torch.from_numpy(grey.copy())[None]]),
                (mask, [Image.fromarray(mask), mask, torch.from_numpy(mask)[None]]),
                (deep / 65535, [tmp_path / "deep.png"])]  # fmt: skip
    for values, kinds in expected:
        for given in kinds:
            torch.testing.assert_close(processor.raw_images(given), pixels_of(values), rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("bits", "dtype"), [(8, "<i4"), (8, "<u2"), (10, "<u2"), (12, "<u2"), (12, ">u2"), (12, "<i2"), (14, "<u2")]
)
def test_full_scale_of_deep_greys_is_that_of_the_bits_they_use(processor: UniTouchProcessor, tmp_path, bits, dtype):
    """Of a file as of its array, and told; an ending is not needed."""
    values = (np.linspace(0.6, 1, 32 * 32).reshape(32, 32) * (2**bits - 1)).astype(dtype)
    Image.fromarray(values).save(tmp_path / "grey.tif")
    np.save(tmp_path / "grey.npy", values)
    (tmp_path / "grey.tif").rename(tmp_path / "grey")
    with pytest.warns(UserWarning, match=f"full scale is taken to be {2**bits - 1}"):
        found = processor.raw_images([tmp_path / "grey", *([values, tmp_path / "grey.npy"] if bits > 8 else [])])
    torch.testing.assert_close(found, pixels_of(values / (2**bits - 1)).expand_as(found), rtol=0, atol=1e-6)


@pytest.mark.parametrize("form", ["png rgb48be", "png rgba64be", "tiff rgb48le", "tiff rgba64le"])
def test_deep_colours_are_their_upper_byte(processor: UniTouchProcessor, tmp_path, form):
    """In files that FFmpeg has written; what is transparent is white."""
    av, (codec, pixel_format) = pytest.importorskip("av"), form.split()
    values = np.linspace(0.3 * 65535, 65535, 32 * 32 * 3).reshape(32, 32, 3).astype(np.uint16)
    share = np.linspace(0, 65535, 32).astype(np.uint16)[:, None, None].repeat(32, axis=1)
    context = av.CodecContext.create(codec, "w")
    context.height, context.width, context.pix_fmt, context.time_base = 32, 32, pixel_format, Fraction(1)
    frame = av.VideoFrame.from_ndarray(np.dstack([values, share]), format="rgba64le").reformat(format=pixel_format)
    (tmp_path / "deep").write_bytes(b"".join(map(bytes, [*context.encode(frame), *context.encode()])))
    found = processor.raw_images([tmp_path / "deep", Image.open(tmp_path / "deep")])
    share = share / 65535 if "rgba" in form else 1
    expected = pixels_of(share * values / 65535 + 1 - share).expand_as(found)
    torch.testing.assert_close(found, expected, rtol=0, atol=2 / 255 if "rgba" in form else 1 / 255)


def test_a_deep_tiff_that_pillow_misreads_is_refused(tmp_path: Path) -> None:
    """One of planes, and one whose zero is white, by the tags of TIFF 6.0."""
    for tag, value in ((284, 2), (262, 0)):
        Image.fromarray(np.zeros((32, 32), np.uint16)).save(tmp_path / "deep.tif", tiffinfo={tag: value})
        with pytest.raises(InvalidInputError, match=r"names .*deep.tif.* with white as zero, which Pillow misreads"):
            load_images("touch", tmp_path / "deep.tif")


def test_a_photo_that_moves_is_its_first_frame_and_told(processor: UniTouchProcessor, tmp_path: Path) -> None:
    first, other = Image.fromarray(PICTURE), Image.fromarray(255 - PICTURE)
    first.save(tmp_path / "photo.png", save_all=True, append_images=[other])
    with pytest.warns(UserWarning, match="has 2 frames"):
        found = processor.touch(tmp_path / "photo.png")
    torch.testing.assert_close(denormalise_pixels(found), pixels_of(PICTURE / 255), rtol=0, atol=1e-5)


def test_a_camera_held_sideways_is_turned_back(processor: UniTouchProcessor, tmp_path: Path) -> None:
    """By EXIF's own table: which visual edges the stored row 0 and column 0 are (bottom, right; right, top)."""
    exif = Image.Exif()
    for exif[0x0112], stored in ((3, PICTURE[::-1, ::-1]), (6, PICTURE.transpose(1, 0, 2)[::-1])):
        Image.fromarray(np.ascontiguousarray(stored)).save(tmp_path / "turned.png", exif=exif)
        found = processor.raw_images(tmp_path / "turned.png")
        torch.testing.assert_close(found, pixels_of(PICTURE / 255), rtol=0, atol=1e-6)


def chunk(kind: bytes, data: bytes) -> bytes:
    """A chunk of a PNG (W3C, Portable Network Graphics, 5.3)."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def test_what_a_png_holds_beside_its_picture_does_not_matter(processor: UniTouchProcessor, tmp_path: Path) -> None:
    """Texts of megabytes, before the pixels and after them, a large colour profile, and broken EXIF."""
    text, srgb = zlib.compress(bytes(4 << 20)), ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    whole, file = encoded("png", Image.fromarray(PICTURE)), tmp_path / "workflow.png"
    for beside in (
        chunk(b"zTXt", b"workflow\0\0" + text),
        chunk(b"iTXt", b"prompt\0\1\0\0\0" + text),
        chunk(b"tEXt", b"workflow\0" + bytes(1 << 20)) * 65,
        chunk(b"iCCP", b"sRGB\0\0" + zlib.compress(srgb + bytes(2 << 20))),
        chunk(b"eXIf", b"junk" * 9),
    ):
        for place in (33, len(whole) - 12):  # after IHDR, before IEND
            file.write_bytes(whole[:place] + beside + whole[place:])
            found = processor.raw_images(file)
            torch.testing.assert_close(found, pixels_of(PICTURE / 255), rtol=0, atol=1.01 / 255)


def test_a_chunk_whose_kind_is_damaged_is_not_left_out(tmp_path: Path) -> None:
    """Without its palette or transparency, a picture would be another one."""
    palette = Image.fromarray(PICTURE).quantize(16)
    palette.info["transparency"] = 0
    whole = encoded("png", palette)
    for kind, damaged in ((b"PLTE", b"pLTE"), (b"tRNS", b"tRNs")):
        (tmp_path / "damaged.png").write_bytes(whole.replace(kind, damaged))
        with pytest.raises(InvalidInputError, match="cannot be read as an image"):
            load_images("touch", tmp_path / "damaged.png")


def test_a_png_is_turned_as_its_texts_say(processor: UniTouchProcessor, tmp_path: Path) -> None:
    """Those of XMP, by EXIF's table of orientations: 6 has the first row at the right."""
    xmp = b'XML:com.adobe.xmp\0\0\0\0\0<x tiff:Orientation="6"/>'
    stored = encoded("png", Image.fromarray(np.ascontiguousarray(PICTURE.transpose(1, 0, 2)[::-1])))
    (tmp_path / "turned.png").write_bytes(stored[:33] + chunk(b"iTXt", xmp) + stored[33:])
    found = processor.raw_images(tmp_path / "turned.png")
    torch.testing.assert_close(found, pixels_of(PICTURE / 255), rtol=0, atol=1e-6)


# What is no picture ---------------------------------------------------------------------------------------------------


def encoded(suffix: str, image: Image.Image | None = None) -> bytes:
    stream = io.BytesIO()
    (image or Image.fromarray(NOISE)).save(stream, suffix)
    return stream.getvalue()


FILES = {
    "empty": b"",
    "text": b"not an image",
    "header": b"\x89PNG\r\n\x1a\n",
    "bomb": encoded("png", Image.new("1", (9_000, 8_000))),
    **{f"cut {suffix}": encoded(suffix)[:-200] for suffix in ("png", "jpeg")},
}


def test_a_png_that_claims_too_many_pixels_is_refused_before_they_are_decoded(tmp_path: Path, monkeypatch) -> None:
    """By a path that begins with `~`, the home folder."""
    monkeypatch.setenv("HOME", str(tmp_path))
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 20_000, 20_000, 1, 0, 0, 0, 0))
    whole = encoded("png")
    (tmp_path / "touch.png").write_bytes(whole[:8] + header + whole[33:])
    with pytest.raises(InvalidInputError, match=r"`touch` names .*400000000 pixels.* pass a smaller one"):
        load_images("touch", "~/touch.png")


def test_a_file_that_is_no_image_or_too_large_is_refused(tmp_path: Path) -> None:
    for name, content in FILES.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InvalidInputError, match=r"`touch` .*(cannot be read as an image|at most 64,000,000)"):
            load_images("touch", tmp_path / name)


def bad(value: float, dtype: type = np.float32) -> np.ndarray:
    array = np.zeros((16, 16, 3), dtype)
    array[3, 4, 0] = value
    return array


SHAPE, RANGE = "is an? (array|tensor) of shape", "holds values from .*0 to 1 and integer images from 0 to 255"
REFUSED = [
    *(("gone/nothing.png", "names '.*nothing.png', which does not exist"), ("/", "is a folder"), ("a\0b", "names")),
    *((np.zeros((7, 100, 3), np.uint8), "100 x 7 pixels"), (Image.new("RGB", (1, 1)), "1 x 1 pixels; .* least 8 x 8")),
    (np.zeros((8, 801, 3), np.uint8), "801 x 8 pixels; .*100 times the other"),
    *((bad(value), "holds 1 of 768 values that are NaN or infinite") for value in (np.nan, -np.inf)),
    *((bad(*values), RANGE) for values in ((1.5,), (-0.1,), (300, int), (-1, int), (2**63, np.uint64), (1e300, float))),
    (torch.full((3, 16, 16), 255.0), RANGE),
    *((Image.fromarray(np.full((16, 16), value, np.int32)), "0 to 255, or to 65535") for value in (-1, 70_000)),
    (Image.fromarray(np.full((16, 16), 99.0, np.float32)), RANGE),
    *((np.zeros(shape), SHAPE) for shape in ((16, 16, 2), (3, 16, 16), (16,), (1, 1, 16, 16, 3), (0, 16, 16, 3))),
    *((torch.zeros(shape), SHAPE) for shape in ((16, 16), (4, 16, 16), (16, 16, 3), (0, 3, 16, 16))),
    *(([], "is an empty list"), ([NOISE, "nothing.png"], r"\[1\]` names")),
]  # fmt: skip
OTHERS = (
    *(None, 3, b"bytes", np.zeros((16, 16), object), np.zeros((16, 16), complex), torch.eye(16).to_sparse()),
    torch.empty(3, 16, 16, device="meta"),
)


def test_what_cannot_be_used_is_refused() -> None:
    for image, words in REFUSED:
        with pytest.raises(InvalidInputError, match=f"`touch.*{words}"):
            load_images("touch", image)
    for image in OTHERS:
        with pytest.raises(InvalidTypeError, match=r"`touch.* is"):
            load_images("touch", image)
