"""Real components, small enough to train in a test: a joint space of four modalities and its processor."""

import copy
from pathlib import Path

import pytest
import torch
from diffusers import AutoencoderDC

from unitouch_gen.models import UniTouchConfig, UniTouchModel, UniTouchProcessor
from unitouch_gen.training.data import DataConfig, Rendered, columns_of
from unitouch_gen.training.stages import save_modalities
from unitouch_gen.training.tokenizer import train_tokenizer

WIDTH = 16
AUDIO = {"clip_seconds": 0.2, "clips": 1, "mel_bins": 16, "frames": 24}


@pytest.fixture(scope="session")
def _processor() -> UniTouchProcessor:
    tokenizer = train_tokenizer(["a photo of rough red brick, a flat face", "slick glass"], 600, 12)
    return UniTouchProcessor(image_size=32, audio=AUDIO, tokenizer=tokenizer)


@pytest.fixture
def processor(_processor: UniTouchProcessor) -> UniTouchProcessor:
    return copy.deepcopy(_processor)


@pytest.fixture
def config(_processor: UniTouchProcessor) -> UniTouchConfig:
    tokenizer = _processor.tokenizer
    clip = {"hidden_size": WIDTH, "intermediate_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2}
    vit = {"hidden_size": WIDTH, "num_hidden_layers": 2, "num_attention_heads": 2, "patch_size": 8, "patch_stride": 8}
    text = {"vocab_size": len(tokenizer), "max_position_embeddings": 12}
    text |= {f"{name}_token_id": getattr(tokenizer, f"{name}_token_id") for name in ("bos", "eos", "pad")}
    return UniTouchConfig(
        projection_dim=WIDTH,
        sensors=("gelsight", "digit"),
        sensor_tokens=2,
        prototype_size=32,
        vision_config={**clip, "image_size": 32, "patch_size": 8, "projection_dim": WIDTH},
        text_config={**clip, **text, "projection_dim": WIDTH},
        touch_config={**vit, "image_height": 32, "image_width": 32, "projection_dim": WIDTH},
        audio_config={**vit, "image_height": 16, "image_width": 24, "num_channels": 1, "projection_dim": WIDTH},
    )


@pytest.fixture
def model(config: UniTouchConfig) -> UniTouchModel:
    torch.manual_seed(0)
    return UniTouchModel(config).eval()


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of what was rendered, shared by all tests."""
    return tmp_path_factory.mktemp("cache")


DRAWN = {"sensors": ["digit"], "objects": 8, "contacts_per_object": 1, "held_out": 2}


@pytest.fixture(scope="session")
def split(cache: Path, _processor: UniTouchProcessor) -> Rendered:
    """136 contacts, eight of each material."""
    data = DataConfig(drawn=DRAWN)
    return columns_of(data.sources(), cache, data, _processor, ())[0]


@pytest.fixture
def joint(tmp_path: Path, model: UniTouchModel, processor: UniTouchProcessor) -> str:
    """What the first stage leaves."""
    save_modalities(model, ("image", "text"), processor, tmp_path / "joint")
    return str(tmp_path / "joint")


@pytest.fixture
def vae(tmp_path: Path) -> str:
    """What the stage of an autoencoder leaves."""
    blocks = {"encoder_block_types": "ResBlock", "decoder_block_types": "ResBlock",
              "encoder_block_out_channels": (8, 8), "decoder_block_out_channels": (8, 8),
              "encoder_layers_per_block": (1, 1), "decoder_layers_per_block": (1, 1),
              "encoder_qkv_multiscales": ((), ()), "decoder_qkv_multiscales": ((), ())}  # fmt: skip
    AutoencoderDC(latent_channels=8, **blocks).save_pretrained(tmp_path / "vae")
    return str(tmp_path / "vae")
