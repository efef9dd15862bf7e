"""Pipelines of published parts: an unCLIP folder of diffusers and a converted joint space."""

import math
import shutil
from functools import partial

import pytest
import torch
from diffusers import StableUnCLIPImg2ImgPipeline
from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection

from tests.helpers.published_parts import FEW, D, made, sizes, write_ldm, write_unclip
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import UniTouchModel
from unitouch_gen.pipelines import TactileStylizationPipeline, TouchToImagePipeline, XToTouchPipeline

# What comes of them ---------------------------------------------------------------------------------------------------


def test_the_picture_is_that_of_the_parts_put_together_by_hand(unclip, unitouch, touch):
    pipe = TouchToImagePipeline.from_published(unclip, unitouch)
    theirs = StableUnCLIPImg2ImgPipeline.from_pretrained(unclip)
    by_hand = TouchToImagePipeline.from_pipe(theirs, unitouch=UniTouchModel.from_pretrained(unitouch))
    by_hand.unitouch.config.embedding_norm = pipe.unitouch.config.embedding_norm
    torch.testing.assert_close(made(pipe, touch), made(by_hand, touch))


def test_the_norm_is_that_of_the_normalisers_embeddings(unclip, unitouch):
    """Norm of embeddings drawn with its mean and deviation."""
    pipe = TouchToImagePipeline.from_published(unclip, unitouch)
    normalizer = pipe.image_normalizer
    drawn = normalizer.unscale(torch.randn(20_000, D, generator=torch.Generator().manual_seed(0))).detach()
    wanted = math.sqrt(float(drawn.double().square().sum(dim=1).mean()))
    assert pipe.unitouch.config.embedding_norm == pytest.approx(wanted, rel=0.01)


def test_the_norm_may_be_given(unclip, unitouch):
    pipe = TouchToImagePipeline.from_published(unclip, unitouch, embedding_norm=7.5)
    assert pipe.encode_touch(torch.rand(1, 3, 32, 32), strength=1.0).norm().item() == pytest.approx(7.5, rel=1e-5)


def test_the_norm_may_be_measured_on_pictures(unclip, unitouch, photo):
    pipe = TouchToImagePipeline.from_published(unclip, unitouch, images=photo)
    theirs = StableUnCLIPImg2ImgPipeline.from_pretrained(unclip)
    pixels = pipe.processor.images(photo)
    with torch.no_grad():
        wanted = theirs.image_encoder(pixel_values=pixels).image_embeds.norm(dim=1).mean().item()
    assert pipe.unitouch.config.embedding_norm == pytest.approx(wanted, rel=1e-5)


def test_a_photo_is_restyled_by_the_joint_spaces_own_image_encoder(other_unclip, unitouch, photo, touch):
    with pytest.warns(UserWarning, match="`unclip` brings another image encoder than `unitouch`"):
        pipe = TactileStylizationPipeline.from_published(other_unclip, unitouch)
    assert pipe.unitouch.loaded_modalities == ()
    made(pipe, photo, touch)
    own = UniTouchModel.from_pretrained(unitouch, modalities=("image",)).vision_model
    for key, weight in own.state_dict().items():
        torch.testing.assert_close(pipe.unitouch.vision_model.state_dict()[key], weight)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_the_same_image_encoder_brings_no_warning(unclip, unitouch, dtype, recwarn, tmp_path):
    StableUnCLIPImg2ImgPipeline.from_pretrained(unclip, dtype=dtype).save_pretrained(tmp_path / "unclip")
    TouchToImagePipeline.from_published(tmp_path / "unclip", unitouch)
    TouchToImagePipeline.from_published(
        unclip, UniTouchModel.from_pretrained(unitouch, dtype=dtype, modalities=("image",))
    )
    assert not [warning for warning in recwarn if "another image encoder" in str(warning.message)]


def test_the_unclips_image_encoder_stands_in_where_the_joint_space_has_none(other_unclip, touch_alone, photo, touch):
    unclip = other_unclip
    pipe = TactileStylizationPipeline.from_published(unclip, touch_alone)
    assert pipe.unitouch.loaded_modalities == () and pipe.unitouch.known_modalities == ("image", "touch")
    assert made(pipe, photo, touch).shape == (2, 3, 16, 16)
    theirs = StableUnCLIPImg2ImgPipeline.from_pretrained(unclip).image_encoder
    assert all(torch.equal(theirs.state_dict()[k], v) for k, v in pipe.unitouch.vision_model.state_dict().items())
    pipe.unitouch.release("image")
    assert "image" not in pipe.unitouch.loaded_modalities and "image" in pipe.unitouch.known_modalities


