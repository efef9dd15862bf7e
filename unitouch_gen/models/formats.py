"""Kinds of files by their first bytes, for messages about files that cannot be read."""

import codecs
import os

SIGNATURES = {
    b"version https://git-lfs": "a Git LFS pointer; run `git lfs pull`",
    b"%PDF": "a PDF",
    b"PK\x03\x04": "a ZIP archive",
    b"\x89HDF": "an HDF5 file",
    b"\x1f\x8b": "a gzip archive",
    b"\x1a\x45\xdf\xa3": "a video",  # Matroska, WebM
    b"\x89PNG": "a PNG image",
    b"\xff\xd8\xff": "a JPEG image",
    b"GIF8": "a GIF image",
    b"fLaC": "a FLAC sound",
    b"OggS": "an Ogg sound",
    b"ID3": "an MP3 sound",
}

RIFF = {b"WAVE": "a WAV sound", b"AVI ": "a video", b"WEBP": "a WebP image"}

BRANDS = {
    b"heic": "a HEIC photo",
    b"heix": "a HEIC photo",
    b"mif1": "a HEIF photo",
    b"avif": "an AVIF image",
    b"M4A ": "an M4A sound",
}
"""Major brands of ISO media files (ISO/IEC 14496-12). Files with other brands are videos."""


def content_kind(content: bytes) -> str:
    """The kind of file that begins with these bytes, such as "a HEIC photo", "text" or "an empty file"."""
    if not content:
        return "an empty file"
    for signature, kind in SIGNATURES.items():
        if content.startswith(signature):
            return kind
    if content.startswith(b"RIFF") and content[8:12] in RIFF:
        return RIFF[content[8:12]]
    if content[4:8] == b"ftyp":
        return BRANDS.get(content[8:12], "a video")
    try:
        text = codecs.getincrementaldecoder("utf-8")().decode(content[:512])  # the last character may be cut off
    except UnicodeDecodeError:
        return "of no known format"
    if text.lstrip().lower().startswith(("<!doctype html", "<html")):
        return "a web page"
    if "<svg" in text:
        return "an SVG drawing"
    return "text" if "".join(text.split()).isprintable() else "of no known format"


def file_kind(file: str | os.PathLike) -> str:
    """The kind of a file, or why it cannot be opened."""
    try:
        with open(file, "rb") as opened:
            return content_kind(opened.read(512))
    except OSError as error:
        return str(error.strerror)
