"""Commands and recipes of training that cannot be used: one line that says what is wrong; nothing is written."""

import json
import shlex
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from diffusers import DDPMScheduler, UNet2DConditionModel

from tests.helpers.calls import quiet
from tests.helpers.components import make_pipelines
from tests.helpers.data_sets import write_image
from tests.helpers.refusals import check_refusal
from tests.helpers.small_family import write_small_family
from tests.training.conftest import read_as
from unitouch_gen import tiny
from unitouch_gen.commands import run_commands
from unitouch_gen.training.batches import shuffled_indices
from unitouch_gen.training.commands import app
from unitouch_gen.training.losses import denoising_loss
from unitouch_gen.training.recipe import build, read, read_recipe
from unitouch_gen.training.stages import Recipe
from unitouch_gen.weights import X_TO_TOUCH

STAGES = [
    ("image_text --set model.audio_config.size=3", "In `model`, `size` is unknown"),
    ("touch_vae --joint {joint} --recipe touch_vae_paper", "`data` takes one of the two"),
    ("image_text --output {joint}/config.json", "cannot be written to"),
    ("audio --joint {joint} --init {joint}", "No such option: --init"),
    ("unclip --llama {joint}", "No such option: --llama"),
    ("touch", "touch needs folders of models: --joint of "),
    ("audio --joint nowhere", "'nowhere' does not exist"),
    ("image_vae --resume", "`resume` finds no checkpoint in 'runs/image_vae'"),
    ("image_vae --set model.class=UNet", "`model.class` is 'UNet'; it has to be one of 'AutoencoderKL'"),
    ("image_vae --set augment.crop=60", "`augment.crop` is 60; take a multiple of 8"),
    ("image_vae --set loss.feature_weight=1 --set loss.trunk={joint}", "which holds no trunk of texture"),
    ("touch_llm --joint {joint} --llama {joint} --set model.hidden_size=16", "`model` is that of `--llama`"),
    ("touch --joint {joint} --set data.drawn.sensors=[digit]", "sigma` is 0.75, with no other data set"),
    ("touch_ldm --joint {joint} --vae {vae} --set model.in_channels=8", "The network has {'in_channels': 8}"),
    ("touch_ldm --joint {joint} --vae {vae} --init {unet} --set data.drawn.sensors=[digit]", "The network has"),
]


@pytest.fixture
def run(capsys, monkeypatch, tmp_path) -> Callable[..., str]:
    """Runs a command that has to end with a line and 2, and leave nothing in the folder it is run in."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")

    def call(*words: str) -> str:
        with pytest.raises(SystemExit, match="2"):
            run_commands(app, "unitouch_gen.training", list(words))
        assert list((tmp_path / "here").iterdir()) == []
        return capsys.readouterr().err.strip().splitlines()[-1]

    return call


@pytest.mark.parametrize(("line", "said"), STAGES)
def test_a_bad_command_of_a_stage_is_one_line_before_anything_is_written(run, joint, vae, line, said):
    places = {"{joint}": joint, "{vae}": vae, "{unet}": str(X_TO_TOUCH / "unet")}
    for name, place in places.items():
        line = line.replace(name, place)
    assert said in run(*shlex.split(line))


DISTILLED = [
    ("gone", "", "'--model'"),
    ("empty", "", "`model` names "),
    ("other", "", "is 'StableDiffusionPipeline'; it has to be one of"),
    ("broken", "", "`model` is "),
    ("teacher", "lora.target_modules=[to_p]", "`lora` does not fit the network"),
    ("teacher", "lora.rank=3", "In `lora`, `rank` is unknown"),
    ("teacher", "objective.timesteps=[9,99]", "`objective.timesteps` is [9, 99]: "),
    ("gels", "data.sets={sets}", "`data.sets` have no untouched gels"),
]
DRAWN = "data.drawn={sensors: [digit], objects: 1, contacts_per_object: 1}"


@pytest.fixture(scope="module")
def teachers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders of pipelines that can be distilled, and of what cannot; and a data set."""
    pytest.importorskip("peft", reason="LoRA needs peft")
    place = tmp_path_factory.mktemp("teachers")
    (place / "empty").mkdir()
    write_small_family(place / "family")
    quiet(tiny("x-to-touch", family=place / "family")).save_pretrained(place / "gels")
    make_pipelines()["touch-to-image"].save_pretrained(place / "teacher")
    other = shutil.copytree(place / "teacher", place / "other")
    (other / "model_index.json").write_text('{"_class_name": "StableDiffusionPipeline"}')
    broken = shutil.copytree(place / "teacher", place / "broken")
    shutil.rmtree(broken / "unet")
    for number in range(2):
        for kind in ("touch", "picture"):
            write_image(place / "mine" / kind / f"{number}.png", (200, 100, 20 * number))
    return place


