"""A joint space of a few thousand weights with all four encoders, a tokenizer and a processor that fits them."""

from pathlib import Path

import pytest
import torch
from transformers import CLIPTokenizer

from unitouch_gen.models import UniTouchConfig, UniTouchModel, UniTouchProcessor
from unitouch_gen.training.tokenizer import train_tokenizer

SENSORS = ("gelsight", "digit", "taxim")
AUDIO = {"clip_seconds": 0.2, "clips": 2, "mel_bins": 16, "frames": 24}


@pytest.fixture(scope="session")
def tokenizer() -> CLIPTokenizer:
    return train_tokenizer(["a photo of rough red brick, a flat face", "slick glass", "touch of soft grass"], 600, 12)


@pytest.fixture
def config(tokenizer: CLIPTokenizer) -> UniTouchConfig:
    clip = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 4}
    vit = {"hidden_size": 32, "num_hidden_layers": 2, "num_attention_heads": 4, "patch_size": 8, "patch_stride": 8}
    text = {"vocab_size": len(tokenizer), "max_position_embeddings": 12}
    text |= {f"{name}_token_id": getattr(tokenizer, f"{name}_token_id") for name in ("bos", "eos", "pad")}
    return UniTouchConfig(
        projection_dim=16,
        sensors=SENSORS,
        sensor_tokens=2,
        prototype_size=16,
        vision_config={**clip, "image_size": 32, "patch_size": 8, "projection_dim": 16},
        text_config={**clip, **text, "projection_dim": 16},
        touch_config={**vit, "image_height": 32, "image_width": 32, "projection_dim": 16},
        audio_config={**vit, "image_height": 16, "image_width": 24, "num_channels": 1, "projection_dim": 16},
    )


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
