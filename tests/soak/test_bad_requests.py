"""Requests to the page of `unitouch-gen app` that cannot be used: each is refused in a line, and the page goes on."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from tests.helpers import served
from tests.helpers.attempts import Attempts
from unitouch_gen.errors import InvalidInputError

pytest.importorskip("gradio", reason="the extra `app` is not installed")

from gradio_client import Client, handle_file
from gradio_client.exceptions import AppError

pytestmark = pytest.mark.slow

VALUES: list[Any] = [
    None, True, -1, 0, 3, 10**9, 10**400, 1.5, 1e308, "", "a\nb", "x" * 5000, "linear", "digit", "/etc/passwd",
    "../x.png", "http://127.0.0.1:9/x.png", [], [1], {}, {"path": "/etc/passwd"}, {"path": [], "meta": {"_type": "x"}},
]  # fmt: skip

TELLS_NOTHING = "has not enabled verbose error reporting"
"""What gradio says of an error that nobody foresaw."""

HIDDEN = ("Traceback", "site-packages", TELLS_NOTHING)
"""What no answer says, nor the folder that the page keeps its files in."""


@pytest.fixture
def ask(pipes: dict[str, Any], tmp_path: Path) -> Iterator[Callable[..., Any]]:
    """Asks a tab; what it refuses is refused by an `InvalidInputError`, as in the terminal."""
    tabs = {
        "touch-to-image": pipes["touch-to-image"],
        "stylization": pipes["stylize"],
        "x-to-touch": pipes["x-to-touch"],
    }
    with served.page(tabs, tmp_path / "served") as address:
        asked = served.asking(Client(address, verbose=False, download_files=False))

        def ask(tab: str, **sent: Any) -> Any:
            try:
                return asked(tab, **sent)
            except AppError as error:
                said = str(error)
                if any(word in said for word in (*HIDDEN, str(tmp_path))):
                    raise RuntimeError(said) from error
                raise InvalidInputError(f"`{tab}`: {said}") from error

        yield ask


def test_values_of_every_kind_and_damaged_uploads(
    attempt: Attempts, ask: Callable[..., Any], files: list[Path]
) -> None:
    whole = {file.name: handle_file(str(file)) for file in files if file.stem == "whole"}
    picture, sound = whole["whole.png"], whole["whole.wav"]
    good: dict[str, dict[str, Any]] = {
        "touch_to_image": {"touch": picture, "prompt": "", "sensor": ""},
        "stylize": {"photo": picture, "touch": picture, "touch_weight": 0.5, "mix": "linear", "init_strength": 0.5,
                    "prompt": "", "sensor": ""},
        "x_to_touch": {"of": "words", "text": "rough brick", "source_sensor": "", "sensor": "digit", "bridge": True,
                       "candidates": 1, "audio": sound, "image": picture, "touch": picture},
    }  # fmt: skip
    settings = {"by": "steps", "steps": 2, "tolerance": 5, "guidance": 2, "pictures": 1, "seed": 0, "new_seed": False}
    for tab, sent in good.items():
        attempt(tab, partial(ask, tab, **sent, **settings), used=True)
        for name in (*sent, *settings):
            for value in VALUES:
                attempt(f"{tab} {name}={value!r:.40}", partial(ask, tab, **{**settings, **sent, name: value}))
    sent = good["x_to_touch"]
    for file in files:
        if file.is_file() and not file.is_symlink() and file.name.isascii():  # others are not uploaded
            upload = handle_file(str(file))
            for of, name in (("a sound", "audio"), ("a photo", "image"), ("another sensor's touch", "touch")):
                attempt(
                    f"{name} {file.name!a}", partial(ask, "x_to_touch", **{**settings, **sent, "of": of, name: upload})
                )
    attempt("after all of them", partial(ask, "touch_to_image", **good["touch_to_image"], **settings), used=True)