@pytest.mark.parametrize(("folder", "setting", "said"), DISTILLED)
def test_a_pipeline_that_cannot_be_distilled_is_one_line(run, teachers, cache, tmp_path, folder, setting, said):
    words = ["distill", "--model", str(teachers / folder), "--output", str(tmp_path / "run"), "--cache", str(cache)]
    sets = json.dumps([{"path": str(teachers / "mine"), "sensor": "digit"}])
    drawn = "data.drawn=null" if "{sets}" in setting else DRAWN
    for one in filter(None, (drawn, "trainer.steps=2", "trainer.batch_size=8", setting.replace("{sets}", sets))):
        words += ["--set", one]
    assert said in run(*words)
    assert not (tmp_path / "run").exists()


# Recipes --------------------------------------------------------------------------------------------------------------

RECIPES = [  # names, what is replaced in them, the name of what is wrong, and what is said
    ("touch", "steps=3", "set", r"is 'steps=3'; write section\.key=value"),
    ("touch", "trainer.steps=[1", "set", r"is 'trainer\.steps=\[1', which is no YAML"),
    ("touch", "trianer.steps=3", "trianer", r"In `recipe`.* is unknown; there are .*mean 'trainer'\?$"),
    ("touch", "trainer.stpes=3", "stpes", r"In `trainer`.* is unknown; .*Did you mean 'steps'\?$"),
    ("touch", "trainer.batch_size=null", "trainer.batch_size", "is None; it has to be a valid integer"),
    ("touch", "trainer.steps=0", "trainer.steps", "is 0; it has to be greater than 0"),
    ("touch", "trainer.mixed_precision=int8", "trainer.mixed_precision", "is 'int8'; it has to be 'no', "),
    ("touch", f"trainer.seed={2**64}", "trainer.seed", f"is {2**64}; it has to be less than"),
    ("touch", f"data.drawn.seed={2**64}", "data.drawn.seed", f"is {2**64}; it has to be less than"),
    ("touch", "trainer.epochs=3", "epochs", "In `trainer`, `steps` is 1700 and `epochs` 3"),
    ("touch_pairs", "objective.touch=0 objective.attributes=0 objective.maps=0", "objective", "weighs nothing"),
    ("unclip", "objective.caption_share=0.9", "caption_share", "In `objective`.* and `empty_share` are more than 1"),
]


@pytest.mark.parametrize(("name", "overrides", "named", "said"), RECIPES)
def test_what_is_wrong_in_a_recipe_is_named(name, overrides, named, said):
    check_refusal(partial(read_as, name, *overrides.split()), named, said)


FILES = [
    (b"data: {image_size: 1}", "trainer", "is missing in the recipe"),
    (b"trainer: 3", "trainer", "is 3; it has to be a valid dictionary"),
    (b"trainer: {steps: [1", "recipe", "cannot be read"),
    (b"trainer: !!python/object/apply:os.system ['true']", "recipe", "cannot be read"),
    (b"data: {base: taste}", "data.base", "names 'taste', which does not exist"),
]


@pytest.mark.parametrize(("content", "named", "said"), FILES)
def test_a_file_that_is_no_recipe_is_refused(tmp_path, content, named, said):
    (tmp_path / "mine.yaml").write_bytes(content)
    check_refusal(lambda: read(Recipe, {"data": {}} | read_recipe(tmp_path / "mine.yaml")), named, said)


LIBRARIES = [
    ({"smaple_size": 3}, "smaple_size", "In `model`.* is unknown.*mean 'sample_size'"),
    ({"block_out_channels": [8]}, "model", "cannot be used: .*block_out_channels"),
]


@pytest.mark.parametrize(("arguments", "named", "said"), LIBRARIES)
def test_what_a_library_refuses_to_build_is_one_line(arguments, named, said):
    check_refusal(partial(build, "model", UNet2DConditionModel, arguments), named, said)


def test_a_batch_of_more_than_there_is_and_a_target_that_is_not_learnt_are_refused():
    check_refusal(partial(shuffled_indices, 0, 5, 64), "batch_size", "is 64, but there are 5 samples")
    network: Any = UNet2DConditionModel
    scheduler = DDPMScheduler(prediction_type="sample")
    loss = partial(denoising_loss, network, scheduler, torch.randn(2, 4, 4, 4), 1.0)
    check_refusal(loss, "scheduler", "predicts 'sample'")
