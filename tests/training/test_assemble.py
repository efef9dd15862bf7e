"""Putting a family together: fp16 copies of what the stages left, all of them or none."""

import json
import shutil
from pathlib import Path

import pytest
import torch
from diffusers import DDPMScheduler, UniPCMultistepScheduler
from safetensors.torch import load_file, save_file

from unitouch_gen.conditioning import EmbeddingBank
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.training.assemble import assemble, half_folder, write_joint
from unitouch_gen.training.stages import STAGES, run_command, save_modalities, weights_of

FOLDERS = {"joint", "embedding-bank", "image-vae", "touch-to-image", "picture-classifier", "touch-vae", "x-to-touch",
           "touch-classifier"}  # fmt: skip
TRAINED = DDPMScheduler(
    beta_schedule="scaled_linear", beta_start=0.00085, beta_end=0.012, prediction_type="v_prediction"
)


def weights(folder: Path) -> None:
    """What stands in for a model that is only copied."""
    folder.mkdir(parents=True)
    save_file({"weight": torch.randn(3)}, folder / "model.safetensors")
    (folder / "config.json").write_text("{}")


@pytest.fixture
def runs(model: UniTouchModel, processor: UniTouchProcessor, tmp_path: Path) -> Path:
    """What all stages leave, the joint space in three parts."""
    runs = tmp_path / "runs"
    model.sensor_bank.set_prototype("digit", torch.rand(3, 32, 32))
    for stage, modalities in {"image_text": ("image", "text"), "audio": ("audio",), "touch": ("touch",)}.items():
        save_modalities(model, modalities, processor, runs / stage / "model")
    for stage in ("image_vae", "picture_classifier", "touch_vae", "touch_classifier"):
        weights(runs / stage / "model")
    unclip, ldm = runs / "unclip" / "model", runs / "touch_ldm" / "model"
    for folder in (unclip / "unet", unclip / "image_normalizer", ldm / "unet"):
        weights(folder)
    for folder in (unclip / "scheduler", unclip / "image_noising_scheduler", ldm / "scheduler"):
        TRAINED.save_pretrained(folder)
    EmbeddingBank.of(torch.eye(4, 16)).save_pretrained(ldm / "embedding_bank")
    (ldm / "sensors.json").write_text(json.dumps(["digit", "gelsight"]))
    for stage in STAGES:
        (runs / stage / "record.json").write_text(json.dumps({"stage": stage}))
    return runs


def test_weights_are_halved_and_everything_else_is_copied(tmp_path: Path) -> None:
    source = tmp_path / "source"
    (source / "inner").mkdir(parents=True)
    state = {"weight": torch.randn(3, 4), "known": torch.tensor([True, False]), "count": torch.tensor([7])}
    save_file(state, source / "inner" / "model.safetensors")
    (source / "config.json").write_text(json.dumps({"a": 1, "_name_or_path": "where it was trained"}))
    half_folder(source, tmp_path / "target")
    copied = load_file(tmp_path / "target" / "inner" / "model.safetensors")
    assert torch.equal(copied.pop("weight"), state.pop("weight").half())
    assert all(torch.equal(copied[key], value) and copied[key].dtype == value.dtype for key, value in state.items())
    assert json.loads((tmp_path / "target" / "config.json").read_text()) == {"a": 1}


def test_the_joint_space_holds_all_four_modalities_once(runs: Path, model: UniTouchModel, tmp_path: Path) -> None:
    write_joint(runs, tmp_path / "joint")
    stored = load_file(tmp_path / "joint" / "model.safetensors")
    expected = model.state_dict()
    assert stored.keys() == expected.keys()
    assert [k for k, v in stored.items() if v.is_floating_point() and not torch.equal(v, expected[k].half())] == []


def test_the_joint_space_is_read_by_modality(runs: Path, tmp_path: Path) -> None:
    write_joint(runs, tmp_path / "joint")
    again = UniTouchModel.from_pretrained(tmp_path / "joint")
    assert again.get_touch_features(torch.zeros(1, 3, 32, 32)).shape == (1, 16)
    assert again.loaded_modalities == ("touch",)


# The whole family -----------------------------------------------------------------------------------------------------


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_family_holds_what_every_stage_left(runs: Path, tmp_path: Path) -> None:
    assemble(runs=runs, output=tmp_path / "family")
    assert {path.name for path in (tmp_path / "family").iterdir()} == {*FOLDERS, "family.json"}
    for stage in ("image_vae", "picture_classifier", "touch_vae", "touch_classifier"):
        stored = load_file(tmp_path / "family" / stage.replace("_", "-") / "model.safetensors")["weight"]
        assert torch.equal(stored, load_file(runs / stage / "model" / "model.safetensors")["weight"].half())
    family = json.loads((tmp_path / "family" / "family.json").read_text())
    assert family == {"training": {stage: {"stage": stage} for stage in STAGES}, "textures": {}, "figures": {}}


