"""Published parts that cannot be used, and options that cannot be."""

import json
import shutil

import pytest
import torch
from safetensors.torch import load_file

from tests.helpers.published_parts import converted
from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.pipelines import TouchToImagePipeline, XToTouchPipeline


def test_widths_have_to_agree_before_anything_is_read(unclip, tmp_path):
    other = converted(tmp_path, width=24, imagebind=False)
    (other / "model-touch.safetensors").unlink()  # nothing of it is looked at
    with pytest.raises(InvalidInputError, match=r"`unitouch` has embeddings of width 24, the unCLIP model of width 16"):
        TouchToImagePipeline.from_published(unclip, other)


@pytest.mark.parametrize("place", ["gone/deep/folder", "./gone", "../gone"])
def test_places_that_are_nothing(unclip, unitouch, place):
    with pytest.raises(InvalidInputError, match=r"`unclip` is .*no folder"):
        TouchToImagePipeline.from_published(place, unitouch)
    with pytest.raises(InvalidInputError, match=r"`unitouch` is .*no folder"):
        TouchToImagePipeline.from_published(unclip, place)


def test_folders_of_something_else(unclip, unitouch, tmp_path):
    with pytest.raises(InvalidInputError, match=r"`unclip` is .*holds no model_index.json"):
        TouchToImagePipeline.from_published(unitouch, unitouch)
    shutil.copytree(unclip, tmp_path / "unclip", ignore=shutil.ignore_patterns("vae"))
    with pytest.raises(InvalidInputError, match=r"`unclip` is .*holds no vae;"):
        TouchToImagePipeline.from_published(tmp_path / "unclip", unitouch)
    with pytest.raises(InvalidInputError, match=r"`unitouch` is .*holds no joint space"):
        TouchToImagePipeline.from_published(unclip, unclip)
    shutil.copytree(unclip / "unet", tmp_path / "ldm" / "unet")
    with pytest.raises(InvalidInputError, match=r"`ldm` is .*holds no vae"):
        XToTouchPipeline.from_published(tmp_path / "ldm", unitouch)


def test_pickled_weights_are_not_read(unclip, unitouch, tmp_path):
    shutil.copytree(unclip, tmp_path / "unclip")
    weights = tmp_path / "unclip" / "unet" / "diffusion_pytorch_model.safetensors"
    weights.unlink()
    torch.save({}, weights.with_suffix(".bin"))
    with pytest.raises(InvalidInputError, match=r"`unclip` is .*cannot be loaded"):
        TouchToImagePipeline.from_published(tmp_path / "unclip", unitouch)


@pytest.mark.parametrize("plan", [None, TouchToImagePipeline.plan("touch.png")])
def test_pickled_weights_of_a_saved_pipeline_are_not_read(unclip, unitouch, tmp_path, plan):
    TouchToImagePipeline.from_published(unclip, unitouch).save_pretrained(tmp_path / "saved")
    weights = tmp_path / "saved" / "unet" / "diffusion_pytorch_model.safetensors"
    torch.save(load_file(weights), weights.with_suffix(".bin"))
    weights.unlink()
    with pytest.raises(InvalidInputError, match=r"`pretrained_model_name_or_path` is .*safetensors"):
        TouchToImagePipeline.from_pretrained(tmp_path / "saved", plan=plan)


@pytest.mark.parametrize("content", [b"{", b"[]", b"{}", b"\xff", b'{"_class_name": "UNet2DModel"}'])
@pytest.mark.parametrize("file", ["model_index.json", "image_normalizer/config.json", "vae/config.json"])
def test_broken_settings_are_told_in_words(unclip, unitouch, tmp_path, file, content):
    shutil.copytree(unclip, tmp_path / "unclip")
    (tmp_path / "unclip" / file).write_bytes(content)
    plan = TouchToImagePipeline.plan("touch.png", output_type="latent")
    with pytest.raises(InvalidInputError):
        TouchToImagePipeline.from_published(tmp_path / "unclip", unitouch, plan=plan)


def test_a_broken_folder_is_one_message(unclip, unitouch, tmp_path):
    shutil.copytree(unclip, tmp_path / "unclip")
    (tmp_path / "unclip" / "vae" / "config.json").write_text(json.dumps({"_class_name": "AutoencoderKL"}))
    with pytest.raises(InvalidInputError, match=r"`unclip` is .*cannot be loaded"):
        TouchToImagePipeline.from_published(tmp_path / "unclip", unitouch)


@pytest.mark.parametrize("dtype", ["bfloat3", torch.int8, None])
def test_a_dtype_has_to_be_one_of_weights(unclip, unitouch, dtype):
    with pytest.raises((InvalidInputError, InvalidTypeError), match="`dtype` is"):
        TouchToImagePipeline.from_published(unclip, unitouch, dtype=dtype)


@pytest.mark.skipif(torch.cuda.is_available(), reason="the device is there")
@pytest.mark.parametrize("device", ["cuda", "cuda:1", "gpu", torch.device("cuda")])
def test_a_device_that_is_not_there_is_told_before_anything_is_read(device):
    with pytest.raises(InvalidInputError, match=rf"`device` is .*{str(device)[:3]}"):
        TouchToImagePipeline.from_published("nowhere", "nowhere", device=device)


def test_a_checkpoint_in_the_place_of_a_folder(unclip, tmp_path):
    (tmp_path / "last.ckpt").write_bytes(b"0")
    with pytest.raises(InvalidInputError, match=r"`unitouch` is .*last.ckpt', which is a file; .*unitouch-gen convert"):
        TouchToImagePipeline.from_published(unclip, tmp_path / "last.ckpt")


def test_an_unclip_draws_no_touch(unclip, unitouch):
    with pytest.raises(InvalidInputError, match="`unet` is conditioned on class labels of the kind 'projection'"):
        XToTouchPipeline.from_published(unclip, unitouch)


@pytest.mark.parametrize(
    ("options", "words"),
    [({"offload": "modul"}, "Did you mean 'model'"), ({"embedding_norm": 0.0}, "`embedding_norm` is 0"),
     ({"offload": "model", "low_memory": True}, "`offload` is 'model' beside `low_memory`"),
     ({"embedding_norm": float("nan")}, "`embedding_norm` is nan"), ({"colour": 3}, r"got \['colour'\]"),
     ({"torch_dtype": torch.float16}, r"got \['torch_dtype'\]; it takes .* device, dtype,")],
)  # fmt: skip
def test_options_that_cannot_be(unclip, unitouch, options, words):
    with pytest.raises(InvalidInputError, match=words):
        TouchToImagePipeline.from_published(unclip, unitouch, **options)
