"""Files and folders that are damaged, lack something, or claim what could not be: refused by a line, or read whole."""

import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from hypothesis import strategies as st

import unitouch_gen
from tests.helpers.attempts import Attempts, drawn
from tests.helpers.damage import SETTINGS, WEIGHTS, claim
from tests.helpers.odd_values import TOUCH, shown
from tests.helpers.published_files import published, small
from unitouch_gen.convert import convert_published
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.pipelines import TouchToImagePipeline, XToTouchPipeline
from unitouch_gen.training.recipe import RECIPES, read_recipe

pytestmark = pytest.mark.slow

CLAIMS = [None, True, -1, 0, 10**9, 10**400, 1.5, float("nan"), "", "x", [], [10**9], {}, {"a": [1]}, [None]]
"""What settings may say in place of what they say."""

QUIET: dict[str, Any] = {"log_fn": lambda line: None}


@contextmanager
def damaged(source: Path, copy: Path, file: Path | str, damage: Callable[[Path], Any]) -> Iterator[Path]:
    """A copy of a folder, with one of its files damaged."""
    shutil.copytree(source, copy)
    try:
        damage(copy / file)
        yield copy
    finally:
        shutil.rmtree(copy)


# Folders of models ----------------------------------------------------------------------------------------------------


def used(folder: Path, kind: Any, settings: dict[str, Any] | None = None, **inputs: Any) -> Any:
    """A pipeline is loaded, and makes a picture: encoders are read when they are first used."""
    pipe = kind.from_pretrained(folder, local_files_only=True, **(settings or {}))
    pipe.set_progress_bar_config(disable=True)
    return pipe(**inputs)


def all_of_it(folder: Path) -> None:
    """A joint space and its processor."""
    model = UniTouchModel.from_pretrained(folder)
    for modality in model.known_modalities:
        model.load(modality)
    UniTouchProcessor.from_pretrained(folder).text("rough brick")


READERS: dict[str, tuple[str, Callable[[Path], Any]]] = {
    "joint": ("joint", all_of_it),
    "touch-to-image": ("touch-to-image", partial(used, kind=TouchToImagePipeline, touch=TOUCH, prompt="brick")),
    "x-to-touch": ("x-to-touch", partial(used, kind=XToTouchPipeline, text="rough brick")),
    "planned": ("x-to-touch", partial(used, kind=XToTouchPipeline, image=TOUCH,
                                      settings={"plan": XToTouchPipeline.plan(image="a")})),
    "family": ("family", lambda folder: unitouch_gen.tiny("x-to-touch", family=folder)),
}  # fmt: skip
"""What reads a folder of `saved`, by a name."""


@pytest.mark.parametrize("name", READERS)
def test_folders_that_are_damaged(attempt: Attempts, saved: dict[str, Path], tmp_path: Path, name: str) -> None:
    """Every file of weights and settings, in every way; a plan and a family leave some unread."""
    source, read = READERS[name]
    for file in sorted(saved[source].rglob("*")):
        ways = {".json": {**SETTINGS, "missing": Path.unlink}, ".safetensors": WEIGHTS}.get(file.suffix, {})
        for way, damage in ways.items():
            inner = file.relative_to(saved[source])
            with damaged(saved[source], tmp_path / "copy", inner, damage) as folder:
                refused = name not in ("planned", "family") and way != "missing"
                attempt(f"{name}, {inner}: {way}", partial(read, folder), refused=refused)


def test_folders_whose_settings_claim_something_else(attempt: Attempts, saved: dict[str, Path], tmp_path: Path) -> None:
    source, (_, read) = saved["x-to-touch"], READERS["x-to-touch"]
    places = [(file.relative_to(source), key) for file in sorted(source.rglob("*config.json"))
              for key in keys_of(json.loads(file.read_text()))]  # fmt: skip
    places += [(Path("model_index.json"), key) for key in json.loads((source / "model_index.json").read_text())]

    @drawn(800, place=st.sampled_from(places), value=st.sampled_from(CLAIMS))
    def change(place: tuple[Path, str], value: Any) -> None:
        with damaged(source, tmp_path / "copy", place[0], claim(**{place[1]: value})) as folder:
            attempt(f"{place[0]}: {place[1]}={shown(value)}", partial(read, folder))


def keys_of(settings: dict[str, Any]) -> list[str]:
    """Keys of settings, and those of their sections behind theirs, as `claim` takes them."""
    inner = [f"{key}__{name}" for key, value in settings.items() if isinstance(value, dict) for name in keys_of(value)]
    return [*settings, *inner]


# Pictures and sounds --------------------------------------------------------------------------------------------------


def test_pictures_and_sounds(attempt: Attempts, pipes: dict[str, Any], files: list[Path]) -> None:
    processor = pipes["x-to-touch"].processor
    for file in files:
        sound, whole = file.suffix in (".wav", ".flac", ".ogg", ".mp3"), file.stem == "whole"
        for read, fits in ((processor.images, not sound), (processor.touch, not sound), (processor.sounds, sound)):
            attempt(f"{read.__name__} {file.name!a}", partial(read, file), used=whole and fits)
            attempt(f"{read.__name__} {file.name!a} in a list", partial(read, [file, str(file)]), used=whole and fits)


# Checkpoints and recipes ----------------------------------------------------------------------------------------------


def test_checkpoints_that_are_damaged(attempt: Attempts, tmp_path: Path) -> None:
    encoders, _ = published(tmp_path, small())
    for way, damage in WEIGHTS.items():
        for key, file in encoders.items():
            (tmp_path / "copy").mkdir()
            copy = Path(shutil.copy(file, tmp_path / "copy"))
            damage(copy)
            convert = partial(convert_published, "out", **{key: copy}, config=small(), **QUIET)
            attempt(f"{file.name}: {way}", convert, refused=True)
            shutil.rmtree(tmp_path / "copy")


def test_recipes_that_are_damaged(attempt: Attempts, tmp_path: Path) -> None:
    """Half a recipe may be one of fewer sections."""
    for recipe in sorted(RECIPES.glob("*.yaml")):
        for way, damage in SETTINGS.items():
            copy = Path(shutil.copy(recipe, tmp_path / "mine.yaml"))
            damage(copy)
            attempt(f"{recipe.name}: {way}", partial(read_recipe, copy), refused=way != "cut")
            copy.rmdir() if copy.is_dir() else copy.unlink()
