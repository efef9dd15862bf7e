"""What the stages share: command lines, cached embeddings, the folders and the record a stage leaves."""

import copy
import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open

from unitouch_gen.errors import InvalidInputError, NonFiniteError
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.training import audio, image_text, touch, touch_ldm, unclip
from unitouch_gen.training.autoencoder import train_autoencoder
from unitouch_gen.training.classifier import train_classifier
from unitouch_gen.training.data import Rendered
from unitouch_gen.training.recipe import BASE, RECIPES, DataConfig, TrainerConfig, read_recipe
from unitouch_gen.training.stages import (
    STAGES,
    Stage,
    command,
    data_key,
    image_embeddings,
    joint_of,
    parse,
    save_modalities,
    training_splits,
    weights_hash,
    write_record,
)
from unitouch_gen.world import TRAINING_COLLECTIONS

PICTURES = np.random.default_rng(0).integers(0, 256, (7, 3, 32, 32), dtype=np.uint8)


def stage(output: Path, **data: object) -> Stage:
    config = DataConfig(**{"contacts_per_object": 2, **data})  # type: ignore[arg-type]
    recipe = {"trainer": {}, "other": {"a": 1}}
    trainer = TrainerConfig(10, 4, 0.1, seed=5)
    return Stage("touch", recipe, trainer, config, output, output / "cache", resume=False, folders={}, commit="abc",
                 inputs={"joint": "0123"})  # fmt: skip


# Commands -------------------------------------------------------------------------------------------------------------


def arguments(monkeypatch: pytest.MonkeyPatch, *words: str) -> None:
    monkeypatch.setattr(sys, "argv", ["stage", *words])


def test_a_command_without_arguments_is_the_stages_own_recipe(monkeypatch: pytest.MonkeyPatch) -> None:
    arguments(monkeypatch)
    parsed = parse("image_text")
    assert parsed.recipe == read_recipe("image_text")
    assert (parsed.output, parsed.cache, parsed.resume) == (Path("runs/image_text"), Path("runs/cache"), False)


def test_a_command_sets_what_it_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, joint: str) -> None:
    arguments(monkeypatch, "--joint", joint, "--output", str(tmp_path / "out"), "--set", "trainer.steps=7", "--set",
              "sampler.sigma=0.5", "--set", "data.world_seed=3")  # fmt: skip
    parsed = parse("touch")
    assert parsed.trainer.steps == 7 and parsed.recipe["sampler"]["sigma"] == 0.5 and parsed.data.world_seed == 3
    assert parsed.folders == {"joint": Path(joint)} and parsed.output == tmp_path / "out" and not parsed.resume


def test_a_model_whose_writing_was_killed_between_the_renames_is_found(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, joint: str
) -> None:
    Path(joint).rename(tmp_path / "joint.old")
    arguments(monkeypatch, "--joint", joint)
    assert parse("touch").folders == {"joint": Path(joint)}


