"""Recipes, their overrides, and what a trainer can be told."""

import math
from pathlib import Path

import pytest
import torch
from diffusers import DDPMScheduler, UNet2DConditionModel
from transformers import ResNetConfig

from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.models import UniTouchConfig
from unitouch_gen.training.data import DataConfig
from unitouch_gen.training.image_text import ImageTextSettings
from unitouch_gen.training.image_vae import AutoencoderAugmentation, AutoencoderLoss, make_autoencoder
from unitouch_gen.training.picture_classifier import AttributeSettings, ClassifierAugmentation
from unitouch_gen.training.recipe import BASE, RECIPES, Settings, check_keys, read_recipe, read_section
from unitouch_gen.training.tokenizer import train_tokenizer
from unitouch_gen.training.touch import LossWeights, SamplerSettings, SensorSettings, TouchAugmentation
from unitouch_gen.training.touch_ldm import BankSettings, TouchDiffusionSettings
from unitouch_gen.training.trainer import TrainerConfig
from unitouch_gen.training.unclip import UnclipSettings

NAMES = sorted({path.stem for path in RECIPES.glob("*.yaml")} - {BASE})
REQUIRED = {"steps": 10, "batch_size": 4, "learning_rate": 0.1}


def trainer_config(recipe: dict) -> TrainerConfig:
    return read_section(recipe, "trainer", TrainerConfig)


def config(**changes: object) -> TrainerConfig:
    return trainer_config({"trainer": {**REQUIRED, **changes}})


def test_a_recipe_may_be_a_file_of_ones_own(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("trainer: {steps: 7, batch_size: 2, learning_rate: 0.5}\n")
    assert trainer_config(read_recipe(tmp_path / "mine.yaml")) == TrainerConfig(
        steps=7, batch_size=2, learning_rate=0.5
    )


def test_a_missing_recipe_is_refused_with_those_there_are() -> None:
    with pytest.raises(InvalidInputError, match=r"`recipe` is 'taste'.*'audio'.*'touch'"):
        read_recipe("taste")


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("12", 12),
        ("0.5", 0.5),
        ("1e-3", 1e-3),
        ("1.0e-3", 1e-3),
        ("adam", "adam"),
        ("[a, b]", ["a", "b"]),
        ("null", None),
    ],
)
def test_an_override_takes_the_kind_of_value_it_looks_like(text: str, value: object) -> None:
    assert read_recipe("touch", [f"trainer.learning_rate={text}"])["trainer"]["learning_rate"] == value


def test_overrides_leave_the_rest_as_it_is() -> None:
    plain, changed = read_recipe("touch"), read_recipe("touch", ["trainer.steps=3", "sampler.sigma=0.5"])
    assert (changed["trainer"].pop("steps"), changed["sampler"].pop("sigma")) == (3, 0.5)
    plain["trainer"].pop("steps"), plain["sampler"].pop("sigma")
    assert changed == plain


def test_what_a_recipe_leaves_to_the_trainer_may_be_set() -> None:
    read = trainer_config(read_recipe("touch", ["trainer.seed=7", "trainer.save_every=9"]))
    assert (read.seed, read.save_every) == (7, 9)


def test_a_value_that_holds_itself_is_refused() -> None:
    with pytest.raises(InvalidInputError, match=r"`set` is 'trainer\.steps=&a \[\*a\]', whose value is no YAML"):
        read_recipe("touch", ["trainer.steps=&a [*a]"])


@pytest.mark.parametrize("overrides", [None, "trainer.steps=3", [3]])
def test_overrides_are_a_list_of_strings(overrides: object) -> None:
    with pytest.raises(InvalidTypeError, match="`set` is"):
        read_recipe("touch", overrides)


def test_of_two_overrides_of_one_key_the_later_holds() -> None:
    assert read_recipe("touch", ["trainer.steps=3", "trainer.steps=4"])["trainer"]["steps"] == 4


def test_a_value_may_hold_an_equals_sign() -> None:
    assert read_recipe("touch", ["data.sets=a=b"])["data"]["sets"] == "a=b"


