"""What the stages share: command lines, cached embeddings, the folders and the record a stage leaves."""

import copy
import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open

from unitouch_gen.encoders import UniTouchModel, UniTouchProcessor
from unitouch_gen.encoders.pixels import normalise_pixels
from unitouch_gen.training.core import RECIPES, TrainerConfig, read_recipe
from unitouch_gen.training.data import Rendered
from unitouch_gen.training.stages import (
    Stage,
    data_key,
    image_embeddings,
    joint_of,
    parse,
    save_senses,
    training_splits,
    weights_hash,
    write_record,
)
from unitouch_gen.training.touch import set_prototypes
from unitouch_gen.world import COLLECTIONS, TRAINING_COLLECTIONS

PICTURES = np.random.default_rng(0).integers(0, 256, (7, 3, 32, 32), dtype=np.uint8)


def stage(output: Path, **data: object) -> Stage:
    recipe = {"data": {"contacts_per_object": 2, **data}, "trainer": {}, "other": {"a": 1}}
    return Stage("touch", recipe, TrainerConfig(10, 4, 0.1, seed=5), output, output / "cache", False, folders={})


# Commands -------------------------------------------------------------------------------------------------------------


def arguments(monkeypatch: pytest.MonkeyPatch, *words: str) -> None:
    monkeypatch.setattr(sys, "argv", ["stage", *words])


def test_a_command_without_arguments_is_the_stages_own_recipe(monkeypatch: pytest.MonkeyPatch) -> None:
    arguments(monkeypatch)
    parsed = parse("image_text")
    assert parsed.recipe == read_recipe("image_text")
    assert (parsed.output, parsed.cache, parsed.resume) == (Path("runs/image_text"), Path("runs/cache"), False)