@pytest.mark.parametrize(
    ("name", "words", "message"),
    [
        ("image_text", ["--set", "trainer=3"], "`set` is 'trainer=3'; write section.key=value"),
        ("image_text", ["--set", "trianer.steps=3"], "no section `trianer`"),
        ("image_text", ["--set", "trainer.stpes=3"], "`trainer` holds ['stpes']"),
        ("image_text", ["--set", "data.wrold_seed=3"], "`data` holds ['wrold_seed']"),
        ("image_text", ["--set", "tokenizer.size=3"], "`tokenizer` holds ['size']; its keys are ['max_length', 'voc"),
        ("image_text", ["--set", "model.audio_config.size=3"], "`model.audio_config` holds ['size']"),
        ("image_text", ["--set", "trainer.steps=-3"], "`steps` is -3"),
        ("image_text", ["--set", "trainer.steps=many"], "`steps` is 'many'"),
        ("image_text", ["--set", "trainer.optimizer=sgd"], "`optimizer` is 'sgd'"),
        ("image_text", ["--set", "data.collections=world_digit"], "`collections` is 'world_digit'"),
        ("image_text", ["--recipe", "taste"], "`recipe` is 'taste'"),
        ("image_text", ["--recipe", "data"], "`recipe` has no section `trainer`"),
        ("image_text", ["--output", "{joint}/config.json"], "config.json', which is a file; name a folder"),
        ("touch_vae", ["--resume"], "`resume` finds no checkpoint in 'runs/touch_vae'"),
        ("touch_vae", ["--set", "model.class=AutoencoderKL"], "`model.class` is 'AutoencoderKL'"),
        ("touch_vae", ["--set", "model.latent_channel=3"], "`model` holds ['latent_channel']"),
        ("touch_vae", ["--set", "loss.latent_noise=-1"], "`latent_noise` is -1"),
        ("touch_classifier", ["--set", "augment.blur=2"], "`blur` is 2"),
        ("touch_classifier", ["--set", "model.dephts=2"], "Did you mean 'depths'?"),
        ("audio", ["--joint", "nowhere"], "`joint` is 'nowhere', which holds no model"),
        ("touch", ["--joint", "{joint}", "--set", "sampler.sigma=2"], "In `sampler`, `sigma` is 2"),
        ("touch", ["--joint", "{joint}", "--set", "sampler.sgima=2"], "`sampler` holds ['sgima']"),
        ("touch", ["--joint", "{joint}", "--set", "augment.turn=2"], "`turn` is 2"),
        ("unclip", ["--joint", "{joint}", "--vae", "nowhere"], "`vae` is 'nowhere'"),
        ("unclip", ["--joint", "{joint}", "--vae", "{joint}", "--init", "nowhere"], "`init` is 'nowhere'"),
        (
            "unclip",
            ["--joint", "{joint}", "--vae", "{joint}", "--set", "objective.condition_dropout=2"],
            "`condition_dropout` is 2",
        ),
        (
            "touch_ldm",
            ["--joint", "{joint}", "--vae", "{joint}", "--set", "embedding_bank.size=0"],
            "In `embedding_bank`, `size` is 0",
        ),
        ("unclip", ["--joint", "{joint}", "--vae", "{vae}", "--set", "model.smaple_size=3"], "mean 'sample_size'?"),
        ("unclip", ["--joint", "{joint}", "--vae", "{vae}", "--set", "scheduler.beta=3"], "`scheduler` holds ['beta']"),
        ("touch_ldm", ["--joint", "{joint}", "--vae", "{vae}", "--set", "model.num_class_embeds=3"], "`model` holds"),
        ("touch_ldm", ["--joint", "{joint}", "--vae", "{vae}", "--set", "scheduler.beta=3"], "`scheduler` holds"),
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
    arguments(monkeypatch, *(word.format(joint=joint, vae=vae) for word in words))
    with pytest.raises(SystemExit) as stopped:
        MAINS[name]()
    assert stopped.value.code == 2
    error = capsys.readouterr().err.splitlines()
    assert len(error) == 1 and message in error[0]
    assert list((tmp_path / "here").iterdir()) == []


MAINS: dict[str, Callable[[], None]] = {
    "image_text": image_text.main,
    "audio": audio.main,
    "touch": touch.main,
    "unclip": unclip.main,
    "touch_ldm": touch_ldm.main,
    "touch_vae": lambda: train_autoencoder("touch_vae", "touch"),
    "touch_classifier": lambda: train_classifier("touch_classifier", "touch"),
}


def test_a_command_in_several_processes_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")  # as `accelerate launch --num_processes 2` does
    arguments(monkeypatch)
    with pytest.raises(InvalidInputError, match="`num_processes` is 2"):
        parse("image_text")


def test_a_loss_that_is_not_finite_ends_a_command_with_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    @command
    def main() -> None:
        raise NonFiniteError("The loss is nan.")

    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 2
    assert capsys.readouterr().err.splitlines() == ["unitouch_gen.training: The loss is nan."]


def test_a_mistake_of_ours_is_not_hidden() -> None:
    @command
    def main() -> None:
        raise KeyError("model")

    with pytest.raises(KeyError):
        main()


def test_a_command_without_the_stage_before_it_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments(monkeypatch)
    with pytest.raises(SystemExit):
        parse("touch")
    assert "--joint" in capsys.readouterr().err


@pytest.mark.parametrize("name", sorted(path.stem for path in RECIPES.glob("*.yaml")))
def test_every_recipe_is_of_a_stage(name: str) -> None:
    assert name == BASE or name.removesuffix("_paper") in STAGES


@pytest.mark.parametrize("name", STAGES)
def test_every_stage_has_a_recipe_and_takes_what_came_before(name: str) -> None:
    assert (RECIPES / f"{name}.yaml").is_file() and (RECIPES.parent / f"{name}.py").is_file()
    before = list(STAGES)[: list(STAGES).index(name)]
    assert set(STAGES[name].values()) <= set(before)


def test_the_recipes_joint_space_is_one_the_paper_would_recognise() -> None:
    config = joint_of(read_recipe("image_text"))
    assert (config.temperature, config.sensor_tokens, len(config.sensors)) == (0.07, 5, 3)


def test_in_batch_sampling_is_the_papers() -> None:
    assert read_recipe("touch")["sampler"]["sigma"] == 0.75


# Data -----------------------------------------------------------------------------------------------------------------


def test_the_key_of_the_four_training_collections_is_short(tmp_path: Path, split: Rendered) -> None:
    assert data_key(stage(tmp_path), [split]).startswith("train2-")
    assert data_key(stage(tmp_path, collections=list(TRAINING_COLLECTIONS)), [split]).startswith("train2-")


def test_other_pictures_have_another_key(tmp_path: Path, split: Rendered) -> None:
    wanted = [
        {},
        {"contacts_per_object": 3},
        {"collections": ["world_digit"]},
        {"collections": ["world_digit", "world_digit_unseen"]},
    ]
    keys = [data_key(stage(tmp_path, **data), [split]) for data in wanted]
    assert len(set(keys)) == len(keys)


def test_pictures_of_another_world_have_another_key(tmp_path: Path, split: Rendered) -> None:
    other = replace(split, fingerprint="0123456789abcdef")
    assert data_key(stage(tmp_path), [split]) != data_key(stage(tmp_path), [other])


def test_a_recipe_may_name_its_data(tmp_path: Path, processor: UniTouchProcessor) -> None:
    data = {"collections": ["world_gelslim", "world_tacto"], "contacts_per_object": 1, "world_seed": 3}
    splits = training_splits(stage(tmp_path, **data, touch_size=16), processor)
    assert [part.sensor for part in splits] == ["gelslim", "tacto"]
    assert {part.image.shape[1:] for part in splits} == {(3, 32, 32)}
    assert {part.touch.shape[1:] for part in splits} == {(3, 16, 16)}
    names = {path.name for path in (tmp_path / "cache").iterdir()}
    assert "world_gelslim-train-1-seed3" in names and len(names) == 4


def test_a_prototype_is_the_mean_raw_image_of_its_sensor(model: UniTouchModel, split: Rendered) -> None:
    rng = np.random.default_rng(0)
    others = [copy.copy(split) for _ in range(2)]
    for other in others:
        other.sensor, other.touch = "gelsight", rng.integers(0, 256, (rng.integers(3, 9), 3, 32, 32), dtype=np.uint8)
    touch.set_prototypes(model, [others[0], split, others[1]])
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
    assert [path.suffix for path in tmp_path.iterdir()] == [".safetensors"]


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


def test_saving_again_replaces_what_was_there(
    model: UniTouchModel, processor: UniTouchProcessor, tmp_path: Path
) -> None:
    for modalities in (("image", "text"), ("audio",)):
        save_modalities(model, modalities, processor, tmp_path / "model")
    assert [path.name for path in tmp_path.iterdir()] == ["model"]
    with safe_open(tmp_path / "model" / "model.safetensors", framework="pt") as file:
        assert {key.partition(".")[0] for key in file.keys()} == {"audio_model"}  # noqa: SIM118


def test_the_record_says_how_the_weights_came_about(tmp_path: Path) -> None:
    write_record(stage(tmp_path), 12.34, psnr=30.0)
    record = json.loads((tmp_path / "record.json").read_text())
    assert (record["stage"], record["seed"], record["seconds"], record["psnr"]) == ("touch", 5, 12.3, 30.0)
    assert record["trainer"]["steps"] == 10 and record["recipe"]["other"] == {"a": 1}
    assert record["commit"] == "abc" and record["inputs"] == {"joint": "0123"}
    assert [path.name for path in tmp_path.iterdir()] == ["record.json"]
