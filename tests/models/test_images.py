"""Pictures of every accepted kind become the same pixels, squared as CLIP's own processor does."""

import zlib
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageCms
from transformers import CLIPImageProcessorPil

from tests.helpers.damage import chunk, encoded
from unitouch_gen.models import UniTouchProcessor
from unitouch_gen.models.images import denormalise_pixels, normalise_pixels


def smooth(height: int, width: int, seed: int = 0) -> np.ndarray:
    """A smooth random picture, uint8 (H, W, 3)."""
    small = np.random.default_rng(seed).integers(0, 256, (5, 5, 3), dtype=np.uint8)
    return np.asarray(Image.fromarray(small).resize((width, height), Image.Resampling.BICUBIC))


PICTURE = smooth(32, 32)
ALPHA = smooth(32, 32, seed=2)[..., 0]
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
    other = smooth(40, 50, seed=1)
    file = tmp_path / "picture.png"
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
    grey = PICTURE[..., 0]
    mask = PICTURE[..., 0] > 128
    deep = np.linspace(0, 65535, 32 * 32).reshape(32, 32).astype(np.uint16)
    Image.fromarray(deep).save(tmp_path / "deep.png")
    expected = [
        (grey / 255, [Image.fromarray(grey), grey, torch.from_numpy(grey.copy())[None]]),
        (mask, [Image.fromarray(mask), mask, torch.from_numpy(mask)[None]]),
        (deep / 65535, [tmp_path / "deep.png"]),
    ]
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


def test_a_photo_that_moves_is_its_first_frame_and_told(processor: UniTouchProcessor, tmp_path: Path) -> None:
    first = Image.fromarray(PICTURE)
    other = Image.fromarray(255 - PICTURE)
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


def test_what_a_png_holds_beside_its_picture_does_not_matter(processor: UniTouchProcessor, tmp_path: Path) -> None:
    """Texts of megabytes, before the pixels and after them, a large colour profile, and broken EXIF."""
    text = zlib.compress(bytes(4 << 20))
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    whole = encoded(Image.fromarray(PICTURE))
    file = tmp_path / "workflow.png"
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


def test_a_png_is_turned_as_its_texts_say(processor: UniTouchProcessor, tmp_path: Path) -> None:
    """Those of XMP, by EXIF's table of orientations: 6 has the first row at the right."""
    xmp = b'XML:com.adobe.xmp\0\0\0\0\0<x tiff:Orientation="6"/>'
    stored = encoded(Image.fromarray(np.ascontiguousarray(PICTURE.transpose(1, 0, 2)[::-1])))
    (tmp_path / "turned.png").write_bytes(stored[:33] + chunk(b"iTXt", xmp) + stored[33:])
    found = processor.raw_images(tmp_path / "turned.png")
    torch.testing.assert_close(found, pixels_of(PICTURE / 255), rtol=0, atol=1e-6)
