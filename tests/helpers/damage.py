"""What becomes of files: cut, emptied, replaced by something else, or by what has no end; and odd arguments."""

import io
import os
import random
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import soundfile
import torch
from PIL import Image

from tests.helpers import recordings

Damage = Callable[[Path], Any]


def replaced(file: Path, make: Damage) -> None:
    file.unlink()
    make(file)


ANY: dict[str, Damage] = {
    "cut": lambda file: file.write_bytes(file.read_bytes()[: file.stat().st_size // 2]),
    "empty": lambda file: file.write_bytes(b""),
    "noise": lambda file: file.write_bytes(bytes(range(256)) * 8),
    "zeros": lambda file: file.write_bytes(bytes(1000)),
    "a page": lambda file: file.write_bytes(b"<html>404</html>"),
    "a folder": lambda file: replaced(file, Path.mkdir),
    "endless": lambda file: replaced(file, lambda file: file.symlink_to("/dev/zero")),
    "a pipe": lambda file: replaced(file, os.mkfifo),
    "a loop": lambda file: replaced(file, lambda file: file.symlink_to(file)),
}
"""Of files that are needed, of any kind."""

WEIGHTS: dict[str, Damage] = {
    **ANY,
    "missing": Path.unlink,
    "cut to its length": lambda file: file.write_bytes(file.read_bytes()[:8]),
    "a header of exabytes": lambda file: file.write_bytes(struct.pack("<Q", 2**62) + b"{}"),
}

SETTINGS: dict[str, Damage] = {
    **ANY,
    "a list": lambda file: file.write_text("[1]"),
    "deep": lambda file: file.write_text("[" * 100_000),
    "an integer of thousands of digits": lambda file: file.write_text(f'{{"a": {"9" * 5000}}}'),
    "no UTF-8": lambda file: file.write_bytes(b'{"a": "\xff"}'),
}


def encoded(image: Image.Image, kind: str = "png") -> bytes:
    stream = io.BytesIO()
    image.save(stream, kind)
    return stream.getvalue()


def chunk(kind: bytes, data: bytes) -> bytes:
    """A chunk of a PNG (W3C, Portable Network Graphics, 5.3)."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


# Of `make soak` -------------------------------------------------------------------------------------------------------


def whole_files(here: Path) -> dict[str, bytes]:
    """Still images, recordings and sounds by name."""
    noise = np.random.default_rng(0)
    moves = [Image.fromarray(frame) for frame in recordings.frames(noise=0.0)]
    for name in ("png", "jpg", "tif", "webp"):
        moves[20].save(here / f"still.{name}")
    Image.fromarray(noise.integers(0, 4096, (48, 64)).astype(np.uint16)).save(here / "still.deep.png")
    Image.fromarray(noise.random((48, 64)).astype(np.float32)).save(here / "still.real.tif")
    np.save(here / "still.npy", noise.random((16, 16, 3)))
    moves[0].save(here / "moves.gif", save_all=True, append_images=moves[1:])
    recordings.write(here / "moves.mp4", [np.asarray(one) for one in moves])
    for name in ("PCM_16.wav", "FLOAT.wav", "PCM_24.flac", "VORBIS.ogg"):
        soundfile.write(here / f"sound.{name}", 0.1 * noise.standard_normal(4000), 16_000, name.split(".")[0])
    return {file.name: file.read_bytes() for file in sorted(here.iterdir())}


NAN = float("nan")
ODD: list[Any] = [
    NAN,
    float("inf"),
    -1,
    0,
    1.5,
    True,
    10**400,
    1j,
    "",
    " ",
    "junk",
    "\ud800",
    "a\0b",
    b"x",
    [],
    (),
    {},
    {"a": 1},
    {1, 2},
    object(),
    np.float64("nan"),
    np.int64(-5),
    np.array(NAN),
    np.zeros((3, 3)),
    torch.tensor(NAN),
    torch.zeros(2, 3),
    torch.zeros(0),
    torch.eye(16).to_sparse(),
    torch.zeros(3, 16, 16, device="meta"),
    np.array("x"),
    lambda *_: None,
    int,
    iter([1]),
    range(3),
    [None],
    [NAN],
    [[1]],
    ["gone.png"],
    Path("gone"),
]
"""Arguments that hardly any parameter takes."""

WORDS = [
    *"-*[~0= ",
    "",
    "nan",
    "-1",
    "1e999",
    "9" * 50,
    "junk",
    "a=b",
    "{}",
    "gone.png",
    "in",
    "in/a.png",
    "table.csv",
    "/proc/self/x",
    "/dev/null",
    "example:junk",
    "cuda:99",
    "a" * 5000,
    "\udcff",
]
"""The same on a command line."""


def odd_array(draw: random.Random) -> Any:
    """An array or tensor of any shape, dtype and values."""
    sides = [draw.choice([0, 1, 2, 3, 4, 8, 16, 32, 32]) for _ in range(draw.choice([0, 1, 2, 3, 3, 4, 4, 5]))]
    values = np.full(sides, draw.choice([0.0, 0.5, 1.0, NAN, np.inf, -1.0, 200.0, 1e30]))
    values.flat[: draw.choice([0, 8])] = 0.25
    with np.errstate(all="ignore"):
        array = values.astype(draw.choice(["u1", "i1", "u2", "i8", "f2", "f4", ">f4", "f8", "c8", "?", "O", "U8"]))
    plain = array.dtype.isnative and array.dtype.char in "BbHlefd?"
    return torch.from_numpy(array) if draw.random() < 0.5 and plain else array
