"""Recipes: YAML files whose sections are settings of a stage, or arguments of a library's class."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from inspect import signature
from pathlib import Path
from typing import Annotated, Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, model_validator

from unitouch_gen.errors import InvalidInputError, check_fields, describe, did_you_mean, first_line
from unitouch_gen.files import as_path, read_settings

RECIPES = Path(__file__).parent / "recipes"

Built = TypeVar("Built")
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Arguments = dict[str, Any]  # a section of arguments of a library's class; `build` checks them


class Settings(BaseModel):
    """A section of a recipe. Its fields have types and bounds, and no other keys are taken."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid", allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _check_keys(cls, values: Any) -> Any:
        if isinstance(values, Mapping):
            check_keys(values, cls.model_fields)
        return values


SettingsKind = TypeVar("SettingsKind", bound=Settings)


def read_recipe(path: str | Path, overrides: Sequence[str] = ()) -> dict[str, Any]:
    """A YAML recipe, by its path or its name in `recipes/`, with overrides; see `overridden`.

    A `base` in its `data` names another YAML file, whose keys are the defaults of this section. Where the recipe or the
    overrides name data `sets`, the contacts that the base draws are left out.
    """
    recipe = read_settings("recipe", _recipe_file("recipe", path), yaml.safe_load)
    data = recipe.get("data")
    if isinstance(data, dict) and "base" in data:
        base = read_settings("data.base", _recipe_file("data.base", data.pop("base")), yaml.safe_load)
        if "sets" in data or any(override.startswith("data.sets") for override in overrides):
            base.pop("drawn", None)
        recipe["data"] = base | data
    return overridden(recipe, overrides)


def _recipe_file(argument: str, path: str | Path) -> Path:
    """The file of a recipe, by its path or its name in `recipes/`."""
    named = RECIPES / f"{path}.yaml"
    return named if named.is_file() else as_path(argument, path)


def overridden(recipe: Mapping[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """A copy of a recipe with values replaced, such as "trainer.steps=100". Keys are checked when sections are read."""
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
        if isinstance(section[leaf], str):
            with suppress(ValueError):  # YAML 1.1 reads 1e-3 as a string, since it has no point
                section[leaf] = float(section[leaf])
    return changed


def read(kind: type[SettingsKind], values: Any) -> SettingsKind:
    """A recipe, or one section of it, as settings of a `kind`.

    Raises:
        InvalidInputError, InvalidTypeError: Naming the first key that is wrong.
    """
    return check_fields(kind, values, "recipe")


def build(section: str, kind: Callable[..., Built], arguments: Arguments, **fixed: Any) -> Built:
    """Calls a class or function with a recipe's section and with `fixed` arguments, which the recipe may not set."""
    try:
        check_keys(arguments, {*signature(kind).parameters} - {*fixed, "kwargs"})
        for name, sub_config in getattr(kind, "sub_configs", {}).items():  # of transformers' configurations
            own_keys = {"stem", "patch_channels"}
            check_keys(arguments.get(name) or (), {*signature(sub_config).parameters, *own_keys} - {"kwargs"})
        return kind(**arguments, **fixed)
    except InvalidInputError as error:
        raise InvalidInputError(f"In `{section}`, {error}") from error
    except Exception as error:  # libraries raise many kinds of errors
        raise InvalidInputError(f"`{section}` cannot be used: {first_line(error)}") from error


def check_keys(keys: Iterable[Any], allowed: Iterable[str]) -> None:
    """Raises for a key that is not allowed, with those that are and the one that was likely meant."""
    for key in keys:
        if key not in allowed:
            hint = did_you_mean(key, allowed)
            raise InvalidInputError(f"`{key}` is unknown; there are {sorted(allowed)}. {hint}".strip())
