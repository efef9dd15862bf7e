"""Pipelines of published parts: an unCLIP folder of diffusers on a joint space."""

import math
import shutil

import pytest
import torch
from diffusers import StableUnCLIPImg2ImgPipeline
from torch.testing import assert_close
from transformers import CLIPVisionModelWithProjection

from tests.helpers.calls import Call, quiet, seeded
from tests.helpers.published import converted, sizes, write_unclip
from unitouch_gen.models import UniTouchModel
from unitouch_gen.pipelines import TactileStylizationPipeline, TouchToImagePipeline

to_image = TouchToImagePipeline.from_published


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    """Folders: a joint space, one of touch alone, an unCLIP with its image encoder, and one with another."""
    folder, other = (tmp_path_factory.mktemp("parts") for _ in range(2))
    joint = converted(folder)
    alone = converted(other, imagebind=False)
    unclip = write_unclip(folder / "unclip", UniTouchModel.from_pretrained(joint, modalities=("image",)).vision_model)
    torch.manual_seed(3)
    other = write_unclip(other / "unclip", CLIPVisionModelWithProjection(sizes().vision_config))
    return {"joint": joint, "alone": alone, "unclip": unclip, "other": other}


def latents(pipe, **inputs):
    return Call(quiet(pipe), {**inputs, "num_inference_steps": 2, "guidance_scale": 2.0}).latents()


def test_the_picture_is_that_of_the_parts_put_together_by_hand(parts, touch, tmp_path):
    """Of files of a variant, too; the unCLIP's image encoder is not read where the joint space has one."""
    pipe = to_image(parts["unclip"], parts["joint"])
    theirs = StableUnCLIPImg2ImgPipeline.from_pretrained(parts["unclip"])
    by_hand = TouchToImagePipeline.from_pipe(theirs, unitouch=UniTouchModel.from_pretrained(parts["joint"]))
    by_hand.unitouch.config.embedding_norm = pipe.unitouch.config.embedding_norm
    theirs.save_pretrained(tmp_path, variant="fp16")
    shutil.rmtree(tmp_path / "image_encoder")
    for made in (pipe, to_image(tmp_path, parts["joint"], variant="fp16")):
        assert_close(latents(made, touch=touch), latents(by_hand, touch=touch))
    assert pipe.processor.tokenizer is pipe.tokenizer
    half = to_image(parts["unclip"], parts["joint"], dtype=torch.bfloat16)
    assert {one.dtype for one in (half.unet, half.vae, half.text_encoder, half.unitouch)} == {torch.bfloat16}


def test_the_norm_of_embeddings_is_the_normalisers(parts, touch):
    pipe = to_image(parts["unclip"], parts["joint"])
    drawn = pipe.image_normalizer.unscale(torch.randn(20_000, 16, generator=seeded())).detach()
    expected = math.sqrt(float(drawn.double().square().sum(dim=1).mean()))
    found = pipe.encode_touch(touch, strength=1.0)
    assert found.norm(dim=1).tolist() == pytest.approx([expected] * 2, rel=0.01)


def test_photos_are_encoded_by_the_joint_space_or_else_by_the_unclip(parts, photo, touch, tmp_path):
    pipe = TactileStylizationPipeline.from_published(parts["other"], parts["joint"])
    own = UniTouchModel.from_pretrained(parts["joint"], modalities=("image",)).vision_model.state_dict()
    assert all(torch.equal(pipe.unitouch.load("image")[0].state_dict()[key], value) for key, value in own.items())
    pipe = TactileStylizationPipeline.from_published(parts["other"], parts["alone"])
    expected = latents(pipe, image=photo, touch=touch)
    theirs = StableUnCLIPImg2ImgPipeline.from_pretrained(parts["other"]).image_encoder.state_dict()
    assert all(torch.equal(theirs[key], value) for key, value in pipe.unitouch.vision_model.state_dict().items())
    own = UniTouchModel.from_pretrained(parts["alone"], modalities=("touch",))
    TactileStylizationPipeline.from_published(parts["other"], own).to(torch.bfloat16)
    assert own.dtype == next(own.touch_model.parameters()).dtype == torch.float32
    assert own.config.embedding_norm != pipe.unitouch.config.embedding_norm  # the caller's stays as it was
    assert own.known_modalities != pipe.unitouch.known_modalities
    pipe.save_pretrained(tmp_path)
    assert_close(latents(TactileStylizationPipeline.from_pretrained(tmp_path), image=photo, touch=touch), expected)


def test_repositories_are_fetched_without_pickles_and_what_is_not_read(parts, monkeypatch):
    asked: list[dict] = []
    fetch = lambda repo_id, **options: asked.append(options) or str(parts[repo_id.removeprefix("someone/")])  # noqa: E731
    monkeypatch.setattr("huggingface_hub.snapshot_download", fetch)
    to_image("someone/unclip", "someone/joint", revision="v2", token="secret")
    joint, unclip = asked
    assert joint["token"] == "secret"
    assert "revision" not in joint
    assert unclip["revision"] == "v2"
    assert {"*.bin", "*.ckpt", "*.pth"} < set(joint["ignore_patterns"]) < set(unclip["ignore_patterns"])
    assert {"image_encoder/*", "*.fp16.*"} < set(unclip["ignore_patterns"])
