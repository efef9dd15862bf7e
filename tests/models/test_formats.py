"""Kinds of files that cannot be read, as other libraries write them."""

import gzip
import io
import zipfile

import numpy as np
import pytest
import soundfile
from PIL import Image

from unitouch_gen.models.formats import content_kind


def image(kind):
    content = io.BytesIO()
    Image.new("RGB", (16, 16)).save(content, kind)
    return content.getvalue()


def sound(kind):
    content = io.BytesIO()
    soundfile.write(content, np.zeros(1000), 16_000, format=kind)
    return content.getvalue()


def archive():
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as opened:
        opened.writestr("name", "text")
    return content.getvalue()


def media(brand):
    """The first box of an ISO media file (ISO/IEC 14496-12, 4.3), as cameras and phones write them."""
    return b"\0\0\0\x18ftyp" + brand + b"\0\0\0\0mif1" + brand


KINDS = {
    "an empty file": b"",
    "text": "größer als ein Bild\n".encode() * 30 + "ö".encode()[:1],
    "a web page": b"\n<!DOCTYPE html><html><body>Please log in.</body></html>",
    "an SVG drawing": b'<?xml version="1.0"?><svg xmlns="http://www.w3.org/2000/svg"/>',
    "a Git LFS pointer": b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n",
    "a HEIC photo": media(b"heic"),
    "an M4A sound": media(b"M4A "),
    "a video": media(b"isom"),
    "a ZIP archive": archive(),
    "a gzip archive": gzip.compress(b"text"),
    "a PNG image": image("PNG"),
    "a JPEG image": image("JPEG"),
    "a GIF image": image("GIF"),
    "a WebP image": image("WEBP"),
    "an AVIF image": image("AVIF"),
    "a WAV sound": sound("WAV"),
    "a FLAC sound": sound("FLAC"),
    "an Ogg sound": sound("OGG"),
    "of no known format": bytes(range(256)),
}


@pytest.mark.parametrize("kind", KINDS)
def test_content_kind_names_the_format_of_a_file(kind):
    assert content_kind(KINDS[kind]).startswith(kind)