@pytest.mark.parametrize("override", ["trainer.steps", "steps=3", "=3", "", "trainer.=3", "trainer"])
def test_an_override_of_another_form_is_refused(override: str) -> None:
    with pytest.raises(InvalidInputError, match=r"`set` is .*; write section\.key=value"):
        read_recipe("touch", [override])


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("trianer.steps=3", r"touch\.yaml has no section `trianer`; its sections are \['data', 'sampler', 'augment', "
         r"'objective', 'trainer'\]\. Did you mean 'trainer'\?"),
        ("model.depth=3", r"no section `model`; its sections are .*'trainer'\]\.$"),
        ("trainer.steps.more=3", r"no section `trainer\.steps`; there are none in it"),
        ("data.sounds.mel_bins=3", r"no section `data\.sounds`; its sections are \['audio', 'drawn'\]"),
    ],
)  # fmt: skip
def test_an_override_of_no_section_is_refused_with_those_there_are(override: str, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message) as raised:
        read_recipe("touch", [override])
    assert "\n" not in str(raised.value)


def test_an_unknown_key_of_the_trainer_is_refused_with_those_there_are() -> None:
    with pytest.raises(InvalidInputError, match=r"`trainer` holds \['stpes'\].*'steps'.*Did you mean 'steps'\?"):
        config(stpes=3)


@pytest.mark.parametrize(
    ("key", "value"),
    [("steps", 0), ("batch_size", -1), ("learning_rate", -0.1), ("learning_rate", float("nan")), ("warmup", -1),
     ("final_rate", 1.5), ("grad_clip", -1.0), ("ema_decay", 1.5), ("save_every", 0), ("mixed_precision", "int8"),
     ("optimizer", "sgd"), ("seed", 2**32)],
)  # fmt: skip
def test_a_value_the_trainer_cannot_use_is_refused_by_name(key: str, value: float | str) -> None:
    with pytest.raises(InvalidInputError, match=rf"`trainer\.{key}` is {value!r}; it has to be"):
        config(**{key: value})


@pytest.mark.parametrize(
    ("key", "value"), [("steps", 10**30), ("learning_rate", 1e300), ("beta2", 1.0), ("ema_decay", 1.0)]
)
def test_a_value_that_no_training_could_use_is_refused_by_name(key: str, value: float) -> None:
    """Optimisers and progress bars would say so in their own words, and an average that never moves would not."""
    with pytest.raises(InvalidInputError, match=rf"`trainer\.{key}` is .*; it has to be less"):
        config(**{key: value})


@pytest.mark.parametrize(
    ("name", "section", "override", "words"),
    [
        ("image_text", "tokenizer", "vocab_size=1000000000000", "`vocab_size` is 1000000000000"),
        ("image_text", "tokenizer", "max_length=0", "`max_length` is 0"),
        ("touch_ldm", "model", "layers_per_block=1000000000", "`layers_per_block` is 1000000000; it may be at most"),
        ("touch_ldm", "model", "layers_per_block=0", "`layers_per_block` is 0; it has to be at least 1"),
        ("touch_ldm", "model", "block_out_channels=[1000000000]", "`block_out_channels` is 1000000000"),
        ("touch_ldm", "model", "attention_head_dim=0", "`model` cannot be used"),
        ("touch_ldm", "scheduler", "num_train_timesteps=10000000000", "`num_train_timesteps` is 10000000000"),
        ("touch_ldm", "scheduler", "num_train_timesteps=0", "`num_train_timesteps` is 0"),
        ("touch_ldm", "scheduler", "beta_start=x", "`scheduler` cannot be used"),
    ],
)
def test_networks_that_could_not_be_are_refused_at_once(name: str, section: str, override: str, words: str) -> None:
    given = {"texts": ["rough brick"]} if section == "tokenizer" else {}
    with pytest.raises(InvalidInputError, match=words):
        read_section(read_recipe(name, [f"{section}.{override}"]), section, TAKERS[name][section], **given)


@pytest.mark.parametrize(
    "value", ["2024-13-45", "[" * 5000, "9" * 5000, "\ud800"], ids=["date", "deep", "long", "half"]
)
def test_an_override_that_yaml_cannot_read_is_refused(value: str) -> None:
    with pytest.raises(InvalidInputError, match=r"`set` is 'trainer\.steps=.*, whose value is no YAML"):
        read_recipe("touch", [f"trainer.steps={value}"])