@pytest.mark.parametrize("name", ["touch-to-image", "x-to-touch"])
def test_the_solver_stored_integrates_the_schedule_trained_with(name: str, runs: Path, tmp_path: Path) -> None:
    assemble(runs=runs, output=tmp_path / "family")
    folder = tmp_path / "family" / name / "scheduler"
    solver = UniPCMultistepScheduler.from_pretrained(folder)
    assert UniPCMultistepScheduler.load_config(folder)["_class_name"] == "UniPCMultistepScheduler"
    torch.testing.assert_close(solver.alphas_cumprod, TRAINED.alphas_cumprod)
    assert (solver.config.prediction_type, solver.config.use_exponential_sigmas) == ("v_prediction", True)


def test_touch_diffusion_keeps_its_sensors_and_its_bank(runs: Path, tmp_path: Path) -> None:
    assemble(runs=runs, output=tmp_path / "family")
    folder = tmp_path / "family" / "x-to-touch"
    assert json.loads((folder / "defaults.json").read_text()) == {
        "sensors": ["digit", "gelsight"],
        "default_guidance_scale": 5.0,
        "default_num_inference_steps": 20,
    }
    assert torch.equal(EmbeddingBank.from_pretrained(folder.parent / "embedding-bank").embeds, torch.eye(4, 16))


def test_what_else_a_folder_holds_stays(runs: Path, tmp_path: Path) -> None:
    assemble(runs=runs, output=tmp_path / "family")
    (tmp_path / "family" / "__init__.py").write_text("1")
    (tmp_path / "family" / "joint" / "stray").write_text("of an earlier family")
    assemble(runs=runs, output=tmp_path / "family")
    assert (tmp_path / "family" / "__init__.py").read_text() == "1"
    assert not (tmp_path / "family" / "joint" / "stray").exists()


@pytest.mark.parametrize("part", ["model", "record.json"])
def test_a_stage_that_is_missing_is_named_with_its_command_and_nothing_is_written(
    part: str, runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--runs", str(runs), "--output", str(tmp_path / "family")]
    for stage in STAGES:
        (runs / stage / part).rename(tmp_path / "away")
        with pytest.raises(SystemExit) as stopped:
            run_command("assemble", assemble, words)
        (tmp_path / "away").rename(runs / stage / part)
        (line,) = capsys.readouterr().err.splitlines()
        assert stopped.value.code == 2
        assert str(runs / stage / part) in line and f"python -m unitouch_gen.training.{stage} " in line
    assert not (tmp_path / "family").exists()


def record_inputs(runs: Path, stage: str) -> None:
    """As the stage does when it was built on what there is now."""
    inputs = {option: weights_of(runs / before / "model") for option, before in STAGES[stage].items()}
    (runs / stage / "record.json").write_text(json.dumps({"stage": stage, "inputs": inputs}))


def test_stages_that_were_built_on_what_there_is_make_a_family(runs: Path, tmp_path: Path) -> None:
    for stage in STAGES:
        record_inputs(runs, stage)
    assemble(runs=runs, output=tmp_path / "family")
    recorded = json.loads((tmp_path / "family" / "family.json").read_text())["training"]["unclip"]["inputs"]
    assert recorded.keys() == {"joint", "vae"}


def test_stages_built_on_what_was_trained_anew_are_named_with_what_to_remove(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for stage in ("touch", "unclip", "touch_ldm"):  # the record of `audio` is older and says nothing
        record_inputs(runs, stage)
    for stage in ("image_vae", "touch_vae"):
        save_file({"weight": torch.randn(3)}, runs / stage / "model" / "model.safetensors")
    words = ["--runs", str(runs), "--output", str(tmp_path / "family")]
    with pytest.raises(SystemExit) as stopped:
        run_command("assemble", assemble, words)
    (line,) = capsys.readouterr().err.splitlines()
    assert stopped.value.code == 2
    assert "unclip (of image_vae), touch_ldm (of touch_vae)" in line
    assert f"Remove {runs / 'unclip'}, {runs / 'touch_ldm'}, and train them anew" in line
    assert not (tmp_path / "family").exists()


def test_a_family_is_not_touched_by_one_that_cannot_be_written(runs: Path, tmp_path: Path) -> None:
    assemble(runs=runs, output=tmp_path / "family")
    before = files(tmp_path / "family")
    for stage in ("image_text", "image_vae"):
        shutil.copytree(runs / "picture_classifier" / "model", runs / stage / "model", dirs_exist_ok=True)
    (runs / "touch_ldm" / "model" / "sensors.json").write_text("[")  # the last that is read
    with pytest.raises(json.JSONDecodeError):
        assemble(runs=runs, output=tmp_path / "family")
    assert files(tmp_path / "family") == before
    assert {path.name for path in (tmp_path / "family").iterdir()} == {*FOLDERS, "family.json"}


def test_a_model_that_was_killed_as_it_took_its_place_is_found(runs: Path, tmp_path: Path) -> None:
    (runs / "touch_vae" / ".unitouch-replaces").mkdir()
    (runs / "touch_vae" / "model").rename(runs / "touch_vae" / ".unitouch-replaces" / "model")
    assemble(runs=runs, output=tmp_path / "family")
