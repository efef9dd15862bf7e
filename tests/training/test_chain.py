"""All stages, one after another as a person would run them, with two steps each: from nothing to a picture."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from safetensors import safe_open

from unitouch_gen.models import UniTouchModel
from unitouch_gen.pipelines.tiny import tiny
from unitouch_gen.world import MATERIAL_NAMES, SENSORS, World, untouched_gel

pytestmark = pytest.mark.slow

STAGES: dict[str, tuple[str, ...]] = {
    "image_text": (),
    "audio": ("--joint", "runs/image_text/model"),
    "touch": ("--joint", "runs/image_text/model"),
    "image_vae": (),
    "unclip": ("--joint", "runs/image_text/model", "--vae", "runs/image_vae/model"),
    "picture_classifier": (),
    "touch_vae": (),
    "touch_ldm": ("--joint", "runs/image_text/model", "--vae", "runs/touch_vae/model"),
    "touch_classifier": (),
}
SHORT = {
    "data.drawn": "{sensors: [null, gelsight, digit], objects: 1, contacts_per_object: 1, held_out: 1}",
    "trainer.steps": "2",
    "trainer.batch_size": "8",
    "trainer.warmup": "1",
    "trainer.save_every": "1",
}


def run(folder: Path, module: str, *words: str) -> None:
    command = [sys.executable, "-m", f"unitouch_gen.training.{module}", *words]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]


def stage(folder: Path, name: str, *words: str, short: dict[str, str] = SHORT) -> None:
    overrides = [word for key, value in short.items() for word in ("--set", f"{key}={value}")]
    run(folder, name, *STAGES[name], *overrides, *words)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where all stages have run and were assembled into `family`."""
    folder = tmp_path_factory.mktemp("chain")
    for name in STAGES:
        stage(folder, name)
    run(folder, "assemble", "--runs", "runs", "--output", "family")
    return folder


@pytest.fixture(scope="module")
def family(folder: Path) -> Path:
    return folder / "family"


def test_a_touch_becomes_a_picture(family: Path) -> None:
    pipe = tiny("touch-to-image", family=family)
    pipe.set_progress_bar_config(disable=True)
    touch = World(0).render([0], [0], [0], modalities=("touch",)).touch["gelsight"]
    output = pipe(touch, num_inference_steps=2, output_type="np")
    assert np.asarray(output.images).shape == (1, 128, 128, 3) and np.isfinite(output.images).all()


@pytest.mark.parametrize("name", STAGES)
def test_every_stage_is_on_record(name: str, family: Path) -> None:
    record = json.loads((family / "family.json").read_text())["training"][name]
    assert record["trainer"]["steps"] == 2 and record["seconds"] > 0


def test_every_weight_is_stored_in_half_precision_once(family: Path) -> None:
    kinds: dict[str, set[str]] = {}
    for path in family.rglob("*.safetensors"):
        with safe_open(path, framework="pt") as file:
            kinds[str(path.relative_to(family))] = {str(file.get_slice(key).get_dtype()) for key in file.keys()}  # noqa: SIM118
    # the joint space; of pictures and of touches the autoencoder, the UNet and the
    # classifier; the normaliser, the bank, and what sensors see untouched
    assert len(kinds) == 10
    assert all(kind <= {"F16", "BOOL", "I64"} for kind in kinds.values())


def test_the_sensors_are_those_of_the_data(family: Path) -> None:
    model = UniTouchModel.from_pretrained(family / "joint", modalities=("touch",))
    assert model.sensor_bank.names == ("gelsight", "digit")
    for name in model.sensor_bank.names:
        assert 0.05 < model.sensor_bank.prototype(name).mean() < 0.95


def test_a_touch_retrieves_the_sensor_it_is_from(family: Path) -> None:
    pipe = tiny("touch-to-image", family=family)
    touches = World(0).render([3] * 4, range(4), [0] * 4, modalities=("touch",), sensors=("digit", "gelsight")).touch
    for name, images in touches.items():
        matches = pipe.unitouch.match_sensors(pipe.processor.touch(images))
        assert [match.name for match in matches] == [name] * 4


def test_embeddings_have_the_norm_the_conditioning_expects(family: Path) -> None:
    pipe = tiny("touch-to-image", family=family)
    images = World(0).render(range(16), [0] * 16, [0] * 16, modalities=("image",)).image
    norm = pipe.unitouch.get_image_features(pipe.processor.images(images)).norm(dim=1).mean().item()
    assert norm == pytest.approx(pipe.unitouch.config.embedding_norm, rel=0.2)


@pytest.mark.parametrize("classifier", ["picture-classifier", "touch-classifier"])
def test_the_classifiers_know_the_materials(family: Path, classifier: str) -> None:
    labels = json.loads((family / classifier / "config.json").read_text())["id2label"]
    assert [labels[str(number)] for number in range(len(labels))] == list(MATERIAL_NAMES)


@pytest.mark.parametrize("sensor", ["gelsight", "digit"])
def test_words_become_a_touch_of_each_sensor(sensor: str, family: Path) -> None:
    pipe = tiny("x-to-touch", family=family)
    pipe.set_progress_bar_config(disable=True)
    output = pipe(text="rough brick", sensor=sensor, num_inference_steps=2, output_type="np")
    assert np.asarray(output.images).shape == (1, 128, 128, 3) and np.isfinite(output.images).all()


def test_a_stage_goes_on_for_more_steps(folder: Path) -> None:
    stage(folder, "touch", "--set", "trainer.steps=3", "--resume", "--override", "--output", "runs/touch")
    progress = json.loads((folder / "runs" / "touch" / "checkpoints" / "step-00000003" / "progress.json").read_text())
    assert progress["step"] == 3


def test_the_cache_is_shared_by_the_stages(folder: Path) -> None:
    names = sorted(
        path.name.rpartition("-train-")[0] for path in (folder / "runs" / "cache").iterdir() if path.is_dir()
    )
    assert names == ["drawn-any", "drawn-digit", "drawn-gelsight", "grasps-any", "grasps-gelsight"]
    # of drawn contacts, and of these with grasps, which touches alone are bound to
    for kind, count in {"image-embeddings": 2, "image-latents": 1, "touch128-latents": 1}.items():
        assert len(list((folder / "runs" / "cache").glob(f"{kind}-*.safetensors"))) == count


def test_a_family_draws_a_sensor_by_its_name_and_by_its_background(family: Path) -> None:
    pipe = tiny("x-to-touch", family=family)
    pipe.set_progress_bar_config(disable=True)
    assert pipe.config.sensors == ["gelsight", "digit"] and pipe.takes_background
    gel = untouched_gel(SENSORS["digit"], 64)
    made = [
        np.asarray(pipe(text="rough brick", num_inference_steps=2, output_type="np", **drawn).images)
        for drawn in ({"sensor": "digit"}, {"background": gel})
    ]
    assert all(image.shape == (1, 128, 128, 3) and np.isfinite(image).all() for image in made)


def test_a_family_makes_pictures_of_16_by_16_latents(family: Path) -> None:
    pipe = tiny("touch-to-image", family=family)
    pipe.set_progress_bar_config(disable=True)
    touch = World(0).render([0], [0], [0], modalities=("touch",), sensors=("digit",)).touch["digit"]
    picture = pipe(touch, num_inference_steps=2, output_type="np").images
    assert pipe.vae_scale_factor == 8 and picture.shape == (1, 128, 128, 3) and np.isfinite(picture).all()
