"""Small encoders for tables: trained by the stage itself, once, and on from where they were stopped."""

from pathlib import Path

import pytest
import torch

from tests.helpers.components import make_components
from unitouch_gen.cli import trained as small
from unitouch_gen.cli.trained import ABLATION, SIGMAS, Setting, small_joint, trained
from unitouch_gen.evaluation.ablation import ALL, BOTH, ONE
from unitouch_gen.models import UniTouchModel
from unitouch_gen.training import touch
from unitouch_gen.training.recipe import read_recipe

SENSORS = ["gelsight", "digit"]


@pytest.fixture
def train(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Trains for a few steps on a few contacts, on the image encoder of a random joint space."""
    parts = make_components()
    for name in ("unitouch", "processor"):
        parts[name].save_pretrained(tmp_path / "joint")
    joint = UniTouchModel.from_pretrained(tmp_path / "joint")
    few = ["data.drawn.objects=1", "data.drawn.contacts_per_object=1", "trainer.batch_size=8", "trainer.warmup=1"]
    monkeypatch.setattr(small, "read_recipe", lambda name, given: read_recipe(name, [*given, *few]))
    monkeypatch.setattr(
        "unitouch_gen.training.stages.read_recipe", lambda name, given: read_recipe(name, [*given, *few])
    )
    folder = small_joint(joint, parts["processor"], tmp_path)

    def run(setting: Setting, seed: int = 0, steps: int = 2) -> UniTouchModel:
        return trained(folder, setting, SENSORS, seed, steps, tmp_path / "cache")

    return run


def test_a_setting_says_what_is_trained_on_what(train) -> None:
    assert train(ABLATION[ONE]).sensors == () == train(ABLATION[ALL]).sensors
    both = train(ABLATION[BOTH])
    assert both.sensors == tuple(SENSORS) and both.load("touch")[1].tokens.shape[:2] == (2, 5)


def weights_of(model: UniTouchModel) -> torch.Tensor:
    return torch.cat([value.flatten() for value in model.load("touch")[0].state_dict().values()])


def test_what_is_trained_is_found_again_and_seeds_differ(train, monkeypatch: pytest.MonkeyPatch) -> None:
    first, other = weights_of(train(ABLATION[BOTH])), weights_of(train(ABLATION[BOTH], seed=1))
    assert not torch.equal(first, other)
    monkeypatch.setattr(touch, "main", None)
    assert torch.equal(weights_of(train(ABLATION[BOTH])), first)
    assert SIGMAS["sigma = 0.75"] == ABLATION[BOTH]  # trained once for both tables


def test_one_that_was_stopped_goes_on(train, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = weights_of(train(ABLATION[BOTH], steps=3))
    saved = touch.Stage.saving
    monkeypatch.setattr(touch.Stage, "saving", None)  # it stops where it would write its model
    with pytest.raises(TypeError):
        train(ABLATION[BOTH], seed=2, steps=3)
    monkeypatch.setattr(touch.Stage, "saving", saved)
    again = weights_of(train(ABLATION[BOTH], seed=2, steps=3))
    assert again.shape == whole.shape and bool(torch.isfinite(again).all())
