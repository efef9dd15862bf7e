"""The whole set: each case has a name of its own, and a pipeline is loaded when a case first needs it, once."""

from typing import Any

import pytest
import torch

from unitouch_gen.numerics.stability import choose
from unitouch_gen.numerics.stability_suite import suite


class Refusing:
    """In the place of a pipeline: refuses every call."""

    quiet = False

    def set_progress_bar_config(self, disable: bool) -> None:
        self.quiet = disable

    def __call__(self, **arguments: Any) -> None:
        raise ValueError("`guidance_scale` is wrong")


def test_names_are_unique_and_nothing_is_loaded_to_list_them() -> None:
    def unwanted(name: str, dtype: torch.dtype) -> None:
        pytest.fail(f"{name} was loaded")

    cases = suite(unwanted)
    assert choose(cases) == cases
    assert {"stiff", "numbers", "gels"} <= set(cases)


def test_cases_share_a_pipeline_without_bars() -> None:
    loaded = {}

    def load(name: str, dtype: torch.dtype) -> Refusing:
        assert (name, dtype) not in loaded
        return loaded.setdefault((name, dtype), Refusing())

    names = ("guidance_scale=-5", "guidance_scale=nan")
    assert [case.run().ok for case in suite(load)["numbers"] if case.name in names] == [True, True]
    assert [(key, pipe.quiet) for key, pipe in loaded.items()] == [(("touch-to-image", torch.float32), True)]