@pytest.mark.parametrize(("key", "value"), [("steps", "1e3"), ("steps", 10.0), ("learning_rate", "fast")])
def test_a_value_of_another_kind_is_refused_by_name(key: str, value: float | str) -> None:
    with pytest.raises(InvalidTypeError, match=rf"`trainer\.{key}` is {value!r}; it has to be a valid "):
        config(**{key: value})


def test_full_precision_may_be_written_without_quotes() -> None:
    assert trainer_config(read_recipe("touch", ["trainer.mixed_precision=no"])).mixed_precision == "no"


# Sections -------------------------------------------------------------------------------------------------------------

SECTIONS = {
    "image_text": {"objective": ImageTextSettings},
    "touch": {"augment": TouchAugmentation, "sampler": SamplerSettings, "objective": LossWeights},
    "touch_pairs": {"augment": TouchAugmentation, "sampler": SamplerSettings, "objective": LossWeights},
    "touch_paper": {"augment": TouchAugmentation, "sampler": SamplerSettings, "sensors": SensorSettings},
    "unclip": {"objective": UnclipSettings},
    "touch_ldm": {"objective": TouchDiffusionSettings, "embedding_bank": BankSettings},
    "touch_ldm_paper": {"objective": TouchDiffusionSettings, "embedding_bank": BankSettings},
    "image_vae": {"loss": AutoencoderLoss, "augment": AutoencoderAugmentation},
    "touch_vae": {"loss": AutoencoderLoss, "augment": AutoencoderAugmentation},
    "touch_vae_paper": {"loss": AutoencoderLoss},
    "picture_classifier": {"augment": ClassifierAugmentation, "objective": AttributeSettings},
    "touch_classifier": {"augment": ClassifierAugmentation, "objective": AttributeSettings},
}


@pytest.mark.parametrize("name", NAMES)
def test_sections_of_recipes_are_understood(name: str) -> None:
    recipe = read_recipe(name)
    for section, kind in {"data": DataConfig, "trainer": TrainerConfig, **SECTIONS.get(name, {})}.items():
        assert isinstance(read_section(recipe, section, kind), kind)


TAKERS = {
    "image_text": {"model": UniTouchConfig, "tokenizer": train_tokenizer},
    "unclip": {"model": UNet2DConditionModel, "scheduler": DDPMScheduler},
    "touch_ldm": {"model": UNet2DConditionModel, "scheduler": DDPMScheduler},
    "touch_ldm_paper": {"model": UNet2DConditionModel, "scheduler": DDPMScheduler},
    "picture_classifier": {"model": ResNetConfig},
    "touch_classifier": {"model": ResNetConfig},
}
"""What takes the sections that are no dataclass of ours."""


@pytest.mark.parametrize(("name", "section"), [(name, section) for name, kinds in TAKERS.items() for section in kinds])
def test_keys_of_recipes_are_arguments_of_what_takes_them(name: str, section: str) -> None:
    check_keys(section, read_recipe(name)[section], TAKERS[name][section], given=("texts",))


@pytest.mark.parametrize("name", NAMES)
def test_every_section_of_a_recipe_is_read(name: str) -> None:
    own = {"model"} if "vae" in name else set()  # by its class
    known = {"data", "trainer", *own, *SECTIONS.get(name, {}), *TAKERS.get(name, {})}
    assert set(read_recipe(name)) <= known


@pytest.mark.parametrize(
    ("name", "section", "key", "meant"),
    [
        ("unclip", "model", "smaple_size", "sample_size"),
        ("touch_ldm", "scheduler", "beta_schedul", "beta_schedule"),
        ("touch_classifier", "model", "embeding_size", "embedding_size"),
        ("image_text", "model", "sensor_token", "sensor_tokens"),
    ],
)
def test_a_wrong_key_is_refused_with_those_there_are_and_the_likely_one(
    name: str, section: str, key: str, meant: str
) -> None:
    recipe = read_recipe(name, [f"{section}.{key}=3"])
    message = rf"`{section}` holds \['{key}'\]; its keys are \[.*'{meant}'.*\]\. Did you mean '{meant}'\?$"
    with pytest.raises(InvalidInputError, match=message) as raised:
        read_section(recipe, section, TAKERS[name][section])
    assert "\n" not in str(raised.value)


