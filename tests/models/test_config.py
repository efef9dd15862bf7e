"""Configurations: they survive a round trip, and refuse what no network can be built from."""

import json
from pathlib import Path

import pytest

from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.models import UniTouchConfig, UniTouchViTConfig


def test_a_config_survives_a_round_trip(config: UniTouchConfig, tmp_path: Path) -> None:
    for known in (config, UniTouchConfig()):
        known.save_pretrained(tmp_path)
        assert UniTouchConfig.from_pretrained(tmp_path).to_dict() == known.to_dict()


REFUSALS = (InvalidInputError, InvalidTypeError)
TRANSFORMER = [
    *(({"hidden_size": value}, "hidden_size") for value in (1000, "wide", 0)),
    *(({name: 0}, name) for name in ("num_attention_heads", "projection_dim", "patch_size", "patch_stride")),
    ({"num_hidden_layers": -1}, "num_hidden_layers"),
    ({"image_height": 8}, "image_height"),
    ({"stem": "resnet"}, "stem"),
    ({"stem": "residual"}, "patch_size"),  # 14 is no power of two
    ({"stem": "residual", "patch_size": 16, "patch_stride": 8}, "patch_size"),
    ({"stem": "residual", "patch_size": 16, "patch_stride": 16, "image_width": 100}, "patch_size"),
    ({"mlp_ratio": "4"}, "mlp_ratio"),
    ({"hiden_size": 32}, "hiden_size"),
]
JOINT_SPACE = [
    ({"sensor": ["digit"]}, "sensor"),
    ({"sensor_tokens": 0}, "sensor_tokens"),
    ({"prototype_size": -1}, "prototype_size"),
    ({"temperature": 0.0}, "temperature"),
    ({"embedding_norm": float("nan")}, "embedding_norm"),
    ({"projection_dim": "wide"}, "projection_dim"),
    ({"sensors": [1, 2]}, "sensors"),
    ({"sensors": ["digit", "gelsight", "digit"]}, "sensors"),
    ({"sensor_reaches": {"digit": "large"}}, r"sensor_reaches\['digit'\]"),
    ({"vision_config": {"hidden_size": "wide", "projection_dim": 1024}}, "hidden_size"),
    ({"vision_config": {"stem": "relief", "projection_dim": 1024}}, "vision_config.stem"),
    ({"vision_config": {"stem": "residual", "patch_size": 12, "projection_dim": 1024}}, "patch_size"),
    *(({"touch_config": value}, named) for value, named in (({"stem": "resnet"}, "stem"), (5, "touch_config"))),
    ({"audio_config": {"projection_dim": 17}}, "audio_config.projection_dim"),
]


def test_what_cannot_be_built_is_refused_by_name(tmp_path: Path) -> None:
    for kind, table in ((UniTouchViTConfig, TRANSFORMER), (UniTouchConfig, JOINT_SPACE)):
        for changes, named in table:
            with pytest.raises(REFUSALS, match=named):
                kind(**changes)
            (tmp_path / "config.json").write_text(json.dumps(kind().to_dict() | changes))
            with pytest.raises(REFUSALS):
                kind.from_pretrained(tmp_path)
