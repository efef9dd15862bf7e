"""Arguments of every kind that calls do not take: each is refused by name, or makes what it is documented to make."""

import inspect
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from tests.helpers.components import make_components
from unitouch_gen.errors import InvalidInputError, InvalidTypeError, NonFiniteError, NotConvergedError
from unitouch_gen.pipelines import TactileStylizationPipeline, TouchToImagePipeline

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]

REFUSED = (InvalidInputError, InvalidTypeError)
LONGEST = 2000
"""Characters of a message."""

ENDED = (NonFiniteError, NotConvergedError)
"""What a call raises that began, as documented."""

BAD: dict[str, Callable[[Path], Any]] = {
    "nothing in a list": lambda folder: [],
    "None in a list": lambda folder: [None],
    "an object": lambda folder: object(),
    "a class": lambda folder: int,
    "a function": lambda folder: len,
    "true": lambda folder: True,
    "-1": lambda folder: -1,
    "0": lambda folder: 0,
    "a huge integer": lambda folder: 10**400,
    "a large integer": lambda folder: 10**7,
    "a fraction": lambda folder: Fraction(1, 3),
    "nan": lambda folder: float("nan"),
    "infinity": lambda folder: float("inf"),
    "a complex number": lambda folder: 1j,
    "an empty string": lambda folder: "",
    "a string": lambda folder: "nothing of the kind",
    "half a surrogate": lambda folder: "brick \ud800",
    "bytes": lambda folder: b"\x00\xff",
    "a dictionary": lambda folder: {"a": 1},
    "a set": lambda folder: {1, 2},
    "an empty array": lambda folder: np.zeros(0),
    "an array of objects": lambda folder: np.array([object()]),
    "a matrix": lambda folder: np.asmatrix(np.ones((2, 2))),
    "strings in an array": lambda folder: np.array(["a", "b"]),
    "a tensor of nan": lambda folder: torch.full((1, 3, 32, 32), float("nan")),
    "an empty tensor": lambda folder: torch.zeros(0, 3, 32, 32),
    "a tensor of five dimensions": lambda folder: torch.zeros(1, 1, 3, 32, 32),
    "a meta tensor": lambda folder: torch.zeros(1, 3, 32, 32, device="meta"),
    "a sparse tensor": lambda folder: torch.zeros(1, 3, 32, 32).to_sparse(),
    "a complex tensor": lambda folder: torch.zeros(1, 3, 32, 32, dtype=torch.complex64),
    "a float8 tensor": lambda folder: torch.zeros(1, 3, 32, 32).to(torch.float8_e4m3fn),
    "a quantised tensor": lambda folder: torch.quantize_per_tensor(torch.zeros(1, 3, 32, 32), 0.1, 0, torch.quint8),
    "a nested tensor": lambda folder: torch.nested.nested_tensor([torch.zeros(2), torch.zeros(3)]),
    "a picture of one pixel": lambda folder: Image.new("RGB", (1, 1)),
    "a missing file": lambda folder: folder / "missing.png",
    "a folder": lambda folder: folder,
    "an empty file": lambda folder: folder / "empty.png",
    "a file cut short": lambda folder: folder / "cut.png",
    "a file of noise": lambda folder: folder / "noise.wav",
    "a device": lambda folder: Path("/dev/zero"),
    "a name with a zero": lambda folder: "a\0b.png",
    "a long name": lambda folder: "a" * 5000 + ".png",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files that are broken."""
    folder = tmp_path_factory.mktemp("broken")
    (folder / "empty.png").touch()
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)).save(folder / "cut.png")
    (folder / "cut.png").write_bytes((folder / "cut.png").read_bytes()[:2000])
    (folder / "noise.wav").write_bytes(np.random.default_rng(0).bytes(3000))
    return folder


TOUCH = torch.full((1, 3, 32, 32), 0.5)
DEFAULTS = {"default_num_inference_steps": 2, "default_guidance_scale": 2.0}


CALLS: dict[str, tuple[Callable[[], Any], dict[str, Any]]] = {
    "touch-to-image": (lambda: TouchToImagePipeline(**make_components(), **DEFAULTS), {"touch": TOUCH}),
    "stylization": (
        lambda: TactileStylizationPipeline(**make_components(), **DEFAULTS), {"image": TOUCH, "touch": TOUCH}
    ),
}  # fmt: skip


THEIRS = {
    *(("callback_on_step_end", kind) for kind in ("a class", "a function")),  # may raise what they like
    *((side, "a large integer") for side in ("height", "width")),  # pictures that some machines have the memory for
}
"""Inputs that are not for a call to refuse."""


def refused_or_done(call: Callable[..., Any], arguments: dict[str, Any]) -> str:
    """How a call ends; anything but a clear refusal, a documented end or a result fails the test."""
    try:
        call(**arguments)
    except REFUSED as error:
        if "`" not in str(error) or len(str(error)) > LONGEST:
            raise RuntimeError(f"no clear message: {error}") from error
        return "refused"
    except ENDED:
        return "ended"
    return "done"


@pytest.mark.parametrize("pipeline", CALLS)
def test_arguments_of_pipelines(pipeline: str, folder: Path, record_property: Callable[[str, object], None]) -> None:
    make, good = CALLS[pipeline]
    pipe = make()
    pipe.set_progress_bar_config(disable=True)
    before = sorted(folder.iterdir())
    counts = dict.fromkeys(("refused", "ended", "done"), 0)
    raw = []
    names = [name for name in inspect.signature(type(pipe).__call__).parameters if name != "self"]
    for name in names:
        for kind, value in BAD.items():
            if (name, kind) in THEIRS:
                continue
            arguments = {**good, "output_type": "np", name: value(folder)}
            try:
                counts[refused_or_done(pipe, arguments)] += 1
            except Exception as error:
                raw.append(f"{name}={kind}: {type(error).__name__}: {str(error)[:150]}")
    assert not raw, "\n".join(raw)
    assert sorted(folder.iterdir()) == before
    for what, count in counts.items():
        record_property(what, count)
