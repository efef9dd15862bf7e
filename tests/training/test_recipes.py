"""Recipes, their overrides, and what a trainer can be told."""

from dataclasses import fields
from pathlib import Path

import pytest

from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.training.core import RECIPES, TrainerConfig, read_recipe, trainer_config

NAMES = sorted(path.stem for path in RECIPES.glob("*.yaml"))
REQUIRED = {"steps": 10, "batch_size": 4, "learning_rate": 0.1}


@pytest.mark.parametrize("name", NAMES)
def test_the_trainer_understands_every_recipe(name: str) -> None:
    assert isinstance(trainer_config(read_recipe(name)["trainer"]), TrainerConfig)


def test_a_recipe_may_be_a_file_of_ones_own(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("trainer: {steps: 7, batch_size: 2, learning_rate: 0.5}\n")
    assert trainer_config(read_recipe(tmp_path / "mine.yaml")["trainer"]) == TrainerConfig(7, 2, 0.5)


def test_a_missing_recipe_is_refused_with_those_there_are() -> None:
    with pytest.raises(InvalidInputError, match=r"`recipe` is 'taste'.*'audio'.*'touch'"):
        read_recipe("taste")


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("12", 12),
        ("0.5", 0.5),
        ("1e-3", 1e-3),
        ("1.0e-3", 1e-3),
        ("adam", "adam"),
        ("[a, b]", ["a", "b"]),
        ("null", None),
    ],
)
def test_an_override_takes_the_kind_of_value_it_looks_like(text: str, value: object) -> None:
    assert read_recipe("touch", [f"trainer.learning_rate={text}"])["trainer"]["learning_rate"] == value


def test_overrides_leave_the_rest_as_it_is() -> None:
    plain, changed = read_recipe("touch"), read_recipe("touch", ["trainer.steps=3", "sampler.sigma=0.5"])
    assert (changed["trainer"].pop("steps"), changed["sampler"].pop("sigma")) == (3, 0.5)
    plain["trainer"].pop("steps"), plain["sampler"].pop("sigma")
    assert changed == plain


@pytest.mark.parametrize("name", NAMES)
def test_what_a_recipe_leaves_to_the_trainer_may_be_set(name: str) -> None:
    section = read_recipe(name, ["trainer.seed=7", "trainer.save_every=9"])["trainer"]
    config = trainer_config(section)
    assert (config.seed, config.save_every) == (7, 9)


def test_of_two_overrides_of_one_key_the_later_holds() -> None:
    assert read_recipe("touch", ["trainer.steps=3", "trainer.steps=4"])["trainer"]["steps"] == 4


def test_a_value_may_hold_an_equals_sign() -> None:
    assert read_recipe("touch", ["data.collections=a=b"])["data"]["collections"] == "a=b"


@pytest.mark.parametrize(
    "override", ["trainer.step=3", "training.steps=3", "trainer.steps", "steps=3", "trainer.steps.more=3", "=3", ""]
)
def test_an_override_of_nothing_in_the_recipe_is_refused(override: str) -> None:
    with pytest.raises(InvalidInputError, match=r"`set` is .*; write section\.key=value with a key of touch\.yaml"):
        read_recipe("touch", [override])


def test_an_unknown_key_of_the_trainer_is_refused_with_those_there_are() -> None:
    with pytest.raises(InvalidInputError, match=r"`trainer` holds \['stpes'\].*'steps'"):
        trainer_config({**REQUIRED, "stpes": 3})


def test_every_field_of_the_trainer_is_described() -> None:
    text = str(TrainerConfig.__doc__)
    assert [field.name for field in fields(TrainerConfig) if field.name not in text] == []


@pytest.mark.parametrize(
    ("key", "value"),
    [("steps", 0), ("batch_size", -1), ("learning_rate", -0.1), ("learning_rate", float("nan")), ("warmup", -1),
     ("final_rate", 1.5), ("grad_clip", -1.0), ("ema_decay", 1.5), ("save_every", 0), ("mixed_precision", "int8")],
)  # fmt: skip
def test_a_value_the_trainer_cannot_use_is_refused_by_name(key: str, value: float | str) -> None:
    with pytest.raises(InvalidInputError, match=f"`{key}` is {value!r}; it has to be"):
        trainer_config({**REQUIRED, key: value})


@pytest.mark.parametrize(("key", "value"), [("steps", "1e3"), ("steps", 10.0), ("learning_rate", "fast")])
def test_a_value_of_another_kind_is_refused_by_name(key: str, value: float | str) -> None:
    with pytest.raises(InvalidTypeError, match=f"`{key}` is {value!r}"):
        trainer_config({**REQUIRED, key: value})


def test_full_precision_may_be_written_without_quotes() -> None:
    section = read_recipe("touch", ["trainer.mixed_precision=no"])["trainer"]
    assert trainer_config(section).mixed_precision == "no"
