"""Values of every kind that somebody may pass: some that can be used, and most that cannot."""

from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hypothesis import strategies as st
from PIL import Image

from tests.helpers.odd_tensors import odd_tensors

NAN, INF = float("nan"), float("inf")

TOUCH = torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(0)) * 0.1 + 0.15
"""What the pipelines of `components` take for a touch, and for a picture."""

SOUND = (np.random.default_rng(0).random(8000), 16_000)
"""Half a second, and its sampling rate."""

NUMBERS: list[Any] = [
    None, True, False, -1, 0, 1, 2, 10**9, 2**63, -(2**63), 10**30, 10**400, -(10**400), 10**5000, 0.5, -0.0, NAN, INF,
    -INF, 5e-324, 1e308, 1e-2, Fraction(1, 3), Fraction(10**400), Decimal("1.5"), 1j, np.float16(0.5), np.int8(-1),
    np.float64(NAN), np.longdouble(2), np.bool_(True), torch.tensor(2.0), np.array(2.0), torch.tensor([1.0]),
]  # fmt: skip

WORDS: list[Any] = [
    "", " ", "brick", "rough \ud800", "a\0b", "a\nb", "x" * 5000, "ddim", "unipcc", "pil", "latent", "digit",
    "all", "nearest", "slerp", "cpu", "\N{PILE OF POO}", b"\x00\xff", Path("gone.png"), "/dev/zero", "/dev/null", "/",
    "~", "..", "http://x.y/z.png",
]  # fmt: skip

CONTAINERS: list[Any] = [
    [], [None], [[]], (), (1, 2), (0.2, 0.8), (0.8, 0.2), (0.2, NAN), [1.0] * 100, ["brick", 3], [10**400], {},
    {"a": [1]}, {"text": 1.0}, {"text": NAN, "image": 1}, {3: 3}, {1, 2}, range(3), ["digit"], [["digit"]],
    [torch.Generator()], [{}],
]  # fmt: skip

OBJECTS: list[Any] = [object(), int, len, torch.float16, torch.int8, torch.device("cuda"), torch.nn.Linear(2, 2)]

ARRAYS: list[Any] = [
    *odd_tensors(TOUCH).values(), *odd_tensors(torch.rand(2, 16)).values(), TOUCH, TOUCH * NAN, TOUCH * 1e30,
    torch.zeros(0, 3, 32, 32), torch.zeros(1, 16), torch.zeros(1, 1, 16), torch.full((1, 16), INF),
    torch.zeros(1, 12, 16), torch.zeros(1, 4, 8, 8), torch.zeros(1, 3, 16, 16), torch.zeros(2, 2, 2, 2, 2),
    torch.zeros(3, 10_000, 9), torch.zeros(1).expand(10**12), torch.zeros(1, 12).long(), np.zeros((32, 32, 3)),
    np.zeros((32, 32, 3), np.uint8), np.full((32, 32, 3), NAN), np.zeros((0, 0, 3)), np.zeros((32, 32), object),
    np.zeros((32, 32), "U3"), np.zeros((32, 32), "M8[s]"), np.zeros((32, 32), [("a", "f4")]), np.asmatrix(np.eye(32)),
    np.zeros((32, 32), complex), np.ma.masked_array(np.zeros((32, 32)), np.eye(32)), np.zeros((32, 32), np.float128),
    np.zeros(8000), (np.zeros(8000), 16_000), (np.full(8000, NAN), 16_000), (np.zeros(8000), 10**400),
    (np.zeros(8000), "fast"), SOUND, Image.new("RGB", (32, 32)), Image.new("RGB", (1, 1)), Image.new("CMYK", (32, 32)),
    Image.new("F", (32, 32), NAN),
]  # fmt: skip

ODD = [*NUMBERS, *WORDS, *CONTAINERS, *OBJECTS, *ARRAYS]

DRAWN = st.one_of(
    st.sampled_from(ODD),
    st.floats(),
    st.integers(-(2**70), -1),
    st.text(max_size=20),
    st.lists(st.sampled_from(ODD), max_size=3),
    st.dictionaries(st.sampled_from(["text", "image", "touch", "latents", ""]), st.sampled_from(ODD), max_size=2),
)


def shown(value: Any) -> str:
    """What a value looks like, in a line of few characters."""
    try:
        return " ".join(repr(value).split())[:100]
    except Exception:  # of integers of thousands of digits, and of tensors that torch cannot print
        return f"a {type(value).__name__} that has no words"