def test_an_image_encoder_that_stands_in_is_saved_with_its_sizes(touch_alone, photo, touch, tmp_path):
    torch.manual_seed(4)
    sizes_of_another = sizes().vision_config.to_dict() | {"num_hidden_layers": 2, "layer_norm_eps": 1e-3}
    unclip = write_unclip(tmp_path / "unclip", CLIPVisionModelWithProjection(CLIPVisionConfig(**sizes_of_another)))
    pipe = TactileStylizationPipeline.from_published(unclip, touch_alone)
    pipe.save_pretrained(tmp_path / "saved")
    again = TactileStylizationPipeline.from_pretrained(tmp_path / "saved")
    torch.testing.assert_close(made(again, photo, touch), made(pipe, photo, touch))


def test_the_unclips_image_encoder_is_not_read_for_touches(unclip, unitouch, touch, tmp_path):
    bare = tmp_path / "unclip"
    shutil.copytree(unclip, bare)
    shutil.rmtree(bare / "image_encoder")
    torch.testing.assert_close(
        made(TouchToImagePipeline.from_published(bare, unitouch), touch),
        made(TouchToImagePipeline.from_published(unclip, unitouch), touch),
    )


def test_prompts_and_texts_have_the_unclips_tokenizer(unclip, unitouch):
    pipe = TouchToImagePipeline.from_published(unclip, unitouch)
    assert pipe.processor.tokenizer is pipe.tokenizer


def test_a_plan_leaves_out_what_it_does(unclip, unitouch, touch):
    plan = TouchToImagePipeline.plan(touch, prompt_embeds=torch.zeros(1), guidance_scale=1.0, output_type="latent")
    pipe = TouchToImagePipeline.from_published(unclip, unitouch, plan=plan)
    assert pipe.text_encoder is None and pipe.vae is None
    with pytest.raises(InvalidInputError, match=r"needs the prompt encoder and the VAE"):
        made(pipe, touch)


def test_encoders_that_have_done_their_work_are_freed(unclip, unitouch, touch, tmp_path):
    whole = TouchToImagePipeline.from_published(unclip, unitouch)
    sparing = TouchToImagePipeline.from_published(unclip, unitouch, low_memory=True)
    alive = []

    def look(pipe, step, timestep, values):
        alive.append((pipe.text_encoder is not None, pipe.unitouch.loaded_modalities))
        return values

    for _ in range(2):  # the second call reads them again
        torch.testing.assert_close(made(sparing, touch, callback_on_step_end=look), made(whole, touch))
    assert set(alive) == {(False, ())}
    assert sparing.text_encoder is None
    torch.testing.assert_close(sparing.encode_prompt(["brick"]), whole.encode_prompt(["brick"]))
    sparing.save_pretrained(tmp_path / "saved")
    again = TouchToImagePipeline.from_pretrained(tmp_path / "saved")
    assert again.text_encoder is not None
    torch.testing.assert_close(made(again, touch), made(whole, touch))


def test_what_was_freed_comes_along_to_another_pipeline(unclip, unitouch, touch, photo):
    sparing = TouchToImagePipeline.from_published(unclip, unitouch, low_memory=True)
    made(sparing, touch)
    assert sparing.text_encoder is None
    restyling = TactileStylizationPipeline.from_pipe(sparing)
    whole = TactileStylizationPipeline.from_published(unclip, unitouch)
    torch.testing.assert_close(made(restyling, photo, touch), made(whole, photo, touch))


def test_a_model_without_a_folder_stays_where_memory_is_low(unclip, unitouch, touch):
    model = UniTouchModel(UniTouchModel.from_pretrained(unitouch).config, modalities=("touch",)).eval()
    pipe = TouchToImagePipeline.from_published(unclip, model, low_memory=True)
    made(pipe, touch)
    assert pipe.text_encoder is None and pipe.unitouch.loaded_modalities == ("touch",)


def test_networks_are_of_the_dtype_and_on_the_device(unclip, unitouch, touch):
    pipe = TouchToImagePipeline.from_published(unclip, unitouch, dtype=torch.bfloat16, device="cpu")
    made(pipe, touch)
    assert {part.dtype for part in (pipe.unet, pipe.vae, pipe.text_encoder, pipe.unitouch)} == {torch.bfloat16}


def test_files_of_a_variant_are_read(unclip, unitouch, tmp_path):
    theirs = StableUnCLIPImg2ImgPipeline.from_pretrained(unclip)
    theirs.save_pretrained(tmp_path / "unclip", variant="fp16")
    pipe = TouchToImagePipeline.from_published(tmp_path / "unclip", unitouch, variant="fp16")
    assert torch.equal(pipe.unet.conv_in.weight, theirs.unet.conv_in.weight)


