"""What is refused of checkpoints in CompVis' layout and their settings: by name, with nothing written."""

import errno
import math
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from tests.helpers.compvis_checkpoints import write
from unitouch_gen.convert import ldm as compvis
from unitouch_gen.convert.checkpoints import write_tensors
from unitouch_gen.convert.ldm import convert_ldm
from unitouch_gen.errors import InvalidInputError


def refused(tmp_path: Path, state: dict, settings: dict, **options: bool) -> str:
    """The message, where nothing was written."""
    files = write(tmp_path / "in", state, settings)
    with pytest.raises((InvalidInputError, TypeError)) as caught:
        convert_ldm(**files, output=tmp_path / "out", **options)
    assert [path.name for path in tmp_path.iterdir()] == ["in"]
    return str(caught.value)


@pytest.mark.parametrize(
    ("key", "name"),
    [
        ("model.diffusion_model.time_embed.0.weight", "time_embedding.linear_1.weight"),
        ("model.diffusion_model.middle_block.1.proj_in.bias", "mid_block.attentions.0.proj_in.bias"),
        ("model.diffusion_model.output_blocks.1.2.conv.bias", "output_blocks.1.2.conv.bias"),
        ("first_stage_model.encoder.down.2.block.0.nin_shortcut.bias",
         "encoder.down_blocks.2.resnets.0.conv_shortcut.bias"),
        ("first_stage_model.encoder.down.1.downsample.conv.bias", "encoder.down_blocks.1.downsamplers.0.conv.bias"),
        ("model.diffusion_model.input_blocks.2.0.op.bias", "down_blocks.0.downsamplers.0.conv.bias"),
        ("first_stage_model.decoder.up.1.upsample.conv.bias", "decoder.up.1.upsample.conv.bias"),
        ("first_stage_model.post_quant_conv.bias", "post_quant_conv.bias"),
        ("first_stage_model.quantize.embedding.weight", "quantize.embedding.weight"),
    ],
)  # fmt: skip
def test_a_missing_tensor_is_named(tmp_path, state, settings, key, name):
    del state[key]
    message = refused(tmp_path, state, settings)
    assert f"fit `config`: '{name}'" in message and message.count("is missing") == 1


@pytest.mark.parametrize("block", ["input_blocks.1", "middle_block.1", "output_blocks.0"])
def test_of_a_missing_block_nothing_else_is_named(tmp_path, state, settings, block):
    lost = [key for key in state if key.startswith(f"model.diffusion_model.{block}.")]
    message = refused(tmp_path, {key: value for key, value in state.items() if key not in lost}, settings)
    assert len(lost) == 10 + int(message.partition("; and ")[2].partition(" more")[0] or 0)
    assert message.count("is missing") == 10


def test_the_first_ten_of_many_are_named(tmp_path, state, settings):
    lost = [key for key in state if ".transformer_blocks." in key and key.startswith("model.")]
    message = refused(tmp_path, {key: value for key, value in state.items() if key not in lost}, settings)
    assert message.count("is missing") == 10 and f"and {len(lost) - 10} more" in message


@pytest.mark.parametrize(
    ("key", "shape"),
    [
        ("model.diffusion_model.out.2.weight", (3, 32, 3, 4)),
        ("first_stage_model.quantize.embedding.weight", (31, 3)),
        ("first_stage_model.encoder.mid.attn_1.q.weight", (64, 64, 3, 3)),
        ("first_stage_model.encoder.mid.attn_1.q.weight", (64, 64, 0, 0)),
        ("first_stage_model.encoder.conv_in.weight", ()),
    ],
)
def test_a_tensor_of_another_shape_is_named(tmp_path, state, settings, key, shape):
    state[key] = torch.zeros(shape)
    message = refused(tmp_path, state, settings)
    assert key in message or "misshapen" in message


@pytest.mark.parametrize("prefix", ["model.diffusion_model.", "first_stage_model."])
def test_a_tensor_without_a_place_is_named(tmp_path, state, settings, prefix):
    state[f"{prefix}adapter.weight"] = torch.ones(3)
    assert f"'{prefix}adapter.weight' has no place" in refused(tmp_path, state, settings)


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("key", ["model.diffusion_model.out.2.bias", "first_stage_model.quantize.embedding.weight"])
def test_weights_that_are_not_finite_are_named(tmp_path, state, settings, key, value):
    state[key] = state[key].clone()
    state[key].view(-1)[1] = value
    assert f"NaN or infinite weights: {key}." in refused(tmp_path, state, settings)


def test_integers_are_no_weights(tmp_path, state, settings):
    state["model.diffusion_model.out.2.bias"] = torch.ones(3, dtype=torch.int64)
    assert "'model.diffusion_model.out.2.bias' is a tensor of shape (3,) and dtype int64" in refused(
        tmp_path, state, settings
    )


def test_moving_averages_have_to_be_there(tmp_path, state, settings):
    del state["model_ema.diffusion_modelout2bias"]
    assert "'model_ema.diffusion_modelout2bias' is missing" in refused(tmp_path / "one", state, settings, ema=True)
    state = {key: tensor for key, tensor in state.items() if not key.startswith("model_ema")}
    assert "no 'model_ema.*'" in refused(tmp_path / "all", state, settings, ema=True)


