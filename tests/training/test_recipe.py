"""Recipes: every one in the folder is understood, and overrides are laid over them."""

from pathlib import Path
from typing import Any

import pytest
import torch
from diffusers import DDPMScheduler, UNet2DConditionModel

from tests.training.conftest import read_as
from unitouch_gen.models import UniTouchConfig
from unitouch_gen.models.autoencoders import autoencoder_class
from unitouch_gen.training.recipe import RECIPES, build, read_recipe

NAMES = sorted({path.stem for path in RECIPES.glob("*.yaml")} - {"data", "data_scanned"})


def autoencoder_of(model: dict[str, Any]) -> Any:
    kind = autoencoder_class("model.class", model["class"])
    return build("model", kind, {key: value for key, value in model.items() if key != "class"})


@pytest.mark.parametrize("name", NAMES)
def test_every_recipe_is_read_and_built(name: str) -> None:
    recipe = read_as(name)
    assert recipe.data.sets == []
    assert (recipe.data.drawn is None) == name.endswith("_paper")
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
        token = torch.empty(1, 1, 1024)
        sensor = torch.zeros(1, dtype=torch.int64)
        sample = unet(latents, torch.zeros(1), token, class_labels=sensor).sample
    assert vae_recipe.data.touch_size == 256
    assert latents.shape == sample.shape == (1, 3, 64, 64)
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
