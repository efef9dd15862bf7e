"""All stages, one after another as a person would run them, with two tiny steps each: from nothing to a picture."""

import json
import re
import shutil
import subprocess
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
import torch
from accelerate.state import AcceleratorState
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from assemble_family import assemble
from tests.helpers.components import AUDIO, SPACE
from unitouch_gen.commands import run_commands
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.pipelines.tiny import tiny
from unitouch_gen.training.checkpoints import checkpoints_in
from unitouch_gen.training.commands import app
from unitouch_gen.training.family import FINAL_RUNS, RUNS, STAGES
from unitouch_gen.training.recipe import read_recipe
from unitouch_gen.training.stages import Stage, hash_weights
from unitouch_gen.training.touch import TouchRecipe
from unitouch_gen.world import World

CHECKOUT = Path(__file__).resolve().parents[2]
SHORT = (
    "data.drawn={sensors: [null, digit], objects: 1, contacts_per_object: 1}",
    "trainer.steps=2",
    "trainer.batch_size=8",
    "trainer.warmup=1",
    "trainer.save_every=1",
    "trainer.keep_checkpoints=2",
)
ALONE = ("data.image_size=32", f"data.audio={json.dumps(AUDIO)}")
"""What the other stages take from the joint space."""

VAE = tuple(f"model.{part}_block_out_channels=[8, 8, 8, 8]" for part in ("encoder", "decoder"))
UNET = (
    "model.sample_size=4",
    "model.block_out_channels=[16, 16, 16]",
    "model.attention_head_dim=1",
    "model.cross_attention_dim=16",
)
SPACED = tuple(f"model.{key}={json.dumps(value)}" for key, value in SPACE.items())
VIEWS = ("objective.views=1.0", "sampler.sigma=0.75", "sampler.group=2")
SETTINGS: dict[str, tuple[str, ...]] = {
    "image_text": (*ALONE, *SPACED, "model.vision_config.stem=residual", *VIEWS),
    "touch": (),
    "texture": ("model.width=16",),
    "audio": (),
    "image_vae": (*ALONE, *VAE, "augment.crop=16"),
    "unclip": (*UNET, "model.projection_class_embeddings_input_dim=32"),
    "touch_vae": (*ALONE, *VAE, "augment.crop=null"),
    "touch_ldm": UNET,
    "language_model": ("model.hidden_size=16", "model.intermediate_size=24"),
    "touch_llm": ("bridge.intermediate_size=24",),
}
NOT_LEARNED = ("known", "prototypes", "mean", "deviation")
FROZEN = defaultdict(set, touch_llm={"language_model"}, image_vae={"features"}, touch_vae={"features"})
"""Parts of an objective that are not trained."""


