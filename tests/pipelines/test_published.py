"""Pipelines of published parts: an unCLIP folder of diffusers, or a latent diffusion of touch, on a joint space."""

import math
import shutil

import pytest
import torch
from diffusers import StableUnCLIPImg2ImgPipeline
from torch.testing import assert_close
from transformers import CLIPVisionModelWithProjection

from tests.helpers.calls import Call, quiet
from tests.helpers.published_parts import converted, sizes, write_ldm, write_unclip
from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.models import UniTouchModel
from unitouch_gen.pipelines import TactileStylizationPipeline, TouchToImagePipeline, XToTouchPipeline

FEW = {"num_inference_steps": 2, "guidance_scale": 2.0}


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    """Folders: a joint space, one of touch alone, an unCLIP with its image encoder, one with another, and an LDM."""
    folder = tmp_path_factory.mktemp("parts")
    for name in ("whole", "alone", "ldm"):
        (folder / name).mkdir()
    joint, alone = converted(folder / "whole"), converted(folder / "alone", imagebind=False)
    own = UniTouchModel.from_pretrained(joint, modalities=("image",)).vision_model
    torch.manual_seed(3)
    other = CLIPVisionModelWithProjection(sizes().vision_config)
    write_ldm(folder / "ldm")
    return {
        "joint": joint, "alone": alone, "ldm": folder / "ldm",
        "unclip": write_unclip(folder / "unclip", own), "other": write_unclip(folder / "other", other),
    }  # fmt: skip


def latents(pipe, **inputs):
    return Call(quiet(pipe), {**inputs, **FEW}).latents()


def test_the_picture_is_that_of_the_parts_put_together_by_hand(parts, touch, tmp_path, recwarn):
    """Of files of a variant, too; the unCLIP's image encoder is not read where the joint space has one."""
    pipe = TouchToImagePipeline.from_published(parts["unclip"], parts["joint"])
    theirs = StableUnCLIPImg2ImgPipeline.from_pretrained(parts["unclip"])
    by_hand = TouchToImagePipeline.from_pipe(theirs, unitouch=UniTouchModel.from_pretrained(parts["joint"]))
    by_hand.unitouch.config.embedding_norm = pipe.unitouch.config.embedding_norm
    expected = latents(by_hand, touch=touch)
    assert_close(latents(pipe, touch=touch), expected)
    theirs.save_pretrained(tmp_path, variant="fp16")
    shutil.rmtree(tmp_path / "image_encoder")
    assert_close(
        latents(TouchToImagePipeline.from_published(tmp_path, parts["joint"], variant="fp16"), touch=touch), expected
    )
    assert pipe.processor.tokenizer is pipe.tokenizer and not [w for w in recwarn if "image encoder" in str(w.message)]
    half = TouchToImagePipeline.from_published(parts["unclip"], parts["joint"], dtype=torch.bfloat16)
    half.encode_touch(touch)
    assert {one.dtype for one in (half.unet, half.vae, half.text_encoder, half.unitouch)} == {torch.bfloat16}


def test_touches_of_a_latent_diffusion_model(parts, photo):
    sensors = ["gelsight", "digit"]
    pipe = XToTouchPipeline.from_published(parts["ldm"], parts["joint"], sensors=sensors)
    by_hand = write_ldm(parts["ldm"])
    by_hand.pop("embedding_bank")
    other = XToTouchPipeline(**by_hand, unitouch=pipe.unitouch, processor=pipe.processor, sensors=sensors)
    assert_close(latents(pipe, image=photo), latents(other, image=photo), atol=1e-5, rtol=1e-5)


def test_the_norm_of_embeddings_is_the_normalisers_or_given_or_measured(parts, photo, touch):
    pipe = TouchToImagePipeline.from_published(parts["unclip"], parts["joint"])
    drawn = pipe.image_normalizer.unscale(torch.randn(20_000, 16, generator=torch.Generator().manual_seed(0))).detach()
    with torch.no_grad():
        measured = pipe.unitouch.get_image_features(pipe.processor.images(photo)).norm(dim=1).mean().item()
    expected = math.sqrt(float(drawn.double().square().sum(dim=1).mean()))
    for options, norm in (({}, expected), ({"embedding_norm": 7.5}, 7.5), ({"images": photo}, measured)):
        pipe = TouchToImagePipeline.from_published(parts["unclip"], parts["joint"], **options)
        assert pipe.encode_touch(touch, strength=1.0).norm(dim=1).tolist() == pytest.approx([norm] * 2, rel=0.01)
    pipe = XToTouchPipeline.from_published(parts["ldm"], parts["joint"], sensors=["gelsight", "digit"])
    assert pipe.encode_condition(photo).norm(dim=-1).flatten().tolist() == pytest.approx([1.0] * 2, rel=1e-5)


