"""A joint space of a few thousand weights with all four encoders, a tokenizer and a processor that fits them."""

from pathlib import Path

import pytest
import torch
from transformers import CLIPTokenizer

from tests.helpers.components import AUDIO, clip_tokenizer, joint_config
from unitouch_gen.models import UniTouchConfig, UniTouchModel, UniTouchProcessor

SENSORS = ("gelsight", "digit", "taxim")


@pytest.fixture(scope="session")
def tokenizer() -> CLIPTokenizer:
    return clip_tokenizer()


@pytest.fixture
def config(tokenizer: CLIPTokenizer) -> UniTouchConfig:
    return joint_config(tokenizer, sensors=SENSORS, prototype_size=16)


@pytest.fixture
def model(config: UniTouchConfig) -> UniTouchModel:
    """Every weight is random, biases too, so that none can be left out unnoticed."""
    torch.manual_seed(0)
    model = UniTouchModel(config).eval()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    for level, name in enumerate(SENSORS):
        model.sensor_bank.set_prototype(name, torch.full((3, 16, 16), 0.2 + 0.3 * level))
    return model


@pytest.fixture
def folder(model: UniTouchModel, tmp_path: Path) -> Path:
    """The model, saved."""
    model.save_pretrained(tmp_path / "model")
    return tmp_path / "model"


@pytest.fixture
def processor(tokenizer: CLIPTokenizer) -> UniTouchProcessor:
    return UniTouchProcessor(image_size=32, audio=AUDIO, tokenizer=tokenizer)


@pytest.fixture
def inputs(tokenizer: CLIPTokenizer) -> dict[str, dict[str, torch.Tensor]]:
    """A batch of two for each modality's `get_..._features`."""
    generator = torch.Generator().manual_seed(1)
    text = tokenizer(["rough brick", "a photo of glass"], padding="max_length", return_tensors="pt")
    return {
        "image": {"pixel_values": torch.randn(2, 3, 32, 32, generator=generator)},
        "text": {"input_ids": text.input_ids},
        "audio": {"input_values": torch.randn(2, 2, 1, 16, 24, generator=generator)},
        "touch": {"pixel_values": torch.randn(2, 3, 32, 32, generator=generator)},
    }