def test_a_wrong_key_of_a_configuration_within_another_is_refused() -> None:
    recipe = read_recipe("image_text", ["model.vision_config.hidden_sze=3"])
    with pytest.raises(InvalidInputError, match=r"`model\.vision_config` holds \['hidden_sze'\].*'hidden_size'\?$"):
        read_section(recipe, "model", UniTouchConfig)


def test_keys_that_every_configuration_has_are_not_listed() -> None:
    """They are about saving and labels; a recipe has no use for them."""
    with pytest.raises(InvalidInputError, match=r"its keys are \[") as raised:
        check_keys("model", {"depth": 3}, ResNetConfig)
    assert "chunk_size_feed_forward" not in str(raised.value) and "'depths'" in str(raised.value)


def test_a_wrong_key_of_an_autoencoder_is_refused_by_its_class() -> None:
    section = read_recipe("touch_vae")["model"] | {"num_vq_embeddings": 3}
    with pytest.raises(InvalidInputError, match=r"`model` holds \['num_vq_embeddings'\].*'latent_channels'"):
        make_autoencoder(section)


def test_what_is_given_beside_a_section_is_not_the_recipes_to_say() -> None:
    recipe = read_recipe("touch_ldm", ["model.num_class_embeds=4"])
    with pytest.raises(InvalidInputError, match=r"`model` holds \['num_class_embeds'\]"):
        read_section(recipe, "model", UNet2DConditionModel, num_class_embeds=3)


@pytest.mark.parametrize(
    ("override", "section", "kind", "message"),
    [
        ("model.block_out_channels=[8]", "model", UNet2DConditionModel, "`model` cannot be used: .*block_out_channels"),
        ("scheduler.beta_schedule=linaer", "scheduler", DDPMScheduler, "`scheduler` cannot be used: linaer"),
    ],
)
def test_a_value_that_the_library_refuses_is_one_line(override: str, section: str, kind: type, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message) as raised:
        read_section(read_recipe("unclip", [override]), section, kind)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("kind", dict.fromkeys(kind for kinds in SECTIONS.values() for kind in kinds.values()))
def test_a_value_below_zero_is_refused_by_name(kind: type[Settings]) -> None:
    fine = dict.fromkeys(kind.model_fields, 1 if kind in (BankSettings, ImageTextSettings) else 0.5)
    for key in kind.model_fields:
        with pytest.raises((InvalidInputError, InvalidTypeError), match=rf"`it\.{key}` is -0\.1; it has to be"):
            read_section({"it": fine | {key: -0.1}}, "it", kind)


@pytest.mark.parametrize("key", ["condition_dropout", "caption_share", "empty_share", "clean_share", "gain"])
def test_a_probability_above_one_is_refused_by_name(key: str) -> None:
    with pytest.raises(InvalidInputError, match=rf"`objective\.{key}` is 1\.5; it has to be less than or equal to 1"):
        read_section(read_recipe("unclip", [f"objective.{key}=1.5"]), "objective", UnclipSettings)


def test_shares_of_prompts_cannot_be_more_than_all() -> None:
    recipe = read_recipe("unclip", ["objective.caption_share=0.7", "objective.empty_share=0.4"])
    with pytest.raises(InvalidInputError, match=r"`caption_share` is 0\.7 and `empty_share` 0\.4"):
        read_section(recipe, "objective", UnclipSettings)


def test_steps_may_all_weigh_the_same() -> None:
    recipe = read_recipe("touch_ldm", ["objective.snr_gamma=.inf"])
    assert read_section(recipe, "objective", TouchDiffusionSettings).snr_gamma == math.inf


