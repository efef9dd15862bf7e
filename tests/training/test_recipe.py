"""Recipes: every one in the folder is understood, overrides are laid over them, and what is wrong is named."""

import re
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import torch
from diffusers import DDPMScheduler, UNet2DConditionModel

from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.models import UniTouchConfig
from unitouch_gen.models.autoencoders import autoencoder_class
from unitouch_gen.training.family import STAGES
from unitouch_gen.training.recipe import RECIPES, build, read, read_recipe
from unitouch_gen.training.stages import Recipe

NAMES = sorted({path.stem for path in RECIPES.glob("*.yaml")} - {"data", "data_scanned"})


def read_as(name: str, *overrides: str) -> Any:
    stage = re.sub("_(paper|pairs|lamps)$", "", name)
    main = import_module(f"unitouch_gen.training.{STAGES[stage].module or stage}").main
    return read(main.__annotations__["recipe"], read_recipe(name, overrides))


def autoencoder_of(model: dict[str, Any]) -> Any:
    kind = autoencoder_class("model.class", model["class"])
    return build("model", kind, {key: value for key, value in model.items() if key != "class"})


@pytest.mark.parametrize("name", NAMES)
def test_every_recipe_is_read_and_built(name: str) -> None:
    recipe = read_as(name)
    assert recipe.data.sets == [] and (recipe.data.drawn is None) == name.endswith("_paper")
    with torch.device("meta"):
        if name == "image_text":
            config = build("model", UniTouchConfig, recipe.model)
            assert (config.temperature, config.sensor_tokens, len(config.sensors)) == (0.07, 5, 4)  # as the paper's
        elif "vae" in name and "paper" in name:
            autoencoder_of(recipe.model)
        elif hasattr(recipe, "scheduler"):
            build("model", UNet2DConditionModel, recipe.model)
    if hasattr(recipe, "scheduler"):
        build("scheduler", DDPMScheduler, recipe.scheduler)


def test_the_papers_networks_have_its_sizes() -> None:
    vae_recipe, recipe, touch = (read_as(f"{name}_paper") for name in ("touch_vae", "touch_ldm", "touch"))
    with torch.device("meta"):
        vae = autoencoder_of(vae_recipe.model)
        latents = vae.encode(torch.empty(1, 3, 256, 256)).latents
        unet = UNet2DConditionModel(**recipe.model, num_class_embeds=3)
        token, sensor = torch.empty(1, 1, 1024), torch.zeros(1, dtype=torch.int64)
        sample = unet(latents, torch.zeros(1), token, class_labels=sensor).sample
    assert vae_recipe.data.touch_size == 256 and latents.shape == sample.shape == (1, 3, 64, 64)
    assert vae.quantize.embedding.weight.shape == (8192, 3)
    assert 8.2e8 < sum(parameter.numel() for parameter in unet.parameters()) < 9.1e8  # Stable Diffusion 1: 0.86e9
    assert (recipe.trainer.weight_decay, recipe.trainer.learning_rate, recipe.trainer.batch_size) == (0.0, 1e-6, 48)
    assert (touch.sampler.sigma, touch.sensors.tokens, touch.trainer.epochs) == (0.75, 5, 150)


def test_an_override_takes_the_kind_of_value_it_looks_like_and_leaves_the_rest() -> None:
    plain = read_recipe("touch")
    for text, value in {"12": 12, "1e-3": 1e-3, "adam": "adam", "[a, b]": ["a", "b"], "null": None}.items():
        changed = read_recipe("touch", ["trainer.steps=1", f"trainer.steps={text}"])
        plain["trainer"]["steps"] = value
        assert changed == plain


def test_data_of_a_recipe_is_laid_over_its_base_and_sets_stand_in_for_what_that_draws(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text("{image_size: 16, touch_size: 3, drawn: {sensors: [digit]}}")
    mine = tmp_path / "mine.yaml"
    mine.write_text(f"data: {{base: {tmp_path / 'base.yaml'}, touch_size: 4}}")
    based = {"image_size": 16, "touch_size": 4}
    drawn = {"drawn": {"sensors": ["digit"]}}
    sets = {"sets": [{"path": "a"}]}
    assert read_recipe(mine)["data"] == based | drawn
    assert read_recipe(mine, ["data.sets=[{path: a}]"])["data"] == based | sets
    assert read_recipe(mine, ["data.sets=[{path: a}]", "data.drawn.sensors=[digit]"])["data"] == based | drawn | sets


def test_what_is_wrong_in_a_recipe_is_named_in_a_line() -> None:
    for name, override, message in (
        ("touch", "steps=3", r"`set` is 'steps=3'; write section\.key=value"),
        ("touch", "trainer.steps=[1", r"`set` is 'trainer\.steps=\[1', which is no YAML"),
        ("touch", "trianer.steps=3", r"In `recipe`, `trianer` is unknown; there are \['augment', .*mean 'trainer'\?$"),
        ("touch", "trainer.stpes=3", r"In `trainer`, `stpes` is unknown; .*Did you mean 'steps'\?$"),
        ("touch", "trainer.batch_size=null", r"`trainer\.batch_size` is None; it has to be a valid integer"),
        ("touch", "trainer.steps=0", r"`trainer\.steps` is 0; it has to be greater than 0"),
        ("touch", "trainer.mixed_precision=int8", r"`trainer\.mixed_precision` is 'int8'; it has to be 'no', "),
        ("touch", f"trainer.seed={2**64}", rf"`trainer\.seed` is {2**64}; it has to be less than"),
        ("touch", f"data.drawn.seed={2**64}", rf"`data\.drawn\.seed` is {2**64}; it has to be less than"),
        ("touch", "trainer.epochs=3", "In `trainer`, `steps` is 1700 and `epochs` 3"),
        ("touch_pairs", "objective.touch=0 objective.attributes=0 objective.maps=0", "`objective` weighs nothing"),
        ("unclip", "objective.caption_share=0.9", "In `objective`, `caption_share` and `empty_share` are more than 1"),
    ):  # fmt: skip
        with pytest.raises((InvalidInputError, InvalidTypeError), match=message) as raised:
            read_as(name, *override.split())
        assert "\n" not in str(raised.value)


def test_a_recipe_that_is_none_is_refused(tmp_path: Path) -> None:
    for content, message in {
        b"data: {image_size: 1}": "`trainer` is missing in the recipe",
        b"trainer: 3": "`trainer` is 3; it has to be a valid dictionary",
        b"trainer: {steps: [1": "cannot be read",
        b"trainer: !!python/object/apply:os.system ['true']": "cannot be read",
        b"data: {base: taste}": r"`data\.base` names 'taste', which does not exist",
    }.items():
        (tmp_path / "mine.yaml").write_bytes(content)
        with pytest.raises((InvalidInputError, InvalidTypeError), match=message) as raised:
            read(Recipe, {"data": {}} | read_recipe(tmp_path / "mine.yaml"))
        assert "\n" not in str(raised.value)


def test_what_a_library_refuses_is_one_line() -> None:
    for arguments, message in (
        ({"smaple_size": 3}, "In `model`, `smaple_size` is unknown.*mean 'sample_size'"),
        ({"block_out_channels": [8]}, "`model` cannot be used: .*block_out_channels"),
    ):
        with pytest.raises(InvalidInputError, match=message) as raised:
            build("model", UNet2DConditionModel, arguments)
        assert "\n" not in str(raised.value)
