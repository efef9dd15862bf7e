"""Configurations: they survive a round trip, and refuse what no network can be built from."""

import json
from pathlib import Path

import pytest
import torch
from transformers import CLIPTextConfig, CLIPVisionConfig

from tests.helpers.odd_tensors import odd_tensors
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import UniTouchConfig, UniTouchViTConfig


def test_a_config_survives_a_round_trip(config: UniTouchConfig, tmp_path: Path) -> None:
    config.save_pretrained(tmp_path)
    assert UniTouchConfig.from_pretrained(tmp_path).to_dict() == config.to_dict()


def test_the_papers_config_survives_a_round_trip(tmp_path: Path) -> None:
    UniTouchConfig().save_pretrained(tmp_path)
    assert UniTouchConfig.from_pretrained(tmp_path).to_dict() == UniTouchConfig().to_dict()


def test_parts_become_configs_of_their_own_kind(config: UniTouchConfig) -> None:
    assert isinstance(config.vision_config, CLIPVisionConfig)
    assert isinstance(config.text_config, CLIPTextConfig)
    assert isinstance(config.touch_config, UniTouchViTConfig)
    assert isinstance(config.audio_config, UniTouchViTConfig)


def test_parts_given_as_configs_are_kept(config: UniTouchConfig) -> None:
    again = UniTouchConfig(
        projection_dim=16,
        vision_config=config.vision_config,
        text_config=config.text_config,
        touch_config=config.touch_config,
        audio_config=config.audio_config,
    )
    assert again.touch_config is config.touch_config


def test_parts_given_as_dicts_keep_their_own_classes_defaults() -> None:
    config = UniTouchConfig(vision_config={"projection_dim": 1024})
    assert config.vision_config.hidden_size == CLIPVisionConfig().hidden_size


def test_the_defaults_are_the_papers() -> None:
    config = UniTouchConfig()
    assert (config.projection_dim, config.sensor_tokens, config.temperature) == (1024, 5, 0.07)
    touch = config.touch_config
    assert (touch.num_hidden_layers, touch.num_attention_heads, touch.hidden_size) == (24, 16, 1024)
    assert touch.grid == (16, 16)
    assert config.vision_config.layer_norm_eps == config.text_config.layer_norm_eps == 1e-6


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"hidden_size": 1000}, "hidden_size"),
        ({"num_attention_heads": 0}, "num_attention_heads"),
        ({"patch_size": 0}, "patch_size"),
        ({"patch_stride": 0}, "patch_stride"),
        ({"image_height": 8}, "image_height"),
        ({"stem": "resnet"}, "stem"),
        ({"stem": "residual"}, "patch_size"),  # 14 is no power of two
        ({"stem": "residual", "patch_size": 16, "patch_stride": 8}, "patch_stride"),
        ({"stem": "residual", "patch_size": 16, "patch_stride": 16, "image_width": 100}, "image_width"),
        ({"hidden_size": "wide"}, "hidden_size"),
        ({"hidden_size": "wide" * 1000}, "hidden_size"),
        ({"mlp_ratio": 10**5000}, "mlp_ratio"),  # Python writes no integers of so many digits
        ({"mlp_ratio": odd_tensors(torch.ones(1, 2))["bits"]}, "mlp_ratio"),  # nor torch these
        ({"hidden_size": 0}, "hidden_size"),
        ({"num_hidden_layers": -1}, "num_hidden_layers"),
        ({"projection_dim": 0}, "projection_dim"),
        ({"mlp_ratio": "4"}, "mlp_ratio"),
        ({"mlp_ratio": 0.0}, "mlp_ratio"),
        ({"layer_norm_eps": float("nan")}, "layer_norm_eps"),
        ({"drop_path": 1.0}, "drop_path"),
    ],
)
def test_a_transformer_that_cannot_be_built_is_refused_by_name(changes: dict, named: str) -> None:
    with pytest.raises(InvalidInputError, match=f"`{named}`") as caught:
        UniTouchViTConfig(**changes)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 500


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"sensor_tokens": 0}, "sensor_tokens"),
        ({"prototype_size": -1}, "prototype_size"),
        ({"sensor_reach": -0.1}, "sensor_reach"),
        ({"temperature": 0.0}, "temperature"),
        ({"temperature": float("inf")}, "temperature"),
        ({"embedding_norm": float("nan")}, "embedding_norm"),
        ({"embedding_norm": -1.0}, "embedding_norm"),
        ({"projection_dim": "wide"}, "projection_dim"),
        ({"sensors": [1, 2]}, "sensors"),
        ({"logit_scales": {"text": "large"}}, "logit_scales"),
        ({"audio_config": {3: 3}}, "audio_config"),
        ({"vision_config": {"hidden_size": "wide", "projection_dim": 1024}}, "hidden_size"),
        ({"touch_config": {"stem": "resnet"}}, "stem"),
    ],
)
def test_a_joint_space_that_cannot_be_built_is_refused_by_name(changes: dict, named: str) -> None:
    with pytest.raises(InvalidInputError, match=f"`{named}`"):
        UniTouchConfig(**changes)


def test_a_bad_value_is_refused_when_it_is_set_later() -> None:
    with pytest.raises(InvalidInputError, match="`hidden_size`"):
        UniTouchViTConfig().hidden_size = "wide"


def test_a_stored_config_with_a_bad_value_is_refused_by_name(config: UniTouchConfig, tmp_path: Path) -> None:
    config.save_pretrained(tmp_path)
    settings = json.loads((tmp_path / "config.json").read_text()) | {"sensor_tokens": "five"}
    (tmp_path / "config.json").write_text(json.dumps(settings))
    with pytest.raises(InvalidInputError, match="`sensor_tokens`"):
        UniTouchConfig.from_pretrained(tmp_path)


@pytest.mark.parametrize("part", ["vision", "text", "touch", "audio"])
def test_a_modality_of_another_width_is_refused_by_name(part: str, config: UniTouchConfig) -> None:
    parts = {
        f"{name}_config": getattr(config, f"{name}_config").to_dict() for name in ("vision", "text", "touch", "audio")
    }
    parts[f"{part}_config"]["projection_dim"] = 17
    with pytest.raises(InvalidInputError, match=f"`{part}_config.projection_dim` is 17"):
        UniTouchConfig(projection_dim=16, **parts)


def test_sensors_with_one_name_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="`sensors`"):
        UniTouchConfig(sensors=["digit", "gelsight", "digit"])