@pytest.mark.parametrize("prefix", ["model.diffusion_model.", "first_stage_model."])
def test_other_checkpoints_are_refused(tmp_path, state, settings, prefix):
    state = {key: tensor for key, tensor in state.items() if not key.startswith(prefix)}
    assert f"holds no '{prefix}*' but" in refused(tmp_path, state, settings)


def test_a_text_is_no_checkpoint(tmp_path, files):
    (tmp_path / "last.ckpt").write_text("version https://git-lfs.github.com/spec/v1\n")
    with pytest.raises(InvalidInputError, match=r"`ldm` names .* cannot be read as a checkpoint"):
        convert_ldm(tmp_path / "last.ckpt", files["vq"]["config"], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_the_schedule_has_to_be_that_of_training(tmp_path, state, settings):
    settings["model"]["params"]["linear_end"] = 0.012
    message = refused(tmp_path, state, settings)
    assert "1000 timesteps with betas from 0.0015 to 0.012, but" in message
    assert "trained on 1000 with betas from 0.0015 to 0.0195" in message


UNET, STAGE = "unet_config.params", "first_stage_config.params"


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        ("unet_config", None, "`config.model.params.unet_config` is None; it has to hold settings"),
        ("conditioning_key", "concat", "`config.model.params.conditioning_key` is 'concat'"),
        ("parameterization", "score", "has to be one of 'eps', 'x0', 'v'"),
        ("linear_start", "a lot", "`config.model.params.linear_start` is 'a lot'"),
        ("timesteps", 0, "`config.model.params.timesteps` is 0"),
        ("scale_factor", math.nan, "`config.model.params.scale_factor` is nan"),
        ("first_stage_config.target", "ldm.models.autoencoder.IdentityFirstStage", "'IdentityFirstStage'"),
        (f"{UNET}.num_res_blocks", "two", f"`config.model.params.{UNET}.num_res_blocks` is 'two'"),
        (f"{UNET}.channel_mult", [1] * 1000, "list of 1 to 12 integers"),
        (f"{UNET}.channel_mult", [2, 4], "begins with 2"),
        (f"{UNET}.model_channels", 40, "multiple of 32"),
        (f"{UNET}.num_heads", 3, "does not divide the 64 channels"),
        (f"{UNET}.num_heads", -1, "one has to be there"),
        (f"{UNET}.attention_resolutions", [16], "attention_resolutions` has 16"),
        (f"{UNET}.in_channels", 6, "a UNet from 6 to 3 channels and latents of 3"),
        (f"{UNET}.use_spatial_transformer", False, "only True can be converted"),
        (f"{UNET}.resblock_updown", True, "only False can be converted"),
        (f"{UNET}.secret", 1, f"`config.model.params.{UNET}.secret` is no setting"),
        (f"{STAGE}.ddconfig.attn_resolutions", [16], "attn_resolutions` has 16"),
        (f"{STAGE}.ddconfig.double_z", True, "double_z` is True"),
    ],
)
def test_settings_that_cannot_be_converted_are_named(tmp_path, state, settings, place, value, words):
    *parents, last = place.split(".")
    section = settings["model"]["params"]
    for name in parents:
        section = section[name]
    section[last] = value
    assert words in refused(tmp_path, {}, settings)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"model: [", "cannot be read as YAML"),
        (b"\xff\xfe\x00model", "cannot be read as YAML"),
        (b"[" * 2000, "cannot be read as YAML"),
        (b"when: 2024-13-45", "cannot be read as YAML"),
        (b"", "which holds None"),
        (b"- a", "a list of 1"),
        (b"other: 1", "`config.model` is missing"),
        (b" " * 2**21, "Was `ldm` meant?"),
    ],
    ids=["yaml", "bytes", "deep", "date", "empty", "list", "other", "large"],
)
def test_other_files_are_no_configuration(tmp_path, files, content, words):
    (tmp_path / "config.yaml").write_bytes(content)
    with pytest.raises(InvalidInputError) as caught:
        convert_ldm(files["vq"]["ldm"], tmp_path / "config.yaml", tmp_path / "out")
    assert words in str(caught.value) and not (tmp_path / "out").exists()


def test_files_have_to_be_there(tmp_path, files):
    with pytest.raises(InvalidInputError, match=r"`config` names .* does not exist"):
        convert_ldm(files["vq"]["ldm"], tmp_path / "config.yaml", tmp_path / "out")
    with pytest.raises(InvalidInputError, match=r"`ldm` names .* does not exist"):
        convert_ldm(tmp_path / "last.ckpt", files["vq"]["config"], tmp_path / "out")


@pytest.mark.parametrize("there", [False, True])
def test_a_full_disk_leaves_what_was_there(tmp_path, monkeypatch, files, there, contents):
    if there:
        convert_ldm(**files["vq"], output=tmp_path / "out", told=lambda line: None)
    before = contents(tmp_path)

    def full(path: Path, promises: dict, written: Callable[[int], None]) -> None:
        write_tensors(path, promises, written)
        if path.parent.name == "vae":
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(compvis, "write_tensors", full)
    with pytest.raises(InvalidInputError, match=r"`output` is .* No space left on device"):
        convert_ldm(**files["vq"], output=tmp_path / "out", ema=True, told=lambda line: None)
    assert contents(tmp_path) == before and len(list(tmp_path.iterdir())) == there
