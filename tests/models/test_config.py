"""Configurations: they survive a round trip, and refuse what no network can be built from."""

from pathlib import Path

from unitouch_gen.models import UniTouchConfig


def test_a_config_survives_a_round_trip(config: UniTouchConfig, tmp_path: Path) -> None:
    for known in (config, UniTouchConfig()):
        known.save_pretrained(tmp_path)
        assert UniTouchConfig.from_pretrained(tmp_path).to_dict() == known.to_dict()
