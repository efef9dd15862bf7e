"""Putting a family together: fp16 copies of what the stages left."""

import json
from pathlib import Path

import pytest
import torch
from diffusers import DDPMScheduler, DPMSolverMultistepScheduler
from safetensors.torch import load_file, save_file

from unitouch_gen.encoders import UniTouchModel, UniTouchProcessor
from unitouch_gen.training.assemble import half_folder, write_joint, write_touch_to_image
from unitouch_gen.training.stages import save_senses


@pytest.fixture
def runs(model: UniTouchModel, processor: UniTouchProcessor, tmp_path: Path) -> Path:
    """The joint space in three parts, as its stages leave it."""
    model.sensor_bank.set_prototype("digit", torch.rand(3, 32, 32))
    for stage, senses in {"image_text": ("image", "text"), "audio": ("audio",), "touch": ("touch",)}.items():
        save_senses(model, senses, processor, tmp_path / "runs" / stage / "model")
    return tmp_path / "runs"


def test_weights_are_halved_and_everything_else_is_copied(tmp_path: Path) -> None:
    source = tmp_path / "source"
    (source / "inner").mkdir(parents=True)
    state = {"weight": torch.randn(3, 4), "known": torch.tensor([True, False]), "count": torch.tensor([7])}
    save_file(state, source / "inner" / "model.safetensors")
    (source / "config.json").write_text(json.dumps({"a": 1}))
    half_folder(source, tmp_path / "target")
    copied = load_file(tmp_path / "target" / "inner" / "model.safetensors")
    assert torch.equal(copied.pop("weight"), state.pop("weight").half())
    assert all(torch.equal(copied[key], value) and copied[key].dtype == value.dtype for key, value in state.items())
    assert json.loads((tmp_path / "target" / "config.json").read_text()) == {"a": 1}


def test_the_joint_space_holds_all_four_senses_once(runs: Path, model: UniTouchModel, tmp_path: Path) -> None:
    (tmp_path / "joint").mkdir()
    write_joint(runs, tmp_path / "joint")
    stored = load_file(tmp_path / "joint" / "model.safetensors")
    expected = model.state_dict()
    assert stored.keys() == expected.keys()
    assert [k for k, v in stored.items() if v.is_floating_point() and not torch.equal(v, expected[k].half())] == []


def test_the_joint_space_is_read_by_sense(runs: Path, tmp_path: Path) -> None:
    (tmp_path / "joint").mkdir()
    write_joint(runs, tmp_path / "joint")
    again = UniTouchModel.from_pretrained(tmp_path / "joint")
    assert again.get_touch_features(torch.zeros(1, 3, 32, 32)).shape == (1, 16)
    assert again.loaded_senses == ("touch",)


def test_the_solver_stored_integrates_the_schedule_trained_with(tmp_path: Path) -> None:
    trained = DDPMScheduler(
        beta_schedule="scaled_linear", beta_start=0.00085, beta_end=0.012, prediction_type="v_prediction"
    )
    source = tmp_path / "runs" / "unclip" / "model"
    for name in ("scheduler", "image_noising_scheduler", "unet", "image_normalizer"):  # the last two are only copied
        trained.save_pretrained(source / name)
    write_touch_to_image(tmp_path / "runs", tmp_path / "family")
    solver = DPMSolverMultistepScheduler.from_pretrained(tmp_path / "family" / "scheduler")
    torch.testing.assert_close(solver.alphas_cumprod, trained.alphas_cumprod)
    assert (solver.config.prediction_type, solver.config.algorithm_type) == ("v_prediction", "dpmsolver++")