def test_a_command_sets_what_it_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    arguments(monkeypatch, "--joint", "j", "--output", str(tmp_path), "--resume", "--set", "trainer.steps=7", "--set",
              "sampler.sigma=0.5")  # fmt: skip
    parsed = parse("touch", needs=("joint",))
    assert parsed.trainer.steps == 7 and parsed.recipe["sampler"]["sigma"] == 0.5
    assert parsed.folders == {"joint": Path("j")} and parsed.output == tmp_path and parsed.resume


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--set", "trainer.stpes=3"], "`set` is 'trainer.stpes=3'"),
        (["--set", "trainer.steps=-3"], "`steps` is -3"),
        (["--set", "trainer.steps=many"], "`steps` is 'many'"),
        (["--recipe", "taste"], "`recipe` is 'taste'"),
    ],
)
def test_a_mistake_in_a_command_ends_it_with_a_line(
    words: list[str], message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments(monkeypatch, *words)
    with pytest.raises(SystemExit) as stopped:
        parse("audio")
    assert stopped.value.code == 2
    assert message in capsys.readouterr().err.splitlines()[-1]


def test_a_command_without_the_stage_before_it_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments(monkeypatch)
    with pytest.raises(SystemExit):
        parse("touch", needs=("joint",))
    assert "--joint" in capsys.readouterr().err


@pytest.mark.parametrize("name", sorted(path.stem for path in RECIPES.glob("*.yaml")))
def test_every_recipe_is_of_a_stage(name: str) -> None:
    assert (RECIPES.parent / f"{name}.py").is_file()


def test_the_recipes_joint_space_is_one_the_paper_would_recognise() -> None:
    config = joint_of(read_recipe("image_text"))
    assert (config.temperature, config.sensor_tokens, len(config.sensors)) == (0.07, 5, 3)


def test_in_batch_sampling_is_the_papers() -> None:
    assert read_recipe("touch")["sampler"]["sigma"] == 0.75


# Data -----------------------------------------------------------------------------------------------------------------


def test_the_four_training_collections_are_the_default(tmp_path: Path) -> None:
    assert data_key(stage(tmp_path)) == data_key(stage(tmp_path, collections=list(TRAINING_COLLECTIONS))) == "train2"


def test_other_pictures_have_another_key(tmp_path: Path) -> None:
    wanted = [{}, {"contacts_per_object": 3}, {"collections": ["ycb_slide"]}, {"collections": ["ycb_slide", "ssvtp"]}]
    keys = [data_key(stage(tmp_path, **data)) for data in wanted]
    assert len(set(keys)) == len(keys)


def test_a_recipe_may_name_its_collections(
    tmp_path: Path, split: Rendered, cache: Path, processor: UniTouchProcessor
) -> None:
    for name in ("taxim", "gelslim"):  # a training split takes long to render, so a small one stands in for it
        collection = next(c.name for c in COLLECTIONS.values() if c.sensor == name)
        shutil.copytree(cache / "ssvtp-val-1-seed0", tmp_path / "cache" / f"{collection}-train-1-seed0")
    wanted = stage(tmp_path, collections=["object_folder_real", "object_folder_2"], contacts_per_object=1)
    assert [part.sensor for part in training_splits(wanted, processor)] == ["gelslim", "taxim"]


def test_a_prototype_is_the_mean_raw_image_of_its_sensor(model: UniTouchModel, split: Rendered) -> None:
    rng = np.random.default_rng(0)
    others = [copy.copy(split) for _ in range(2)]
    for other in others:
        other.sensor, other.touch = "gelsight", rng.integers(0, 256, (rng.integers(3, 9), 3, 32, 32), dtype=np.uint8)
    set_prototypes(model, [others[0], split, others[1]])
    both = np.concatenate([other.touch for other in others])
    np.testing.assert_allclose(model.sensor_bank.prototype("gelsight"), both.mean(axis=0) / 255, atol=1e-6)
    np.testing.assert_allclose(model.sensor_bank.prototype("digit"), split.touch.mean(axis=0) / 255, atol=1e-6)


# Embeddings and hashes ------------------------------------------------------------------------------------------------


def test_embeddings_are_the_encoders(model: UniTouchModel, tmp_path: Path) -> None:
    embeds = image_embeddings(model, [PICTURES[:4], PICTURES[4:]], "k", tmp_path, batch_size=3)
    with torch.no_grad():
        expected = model.get_image_features(normalise_pixels(torch.from_numpy(PICTURES) / 255.0))
    torch.testing.assert_close(embeds, expected)


def test_embeddings_are_computed_once(model: UniTouchModel, tmp_path: Path) -> None:
    first = image_embeddings(model, [PICTURES], "k", tmp_path)
    assert torch.equal(image_embeddings(model, [], "k", tmp_path), first)  # no picture is looked at
    assert [path.suffix for path in tmp_path.iterdir()] == [".pt"]


def test_a_changed_encoder_has_its_embeddings_computed_anew(model: UniTouchModel, tmp_path: Path) -> None:
    first = image_embeddings(model, [PICTURES], "k", tmp_path)
    with torch.no_grad():
        model.vision_model.visual_projection.weight[3, 5] += 1.0
    assert not torch.equal(image_embeddings(model, [PICTURES], "k", tmp_path), first)


def test_other_pictures_have_embeddings_of_their_own(model: UniTouchModel, tmp_path: Path) -> None:
    image_embeddings(model, [PICTURES], "k", tmp_path)
    assert len(image_embeddings(model, [PICTURES[:2]], "other", tmp_path)) == 2


def test_a_hash_changes_with_any_weight(model: UniTouchModel) -> None:
    module = model.touch_model
    hashes = {weights_hash(module)}
    for parameter in module.parameters():
        with torch.no_grad():
            parameter.view(-1)[-1] += 1e-4
        hashes.add(weights_hash(module))
    assert len(hashes) == 1 + len(list(module.parameters()))


def test_a_hash_follows_from_the_weights_alone(model: UniTouchModel) -> None:
    assert weights_hash(copy.deepcopy(model.touch_model).train()) == weights_hash(model.touch_model)


# What a stage leaves --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("senses", [("image", "text"), ("audio",), ("touch",)])
def test_saved_senses_are_read_back_as_they_were(
    senses: tuple[str, ...], model: UniTouchModel, processor: UniTouchProcessor, tmp_path: Path
) -> None:
    model.sensor_bank.set_prototype("digit", torch.rand(3, 32, 32))
    save_senses(model, senses, processor, tmp_path / "model")
    again = UniTouchModel.from_pretrained(tmp_path / "model", senses=senses)
    assert again.loaded_senses == senses
    expected = model.state_dict()
    assert again.state_dict().keys() and all(torch.equal(t, expected[key]) for key, t in again.state_dict().items())


def test_only_the_senses_asked_for_are_saved(
    model: UniTouchModel, processor: UniTouchProcessor, tmp_path: Path
) -> None:
    save_senses(model, ("touch",), processor, tmp_path / "model")
    with safe_open(tmp_path / "model" / "model.safetensors", framework="pt") as file:
        assert {key.partition(".")[0] for key in file.keys()} == {"touch_model", "sensor_bank"}  # noqa: SIM118


def test_the_processor_is_saved_beside_the_senses(
    model: UniTouchModel, processor: UniTouchProcessor, tmp_path: Path
) -> None:
    save_senses(model, ("image",), processor, tmp_path / "model")
    again = UniTouchProcessor.from_pretrained(tmp_path / "model")
    assert (again.image_size, again.audio) == (processor.image_size, processor.audio)
    assert again.text("rough brick")["input_ids"].tolist() == processor.text("rough brick")["input_ids"].tolist()


def test_saving_again_replaces_what_was_there(
    model: UniTouchModel, processor: UniTouchProcessor, tmp_path: Path
) -> None:
    for senses in (("image", "text"), ("audio",)):
        save_senses(model, senses, processor, tmp_path / "model")
    assert [path.name for path in tmp_path.iterdir()] == ["model"]
    with safe_open(tmp_path / "model" / "model.safetensors", framework="pt") as file:
        assert {key.partition(".")[0] for key in file.keys()} == {"audio_model"}  # noqa: SIM118


def test_the_record_says_how_the_weights_came_about(tmp_path: Path) -> None:
    write_record(stage(tmp_path), 12.34, psnr=30.0)
    record = json.loads((tmp_path / "record.json").read_text())
    assert (record["stage"], record["seed"], record["seconds"], record["psnr"]) == ("touch", 5, 12.3, 30.0)
    assert record["trainer"]["steps"] == 10 and record["recipe"]["other"] == {"a": 1}
    assert "commit" in record and [path.name for path in tmp_path.iterdir()] == ["record.json"]
