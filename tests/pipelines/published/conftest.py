"""A joint space and unCLIP models, as they are converted and shared."""

from pathlib import Path

import pytest
import torch
from transformers import CLIPVisionModelWithProjection

from tests.helpers.published_parts import converted, sizes, write_unclip
from unitouch_gen.models import UniTouchModel


@pytest.fixture(scope="session")
def unitouch(tmp_path_factory) -> Path:
    return converted(tmp_path_factory.mktemp("whole"))


@pytest.fixture(scope="session")
def touch_alone(tmp_path_factory) -> Path:
    return converted(tmp_path_factory.mktemp("touch"), imagebind=False)


@pytest.fixture(scope="session")
def unclip(unitouch, tmp_path_factory) -> Path:
    """The folder of a diffusers unCLIP pipeline, with the image encoder that the joint space was bound to."""
    encoder = UniTouchModel.from_pretrained(unitouch, modalities=("image",)).vision_model
    return write_unclip(tmp_path_factory.mktemp("unclip"), encoder)


@pytest.fixture(scope="session")
def other_unclip(tmp_path_factory) -> Path:
    """One with an image encoder of its own."""
    torch.manual_seed(3)
    return write_unclip(tmp_path_factory.mktemp("other"), CLIPVisionModelWithProjection(sizes().vision_config))
