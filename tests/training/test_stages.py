"""What the stages share: command lines, what they are built on, the folder and the record a stage leaves."""

import copy
import json
import subprocess
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from unitouch_gen.errors import InvalidInputError, NonFiniteError
from unitouch_gen.models import UniTouchConfig, UniTouchModel, UniTouchProcessor
from unitouch_gen.training.batches import ArrayDataset
from unitouch_gen.training.data import Rendered
from unitouch_gen.training.recipe import BASE, RECIPES, read_recipe, read_section
from unitouch_gen.training.stages import (
    STAGES,
    Stage,
    commit,
    record_beside,
    run,
    run_command,
    save_modalities,
    weights_of,
)
from unitouch_gen.training.touch import set_prototypes, start_from
from unitouch_gen.training.trainer import Trainer, TrainerConfig
from unitouch_gen.weights import X_TO_TOUCH


def stage(output: Path, **data: object) -> Stage:
    overrides = [f"data.{key}={value}" for key, value in {"drawn.objects": 2, **data}.items()]
    return Stage("image_text", overrides=[*overrides, "trainer.seed=5"], output=output, cache=output / "cache")


# Commands -------------------------------------------------------------------------------------------------------------


def called(name: str, *words: str) -> Stage:
    """What a command line asks a stage for."""
    found: list[Stage] = []
    run(name, found.append, words)
    return found[0]


def test_a_command_without_arguments_is_the_stages_own_recipe() -> None:
    found = called("image_text")
    assert found.recipe == read_recipe("image_text")
    assert (found.output, found.cache, found.resume) == (Path("runs/image_text"), Path("runs/cache"), False)


def test_a_command_sets_what_it_is_told(tmp_path: Path, joint: str) -> None:
    overrides = ("--set", "trainer.steps=7", "--set", "sampler.sigma=0.5", "--set", "data.drawn.seed=3")
    found = called("touch", "--joint", joint, "--output", str(tmp_path / "out"), *overrides)
    assert found.trainer.steps == 7 and found.recipe["sampler"]["sigma"] == 0.5 and found.data.drawn.seed == 3
    assert found.folders == {"joint": Path(joint)} and found.output == tmp_path / "out" and not found.resume


def test_textures_are_for_drawn_contacts(tmp_path: Path) -> None:
    words = ("--set", "data.image_size=32", "--output", str(tmp_path / "out"))
    found = called("image_vae", *words, "--textures", str(tmp_path))
    assert found.data.drawn.textures == str(tmp_path)  # type: ignore[union-attr]
    with pytest.raises(SystemExit, match="2"):
        called("image_vae", *words, "--textures", str(tmp_path / "none"))
    with pytest.raises(SystemExit, match="2"):
        called("image_vae", *words, "--set", "data.drawn=null", "--textures", str(tmp_path))


def test_a_stage_begins_with_the_seed_of_its_recipe() -> None:
    drawn = []
    for seed in ("3", "3", "4"):
        run("image_text", lambda stage: drawn.append(torch.rand(()).item()), ["--set", f"trainer.seed={seed}"])
    assert drawn[0] == drawn[1] != drawn[2]


def test_a_model_that_was_killed_as_it_took_its_place_is_found(tmp_path: Path, joint: str) -> None:
    (tmp_path / ".unitouch-replaces").mkdir()
    Path(joint).rename(tmp_path / ".unitouch-replaces" / "joint")
    assert called("touch", "--joint", joint).folders == {"joint": Path(joint)}