@pytest.mark.parametrize("gamma", ["0", ".nan"])
def test_a_bound_that_weighs_nothing_is_refused(gamma: str) -> None:
    with pytest.raises(InvalidInputError, match=r"`objective\.snr_gamma` is"):
        read_section(read_recipe("touch_ldm", [f"objective.snr_gamma={gamma}"]), "objective", TouchDiffusionSettings)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("data: {image_size: 1}", "`recipe` has no section `trainer`; it holds \\['data'\\]"),
        ("trainer: 3", "`recipe` has no section `trainer`"),
        ("trainer: {batch_size: 2}", "`trainer` lacks \\['learning_rate'\\]"),
        ("trainer: {steps: [1", "cannot be read as YAML: while parsing"),
        ("- trainer", "and no settings"),
        ("", "and no settings"),
        ("data: {base: taste}", "`data.base` is 'taste'; pass a YAML file or one of"),
    ],
)
def test_a_recipe_that_is_none_is_refused(content: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(content)
    with pytest.raises(InvalidInputError, match=message) as raised:
        trainer_config(read_recipe(tmp_path / "mine.yaml"))
    assert "\n" not in str(raised.value)


def test_a_recipe_that_is_no_text_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InvalidInputError, match="cannot be read as YAML"):
        read_recipe(tmp_path / "mine.yaml")


def test_an_override_that_is_no_yaml_is_refused() -> None:
    with pytest.raises(InvalidInputError, match=r"`set` is 'trainer\.steps=\[1', whose value is no YAML"):
        read_recipe("touch", ["trainer.steps=[1"])


# Data -----------------------------------------------------------------------------------------------------------------


def data_of(*overrides: str, name: str = "touch") -> DataConfig:
    return read_section(read_recipe(name, list(overrides)), "data", DataConfig)


def test_a_recipes_own_data_is_laid_over_its_base(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text("{image_size: 16, touch_size: 3}")
    (tmp_path / "mine.yaml").write_text(f"data: {{base: {tmp_path / 'base.yaml'}, touch_size: 4}}")
    assert read_recipe(tmp_path / "mine.yaml")["data"] == {"image_size": 16, "touch_size": 4}


def test_what_comes_from_the_base_may_be_set() -> None:
    assert data_of("data.audio.mel_bins=32", "data.image_size=32", name="image_text").audio["mel_bins"] == 32
    assert data_of(name="image_text").audio["mel_bins"] == 64


def test_a_world_may_be_chosen() -> None:
    assert data_of("data.drawn.seed=3").drawn.seed == 3


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("sensors=[dgiit]", "`sensors` is 'dgiit'; it has .* Did you mean 'digit'"),
        ("sensors=[]", "`data.drawn.sensors` is"),
        ("contacts_per_object=0", "`data.drawn.contacts_per_object` is 0"),
        ("seed=-1", "`data.drawn.seed` is -1"),
    ],
)
def test_data_that_cannot_be_rendered_is_refused(override: str, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        data_of(f"data.drawn.{override}")


# The paper's size -----------------------------------------------------------------------------------------------------


def test_the_papers_autoencoder_makes_64_by_64_by_3_of_a_touch() -> None:
    recipe = read_recipe("touch_vae_paper")
    size = read_section(recipe, "data", DataConfig).touch_size
    with torch.device("meta"):
        vae = make_autoencoder(recipe["model"])
        latents = vae.encode(torch.empty(1, 3, size, size)).latents
        assert latents.shape == (1, 3, 64, 64)
        assert vae.decode(latents).sample.shape == (1, 3, 256, 256)
    assert vae.quantize.embedding.weight.shape == (8192, 3)


def test_the_papers_network_takes_its_latents_and_one_token_of_its_joint_space() -> None:
    recipe = read_recipe("touch_ldm_paper")
    with torch.device("meta"):
        unet = UNet2DConditionModel(**recipe["model"], num_class_embeds=3)
        latents, token = torch.empty(1, 3, 64, 64), torch.empty(1, 1, 1024)
        sample = unet(latents, torch.zeros(1), token, class_labels=torch.zeros(1, dtype=torch.int64)).sample
    assert sample.shape == (1, 3, 64, 64)
    assert 8.2e8 < sum(parameter.numel() for parameter in unet.parameters()) < 9.1e8  # Stable Diffusion 1: 0.86e9


def test_the_papers_network_is_trained_as_the_paper_says() -> None:
    trainer = trainer_config(read_recipe("touch_ldm_paper"))
    assert (trainer.optimizer, trainer.learning_rate, trainer.batch_size) == ("adam", 1e-6, 48)
    assert read_recipe("touch_ldm_paper")["data"]["touch_size"] == read_recipe("touch_vae_paper")["data"]["touch_size"]
