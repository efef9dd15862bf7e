"""Real components, small enough to train in a test: a joint space of four modalities and its processor."""

import copy
import re
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import torch
from accelerate.state import AcceleratorState
from diffusers import AutoencoderTiny

from tests.helpers.components import AUDIO, clip_tokenizer, joint_config
from unitouch_gen.models import UniTouchConfig, UniTouchModel, UniTouchProcessor
from unitouch_gen.training.data import Contacts, DataConfig, columns_of
from unitouch_gen.training.family import STAGES
from unitouch_gen.training.recipe import read, read_recipe

DRAWN = {"sensors": ["digit"], "objects": 8, "contacts_per_object": 1}
BLOCKS = {f"{part}_block_out_channels": (8, 8) for part in ("encoder", "decoder")}
BLOCKS |= {"num_encoder_blocks": (0, 1), "num_decoder_blocks": (1, 0)}


@pytest.fixture(autouse=True)
def fresh_accelerator_state() -> None:
    """Resets accelerate's state, which keeps the precision of the first training in a process."""
    AcceleratorState._reset_state()


def autoencoder(**changes: object) -> AutoencoderTiny:
    torch.manual_seed(0)
    return AutoencoderTiny(**{"latent_channels": 4, **BLOCKS, **changes}).eval()


@pytest.fixture(scope="session")
def _processor() -> UniTouchProcessor:
    return UniTouchProcessor(image_size=32, audio=AUDIO, tokenizer=clip_tokenizer())


@pytest.fixture
def processor(_processor: UniTouchProcessor) -> UniTouchProcessor:
    return copy.deepcopy(_processor)


@pytest.fixture
def config(_processor: UniTouchProcessor) -> UniTouchConfig:
    return joint_config(_processor.tokenizer)


@pytest.fixture
def model(config: UniTouchConfig) -> UniTouchModel:
    torch.manual_seed(0)
    return UniTouchModel(config).eval()


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of what was rendered, shared by all tests."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="session")
def split(cache: Path, _processor: UniTouchProcessor) -> Contacts:
    """136 contacts, eight of each material."""
    data = DataConfig(drawn=DRAWN)
    return columns_of(data.sources(), cache, data, _processor, ())[0]


@pytest.fixture
def joint(tmp_path: Path, config: UniTouchConfig, processor: UniTouchProcessor) -> str:
    """What the first stage leaves."""
    UniTouchModel(config, modalities=("image", "text")).save_pretrained(tmp_path / "joint")
    processor.save_pretrained(tmp_path / "joint")
    return str(tmp_path / "joint")


@pytest.fixture
def vae(tmp_path: Path) -> str:
    """What the stage of an autoencoder leaves."""
    autoencoder(latent_channels=8).save_pretrained(tmp_path / "vae")
    return str(tmp_path / "vae")


def read_as(name: str, *overrides: str) -> Any:
    """A recipe by its name, with values replaced, as its stage reads it."""
    stage = re.sub("_(paper|pairs|lamps)$", "", name)
    main = import_module(f"unitouch_gen.training.{STAGES[stage].module or stage}").main
    return read(main.__annotations__["recipe"], read_recipe(name, overrides))