def test_photos_are_encoded_by_the_joint_space_or_else_by_the_unclip(parts, photo, touch, tmp_path):
    with pytest.warns(UserWarning, match="`unclip` brings another image encoder than `unitouch`") as caught:
        pipe = TactileStylizationPipeline.from_published(parts["other"], parts["joint"])
    assert caught[0].filename == __file__
    own = UniTouchModel.from_pretrained(parts["joint"], modalities=("image",)).vision_model.state_dict()
    assert all(torch.equal(pipe.unitouch.vision_model.state_dict()[key], value) for key, value in own.items())
    pipe = TactileStylizationPipeline.from_published(parts["other"], parts["alone"])
    expected = latents(pipe, image=photo, touch=touch)
    theirs = StableUnCLIPImg2ImgPipeline.from_pretrained(parts["other"]).image_encoder.state_dict()
    assert all(torch.equal(theirs[key], value) for key, value in pipe.unitouch.vision_model.state_dict().items())
    pipe.save_pretrained(tmp_path)
    assert_close(latents(TactileStylizationPipeline.from_pretrained(tmp_path), image=photo, touch=touch), expected)


def test_repositories_are_fetched_without_pickles_and_what_is_not_read(parts, touch, monkeypatch):
    asked = []

    def snapshot_download(repo_id: str, **options) -> str:
        asked.append({"repo_id": repo_id, **options})
        return str(parts[repo_id.removeprefix("someone/")])

    monkeypatch.setattr("huggingface_hub.snapshot_download", snapshot_download)
    TouchToImagePipeline.from_published("someone/unclip", "someone/joint", revision="v2", token="secret")
    joint, unclip = asked
    assert joint["token"] == "secret" and "revision" not in joint and unclip["revision"] == "v2"
    assert {"*.bin", "*.ckpt", "*.pth"} < set(joint["ignore_patterns"]) < set(unclip["ignore_patterns"])
    assert {"image_encoder/*", "*.fp16.*"} < set(unclip["ignore_patterns"])


@pytest.mark.parametrize(
    ("unclip", "joint", "options", "named"),
    [
        ("./gone", "joint", {}, "unclip"),
        ("unclip", "../gone", {}, "unitouch"),
        ("joint", "joint", {}, "unclip"),
        ("unclip", "unclip", {}, "unitouch"),
        ("pickled", "joint", {}, "unclip"),
        ("broken", "joint", {}, "unclip"),
        ("unclip", "narrow", {}, "unitouch"),
        ("unclip", "joint", {"dtype": torch.int8}, "dtype"),
        ("unclip", "joint", {"embedding_norm": 0.0}, "embedding_norm"),
        ("unclip", "joint", {"embedding_norm": 7.5, "images": torch.zeros(3, 32, 32)}, "embedding_norm"),
        ("unclip", "joint", {"colour": 3}, "colour"),
    ],
)
def test_what_cannot_be_built_on_is_refused_by_name(parts, tmp_path, unclip, joint, options, named):
    places = dict(parts)
    if unclip in ("pickled", "broken"):
        places[unclip] = shutil.copytree(parts["unclip"], tmp_path / unclip)
        file = places[unclip] / "unet" / "diffusion_pytorch_model.safetensors"
        torch.save({}, file.with_suffix(".bin"))
        file.unlink() if unclip == "pickled" else file.write_bytes(file.read_bytes()[:-500])
    if joint == "narrow":
        places[joint] = converted(tmp_path, width=24, imagebind=False)
    with pytest.raises((InvalidInputError, InvalidTypeError), match=f"`{named}`"):
        TouchToImagePipeline.from_published(places.get(unclip, unclip), places.get(joint, joint), **options)


def test_an_unclip_draws_no_touch(parts):
    with pytest.raises(InvalidInputError, match=r"`unet`|`sensors`"):
        XToTouchPipeline.from_published(parts["unclip"], parts["joint"])
