"""Configurations: they survive a round trip, and refuse what no network can be built from."""

import json
from pathlib import Path

import pytest
from transformers import CLIPTextConfig, CLIPVisionConfig

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import UniTouchConfig, UniTouchViTConfig


def test_a_config_survives_a_round_trip(config: UniTouchConfig, tmp_path: Path) -> None:
    for known in (config, UniTouchConfig()):
        known.save_pretrained(tmp_path)
        assert UniTouchConfig.from_pretrained(tmp_path).to_dict() == known.to_dict()


def test_parts_become_configs_of_their_own_kind_and_are_kept(config: UniTouchConfig) -> None:
    kinds = {"vision_config": CLIPVisionConfig, "text_config": CLIPTextConfig, "touch_config": UniTouchViTConfig,
             "audio_config": UniTouchViTConfig}  # fmt: skip
    parts = {name: getattr(config, name) for name in kinds}
    assert all(isinstance(parts[name], kind) for name, kind in kinds.items())
    assert UniTouchConfig(projection_dim=16, **parts).touch_config is config.touch_config
    own = UniTouchConfig(vision_config={"projection_dim": 1024}).vision_config  # a dict has its own class's defaults
    assert own.hidden_size == CLIPVisionConfig().hidden_size


def test_the_defaults_are_the_papers() -> None:
    config = UniTouchConfig()
    assert (config.projection_dim, config.sensor_tokens, config.temperature) == (1024, 5, 0.07)
    touch = config.touch_config
    assert (touch.num_hidden_layers, touch.num_attention_heads, touch.hidden_size) == (24, 16, 1024)
    assert touch.grid == (16, 16)
    assert config.audio_config.grid == (12, 19)  # and one token more: ImageBind's 229 positions
    assert config.vision_config.layer_norm_eps == config.text_config.layer_norm_eps == 1e-6


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        *(({"hidden_size": value}, "hidden_size") for value in (1000, "wide", 0)),
        *(({name: 0}, name) for name in ("num_attention_heads", "projection_dim", "patch_size", "patch_stride")),
        ({"num_hidden_layers": -1}, "num_hidden_layers"),
        ({"image_height": 8}, "image_height"),
        ({"stem": "resnet"}, "stem"),
        ({"stem": "residual"}, "patch_size"),  # 14 is no power of two
        ({"stem": "residual", "patch_size": 16, "patch_stride": 8}, "patch_size"),
        ({"stem": "residual", "patch_size": 16, "patch_stride": 16, "image_width": 100}, "patch_size"),
        *(({"mlp_ratio": value}, "mlp_ratio") for value in ("4", 0.0)),
        ({"layer_norm_eps": float("nan")}, "layer_norm_eps"),
        ({"drop_path": 1.0}, "drop_path"),
    ],
    ids=str,
)
def test_a_transformer_that_cannot_be_built_is_refused_by_name(changes: dict, named: str) -> None:
    with pytest.raises(InvalidInputError, match=f"`{named}`"):
        UniTouchViTConfig(**changes)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"sensor_tokens": 0}, "sensor_tokens"),
        ({"prototype_size": -1}, "prototype_size"),
        ({"temperature": 0.0}, "temperature"),
        ({"embedding_norm": float("nan")}, "embedding_norm"),
        ({"projection_dim": "wide"}, "projection_dim"),
        ({"sensors": [1, 2]}, "sensors"),
        ({"sensors": ["digit", "gelsight", "digit"]}, "sensors"),
        ({"logit_scales": {"text": "large"}}, "logit_scales"),
        ({"vision_config": {"hidden_size": "wide", "projection_dim": 1024}}, "hidden_size"),
        ({"vision_config": {"stem": "relief", "projection_dim": 1024}}, "vision_config.stem"),
        ({"vision_config": {"stem": "residual", "patch_size": 12, "projection_dim": 1024}}, "patch_size"),
        ({"touch_config": {"stem": "resnet"}}, "stem"),
        ({"audio_config": {"projection_dim": 17}}, "audio_config.projection_dim"),
    ],
)
def test_a_joint_space_that_cannot_be_built_is_refused_by_name(changes: dict, named: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=f"`{named}`"):
        UniTouchConfig(**changes)
    settings = UniTouchConfig().to_dict() | changes
    (tmp_path / "config.json").write_text(json.dumps(settings))
    with pytest.raises(InvalidInputError):
        UniTouchConfig.from_pretrained(tmp_path)
