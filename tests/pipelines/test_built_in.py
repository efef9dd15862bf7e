"""The built-in family as pipelines: what it is made of, how it is read, and steps to a tolerance."""

import shutil

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch.testing import assert_close

import unitouch_gen
from tests.helpers.calls import Call, quiet, seeded
from tests.helpers.small_family import write_small_family
from unitouch_gen import weights
from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.pipelines.tiny import PIPELINES, TURBO


@pytest.fixture(scope="module", params=["touch-to-image", "x-to-touch"])
def call(request):
    name = "touch" if request.param == "touch-to-image" else "image"
    return Call(quiet(unitouch_gen.tiny(request.param)), {name: unitouch_gen.example("wood", name)})


def test_a_call_without_options_has_the_checkpoints_defaults_and_128_pixels(call):
    output = call()
    assert output.images.shape == (1, 3, 128, 128) and output.report.success
    assert call.pipe.guidance_scale == call.pipe.config.default_guidance_scale
    assert output.report.steps == call.pipe.config.default_num_inference_steps
    assert "audio" not in call.pipe.unitouch.loaded_modalities
    assert not any(part.training for part in call.pipe.components.values() if isinstance(part, torch.nn.Module))


def test_pictures_and_restyled_photos_share_networks_but_neither_bank_nor_noise_level() -> None:
    pictures, restyled = (unitouch_gen.tiny(name) for name in ("touch-to-image", "stylization"))
    assert pictures.embedding_bank is None and restyled.embedding_bank is not None
    assert pictures.config.default_noise_level < restyled.config.default_noise_level
    weights = zip(pictures.unet.parameters(), restyled.unet.parameters(), strict=True)
    assert all(torch.equal(*pair) for pair in weights)


def test_a_tolerance_is_kept(call):
    """Against many more steps of another solver."""
    found, reference = call(tolerance=0.1, output_type="latent"), call.latents(solver="dpm++2m", num_inference_steps=30)
    assert (found.images - reference).norm() / reference.norm() < 0.12
    assert found.report.evaluations < 40 and found.report.solver == "adaptive"


def test_diffusers_own_pipeline_makes_the_same_picture():
    pipe = quiet(unitouch_gen.tiny("touch-to-image"))
    assert pipe.text_encoder is pipe.unitouch.text_model.text_model
    embeds = pipe.encode_touch(unitouch_gen.example("brick"))
    options = {"prompt": "metal", "num_inference_steps": 3, "guidance_scale": 3.0}
    options |= {"noise_level": 250, "output_type": "pt"}
    found = pipe(touch_embeds=embeds, generator=seeded(), **options).images
    expected = quiet(pipe.to_diffusers())(image_embeds=embeds, generator=seeded(), **options).images
    assert_close(found, expected, atol=1e-5, rtol=0)


def test_a_saved_family_makes_the_same_picture_and_brings_its_card(call, tmp_path):
    call.pipe.save_pretrained(tmp_path)
    loaded = Call(quiet(type(call.pipe).from_pretrained(tmp_path)), call.inputs)
    assert_close(loaded.latents(num_inference_steps=2), call.latents(num_inference_steps=2), atol=1e-4, rtol=1e-4)
    card = (tmp_path / "README.md").read_text()
    assert "license: apache-2.0" in card and "class mean" in card and list((tmp_path / "pictures").iterdir())


def test_a_family_of_ones_own_is_read_and_a_damaged_one_refused(tmp_path):
    write_small_family(tmp_path)
    for name in PIPELINES:
        assert unitouch_gen.tiny(name, family=tmp_path, dtype="bfloat16").dtype is torch.bfloat16
    file = tmp_path / weights.X_TO_TOUCH.name / "unet" / "diffusion_pytorch_model.safetensors"
    save_file(dict(list(load_file(file).items())[1:]), file, metadata={"format": "pt"})
    with pytest.raises(InvalidInputError, match="`family` "):
        unitouch_gen.tiny("x-to-touch", family=tmp_path)
    shutil.rmtree(file.parent)
    families = [{"family": family} for family in (tmp_path, 3, "gone")]
    families += [{"family": tmp_path, "name": name} for name in TURBO]  # without their LoRA weights
    for wrong in (*families, {"name": "touch-to-imag"}, {"dtype": "int8"}):
        with pytest.raises((InvalidInputError, InvalidTypeError), match=f"`{next(iter(wrong))}` "):
            unitouch_gen.tiny(**{"name": "x-to-touch", **wrong})


def test_answers_name_what_was_touched_or_seen():
    pipe = unitouch_gen.tiny("touch-to-text")
    names = ["brick", "leather", "wood"]
    touches = pipe([unitouch_gen.example(name) for name in names], "What is it?")
    assert touches.texts == [f"it is {name}." for name in names] and len(touches.report.tokens) == 3
    assert pipe(image=unitouch_gen.example("wood", "image"), question="What is it?").texts == ["it is wood."]
