"""Recipes: YAML files whose sections are read as dataclasses that check what they are told."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from inspect import Parameter, signature
from pathlib import Path
from typing import Any, TypeVar

import yaml
from transformers import PreTrainedConfig

from unitouch_gen.errors import (
    InvalidInputError,
    InvalidTypeError,
    check_choice,
    check_integer,
    check_number,
    describe,
    did_you_mean,
)
from unitouch_gen.world import COLLECTIONS, TRAINING_COLLECTIONS

RECIPES = Path(__file__).parent / "recipes"
BASE = "data"
"""The recipe that holds nothing but data, on which others may base theirs."""

Settings = TypeVar("Settings")


@dataclass(frozen=True)
class TrainerConfig:
    """How long and how fast.

    Attributes:
        steps: Optimiser steps.
        batch_size: Samples a step.
        learning_rate: Peak of the cosine schedule.
        warmup: Steps of linear warm-up.
        final_rate: Where the cosine ends, as a share of the peak.
        optimizer: "adamw" or "adam".
        weight_decay: Of the optimiser, on the weights of linear and convolution layers alone.
        beta2: Of the optimiser.
        grad_clip: Largest gradient norm; 0 switches clipping off.
        ema_decay: Of the averaged weights, which are the ones kept; 0 keeps the raw weights.
        mixed_precision: "no", "fp16" or "bf16", for accelerate.
        save_every: Steps between checkpoints.
        seed: Of initial weights, batches and noise.
    """

    steps: int
    batch_size: int
    learning_rate: float
    warmup: int = 100
    final_rate: float = 0.0
    optimizer: str = "adamw"
    weight_decay: float = 0.05
    beta2: float = 0.98
    grad_clip: float = 1.0
    ema_decay: float = 0.0
    mixed_precision: str = "no"
    save_every: int = 250
    seed: int = 0

    def __post_init__(self) -> None:
        for name, low in {"steps": 1, "batch_size": 1, "warmup": 0, "save_every": 1}.items():
            check_integer(name, getattr(self, name), low)
        check_integer("seed", self.seed, 0, 2**32 - 1)
        for name in ("learning_rate", "weight_decay", "grad_clip"):
            check_number(name, getattr(self, name), 0.0)
        check_probabilities(self, "final_rate", "beta2", "ema_decay")
        check_choice("optimizer", self.optimizer, ("adam", "adamw"))
        check_choice("mixed_precision", self.mixed_precision, ("no", "fp16", "bf16"))


@dataclass(frozen=True)
class DataConfig:
    """What a stage is trained on.

    Attributes:
        contacts_per_object: Contacts rendered of each object.
        collections: Names in `COLLECTIONS`; null stands for the four training collections.
        world_seed: Of the world.
        image_size: Side of the pictures, pixels, where no joint space says it.
        touch_size: Side of the touches, pixels; `image_size` if left out.
        audio: Fields of `LogMel`, where no joint space says them; the paper's if left out.
    """

    contacts_per_object: int
    collections: tuple[str, ...] = TRAINING_COLLECTIONS
    world_seed: int = 0
    image_size: int | None = None
    touch_size: int | None = None
    audio: dict[str, Any] | None = None

    def __post_init__(self) -> None:
        check_integer("contacts_per_object", self.contacts_per_object, 1)
        check_integer("world_seed", self.world_seed, 0)
        if self.touch_size is not None:
            check_integer("touch_size", self.touch_size, 8)
        names = TRAINING_COLLECTIONS if self.collections is None else self.collections
        if not isinstance(names, list | tuple) or not names:
            raise InvalidInputError(
                f"`collections` is {describe(names)}; it has to be a list of names, such as [world_digit], or null."
            )
        for name in names:
            check_choice("collections", name, COLLECTIONS)
        object.__setattr__(self, "collections", tuple(names))


def check_probabilities(settings: Any, *names: str) -> None:
    """Checks that attributes lie within 0 and 1.

    Raises:
        InvalidInputError, InvalidTypeError: If one does not; the message names it.
    """
    for name in names:
        check_number(name, getattr(settings, name), 0.0, 1.0)


def read_recipe(path: str | Path, overrides: list[str] | None = None) -> dict[str, Any]:
    """A YAML recipe with `section.key=value` overrides laid over it.

    A `base` in its `data` names another YAML file, whose keys hold where the recipe has none of its own.

    Args:
        path: A file, or the name of one in `training/recipes`.
        overrides: May add keys to a section; whether those are any is for what reads the section to say.

    Raises:
        InvalidInputError: If the file is missing or no mapping of sections, or an override is in none of them.
    """
    file = _recipe_file("recipe", path)
    recipe = _read_yaml(file)
    data = recipe.get("data")
    if isinstance(data, dict) and "base" in data:
        base = _read_yaml(_recipe_file("data.base", data["base"]))
        recipe["data"] = {**base, **{key: value for key, value in data.items() if key != "base"}}
    for override in overrides or []:
        key, separator, value = override.partition("=")
        *parents, leaf = key.split(".")
        if not separator or not parents or not leaf:
            raise InvalidInputError(f"`set` is {override!r}; write section.key=value, such as trainer.steps=100.")
        section = recipe
        for place, parent in enumerate(parents):
            if not isinstance(section.get(parent), dict):
                inner = [name for name in map(str, section) if isinstance(section.get(name), dict)]
                raise InvalidInputError(
                    f"`set` is {override!r}, but {file.name} has no section `{'.'.join(parents[: place + 1])}`; "
                    f"{f'its sections are {inner}' if inner else 'there are none in it'}."
                    f"{_sentence(did_you_mean(parent, inner))}"
                )
            section = section[parent]
        section[leaf] = _value(override, value)
    return recipe


def read_section(recipe: Mapping[str, Any], name: str, kind: Callable[..., Settings], **given: Any) -> Settings:
    """A recipe's section as a dataclass, or as what another class makes of it.

    Args:
        recipe: As read.
        name: Of the section.
        kind: Takes its keys as arguments.
        given: Arguments that are not the recipe's to say.

    Raises:
        InvalidInputError: If the recipe has no such section, it lacks a key or holds one too many, or the class refuses
            what it holds.
        InvalidInputError, InvalidTypeError: From the class's own checks.
    """
    section = section_of(recipe, name)
    check_keys(name, section, kind, given)
    try:
        return kind(**section, **given)
    except (InvalidInputError, InvalidTypeError) as error:
        raise type(error)(f"In `{name}`, {error}") from error
    except (TypeError, ValueError, NotImplementedError) as error:  # how the libraries refuse what they are told
        raise InvalidInputError(f"`{name}` cannot be used: {_one_line(error)}") from error


def check_keys(name: str, section: Mapping[Any, Any], taker: Callable[..., Any], given: Iterable[str] = ()) -> None:
    """Checks that the keys of a section are arguments of what takes them, and that none is missing.

    Sections within the section of a configuration that holds others are checked against those.

    Args:
        name: Of the section.
        section: Its keys and values.
        taker: A class or function.
        given: Arguments that are not the recipe's to say.

    Raises:
        InvalidInputError: If a key is wrong or missing; the message lists those there are, and the likely one.
    """
    arguments = {key: argument for key, argument in _arguments(taker).items() if key not in given}
    unknown = [key for key in section if key not in arguments]
    if unknown:
        hint = _sentence(did_you_mean(unknown[0], arguments))
        raise InvalidInputError(f"`{name}` holds {unknown}; its keys are {sorted(arguments)}.{hint}")
    missing = [key for key, argument in arguments.items() if argument.default is Parameter.empty and key not in section]
    if missing:
        raise InvalidInputError(f"`{name}` lacks {missing}; its keys are {sorted(arguments)}.")
    for key, inner in getattr(taker, "sub_configs", {}).items():
        if isinstance(section.get(key), Mapping):
            check_keys(f"{name}.{key}", section[key], inner)


def _arguments(taker: Callable[..., Any]) -> dict[str, Parameter]:
    """By name, without what takes all the others, and what every configuration of transformers has."""
    common = signature(PreTrainedConfig).parameters
    shared = common if isinstance(taker, type) and issubclass(taker, PreTrainedConfig) else {}
    kinds = (Parameter.POSITIONAL_OR_KEYWORD, Parameter.KEYWORD_ONLY)
    return {
        name: argument
        for name, argument in signature(taker).parameters.items()
        if argument.kind in kinds and name not in shared
    }


def section_of(recipe: Mapping[str, Any], name: str) -> dict[str, Any]:
    """A section of a recipe as it stands.

    Raises:
        InvalidInputError: If the recipe has none of that name.
    """
    section = recipe.get(name)
    if not isinstance(section, dict):
        raise InvalidInputError(f"`recipe` has no section `{name}`; it holds {sorted(map(str, recipe))}.")
    return section


def trainer_config(recipe: Mapping[str, Any]) -> TrainerConfig:
    """`TrainerConfig` of a recipe.

    Raises:
        InvalidInputError, InvalidTypeError: See `read_section`.
    """
    section = section_of(recipe, "trainer")
    if section.get("mixed_precision") is False:  # YAML 1.1 reads a bare no as false
        section = {**section, "mixed_precision": "no"}
    return read_section({"trainer": section}, "trainer", TrainerConfig)


def _recipe_file(argument: str, path: Any) -> Path:
    """A file by its path, or by its name in `training/recipes`."""
    for file in (Path(str(path)), RECIPES / f"{path}.yaml"):
        if file.is_file():
            return file
    known = sorted({file.stem for file in RECIPES.glob("*.yaml")} - {BASE})
    raise InvalidInputError(f"`{argument}` is {str(path)!r}; pass a YAML file or one of {known}.")


def _read_yaml(file: Path) -> dict[str, Any]:
    try:
        recipe = yaml.safe_load(file.read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InvalidInputError(f"`recipe` is {str(file)!r}, which is no YAML: {_one_line(error)}.") from error
    if not isinstance(recipe, dict):
        raise InvalidInputError(f"`recipe` is {str(file)!r}, which holds no sections; see those in training/recipes.")
    return recipe


def _value(override: str, text: str) -> Any:
    """YAML, and 1e-3 is a number: YAML 1.1 takes it for a string, as it holds no point."""
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise InvalidInputError(f"`set` is {override!r}, whose value is no YAML: {_one_line(error)}.") from error
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


def _sentence(text: str) -> str:
    return f" {text}" if text else ""
