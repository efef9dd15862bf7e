"""Options of commands, with every kind of word: each does its work, or ends with one line and exit code 2."""

import io
import sys
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import pytest
import typer
from diffusers import DDPMScheduler
from hypothesis import strategies as st
from transformers import ResNetConfig

from tests.helpers.attempts import Attempts, drawn
from tests.helpers.odd_values import shown
from tests.helpers.published_files import published, small
from tests.helpers.recordings import frames
from tests.helpers.recordings import write as write_recording
from unitouch_gen.cli import commands, main
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import UniTouchConfig
from unitouch_gen.training import image_text, touch
from unitouch_gen.training.data import DataConfig
from unitouch_gen.training.image_vae import AutoencoderLoss
from unitouch_gen.training.picture_classifier import ClassifierAugmentation
from unitouch_gen.training.recipe import RECIPES, Settings, build, read, read_recipe
from unitouch_gen.training.stages import run
from unitouch_gen.training.touch import SamplerSettings, SensorSettings, TouchAugmentation
from unitouch_gen.training.touch_ldm import BankSettings, TouchDiffusionSettings
from unitouch_gen.training.trainer import TrainerConfig
from unitouch_gen.training.unclip import UnclipSettings

pytestmark = pytest.mark.slow

DONE = (None, 0, 1)
"""Exit codes of commands that came to their end; 1 says that what they looked at is not as it should be."""

WORDS = ["", "x", "-1", "0", "1.5", "nan", "inf", "1e400", "9" * 400, "\udcff", "a\nb", "x=y", "text=1", "a,b", "1,nan",
         "gone", "gone/deep.png", "gone/\udcff.png", ".", "/dev/zero", "/dev/null", "x" * 300]  # fmt: skip


def ended(call: Callable[[], Any]) -> None:
    """Runs a command in this process, on streams as strict as real ones.

    Raises:
        InvalidInputError: With its line, if it was refused.
        RuntimeError: If it ended otherwise than commands end.
    """
    out, err = (
        io.TextIOWrapper(io.BytesIO(), encoding="utf-8", errors=errors) for errors in ("strict", "backslashreplace")
    )
    try:
        with redirect_stdout(out), redirect_stderr(err):
            call()
    except SystemExit as end:
        out.flush(), err.flush()
        printed, said = (stream.buffer.getvalue().decode(errors="replace") for stream in (out, err))  # type: ignore[attr-defined]
        if end.code == 2 and said.count("\n") == 1 and said.startswith("unitouch") and not printed:
            raise InvalidInputError(f"`{said.strip()}`") from end  # click quotes options in its own way
        if end.code not in DONE:
            raise RuntimeError(f"exit code {end.code}: {said!r}, {printed!r}") from end


def interrupted(seconds: float) -> None:
    """Ctrl-C, as soon as a page is served."""
    raise KeyboardInterrupt


def command(*words: object) -> None:
    """`unitouch-gen ...`."""
    with patch.object(sys, "argv", ["unitouch-gen", *map(str, words)]):
        ended(main)


def options_of(words: Sequence[object]) -> list[str]:
    """Options that take a value of the command that a line begins with; "" stands for a word without one."""
    found: Any = typer.main.get_command(commands)
    for word in words:
        found = found.commands[word] if hasattr(found, "commands") else found
    return [one.opts[0] if one.param_type_name == "option" else "" for one in found.params
            if not getattr(one, "is_flag", False)]  # fmt: skip


@pytest.fixture
def lines(given: Path, saved: dict[str, Path], tmp_path: Path) -> dict[str, list[object]]:
    """Command lines that work, in seconds."""
    picture = given / "touches" / "0.png"
    encoders, _ = published(tmp_path, small())
    small().save_pretrained(tmp_path)
    return {
        "touch-to-image": [picture, "--model", saved["touch-to-image"], "-o", "out", "--overwrite"],
        "stylize": [picture, picture, "--model", saved["stylize"], "-o", "out", "--overwrite"],
        "x-to-touch": ["--text", "brick", "--model", saved["x-to-touch"], "-o", "out", "--overwrite"],
        "watch": [write_recording(tmp_path / "press.mp4", list(frames())), "--touches", "1", "-o", "out", "--model",
                  saved["touch-to-image"]],
        "doctor": ["--model", saved["x-to-touch"]],
        "classify": [picture, "--model", saved["joint"]],
        "app": ["--model", saved["x-to-touch"]],
        "batch": [given / "touches", "--model", saved["touch-to-image"], "-o", "out"],
        "stability": ["--only", "x-to-touch: guidance_scale 1e6", "--model", saved["x-to-touch"]],
        "adapt": [given / "touches", "--sensor", "mine", "--steps", "1", "--model", saved["joint"],
                  "--overwrite"],
        "convert unitouch": ["--touch", encoders["touch"], "--config", tmp_path / "config.json", "-o", "out"],
        "data check": [given / "touches"],
        "work-precision": ["--problem", "gaussian", "--solvers", "ddim", "--steps", "2", "--seeds", "2", "-o", "out"],
    }  # fmt: skip


