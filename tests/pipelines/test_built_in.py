"""The built-in family as a pipeline: what it is made of, and that it feels what it is given."""

import shutil
from pathlib import Path

import pytest
import torch
from diffusers.pipelines.stable_diffusion.stable_unclip_image_normalizer import StableUnCLIPImageNormalizer

import unitouch_gen
from tests.helpers.damage import SETTINGS
from tests.helpers.small_family import write_small_family
from unitouch_gen import weights
from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.world import World

pytestmark = pytest.mark.skipif(
    not (weights.JOINT / "model.safetensors").exists(), reason="built-in weights are not there"
)


@pytest.fixture(scope="module")
def pipe():
    pipeline = unitouch_gen.tiny("touch-to-image")
    pipeline.set_progress_bar_config(disable=True)
    return pipeline


@pytest.fixture
def touch() -> torch.Tensor:
    return World().render([0, 4], object=[0, 0], contact=[0, 0], modalities=("touch",)).touch["gelsight"]


def pictures(pipe, *args, **kwargs) -> torch.Tensor:
    return pipe(*args, generator=torch.Generator().manual_seed(0), output_type="pt", **kwargs).images


def test_a_picture_has_128_pixels_a_side(pipe, touch):
    assert pictures(pipe, touch).shape == (2, 3, 128, 128)


def test_a_call_without_options_uses_the_checkpoints_defaults(pipe, touch):
    report = pipe(touch[:1]).report
    assert report.guidance_scale == pipe.config.default_guidance_scale
    assert report.steps == pipe.config.default_num_inference_steps
    assert report.success


@pytest.mark.filterwarnings("ignore:.*nothing is touched")  # some are like gels at rest
def test_a_prototype_is_taken_for_its_sensor(pipe):
    names = list(pipe.unitouch.config.sensors)
    pipe.unitouch.load("touch")
    prototypes = torch.stack([pipe.unitouch.sensor_bank.prototype(name) for name in names]).float()
    report = pipe(prototypes, num_inference_steps=2).report
    assert report.sensors == names
    assert report.sensor_distances == pytest.approx([0.0] * len(names), abs=1e-2)


def test_embeddings_have_the_norm_of_the_joint_space(pipe, touch):
    norms = pipe.encode_touch(touch, strength=1.0).norm(dim=1)
    torch.testing.assert_close(norms, torch.full((2,), pipe.unitouch.config.embedding_norm), rtol=1e-5, atol=0)


def test_image_and_audio_encoders_stay_on_disk(touch):
    pipe = unitouch_gen.tiny("touch-to-image")
    pipe(touch[:1], num_inference_steps=2)
    assert set(pipe.unitouch.loaded_modalities) <= {"text", "touch"}


def test_the_text_encoder_is_the_joint_spaces_own(pipe):
    assert pipe.text_encoder is pipe.unitouch.text_model.text_model


def test_diffusers_own_pipeline_makes_the_same_picture(pipe, touch):
    theirs = pipe.to_diffusers()
    theirs.set_progress_bar_config(disable=True)
    embeds = pipe.encode_touch(touch[:1])
    options = {"prompt": "metal", "num_inference_steps": 4, "guidance_scale": 4.0, "noise_level": 250}
    found = pictures(pipe, touch_embeds=embeds, bridge=False, **options)
    expected = theirs(image_embeds=embeds, generator=torch.Generator().manual_seed(0), output_type="pt", **options)
    torch.testing.assert_close(found, expected.images, atol=1e-5, rtol=0)


def test_networks_do_not_train(pipe):
    networks = (pipe.unet, pipe.vae, pipe.text_encoder, pipe.image_normalizer, pipe.unitouch)
    assert not any(network.training for network in networks)


def test_a_saved_family_makes_the_same_picture(pipe, touch, tmp_path):
    pipe.save_pretrained(tmp_path)
    assert '"block_out_channels"' not in (tmp_path / "vae/config.json").read_text()  # diffusers warns of it
    loaded = type(pipe).from_pretrained(tmp_path)
    options = {"num_inference_steps": 3}
    torch.testing.assert_close(pictures(loaded, touch, **options), pictures(pipe, touch, **options), atol=1e-5, rtol=0)


def test_bfloat16_is_close_to_float32(pipe, touch):
    half = unitouch_gen.tiny("touch-to-image", dtype=torch.bfloat16)
    latents = torch.randn(2, pipe.unet.config.in_channels, 16, 16, generator=torch.Generator().manual_seed(1))
    options = {"latents": latents, "touch_embeds": pipe.encode_touch(touch), "num_inference_steps": 4}
    exact, rough = (pictures(one, **options) for one in (pipe, half))
    assert (exact - rough).abs().mean() < 0.02


def test_an_unknown_pipeline_is_refused_with_the_nearest():
    with pytest.raises(InvalidInputError, match=r"`name` is 'touch-to-imag'.*Did you mean 'touch-to-image'\?"):
        unitouch_gen.tiny("touch-to-imag")


@pytest.mark.parametrize(
    ("setting", "value"),
    [("family", 3), ("family", None), ("family", "gone"), ("dtype", "float3"), ("dtype", torch.int8), ("dtype", None),
     ("low_memory", "no")],
)  # fmt: skip
def test_settings_that_cannot_be_used_are_refused_by_name(setting, value):
    with pytest.raises((InvalidInputError, InvalidTypeError), match=f"`{setting}` is"):
        unitouch_gen.tiny("touch-to-image", **{setting: value})


def test_a_dtype_may_be_a_word():
    assert unitouch_gen.tiny("x-to-touch", dtype="bfloat16").unet.dtype is torch.bfloat16


@pytest.fixture(scope="module")
def small_family(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("family")
    write_small_family(folder)
    return folder


def test_a_pickle_in_a_family_is_not_read(tmp_path):
    for part in weights.JOINT.parent.iterdir():
        if part.name != weights.TOUCH_TO_IMAGE.name:
            (tmp_path / part.name).symlink_to(part)
    folder = Path(shutil.copytree(weights.TOUCH_TO_IMAGE, tmp_path / weights.TOUCH_TO_IMAGE.name)) / "image_normalizer"
    normalizer = StableUnCLIPImageNormalizer.from_pretrained(folder)
    (folder / "diffusion_pytorch_model.safetensors").unlink()
    normalizer.save_pretrained(folder, safe_serialization=False)
    with pytest.raises(InvalidInputError, match=r"`family` is .*no file named .*\.safetensors"):
        unitouch_gen.tiny("touch-to-image", family=tmp_path)


@pytest.mark.parametrize("file", ["defaults.json", "unet/config.json", "scheduler/scheduler_config.json"])
@pytest.mark.parametrize("damage", ["cut", "endless", "a list"])
def test_a_damaged_family_is_refused(small_family, tmp_path, file, damage):
    shutil.copytree(small_family, tmp_path / "family")
    SETTINGS[damage](tmp_path / "family" / weights.X_TO_TOUCH.name / file)
    with pytest.raises(InvalidInputError, match="`family` "):
        unitouch_gen.tiny("x-to-touch", family=tmp_path / "family")
