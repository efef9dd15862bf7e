"""The built-in family as pipelines: what it is made of, how it is read, and that it draws what it is given."""

import shutil
from statistics import mean

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch.testing import assert_close

import unitouch_gen
from drawing import flat_contacts
from tests.helpers.calls import Call, quiet, seeded
from tests.helpers.small_family import write_small_family
from unitouch_gen import weights
from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.models.classifier import ContactClassifier
from unitouch_gen.pipelines.tiny import PIPELINES, _card
from unitouch_gen.world import ATTRIBUTES, World


@pytest.fixture(scope="module")
def scene():
    """A flat contact with a held-out object of each material."""
    world = World()
    return world.render(*flat_contacts(world), modalities=("image", "touch", "attributes"), sensors=("gelsight",))


@pytest.fixture(scope="module", params=sorted(PIPELINES))
def call(request, scene):
    touch, image = scene.touch["gelsight"][:2], scene.image[:2]
    inputs = {"touch-to-image": {"touch": touch}, "stylization": {"touch": touch, "image": image, "init_strength": 1.0}}
    return Call(quiet(unitouch_gen.tiny(request.param)), inputs.get(request.param, {"image": image}))


def test_a_call_without_options_has_the_checkpoints_defaults_and_128_pixels(call):
    output = call.one(0)()
    assert output.images.shape == (1, 3, 128, 128) and output.report.success
    assert output.report.guidance_scale == call.pipe.config.default_guidance_scale
    assert output.report.steps == call.pipe.config.default_num_inference_steps
    assert "audio" not in call.pipe.unitouch.loaded_modalities
    assert not any(part.training for part in call.pipe.components.values() if isinstance(part, torch.nn.Module))


def test_a_loose_tolerance_is_kept_on_trained_networks(call):
    """Against many more steps of another solver."""
    found, reference = call(tolerance=0.1, output_type="latent"), call.latents(solver="heun", num_inference_steps=40)
    difference = (found.images - reference).flatten(1).norm(dim=1) / reference.flatten(1).norm(dim=1)
    assert difference.min() < 0.1 and difference.mean() < 0.15  # a guided sample may tip over to another mode
    assert found.report.evaluations < 40 and found.report.tolerance == 0.1


def test_diffusers_own_pipeline_makes_the_same_picture(scene):
    pipe = quiet(unitouch_gen.tiny("touch-to-image"))
    assert pipe.text_encoder is pipe.unitouch.text_model.text_model
    embeds = pipe.encode_touch(scene.touch["gelsight"][:1])
    options = {
        "prompt": "metal",
        "num_inference_steps": 4,
        "guidance_scale": 4.0,
        "noise_level": 250,
        "output_type": "pt",
    }
    found = pipe(touch_embeds=embeds, generator=seeded(), **options).images
    expected = quiet(pipe.to_diffusers())(image_embeds=embeds, generator=seeded(), **options).images
    assert_close(found, expected, atol=1e-5, rtol=0)


def test_imagined_touches_have_the_relief_that_a_photo_shows(scene):
    """Read by a classifier that knows nothing of the joint space; of another photo's touches it reads no such thing."""
    pipe = quiet(unitouch_gen.tiny("x-to-touch"))
    options = {"sensor": "gelsight", "num_inference_steps": 10, "output_type": "pt", "generator": seeded()}
    touches, classifier = (
        pipe(image=scene.image, **options).images,
        ContactClassifier.from_pretrained(weights.TOUCH_CLASSIFIER, dtype=torch.float32),
    )
    names = ("slope", "steepness", "fine relief")
    columns = [classifier.attributes.index(name) for name in names]
    truth = scene.attributes["gelsight"][:, [ATTRIBUTES.index(name) for name in names]]

    def correlation(images: torch.Tensor) -> float:
        read = classifier.observe(images).attributes[:, columns]
        return mean(torch.corrcoef(torch.stack(pair))[0, 1].item() for pair in zip(read.T, truth.T, strict=True))

    own, others = correlation(touches), correlation(touches.roll(1, 0))
    assert own > 0.35 and own > others + 0.25


def test_a_saved_family_makes_the_same_picture_and_brings_its_card(call, tmp_path):
    call.pipe.save_pretrained(tmp_path)
    loaded = Call(quiet(type(call.pipe).from_pretrained(tmp_path)), call.inputs)
    assert_close(loaded.latents(num_inference_steps=2), call.latents(num_inference_steps=2), atol=1e-4, rtol=1e-4)
    assert "license: apache-2.0" in (tmp_path / "README.md").read_text() and list((tmp_path / "pictures").iterdir())
    name = next(name for name, kind in PIPELINES.items() if kind is type(call.pipe))
    assert (len(_card(weights.FAMILY, name).figures) > 0) == (name != "stylization")


@pytest.mark.parametrize(
    ("name", "setting", "value"),
    [("touch-to-imag", "name", None), ("x-to-touch", "family", 3), ("x-to-touch", "family", "gone"),
     ("x-to-touch", "dtype", "float3"), ("x-to-touch", "dtype", torch.int8)],
)  # fmt: skip
def test_settings_that_cannot_be_used_are_refused_by_name(name, setting, value):
    with pytest.raises((InvalidInputError, InvalidTypeError), match=f"`{setting}` is"):
        unitouch_gen.tiny(name, **({} if setting == "name" else {setting: value}))


def test_a_family_of_ones_own_is_read_and_a_damaged_one_refused(tmp_path):
    write_small_family(tmp_path)
    assert unitouch_gen.tiny("x-to-touch", family=tmp_path, dtype="bfloat16").unet.dtype is torch.bfloat16
    file = tmp_path / weights.X_TO_TOUCH.name / "unet" / "diffusion_pytorch_model.safetensors"
    state = load_file(file)
    save_file(dict(list(state.items())[1:]), file, metadata={"format": "pt"})
    with pytest.raises(InvalidInputError, match="`family` "):
        unitouch_gen.tiny("x-to-touch", family=tmp_path)
    shutil.rmtree(file.parent)
    with pytest.raises(InvalidInputError, match="`family` "):
        unitouch_gen.tiny("x-to-touch", family=tmp_path)


def test_the_family_is_small_and_every_tensor_is_stored_once():
    files = [file for file in weights.FAMILY.rglob("*.safetensors") if file.parent.name != "joint-next"]
    assert sum(file.stat().st_size for file in files) < 40e6
    stored = [
        tensor for file in files for tensor in load_file(file).values() if tensor.ndim > 1 and tensor.numel() > 63
    ]
    assert len({(one.shape, one.flatten()[:64].numpy().tobytes()) for one in stored}) == len(stored)
