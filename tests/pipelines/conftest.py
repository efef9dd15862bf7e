"""Pipelines of tiny randomly initialised components, made once and copied."""

import copy
import os
import re
from pathlib import Path

import pytest
import torch

from tests.helpers.calls import Call, quiet, seeded
from tests.helpers.components import make_components, make_x_to_touch
from unitouch_gen.pipelines import TactileStylizationPipeline, TouchToImagePipeline, XToTouchPipeline

_COMPONENTS = make_components()
_X_TO_TOUCH = make_x_to_touch()
DEFAULTS = {"default_num_inference_steps": 2, "default_guidance_scale": 2.0}


def pytest_configure(config: pytest.Config) -> None:
    """Declares the markers of diffusers' tests, for `test_diffusers_mixins.py`, which imports them."""
    if "DIFFUSERS_REPOSITORY" in os.environ:
        files = Path(os.environ["DIFFUSERS_REPOSITORY"], "tests").rglob("*.py")
        for name in {name for file in files for name in re.findall(r"\bmark\.(\w+)", file.read_text("utf-8"))}:
            config.addinivalue_line("markers", f"{name}: one of diffusers'")


@pytest.fixture
def components() -> dict:
    return copy.deepcopy(_COMPONENTS)


@pytest.fixture
def x_components() -> dict:
    shared = {name: _COMPONENTS[name] for name in ("unitouch", "processor", "scheduler")}
    return copy.deepcopy({**shared, **_X_TO_TOUCH})


@pytest.fixture
def pipe(components: dict) -> TouchToImagePipeline:
    return quiet(TouchToImagePipeline(**components, **DEFAULTS, default_strength=0.75))


@pytest.fixture
def stylize(components: dict) -> TactileStylizationPipeline:
    return quiet(TactileStylizationPipeline(**components, **DEFAULTS))


@pytest.fixture
def x_to_touch(x_components: dict) -> XToTouchPipeline:
    return quiet(XToTouchPipeline(**x_components, **DEFAULTS, sensors=["gelsight", "digit"]))


@pytest.fixture(params=["pipe", "stylize", "x_to_touch"])
def call(request: pytest.FixtureRequest, touch: torch.Tensor, photo: torch.Tensor) -> Call:
    """A call of each pipeline, with two inputs."""
    inputs = {"pipe": {"touch": touch}, "stylize": {"image": photo, "touch": touch, "layout": None}}
    inputs["x_to_touch"] = {"image": photo}
    return Call(request.getfixturevalue(request.param), inputs[request.param])


@pytest.fixture
def touch() -> torch.Tensor:
    """One dark and one bright, as the prototypes of the two sensors are."""
    return 0.1 * torch.rand(2, 3, 32, 32, generator=seeded()) + torch.tensor([0.15, 0.75]).view(2, 1, 1, 1)


@pytest.fixture
def photo() -> torch.Tensor:
    return torch.rand(2, 3, 32, 48, generator=seeded(1))


@pytest.fixture(scope="session")
def family(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pipeline of the fixture `pipe`, saved."""
    folder = tmp_path_factory.mktemp("family")
    TouchToImagePipeline(**copy.deepcopy(_COMPONENTS), **DEFAULTS, default_strength=0.75).save_pretrained(folder)
    return folder
