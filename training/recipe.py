"""Recipes: YAML files whose sections are read as settings, or as what another class makes of them."""

import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from inspect import Parameter, signature
from pathlib import Path
from typing import Annotated, Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from transformers import PreTrainedConfig

from unitouch_gen.errors import InvalidInputError, InvalidTypeError, check_names, describe, did_you_mean
from unitouch_gen.files import as_path, check_sizes, read_yaml

RECIPES = Path(__file__).parent / "recipes"
BASE = "data"
"""The recipe that holds nothing but data, on which others may base theirs."""

Section = TypeVar("Section")
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Decay = Annotated[float, Field(ge=0.0, lt=1.0)]
Rate = Annotated[float, Field(ge=0.0, le=1e3)]
Seed = Annotated[int, Field(ge=0, lt=2**32)]
Steps = Annotated[int, Field(gt=0, le=10**9)]  # a bound for what was mistyped: nobody waits for as many


class Settings(BaseModel):
    """A section whose fields say what they hold: of which kind, within which bounds, and nothing beside them."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid", allow_inf_nan=False)


def read_recipe(path: str | Path, overrides: Sequence[str] = ()) -> dict[str, Any]:
    """A YAML recipe with `section.key=value` overrides laid over it.

    A `base` in its `data` names another YAML file, whose keys hold where the recipe has none of its own. Where data
    `sets` are named, they stand in the place of the contacts and grasps that the base draws.

    Args:
        path: A file, or the name of one in `training/recipes`.
        overrides: May add keys to a section; whether those are any is for what reads the section to say.

    Raises:
        InvalidInputError: If the file is missing or no mapping of sections, or an override is in none of them.
    """
    file = _recipe_file("recipe", path)
    recipe = read_yaml("recipe", file)
    data, based = recipe.get("data"), False
    if isinstance(data, dict) and "base" in data:
        based = "drawn" not in data
        recipe["data"] = read_yaml("data.base", _recipe_file("data.base", data.pop("base"))) | data
    for override in check_names("set", overrides):
        key, separator, value = override.partition("=")
        *parents, leaf = key.split(".")
        if not separator or not parents or not leaf:
            raise InvalidInputError(f"`set` is {override!r}; write section.key=value, such as trainer.steps=100.")
        section = recipe
        for place, parent in enumerate(parents):
            if not isinstance(section.get(parent), dict):
                inner = [name for name in map(str, section) if isinstance(section.get(name), dict)]
                missing = ".".join(parents[: place + 1])
                held = f"its sections are {inner}" if inner else "there are none in it"
                hint = did_you_mean(parent, inner)
                raise InvalidInputError(
                    f"`set` is {override!r}, but {file.name} has no section `{missing}`; {held}. {hint}".rstrip()
                )
            section = section[parent]
        section[leaf] = _value(override, value)
    if based and recipe["data"].get("sets") and not any(item.startswith("data.drawn") for item in overrides):
        recipe["data"] = {key: value for key, value in recipe["data"].items() if key not in ("drawn", "grasps")}
    return recipe


def flat(recipe: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Values of a recipe by keys such as "trainer.steps"."""
    found: dict[str, Any] = {}
    for key, value in recipe.items():
        found |= flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return found


def section_of(recipe: Mapping[str, Any], name: str) -> dict[str, Any]:
    """A section of a recipe as it stands.

    Raises:
        InvalidInputError: If the recipe has none of that name.
    """
    section = recipe.get(name)
    if not isinstance(section, dict):
        raise InvalidInputError(f"`recipe` has no section `{name}`; it holds {sorted(map(str, recipe))}.")
    return section


def read_section(recipe: Mapping[str, Any], name: str, kind: Callable[..., Section], **given: Any) -> Section:
    """What a class makes of a recipe's section.

    Args:
        recipe: As read.
        name: The section's.
        kind: `Settings`, or any other class or function that takes its keys as arguments.
        given: Arguments that are not the recipe's to say.

    Raises:
        InvalidInputError, InvalidTypeError: If the recipe has no such section, it lacks a key or holds one too many, or
            the class refuses a value.
    """
    section = section_of(recipe, name)
    check_keys(name, section, kind, given)
    if not (isinstance(kind, type) and issubclass(kind, Settings)):
        check_sizes(name, section)
    try:
        return kind(**section, **given)
    except ValidationError as error:
        raise _refusal(name, error) from error
    except (InvalidInputError, InvalidTypeError) as error:
        raise type(error)(f"In `{name}`, {error}") from error
    except MemoryError:
        raise
    except Exception as error:  # libraries refuse what they are told in many ways
        raise InvalidInputError(f"`{name}` cannot be used: {_one_line(error)}") from error


def check_keys(name: str, section: Mapping[Any, Any], kind: Callable[..., Any], given: Iterable[str] = ()) -> None:
    """Checks that the keys of a section are arguments of what takes them, and that none is missing.

    Sections within the section of a configuration that holds others are checked against those. Arguments that every
    configuration of transformers has, for saving and labels, are none of a recipe's.

    Raises:
        InvalidInputError: If a key is wrong or missing; the message lists those there are, and the likely one.
    """
    shared = PreTrainedConfig if isinstance(kind, type) and issubclass(kind, PreTrainedConfig) else lambda: None
    arguments = {
        key: argument
        for key, argument in signature(kind).parameters.items()
        if argument.kind not in (Parameter.VAR_POSITIONAL, Parameter.VAR_KEYWORD)
        and key not in {*given, *signature(shared).parameters}
    }
    unknown = [key for key in section if key not in arguments]
    if unknown:
        hint = did_you_mean(unknown[0], arguments)
        raise InvalidInputError(f"`{name}` holds {unknown}; its keys are {sorted(arguments)}. {hint}".rstrip())
    missing = [key for key, argument in arguments.items() if argument.default is Parameter.empty and key not in section]
    if missing:
        raise InvalidInputError(f"`{name}` lacks {missing}; its keys are {sorted(arguments)}.")
    for key, inner in getattr(kind, "sub_configs", {}).items():
        if isinstance(section.get(key), Mapping):
            check_keys(f"{name}.{key}", section[key], inner)


def _refusal(name: str, error: ValidationError) -> InvalidInputError | InvalidTypeError:
    """The first thing that settings are wrong in, as this package says it."""
    first = error.errors()[0]
    own = first.get("ctx", {}).get("error")  # of a check that is ours
    key = ".".join(map(str, (name, *first["loc"])))
    wanted = first["msg"].replace("Input should", "it has to")
    kind = InvalidTypeError if first["type"].endswith("_type") else InvalidInputError
    return kind(f"In `{name}`, {own}" if own else f"`{key}` is {describe(first['input'])}; {wanted}.")


def _recipe_file(argument: str, path: Any) -> Path:
    """A file by its path, or by its name in `training/recipes`."""
    for file in (as_path(argument, path), RECIPES / f"{path}.yaml"):
        if os.path.isfile(file):
            return file
    known = sorted({file.stem for file in RECIPES.glob("*.yaml")} - {BASE})
    raise InvalidInputError(f"`{argument}` is {str(path)!r}; pass a YAML file or one of {known}.")


def _value(override: str, text: str) -> Any:
    """YAML, and 1e-3 is a number: YAML 1.1 takes it for a string, as it holds no point."""
    try:
        value = yaml.safe_load(text)
        json.dumps(value, default=str, skipkeys=True)  # it may hold itself
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InvalidInputError(
            f"`set` is {describe(override)}, whose value is no YAML: {_one_line(error)}."
        ) from error
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