@pytest.mark.parametrize("offload", ["model", "sequential"])
def test_offloading_is_passed_on(unclip, unitouch, offload, monkeypatch):
    called = []
    for name in ("enable_model_cpu_offload", "enable_sequential_cpu_offload"):
        monkeypatch.setattr(TouchToImagePipeline, name, lambda self, name=name, **kwargs: called.append((name, kwargs)))
    TouchToImagePipeline.from_published(unclip, unitouch, offload=offload, device="cpu")
    assert called == [(f"enable_{offload}_cpu_offload", {"device": "cpu"})]


def test_touches_of_a_latent_diffusion_model(tmp_path, unitouch, photo):
    torch.manual_seed(5)
    parts = write_ldm(tmp_path / "ldm")
    pipe = XToTouchPipeline.from_published(tmp_path / "ldm", unitouch, sensors=["gelsight", "digit"])
    by_hand = XToTouchPipeline(
        unet=parts["unet"], vae=parts["vae"], scheduler=parts["scheduler"], sensors=["gelsight", "digit"],
        unitouch=pipe.unitouch, processor=pipe.processor,
    )  # fmt: skip
    latents = [made(each, image=photo, output_type="latent") for each in (pipe, by_hand)]  # before a codebook's jumps
    assert (latents[0] - latents[1]).norm() <= 1e-5 * latents[1].norm()
    assert made(pipe, image=photo).shape == (2, 3, 16, 16)


def test_the_norm_that_touches_are_made_of_is_the_joint_spaces_or_given_or_measured(tmp_path, unitouch, photo):
    write_ldm(tmp_path / "ldm")
    read = partial(XToTouchPipeline.from_published, tmp_path / "ldm", unitouch, sensors=["gelsight", "digit"])
    model = UniTouchModel.from_pretrained(unitouch)
    with torch.no_grad():
        measured = model.get_image_features(read().processor.images(photo)).norm(dim=1).mean().item()
    for options, norm in (({}, 1.0), ({"embedding_norm": 7.5}, 7.5), ({"images": photo}, measured)):
        found = read(**options).encode_condition(photo).norm(dim=-1).flatten().tolist()
        assert found == pytest.approx([norm] * 2, rel=1e-5)
    with pytest.raises(InvalidInputError, match="`embedding_norm` came beside `images`"):
        read(embedding_norm=7.5, images=photo)


# Repositories ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def fetched(unclip, unitouch, monkeypatch) -> list[dict]:
    """What is asked of the Hub, which has two repositories."""
    asked: list[dict] = []

    def snapshot_download(repo_id: str, **options) -> str:
        asked.append({"repo_id": repo_id, **options})
        return str({"someone/unclip": unclip, "someone/unitouch": unitouch}[repo_id])

    monkeypatch.setattr("huggingface_hub.snapshot_download", snapshot_download)
    return asked


def test_repositories_are_fetched_without_pickles_and_what_is_not_read(unclip, unitouch, touch, fetched):
    pipe = TouchToImagePipeline.from_published("someone/unclip", "someone/unitouch", revision="v2", token="secret")
    torch.testing.assert_close(made(pipe, touch), made(TouchToImagePipeline.from_published(unclip, unitouch), touch))
    joint, model = fetched
    assert joint["repo_id"] == "someone/unitouch" and joint["token"] == "secret" and "revision" not in joint
    assert model["repo_id"] == "someone/unclip" and model["revision"] == "v2"
    assert {"*.bin", "*.ckpt", "*.pth"} < set(joint["ignore_patterns"]) < set(model["ignore_patterns"])
    assert {"image_encoder/*", "*.fp16.*"} < set(model["ignore_patterns"])


def test_a_planned_pipeline_is_read_from_a_repository(unclip, unitouch, touch, monkeypatch, tmp_path):
    whole = TouchToImagePipeline.from_published(unclip, unitouch)
    whole.save_pretrained(tmp_path / "saved")
    monkeypatch.setattr("huggingface_hub.snapshot_download", lambda repo_id, **options: str(tmp_path / "saved"))
    plan = TouchToImagePipeline.plan(touch, output_type="latent")
    pipe = TouchToImagePipeline.from_pretrained("someone/saved", plan=plan)
    assert pipe.vae is None
    found, expected = (made(each, touch, output_type="latent") for each in (pipe, whole))
    torch.testing.assert_close(found, expected)
    assert "VAE" in pipe(touch, **{**FEW, "output_type": "latent"}).report.left_out
