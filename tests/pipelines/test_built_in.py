"""The built-in family as pipelines: what it is made of, how it is read, steps to a tolerance, four evaluations."""

import json

import pytest
import torch
from diffusers import DDIMScheduler, LCMScheduler
from torch.testing import assert_close

import unitouch_gen
from tests.helpers.calls import Call, quiet, seeded
from tests.helpers.small_family import write_small_family
from unitouch_gen.pipelines.tiny import PIPELINES, TURBO


@pytest.fixture(scope="module", params=["touch-to-image", "x-to-touch"])
def call(request):
    name = "touch" if request.param == "touch-to-image" else "image"
    return Call(quiet(unitouch_gen.tiny(request.param)), {name: unitouch_gen.example("wood", name)})


def test_a_call_without_options_has_the_checkpoints_defaults_and_128_pixels(call):
    output = call()
    assert output.images.shape == (1, 3, 128, 128)
    assert output.report.success
    assert call.pipe.guidance_scale == call.pipe.config.default_guidance_scale
    assert output.report.steps == call.pipe.config.default_num_inference_steps
    assert not hasattr(call.pipe.unitouch, "audio_model")
    assert not any(part.training for part in call.pipe.components.values() if isinstance(part, torch.nn.Module))


def test_pictures_and_restyled_photos_share_networks_but_neither_bank_nor_noise_level() -> None:
    pictures, restyled = (unitouch_gen.tiny(name) for name in ("touch-to-image", "stylization"))
    assert pictures.text_encoder is pictures.unitouch.text_model.text_model
    assert pictures.embedding_bank is None
    assert restyled.embedding_bank is not None
    assert pictures.config.default_noise_level < restyled.config.default_noise_level
    weights = zip(pictures.unet.parameters(), restyled.unet.parameters(), strict=True)
    assert all(torch.equal(*pair) for pair in weights)


def test_a_tolerance_is_kept(call):
    found = call(tolerance=0.1, output_type="latent")
    reference = call.latents(solver="dpm++2m", num_inference_steps=30)
    assert (found.images - reference).norm() / reference.norm() < 0.12
    assert found.report.evaluations < 40
    assert found.report.solver == "adaptive"


def test_a_saved_family_makes_the_same_picture_and_brings_its_card(call, tmp_path):
    call.pipe.save_pretrained(tmp_path)
    loaded = Call(quiet(type(call.pipe).from_pretrained(tmp_path)), call.inputs)
    assert_close(loaded.latents(num_inference_steps=2), call.latents(num_inference_steps=2), atol=1e-4, rtol=1e-4)
    card = (tmp_path / "README.md").read_text()
    assert "license: apache-2.0" in card
    assert "class mean" in card
    assert list((tmp_path / "pictures").iterdir())


def test_a_family_of_ones_own_is_read_in_the_dtype_asked_for(tmp_path):
    write_small_family(tmp_path)
    for name in PIPELINES:
        assert unitouch_gen.tiny(name, family=tmp_path, dtype="bfloat16").dtype is torch.bfloat16


def test_answers_name_what_was_touched_or_seen():
    pipe = unitouch_gen.tiny("touch-to-text")
    names = ["brick", "leather", "wood"]
    touches = pipe([unitouch_gen.example(name) for name in names], "What is it?")
    assert touches.texts == [f"it is {name}." for name in names]
    assert len(touches.report.tokens) == 3
    assert pipe(image=unitouch_gen.example("wood", "image"), question="What is it?").texts == ["it is wood."]


def test_diffusers_own_pipeline_makes_the_same_picture():
    pipe = quiet(unitouch_gen.tiny("touch-to-image"))
    embeds = pipe.encode_touch(unitouch_gen.example("brick"))
    options = {"prompt": "metal", "num_inference_steps": 3, "guidance_scale": 3.0}
    options |= {"noise_level": 250, "output_type": "pt"}
    found = pipe(touch_embeds=embeds, generator=seeded(), **options).images
    expected = quiet(pipe.to_diffusers())(image_embeds=embeds, generator=seeded(), **options).images
    assert_close(found, expected, atol=1e-5, rtol=0)


# In four evaluations: LoRA weights under diffusers' `LCMScheduler` ---------------------------------------------------


LEVELS = [999, 619, 299, 79]


@pytest.fixture(scope="module")
def family(tmp_path_factory):
    peft = pytest.importorskip("peft", reason="LoRA needs peft")
    folder = tmp_path_factory.mktemp("family")
    torch.manual_seed(0)
    write_small_family(folder)
    for name in TURBO.values():
        pipe = unitouch_gen.tiny(name, family=folder)
        pipe.unet.add_adapter(peft.LoraConfig(r=2, target_modules=["to_q", "conv1"], init_lora_weights=False))
        layers = peft.get_peft_model_state_dict(pipe.unet, adapter_name="default")
        pipe.save_lora_weights(folder / name / "turbo", unet_lora_layers=layers)
        defaults = {"default_num_inference_steps": 4, "default_timesteps": LEVELS, "default_guidance_scale": 1.0}
        (folder / name / "turbo" / "defaults.json").write_text(json.dumps(defaults))
    return folder


@pytest.fixture(params=TURBO)
def name(request):
    return request.param


@pytest.fixture
def turbo(name, family):
    return quiet(unitouch_gen.tiny(name, family=family))


def draw(pipe, name, count=1, **options):
    inputs = {"touch" if TURBO[name] == "touch-to-image" else "image": torch.rand(2, 3, 128, 128, generator=seeded())}
    call = Call(pipe, {**inputs, "sensor": "digit", "output_type": "latent"})
    return (call.one(0) if count == 1 else call)(**options)


def test_turbo_draws_in_four_evaluations_of_one_branch_unless_told_otherwise(turbo, name):
    output = draw(turbo, name)
    assert (output.report.evaluations, output.report.guided) == (4, 0)
    assert "unconditional branch" in output.report.left_out
    assert torch.equal(draw(turbo, name, num_inference_steps=4).images, output.images)  # as a page passes it
    for steps in (2, 8):
        assert draw(turbo, name, num_inference_steps=steps).report.evaluations == steps
    assert draw(turbo, name, guidance_scale=2.0).report.guided == 4
    turbo.scheduler = DDIMScheduler.from_config(turbo.scheduler.config)  # which takes no timesteps
    assert draw(turbo, name).report.evaluations == 4


def test_turbo_is_the_pipeline_with_lora_weights_that_anybody_can_load(turbo, name, family):
    pipe = quiet(unitouch_gen.tiny(TURBO[name], family=family))
    pipe.scheduler = LCMScheduler.from_config(pipe.scheduler.config)
    plain = draw(pipe, name, timesteps=LEVELS, guidance_scale=1.0).images
    pipe.load_lora_weights(family / TURBO[name] / "turbo")
    expected = draw(pipe, name, timesteps=LEVELS, guidance_scale=1.0).images
    assert_close(draw(turbo, name).images, expected, atol=1e-4, rtol=1e-3)
    assert not torch.allclose(expected, plain, atol=1e-2)


def test_turbo_draws_the_noise_of_each_step_from_each_pictures_own_generator(turbo, name):
    both = draw(turbo, name, 2, generator=[seeded(0), seeded(1)]).images
    assert_close(both[:1], draw(turbo, name, generator=seeded(0)).images, atol=1e-4, rtol=1e-3)
    noise = {"latents": torch.randn(1, *both.shape[1:])}
    first, second = (draw(turbo, name, **noise, generator=seeded(seed)).images for seed in (0, 1))
    assert not torch.allclose(first, second, atol=1e-2)
