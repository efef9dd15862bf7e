"""Recipes: YAML files whose sections are settings of ours, or arguments of a library's class."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from inspect import signature
from pathlib import Path
from typing import Annotated, Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from unitouch_gen.errors import InvalidInputError, describe, did_you_mean, first_line
from unitouch_gen.files import as_path, read_settings

RECIPES = Path(__file__).parent / "recipes"

Built = TypeVar("Built")
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Arguments = dict[str, Any]  # a section of arguments of a library's class; `build` checks them


class Settings(BaseModel):
    """A section whose fields say of which kind its values are and within which bounds; it holds no other keys."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid", allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _knows_the_keys(cls, given: Any) -> Any:
        check_keys(given if isinstance(given, Mapping) else (), cls.model_fields)
        return given


SettingsKind = TypeVar("SettingsKind", bound=Settings)


def read_recipe(path: str | Path, overrides: Sequence[str] = ()) -> dict[str, Any]:
    """A YAML recipe, by its path or its name in `recipes/`, under overrides; see `overridden`.

    A `base` in its `data` names another YAML file, whose keys hold where the recipe has none of its own. Where data
    `sets` are named, they stand in the place of the contacts that the base draws.
    """
    recipe = read_settings("recipe", _file_of("recipe", path), yaml.safe_load)
    data = recipe.get("data")
    if isinstance(data, dict) and "base" in data:
        base = read_settings("data.base", _file_of("data.base", data.pop("base")), yaml.safe_load)
        if "sets" in data or any(one.startswith("data.sets") for one in overrides):
            base.pop("drawn", None)
        recipe["data"] = base | data
    return overridden(recipe, overrides)


def _file_of(argument: str, path: str | Path) -> Path:
    named = RECIPES / f"{path}.yaml"
    return named if named.is_file() else as_path(argument, path)


def overridden(recipe: Mapping[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """A recipe with values laid over it, such as "trainer.steps=100"; what reads the sections checks their keys."""
    changed: dict[str, Any] = deepcopy(dict(recipe))
    for override in overrides:
        key, _, text = override.partition("=")
        *parents, leaf = key.split(".")
        if not (text and parents):
            raise InvalidInputError(f"`set` is {override!r}; write section.key=value, such as trainer.steps=100.")
        section = changed
        for parent in parents:
            if not isinstance(section.get(parent), dict):
                section[parent] = {}
            section = section[parent]
        try:
            section[leaf] = yaml.safe_load(text)
        except (yaml.YAMLError, ValueError, RecursionError) as error:
            raise InvalidInputError(f"`set` is {describe(override)}, which is no YAML: {first_line(error)}.") from error
        with suppress(ValueError, TypeError):  # 1e-3 is a number: YAML 1.1 takes it for a string, as it holds no point
            section[leaf] = float(section[leaf]) if isinstance(section[leaf], str) else section[leaf]
    return changed


def read(kind: type[SettingsKind], given: Any) -> SettingsKind:
    """A recipe, or one section of it, as settings; an error names the first key that is wrong."""
    try:
        return kind.model_validate(given)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"])) or "recipe"
        message = f"`{key}` is {describe(first['input'])}; {first['msg'].replace('Input should', 'it has to')}."
        if "error" in first.get("ctx", {}):  # of a check of ours
            message = f"In `{key}`, {first['ctx']['error']}"
        elif first["type"] == "missing":
            message = f"`{key}` is missing in the recipe; set it."
        raise InvalidInputError(message) from error


def build(section: str, kind: Callable[..., Built], arguments: Arguments, **given: Any) -> Built:
    """What a class or function makes of a recipe's section, and of arguments that are not the recipe's to say."""
    try:
        check_keys(arguments, {*signature(kind).parameters} - {*given, "kwargs"})
        for name, inner in getattr(kind, "sub_configs", {}).items():  # of transformers' configurations
            ours = {"stem", "patch_channels"}
            check_keys(arguments.get(name) or (), {*signature(inner).parameters, *ours} - {"kwargs"})
        return kind(**arguments, **given)
    except InvalidInputError as error:
        raise InvalidInputError(f"In `{section}`, {error}") from error
    except Exception as error:  # libraries refuse in many ways
        raise InvalidInputError(f"`{section}` cannot be used: {first_line(error)}") from error


def check_keys(given: Iterable[Any], known: Iterable[str]) -> None:
    """Refuses a key that is not known, with those that are and the one that was likely meant."""
    for key in given:
        if key not in known:
            hint = did_you_mean(key, known)
            raise InvalidInputError(f"`{key}` is unknown; there are {sorted(known)}. {hint}".strip())