@pytest.mark.parametrize(
    ("name", "words", "message"),
    [
        ("image_text", ["--set", "trainer=3"], "`set` is 'trainer=3'; write section.key=value"),
        ("image_text", ["--set", "objective.kept=1.0"], "`objective.kept` is above 0, and `init` names no weights"),
        ("image_text", ["--set", "trianer.steps=3"], "no section `trianer`"),
        ("image_text", ["--set", "trainer.stpes=3"], "`trainer` holds ['stpes']"),
        ("image_text", ["--set", "data.imgae_size=3"], "`data` holds ['imgae_size']"),
        ("image_text", ["--set", "tokenizer.size=3"], "`tokenizer` holds ['size']; its keys are ['max_length', 'voc"),
        ("image_text", ["--set", "model.audio_config.size=3"], "`model.audio_config` holds ['size']"),
        ("image_text", ["--set", "trainer.steps=-3"], "`trainer.steps` is -3; it has to be greater than 0"),
        ("image_text", ["--set", "trainer.steps=many"], "`trainer.steps` is 'many'; it has to be a valid integer"),
        (
            "image_text",
            ["--set", "trainer.optimizer=sgd"],
            "`trainer.optimizer` is 'sgd'; it has to be 'adam' or 'adamw'",
        ),
        ("image_text", ["--set", "data.drawn=null"], "`data` names nothing to train on"),
        ("touch_vae", ["--recipe", "touch_vae_paper"], "`data` names nothing to train on"),
        ("image_text", ["--recipe", "taste"], "`recipe` is 'taste'"),
        ("image_text", ["--recipe", "data"], "`recipe` has no section `trainer`"),
        ("image_text", ["--output", "{joint}/config.json"], "config.json is a file"),
        ("image_text", ["--vae", "{vae}"], "No such option: --vae"),
        ("audio", ["--joint", "{joint}", "--init", "{joint}"], "No such option: --init"),
        ("touch", [], "Missing option '--joint'"),
        ("touch_vae", ["--resume"], "`resume` finds no checkpoint in 'runs/touch_vae'"),
        ("touch_vae", ["--set", "model.class=AsymmetricAutoencoderKL"], "`model.class` is 'AsymmetricAutoencoderKL'"),
        ("touch_vae", ["--set", "model.latent_channel=3"], "`model` holds ['latent_channel']"),
        ("touch_vae", ["--set", "loss.latent_noise=-1"], "`loss.latent_noise` is -1"),
        ("touch_classifier", ["--set", "augment.blur=2"], "`augment.blur` is 2"),
        ("touch_classifier", ["--set", "model.dephts=2"], "Did you mean 'depths'?"),
        ("audio", ["--joint", "nowhere"], "`joint` is 'nowhere', which holds no model"),
        ("touch", ["--joint", "{joint}", "--set", "sampler.sigma=2"], "`sampler.sigma` is 2"),
        (
            "touch",
            ["--joint", "{joint}", "--set", "data.drawn.sensors=[digit]", "--set", "data.grasps=[]"],
            "`sigma` is 0.75 with 1 data set",
        ),
        ("touch", ["--joint", "{joint}", "--set", "sampler.sgima=2"], "`sampler` holds ['sgima']"),
        ("touch", ["--joint", "{joint}", "--set", "augment.turn=2"], "`augment.turn` is 2"),
        ("unclip", ["--joint", "{joint}", "--vae", "nowhere"], "`vae` is 'nowhere'"),
        ("unclip", ["--joint", "{joint}", "--vae", "{joint}", "--init", "nowhere"], "`init` is 'nowhere'"),
        (
            "unclip",
            ["--joint", "{joint}", "--vae", "{joint}", "--set", "objective.condition_dropout=2"],
            "`objective.condition_dropout` is 2",
        ),
        (
            "touch_ldm",
            ["--joint", "{joint}", "--vae", "{joint}", "--set", "embedding_bank.size=0"],
            "`embedding_bank.size` is 0",
        ),
        ("unclip", ["--joint", "{joint}", "--vae", "{vae}", "--set", "model.smaple_size=3"], "mean 'sample_size'?"),
        ("unclip", ["--joint", "{joint}", "--vae", "{vae}", "--set", "scheduler.beta=3"], "`scheduler` holds ['beta']"),
        ("touch_ldm", ["--joint", "{joint}", "--vae", "{vae}", "--set", "model.num_class_embeds=3"], "`model` holds"),
        ("touch_ldm", ["--joint", "{joint}", "--vae", "{vae}", "--set", "scheduler.beta=3"], "`scheduler` holds"),
        (
            "touch_ldm",
            ["--joint", "{joint}", "--vae", "{vae}", "--set", "model.in_channels=8"],
            "`data.drawn.sensors` holds null",
        ),
        (
            "touch_ldm",
            [
                "--joint",
                "{joint}",
                "--vae",
                "{vae}",
                "--init",
                str(X_TO_TOUCH / "unet"),
                "--set",
                "data.drawn.sensors=[digit]",
            ],
            "a network that draws 5 sensors, and the data is of 2: ['digit']",
        ),
    ],
)
def test_a_mistake_in_a_command_ends_it_with_a_line_before_anything_is_written(
    name: str,
    words: list[str],
    message: str,
    joint: str,
    vae: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    main = import_module(f"unitouch_gen.training.{name}").main
    with pytest.raises(SystemExit) as stopped:
        run(name, main, [word.format(joint=joint, vae=vae) for word in words])
    assert stopped.value.code == 2
    error = capsys.readouterr().err.splitlines()
    assert len(error) == 1 and message in error[0]
    assert list((tmp_path / "here").iterdir()) == []


def test_a_record_names_the_run_that_it_started_from(tmp_path: Path) -> None:
    (tmp_path / "run" / "model" / "unet").mkdir(parents=True)
    assert record_beside(tmp_path / "run" / "model") is None
    (tmp_path / "run" / "record.json").write_text('{"seed": 3}')
    for weights in ("model", "model/unet"):
        assert record_beside(tmp_path / "run" / weights) == {"seed": 3}


def test_a_loss_that_is_not_finite_ends_a_command_with_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    def main() -> None:
        raise NonFiniteError("The loss is nan.")

    with pytest.raises(SystemExit) as stopped:
        run_command("stage", main, [])
    assert stopped.value.code == 2
    assert capsys.readouterr().err.splitlines() == ["unitouch_gen.training: The loss is nan."]


def test_a_command_that_is_interrupted_says_so_by_its_exit_code() -> None:
    def main() -> None:
        raise KeyboardInterrupt

    with pytest.raises(SystemExit) as stopped:
        run_command("stage", main, [])
    assert stopped.value.code == 130


def test_a_mistake_of_ours_is_not_hidden() -> None:
    def main() -> None:
        raise KeyError("model")

    with pytest.raises(KeyError):
        run_command("stage", main, [])


@pytest.mark.parametrize("name", sorted(path.stem for path in RECIPES.glob("*.yaml")))
def test_every_recipe_is_of_a_stage(name: str) -> None:
    assert name == BASE or name.removesuffix("_paper").removesuffix("_pairs") in STAGES


@pytest.mark.parametrize("name", STAGES)
def test_every_stage_has_a_recipe_and_takes_what_came_before(name: str) -> None:
    assert (RECIPES / f"{name}.yaml").is_file() and (RECIPES.parent / f"{name}.py").is_file()
    before = list(STAGES)[: list(STAGES).index(name)]
    assert set(STAGES[name].values()) <= set(before)


def test_the_recipes_joint_space_is_one_the_paper_would_recognise() -> None:
    config = read_section(read_recipe("image_text"), "model", UniTouchConfig)
    assert (config.temperature, config.sensor_tokens, len(config.sensors)) == (0.07, 5, 4)


def test_in_batch_sampling_is_the_papers() -> None:
    assert read_recipe("touch")["sampler"]["sigma"] == 0.75


# Data -----------------------------------------------------------------------------------------------------------------


def test_pictures_of_another_world_have_another_key(tmp_path: Path, split: Rendered) -> None:
    other = replace(split, fingerprint="0123456789abcdef")
    assert stage(tmp_path).key([split]) != stage(tmp_path).key([other])


def test_a_recipe_may_name_its_data(tmp_path: Path, processor: UniTouchProcessor) -> None:
    data = {
        "drawn.sensors": ["gelsight_r15"],
        "drawn.contacts_per_object": 1,
        "drawn.objects": 1,
        "drawn.seed": 3,
        "grasps": [],
    }
    (split,) = stage(tmp_path, **data).splits(processor)
    assert (split.sensor, split.image.shape) == ("gelsight_r15", (17, 3, 32, 32))
    (folder,) = (tmp_path / "cache").iterdir()
    assert folder.name.startswith("drawn-gelsight_r15-train-")


def test_a_prototype_is_the_mean_raw_image_of_its_sensor(model: UniTouchModel, split: Rendered) -> None:
    rng = np.random.default_rng(0)
    others = [copy.copy(split) for _ in range(2)]
    for other in others:
        other.sensor, other.touch = "gelsight", rng.integers(0, 256, (rng.integers(3, 9), 3, 32, 32), dtype=np.uint8)
    set_prototypes(model, [others[0], split, others[1]])
    both = np.concatenate([other.touch for other in others])
    np.testing.assert_allclose(model.sensor_bank.prototype("gelsight"), both.mean(axis=0) / 255, atol=1e-6)
    np.testing.assert_allclose(model.sensor_bank.prototype("digit"), split.touch.mean(axis=0) / 255, atol=1e-6)


# What a stage is built on ---------------------------------------------------------------------------------------------


class Least(torch.nn.Module):
    """Something to train."""

    def __init__(self) -> None:
        super().__init__()
        self.trained = torch.nn.Linear(3, 1)

    def forward(self, batch: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        return {"loss": self.trained(batch["x"]).square().mean()}


def train_anew(folder: str, value: float) -> None:
    """Other weights in a model's folder."""
    file = next(Path(folder).rglob("*.safetensors"))
    save_file({"weight": torch.full((2,), value)}, file)


def test_the_weights_of_a_folder_are_those_of_all_its_files(tmp_path: Path) -> None:
    hashes = set()
    for name in ("model.safetensors", "unet/model.safetensors", "vae/model.safetensors"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        save_file({"weight": torch.ones(2)}, tmp_path / name)
        hashes.add(weights_of(tmp_path))
    (tmp_path / "unet").rename(tmp_path / "other")
    hashes.add(weights_of(tmp_path))
    train_anew(str(tmp_path / "vae"), 2.0)
    hashes.add(weights_of(tmp_path))
    (tmp_path / "config.json").write_text("{}")
    assert len(hashes) == 5 and weights_of(tmp_path) in hashes


def test_a_stage_knows_what_it_is_built_on(joint: str, vae: str) -> None:
    found = called("unclip", "--joint", joint, "--vae", vae)
    assert found.inputs == {"joint": weights_of(Path(joint)), "vae": weights_of(Path(vae))}
    assert called("image_text").inputs == {}


def test_a_stage_does_not_go_on_with_other_weights_than_it_began_with(tmp_path: Path, joint: str) -> None:
    output = tmp_path / "runs" / "touch"
    begun = TrainerConfig(steps=1, batch_size=2, learning_rate=0.1, warmup=0)
    inputs = {"joint": weights_of(Path(joint))}
    Trainer(Least(), ArrayDataset(x=torch.ones(2, 3)), lambda step: [0, 1], begun, output, {"inputs": inputs}).fit()
    given = {"joint": Path(joint), "output": output}
    assert Stage("touch", resume=True, **given).inputs == inputs
    train_anew(joint, 2.0)
    with pytest.raises(InvalidInputError, match=r"`resume` finds .*other weights than `joint` .*; remove .*touch"):
        Stage("touch", resume=True, **given)
    assert Stage("touch", joint=Path(joint), output=tmp_path / "anew").inputs != inputs


def test_a_checkpoint_that_says_nothing_of_its_inputs_is_gone_on_from(tmp_path: Path, joint: str) -> None:
    checkpoint = tmp_path / "touch" / "checkpoints" / "step-00000001"
    checkpoint.mkdir(parents=True)
    (checkpoint / "progress.json").write_text('{"step": 1, "seconds": 1.0}')
    assert Stage("touch", output=tmp_path / "touch", resume=True, joint=Path(joint)).resume


def test_a_changed_recipe_is_told_and_has_to_be_asked_for(
    tmp_path: Path, joint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    recipe = read_recipe("touch", ["trainer.steps=1"])
    begun = TrainerConfig(steps=1, batch_size=2, learning_rate=0.1, warmup=0)
    progress = {"recipe": recipe}
    Trainer(Least(), ArrayDataset(x=torch.ones(2, 3)), lambda step: [0, 1], begun, tmp_path, progress).fit()
    given = {"joint": Path(joint), "output": tmp_path, "resume": True}
    same = ["trainer.steps=1", "trainer.save_every=7"]  # which no weight depends on
    assert Stage("touch", overrides=same, **given).trainer.save_every == 7
    other = ["trainer.steps=2", "sampler.sigma=0.5"]
    changes = "sampler.sigma from 0.75 to 0.5, trainer.steps from 1 to 2"
    with pytest.raises(InvalidInputError, match=f"began with another recipe: {changes}. Pass `--override`"):
        Stage("touch", overrides=other, **given)
    assert Stage("touch", overrides=other, override=True, **given).trainer.steps == 2
    assert f"The recipe has changed: {changes}." in capsys.readouterr().err


def test_a_run_is_not_begun_over_another_one(tmp_path: Path, joint: str) -> None:
    begun = TrainerConfig(steps=1, batch_size=2, learning_rate=0.1, warmup=0)
    Trainer(Least(), ArrayDataset(x=torch.ones(2, 3)), lambda step: [0, 1], begun, tmp_path).fit()
    with pytest.raises(InvalidInputError, match=r"holds step-00000001 of a run that would be lost; pass `--resume`"):
        Stage("touch", joint=Path(joint), output=tmp_path)


# What it starts from --------------------------------------------------------------------------------------------------


def test_a_touch_encoder_starts_from_anothers_weights_and_keeps_tokens_of_sensors_by_name(
    tmp_path: Path, config: UniTouchConfig, model: UniTouchModel
) -> None:
    model.save_pretrained(tmp_path)
    config.sensors = ["digit", "gelsight_r15"]
    fresh = UniTouchModel(config, modalities=("touch",))
    before = fresh.sensor_bank.tokens.detach().clone()
    start_from(fresh, tmp_path)
    for name, tensor in model.touch_model.state_dict().items():
        assert torch.equal(fresh.touch_model.state_dict()[name], tensor)
    kept = fresh.sensor_bank.tokens
    assert torch.equal(kept[0], model.sensor_bank.tokens[model.sensor_bank.index("digit")])
    assert torch.equal(kept[1], before[1])


def test_weights_without_a_touch_encoder_are_none_to_start_from(model: UniTouchModel, joint: str) -> None:
    with pytest.raises(InvalidInputError, match=r"`init` is .*, which holds no touch encoder; it has image, text"):
        start_from(model, Path(joint))


# The commit on record -------------------------------------------------------------------------------------------------


def git(folder: Path, *words: str) -> str:
    identity = ["-c", "user.name=A", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false"]
    command = ["git", "-C", str(folder), *identity, *words]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    git(tmp_path, "init", "--quiet")
    (tmp_path / "training").mkdir()
    (tmp_path / "training" / "stages.py").write_text("1\n")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "--quiet", "--message", "Begin")
    return tmp_path


def test_the_commit_is_the_checkouts(checkout: Path) -> None:
    (checkout / "untracked").touch()
    found = commit(checkout / "training" / "stages.py")
    assert found == git(checkout, "rev-parse", "HEAD")[:12]


def test_a_commit_from_which_tracked_files_differ_is_dirty(checkout: Path) -> None:
    clean = commit(checkout / "training" / "stages.py")
    (checkout / "training" / "stages.py").write_text("2\n")
    assert commit(checkout / "training" / "stages.py") == f"{clean}-dirty"


def test_a_tag_does_not_hide_the_commit(checkout: Path) -> None:
    git(checkout, "tag", "--annotate", "v1", "--message", "One")
    assert commit(checkout / "training" / "stages.py") == git(checkout, "rev-parse", "HEAD")[:12]


def test_what_is_installed_in_a_checkout_has_no_commit(checkout: Path) -> None:
    installed = checkout / ".venv" / "stages.py"
    installed.parent.mkdir()
    installed.touch()
    assert commit(installed) is None


def test_outside_of_a_checkout_there_is_no_commit(tmp_path: Path) -> None:
    (tmp_path / "stages.py").touch()
    assert commit(tmp_path / "stages.py") is None


def test_without_git_there_is_no_commit(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    assert commit(checkout / "training" / "stages.py") is None


# What a stage leaves --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("modalities", [("image", "text"), ("audio",), ("touch",)])
def test_saved_modalities_are_read_back_as_they_were(
    modalities: tuple[str, ...], model: UniTouchModel, processor: UniTouchProcessor, tmp_path: Path
) -> None:
    model.sensor_bank.set_prototype("digit", torch.rand(3, 32, 32))
    save_modalities(model, modalities, processor, tmp_path / "model")
    again = UniTouchModel.from_pretrained(tmp_path / "model", modalities=modalities)
    assert again.loaded_modalities == modalities
    expected = model.state_dict()
    assert again.state_dict().keys() and all(torch.equal(t, expected[key]) for key, t in again.state_dict().items())


def test_only_the_modalities_asked_for_are_saved(
    model: UniTouchModel, processor: UniTouchProcessor, tmp_path: Path
) -> None:
    save_modalities(model, ("touch",), processor, tmp_path / "model")
    with safe_open(tmp_path / "model" / "model.safetensors", framework="pt") as file:
        assert {key.partition(".")[0] for key in file.keys()} == {"touch_model", "sensor_bank"}  # noqa: SIM118


def test_the_processor_is_saved_beside_the_modalities(
    model: UniTouchModel, processor: UniTouchProcessor, tmp_path: Path
) -> None:
    save_modalities(model, ("image",), processor, tmp_path / "model")
    again = UniTouchProcessor.from_pretrained(tmp_path / "model")
    assert (again.image_size, again.audio) == (processor.image_size, processor.audio)
    assert again.text("rough brick")["input_ids"].tolist() == processor.text("rough brick")["input_ids"].tolist()


def test_a_stage_leaves_its_model_and_how_the_weights_came_about(tmp_path: Path) -> None:
    left = stage(tmp_path)
    for name in ("first", "second"):  # which takes the place of the first
        with left.saving(psnr=30.0) as folder:
            (folder / name).touch()
    record = json.loads((tmp_path / "record.json").read_text())
    assert (record["stage"], record["seed"], record["psnr"]) == ("image_text", 5, 30.0)
    assert record["trainer"]["steps"] == 1500
    assert record["recipe"]["tokenizer"] == {"vocab_size": 1024, "max_length": 32}
    assert record["commit"] == commit() and record["inputs"] == {} and "trainer" not in record["recipe"]
    assert sorted(path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*")) == [
        "model",
        "model/second",
        "record.json",
    ]