def stage(runs: Path, name: str, *words: str, output: str | None = None) -> None:
    """Runs the command of a stage, on what the stages before have left."""
    given = [
        word for option, before in STAGES[name].takes.items() for word in (f"--{option}", str(runs / before / "model"))
    ]
    overrides = [word for setting in (*SHORT, *SETTINGS[name]) for word in ("--set", setting)]
    places = ["--output", str(runs / (output or name)), "--cache", str(runs / "cache")]
    AcceleratorState._reset_state()  # as a process of its own would find it
    run_commands(app, "unitouch_gen.training", [name, *given, *overrides, *places, *words])


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where all stages have run."""
    runs = tmp_path_factory.mktemp("runs")
    for run in FINAL_RUNS:
        stage(runs, run.name)
    return runs


def test_every_stage_leaves_its_model_and_how_the_weights_came_about(runs: Path) -> None:
    for name in [run.name for run in FINAL_RUNS]:
        assert {path.name for path in (runs / name).iterdir()} == {"checkpoints", "log.jsonl", "model", "record.json"}
        record = json.loads((runs / name / "record.json").read_text())
        assert (record["stage"], record["trainer"]["steps"], record["seed"]) == (name, 2, 0)
        assert record["inputs"] == {
            option: hash_weights(runs / stage / "model") for option, stage in STAGES[name].takes.items()
        }
        lines = [json.loads(line) for line in (runs / name / "log.jsonl").read_text().splitlines()]
        assert np.isfinite([line["loss"] for line in lines if "loss" in line]).all()
        first, last = (load_file(folder / "model.safetensors") for folder in checkpoints_in(runs / name))
        still = {key for key, value in last.items() if torch.equal(value, first[key])}
        if name not in ("unclip", "touch_ldm"):  # group norms of single pixels learn nothing
            assert {key.split(".")[0] for key in still if not key.endswith(NOT_LEARNED)} <= FROZEN[name]


@pytest.mark.parametrize("name", ["touch", "unclip", "language_model", "touch_llm"])
def test_a_stage_that_was_stopped_goes_on_to_the_same_bits(name: str, runs: Path) -> None:
    shutil.copytree(runs / name, runs / f"{name}-again")
    (checkpoints_in(runs / f"{name}-again")[-1] / "progress.json").unlink()
    with pytest.raises(SystemExit, match="2"):
        stage(runs, name, output=f"{name}-again")  # a run is not begun over another one
    stage(runs, name, "--resume", output=f"{name}-again")
    for file in (runs / name / "model").rglob("*.safetensors"):
        again = load_file(runs / f"{name}-again" / file.relative_to(runs / name))
        assert all(torch.equal(again[key], value) for key, value in load_file(file).items())


def test_stages_start_from_weights_and_leave_behind_what_was_measured_of_them(runs: Path, tmp_path: Path) -> None:
    began = shutil.copytree(runs / "touch" / "model", tmp_path / "run" / "model")
    (tmp_path / "run" / "record.json").write_text('{"seed": 3}')
    changed = ("--set", "objective.views=0")
    stage(runs, "image_text", "--init", str(began), *changed, output="kept")
    made = UniTouchModel.from_pretrained(runs / "kept" / "model")
    assert made.known_modalities == ("image", "text")  # to which no touch and no sound is bound yet
    assert made.config.sensor_reaches == made.config.ood_thresholds == {}
    assert made.config.embedding_norm > 0
    words = [UniTouchProcessor.from_pretrained(one).tokenizer.get_vocab() for one in (began, runs / "kept" / "model")]
    record = json.loads((runs / "kept" / "record.json").read_text())
    assert words[0] == words[1]
    assert record["started_from"] == {"seed": 3}
    stage(runs, "image_vae", "--init", str(runs / "image_vae" / "model"), output="vae-again")
    assert json.loads((runs / "vae-again" / "record.json").read_text())["started_from"]["stage"] == "image_vae"
    with pytest.raises(SystemExit, match="2"):
        stage(runs, "image_text", "--resume", *changed, output="kept")  # without the weights that it started from


def test_weights_behind_links_count_in_their_hash(tmp_path: Path) -> None:
    for name, value in (("one", 1.0), ("other", 2.0)):
        (tmp_path / f"weights-{name}").mkdir()
        save_file({"a": torch.full((2,), value)}, tmp_path / f"weights-{name}" / "model.safetensors")
        (tmp_path / name).mkdir()
        (tmp_path / name / "unitouch").symlink_to(tmp_path / f"weights-{name}")
    assert hash_weights(tmp_path / "one") != hash_weights(tmp_path / "other")
    shutil.copytree(tmp_path / "one", tmp_path / "copy")  # which follows the link
    assert hash_weights(tmp_path / "one") == hash_weights(tmp_path / "copy")


@pytest.fixture(scope="module")
def family(runs: Path) -> Path:
    assemble(runs, runs / "family")
    return runs / "family"


def test_a_family_becomes_pictures_and_touches(family: Path) -> None:
    pipe = tiny("touch-to-image", family=family)
    pipe.set_progress_bar_config(disable=True)
    assert pipe.unitouch.config.sensors == ["digit"]  # sensors that were drawn have no name
    touch = World(0, image_size=32).render([0], [0], [0], modalities=("touch",), sensors=("digit",)).touch["digit"]
    picture = pipe(touch, num_inference_steps=2, output_type="np").images
    assert picture.shape == (1, 32, 32, 3)
    assert np.isfinite(picture).all()
    pipe = tiny("x-to-touch", family=family)
    pipe.set_progress_bar_config(disable=True)
    for drawn in ({"sensor": "digit"}, {"background": touch[0]}):
        made = pipe(text="rough brick", num_inference_steps=2, output_type="np", **drawn).images
        assert made.shape == (1, 32, 32, 3)
        assert np.isfinite(made).all()
    assert len(tiny("touch-to-text", family=family)(touch, "How does it feel?", max_new_tokens=4).texts) == 1


def test_every_weight_of_a_family_is_stored_in_half_precision_once(family: Path, runs: Path) -> None:
    kinds = {}
    for path in family.rglob("*.safetensors"):
        with safe_open(path, framework="pt") as file:
            kinds[path] = {str(file.get_slice(key).get_dtype()) for key in file.keys()}  # noqa: SIM118
    # the joint space; of pictures and of touches autoencoder and UNet; normaliser, bank, and untouched gels; language
    # model and bridge
    assert len(kinds) == 10
    assert all(kind <= {"F16", "BOOL", "I64"} for kind in kinds.values())
    stored = load_file(family / "joint" / "model.safetensors")
    for part in ("image_text", "touch", "texture", "audio"):  # each leaves what was there as it was
        state = load_file(runs / part / "model" / "model.safetensors")
        assert all(torch.equal(stored[key], v.half() if v.is_floating_point() else v) for key, v in state.items())
    assert {*stored} == {*state}
    assert [*json.loads((family / "family.json").read_text())["training"]] == [run.name for run in FINAL_RUNS]


def test_a_family_is_not_touched_by_stages_that_are_missing_or_were_built_on_other_weights(family, runs, tmp_path):
    shutil.copytree(runs, tmp_path / "runs", ignore=shutil.ignore_patterns("checkpoints", "cache", "family"))
    before = {path: path.read_bytes() for path in family.rglob("*") if path.is_file()}
    vae = tmp_path / "runs" / "image_vae"
    save_file({"weight": torch.ones(2)}, next((vae / "model").glob("*.safetensors")))
    with pytest.raises(InvalidInputError, match="unclip', which was built on other weights than image_vae holds now"):
        assemble(tmp_path / "runs", family)
    (vae / "record.json").unlink()
    with pytest.raises(InvalidInputError, match=r"lacks .*image_vae/record.json'; make it with: python -m "):
        assemble(tmp_path / "runs", family)
    assert {path: path.read_bytes() for path in family.rglob("*") if path.is_file()} == before


def test_a_run_goes_on_with_the_recipe_and_the_weights_that_it_began_with(joint: str, tmp_path: Path) -> None:
    recipe = read_recipe("touch", ["sampler.sigma=0.5"])
    inputs = {"joint": hash_weights(Path(joint))}
    place = tmp_path / "checkpoints" / "step-00000001"
    place.mkdir(parents=True)
    (place / "progress.json").write_text(json.dumps({"step": 1, "seconds": 1.0, "recipe": recipe, "inputs": inputs}))
    given = {"joint": Path(joint), "output": tmp_path, "resume": True}
    found = Stage("touch", TouchRecipe, overrides=["trainer.steps=3"], **given)
    assert (found.recipe.sampler.sigma, found.trainer.steps) == (0.5, 3)
    with pytest.raises(InvalidInputError, match="`recipe` cannot be passed with `--resume`"):
        Stage("touch", TouchRecipe, recipe="touch_pairs", **given)
    file = next(Path(joint).rglob("*.safetensors"))
    save_file({"weight": torch.ones(2)}, file)
    with pytest.raises(InvalidInputError, match=r"was built on other weights than --joint"):
        Stage("touch", TouchRecipe, **given)


def remaining(runs: Path, capsys: pytest.CaptureFixture[str]) -> list[str]:
    """The commands that are left to train a family."""
    run_commands(app, "unitouch_gen.training", ["family", "--runs", str(runs), "--dry-run"])
    return capsys.readouterr().out.splitlines()


def test_a_family_is_trained_in_an_order_in_which_every_run_finds_what_it_takes() -> None:
    done = set[str]()
    for run in RUNS:
        assert {*run.takes.values()} <= done
        done.add(run.name)
    assert {run.name for run in FINAL_RUNS} == {
        run.stage or run.name for run in RUNS
    }  # of each stage there is a last one


def test_a_family_goes_on_where_it_was_stopped(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert len(remaining(tmp_path, capsys)) == len(RUNS)
    (tmp_path / "captions").mkdir()
    (tmp_path / "captions" / "record.json").write_text("{}")
    checkpoint = tmp_path / "image_text" / "checkpoints" / "step-00000001"
    checkpoint.mkdir(parents=True)
    lines = remaining(tmp_path, capsys)
    assert len(lines) == len(RUNS) - 1
    assert " --recipe image_text_lamps " in lines[0]  # it has saved nothing yet
    (checkpoint / "progress.json").write_text("{}")
    assert remaining(tmp_path, capsys)[0] == (
        f"python -m unitouch_gen.training image_text --init {tmp_path}/captions/model "
        f"--output {tmp_path}/image_text --cache {tmp_path}/cache --resume"
    )


@pytest.mark.slow
def test_a_family_stops_at_a_stage_that_fails(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """With the stage's exit code, after its own message."""
    (tmp_path / "runs").write_text("a file")
    with pytest.raises(SystemExit, match="2"):
        run_commands(app, "unitouch_gen.training", ["family", "--runs", str(tmp_path / "runs")])
    [error] = capfd.readouterr().err.splitlines()
    assert str(tmp_path / "runs" / "captions") in error
    assert "cannot be written to" in error


