"""Configurations: they survive a round trip, and refuse what no network can be built from."""

from pathlib import Path

from unitouch_gen.models import UniTouchConfig


def test_a_config_survives_a_round_trip(config: UniTouchConfig, tmp_path: Path) -> None:
    for known in (config, UniTouchConfig()):
        known.save_pretrained(tmp_path)
        assert UniTouchConfig.from_pretrained(tmp_path).to_dict() == known.to_dict()


def test_encoders_without_a_configuration_project_to_the_width_of_the_space() -> None:
    config = UniTouchConfig(projection_dim=12)
    parts = [getattr(config, name) for name in UniTouchConfig.sub_configs_defaults]
    assert {part.projection_dim for part in parts} == {12}
    assert (config.vision_config.num_hidden_layers, config.audio_config.image_width) == (32, 204)  # ImageBind's
