"""The whole stiff and extreme set: solvers on exact problems, pipelines, and the world's physics."""

from collections.abc import Callable
from functools import cache
from typing import Any

import diffusers.utils.logging
import torch
import transformers.utils.logging

from unitouch_gen.numerics.physics_stability import physics_suite
from unitouch_gen.numerics.stability import Case
from unitouch_gen.numerics.stability_parts import pipeline_suite
from unitouch_gen.numerics.stability_problems import problem_suite


def suite(load: Callable[..., Any]) -> dict[str, list[Case]]:
    """All cases, by group.

    Args:
        load: Called as `load(name, dtype=...)` for "touch-to-image", "stylization" or "x-to-touch" when a case first
            needs it, as `unitouch_gen.tiny` is; the libraries' messages and bars are off from then on.
    """

    @cache
    def make(name: str, dtype: torch.dtype) -> Any:
        for library in (diffusers, transformers):
            library.utils.logging.disable_progress_bar()
            library.utils.logging.set_verbosity_error()
        pipe = load(name, dtype=dtype)
        pipe.set_progress_bar_config(disable=True)
        return pipe

    return {**problem_suite(), **pipeline_suite(make), **physics_suite()}