needs_checkout = pytest.mark.skipif(not (CHECKOUT / "Makefile").is_file(), reason="there is no checkout")


@needs_checkout
def test_the_page_on_training_lists_the_commands_of_a_family(monkeypatch, tmp_path, capsys) -> None:
    monkeypatch.chdir(tmp_path)  # where no run is done
    lines = [line.replace(" --cache runs/cache", "") for line in remaining(Path("runs"), capsys)]
    page = (CHECKOUT / "docs" / "training.md").read_text()
    assert "\n".join(lines) in page


@needs_checkout
@pytest.mark.skipif(shutil.which("make") is None, reason="there is no make")
def test_make_weights_trains_a_family_and_puts_it_together(tmp_path: Path) -> None:
    words = ["make", "--dry-run", "weights", f"RUNS={tmp_path}", f"FAMILY={tmp_path / 'family'}"]
    done = subprocess.run(words, cwd=CHECKOUT, capture_output=True, text=True, check=True)
    commands = [re.sub(r"^\S*python", "python", line) for line in done.stdout.splitlines() if str(tmp_path) in line]
    assert commands == [
        f"python -m unitouch_gen.training family --runs {tmp_path}",
        f"python samples/assemble_family.py {tmp_path} {tmp_path / 'family'}",
    ]