COMMANDS = ("touch-to-image", "stylize", "x-to-touch", "watch", "doctor", "classify", "app", "batch", "stability",
            "adapt", "convert unitouch", "data check", "work-precision")  # fmt: skip


EVERY = {"stability": 4, "work-precision": 4}
"""Of how many words an option gets one, where a command takes its time; the next option gets the next one."""


@pytest.mark.parametrize("name", COMMANDS)
def test_commands(
    attempt: Attempts, lines: dict[str, list[object]], name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GRADIO_TEMP_DIR", "")  # which `app` sets for its process
    monkeypatch.setattr(sys.modules["unitouch_gen.cli.app"], "time", SimpleNamespace(sleep=interrupted))
    words = [*name.split(), *lines[name]]
    attempt(name, partial(command, *words), used=True)
    attempt(f"{name} --bogus", partial(command, *words, "--bogus"), refused=True)
    every = EVERY.get(name, 2)
    for place, option in enumerate(options_of(words)):
        for value in WORDS[place % every :: every]:
            said = [option, value] if option else [value]
            attempt(f"{name} {option} {value!a}", partial(command, *words, *said))


def test_commands_on_files(attempt: Attempts, saved: dict[str, Path], files: list[Path]) -> None:
    whole = files[0].with_name("whole.png")
    for file in files:
        for words in (
            ["touch-to-image", file, "--model", saved["touch-to-image"]],
            ["stylize", file, whole, "--model", saved["stylize"]],
            ["x-to-touch", "--image", file, "--model", saved["x-to-touch"]],
            ["x-to-touch", "--audio", file, "--model", saved["x-to-touch"]],
        ):
            attempt(f"{words[0]} {file.name!a}", partial(command, *words, "-o", "out"))
        for words in (
            ["adapt", file, "--sensor", "mine"],
            ["convert", "unitouch", "--touch", file, "-o", "out"],
        ):
            attempt(f"{words[0]} {file.name!a}", partial(command, *words), refused=True)
        attempt(f"data check {file.name!a}", partial(command, "data", "check", file), refused=True)


# Recipes --------------------------------------------------------------------------------------------------------------


def test_stages(attempt: Attempts) -> None:
    """None is let go so far as to render."""
    for name, stage, words in (
        ("touch", touch, ["--joint", "gone"]),
        ("image_text", image_text, ["--recipe", "gone"]),
    ):
        for option in ("--recipe", "--set", "--output", "--cache", "--init", "--joint", "--resume", "--bogus"):
            for value in WORDS:
                call = partial(run, name, stage.main, [*words, option, value])
                attempt(f"{name} {option} {value!a}", partial(ended, call), refused=True)


SECTIONS: dict[str, Callable[..., Any]] = {
    "trainer": TrainerConfig,
    "data": DataConfig,
    "scheduler": DDPMScheduler,
    "image_text.model": UniTouchConfig,
    "touch.sampler": SamplerSettings,
    "touch.augment": TouchAugmentation,
    "touch.sensors": SensorSettings,
    "image_vae.loss": AutoencoderLoss,
    "picture_classifier.model": ResNetConfig,
    "picture_classifier.augment": ClassifierAugmentation,
    "touch_ldm.objective": TouchDiffusionSettings,
    "touch_ldm.embedding_bank": BankSettings,
    "unclip.objective": UnclipSettings,
}
"""What reads sections of all recipes, or of one."""

VALUES = [*WORDS, "null", "true", "1", "1000000000", "-0.0", ".nan", "[]", "[1000000000]", "{}", "{a: 1}", "[", "{",
          "[null]", "2024-13-45", "!!python/object:os.system x", "&a [*a]", "[" * 3000]  # fmt: skip


def test_recipes(attempt: Attempts) -> None:
    recipes = {file.stem: read_recipe(file) for file in sorted(RECIPES.glob("*.yaml")) if file.stem != "data"}
    keys = {name: [f"{part}.{key}" for part in recipe for key in recipe[part]] for name, recipe in recipes.items()}
    places = [(name, key) for name in keys for key in [*keys[name], "trainer.bogus", "bogus.a"]]

    @drawn(300, place=st.sampled_from(places), value=st.one_of(st.sampled_from(VALUES), st.text(max_size=20)))
    def override(place: tuple[str, str], value: str) -> None:
        name, key = place
        section = key.partition(".")[0]
        kind = SECTIONS.get(section, SECTIONS.get(f"{name.removesuffix('_paper')}.{section}"))

        def read_one() -> Any:
            recipe = read_recipe(name, [f"{key}={value}"])
            if kind is None:
                return recipe
            is_settings = isinstance(kind, type) and issubclass(kind, Settings)
            return read(kind, recipe[section]) if is_settings else build(section, kind, recipe[section])

        attempt(f"{name} {key}={shown(value)}", read_one)
