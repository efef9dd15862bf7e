"""Checkpoints in CompVis' layout, against the same networks in plain PyTorch (see compvis_networks.py), and what is
refused of them and of their settings: by name, with nothing written.
"""

import errno
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel, VQModel
from safetensors.torch import load_file, save_file
from torch import Tensor
from typer.testing import CliRunner

from tests.helpers.compvis_checkpoints import (
    END,
    SCALES,
    START,
    STEPS,
    UNETS,
    WIDTH,
    betas,
    networks_of,
    settings_of,
    state_of,
    write,
)  # fmt: skip
from unitouch_gen.cli.convert import app
from unitouch_gen.convert import ldm as compvis
from unitouch_gen.convert.checkpoints import write_tensors
from unitouch_gen.convert.ldm import convert_ldm, read_layout
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.pipelines import XToTouchPipeline

KINDS = tuple(UNETS)


@pytest.fixture(scope="module", params=KINDS)
def kind(request) -> str:
    return request.param


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> dict[str, dict[str, Path]]:
    folder = tmp_path_factory.mktemp("published")
    return {kind: write(folder / kind, state_of(kind), settings_of(kind)) for kind in KINDS}


@pytest.fixture(scope="module")
def folders(files, tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("converted")
    for kind in KINDS:
        convert_ldm(**files[kind], output=folder / kind, told=lambda line: None)
    return {kind: folder / kind for kind in KINDS}


@pytest.fixture
def state() -> dict[str, Tensor]:
    """Tensors of the VQ model, to be changed."""
    return dict(state_of("vq"))


@pytest.fixture
def settings() -> dict:
    return settings_of("vq")


def read_vae(folder: Path) -> AutoencoderKL | VQModel:
    kind = {"VQModel": VQModel, "AutoencoderKL": AutoencoderKL}[VQModel.load_config(folder / "vae")["_class_name"]]
    return kind.from_pretrained(folder / "vae")


def latents_of(kind: str, count: int = 2) -> Tensor:
    channels = UNETS[kind]["in_channels"]
    return torch.randn(count, channels, 8, 8, generator=torch.Generator().manual_seed(3))


def condition(count: int = 2) -> Tensor:
    return torch.randn(count, 1, WIDTH, generator=torch.Generator().manual_seed(4))


def assert_same(found: Tensor, expected: Tensor) -> None:
    """To 1e-5 of the largest value."""
    error = float((found - expected).abs().max() / expected.abs().max())
    assert found.shape == expected.shape and error <= 1e-5, f"relative error {error:.1e}"


# What the networks compute --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ema", [False, True])
@torch.no_grad()
def test_the_unet_computes_the_same(kind, ema, files, folders, tmp_path):
    folder = folders[kind]
    if ema:
        convert_ldm(**files[kind], output=tmp_path, ema=True, told=lambda line: None)
        folder = tmp_path
    unet = UNet2DConditionModel.from_pretrained(folder / "unet")
    times = torch.tensor([7, 930])
    expected = networks_of(kind)[2 if ema else 0](latents_of(kind), times, condition())
    assert_same(unet(latents_of(kind), times, condition()).sample, expected)


@torch.no_grad()
def test_the_autoencoder_encodes_the_same(kind, folders):
    vae = read_vae(folders[kind])
    pixels = 2 * torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(5)) - 1
    found = vae.encode(pixels).latents if kind == "vq" else vae.encode(pixels).latent_dist.mode()
    assert_same(found, networks_of(kind)[1].encode(pixels))


@torch.no_grad()
def test_the_autoencoder_decodes_the_same(kind, folders):
    vae = read_vae(folders[kind])
    assert_same(vae.decode(latents_of(kind)).sample, networks_of(kind)[1].decode(latents_of(kind)))
    assert vae.config.scaling_factor == SCALES[kind]


def test_the_noise_is_that_of_training(kind, folders):
    scheduler = DDIMScheduler.from_pretrained(folders[kind] / "scheduler")
    np.testing.assert_allclose(scheduler.alphas_cumprod.numpy(), np.cumprod(1 - betas()), rtol=1e-4)
    scheduler.set_timesteps(50)
    assert scheduler.timesteps.tolist() == list(range(1, STEPS, STEPS // 50))[::-1]
    assert scheduler.config.prediction_type == "epsilon"


@pytest.mark.parametrize(
    ("name", "expected"), [("linear", lambda t: t**2), ("sqrt_linear", lambda t: t)], ids=["linear", "sqrt_linear"]
)
def test_schedules_go_by_other_names(settings, state, tmp_path, name, expected):
    settings["model"]["params"]["beta_schedule"] = name
    ends = (math.sqrt(START), math.sqrt(END)) if name == "linear" else (START, END)
    files = write(tmp_path, state, settings)
    found = DDIMScheduler(**read_layout(files["config"]).scheduler).betas
    np.testing.assert_allclose(found.numpy(), expected(np.linspace(*ends, STEPS)), rtol=1e-5)


PUBLISHED = {
    "class-conditional ImageNet, LDM-4": (
        {"model_channels": 192, "attention_resolutions": [8, 4, 2], "num_res_blocks": 2, "channel_mult": [1, 2, 3, 5],
         "num_heads": 1, "context_dim": 512, "image_size": 64, "in_channels": 3, "out_channels": 3},
        400.92,
    ),
    "Stable Diffusion 1": (
        {"model_channels": 320, "attention_resolutions": [4, 2, 1], "num_res_blocks": 2, "channel_mult": [1, 2, 4, 4],
         "num_heads": 8, "context_dim": 768, "image_size": 32, "in_channels": 3, "out_channels": 3, "legacy": False},
        859.52,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", PUBLISHED)
def test_published_unets_have_their_published_size(name, settings, tmp_path):
    unet, millions = PUBLISHED[name]
    settings["model"]["params"]["unet_config"]["params"] |= unet
    layout = read_layout(write(tmp_path, {}, settings)["config"])
    with torch.device("meta"):
        found = UNet2DConditionModel(**layout.unet)
    assert sum(tensor.numel() for tensor in found.parameters()) / 1e6 == pytest.approx(millions, abs=0.02)


# A picture ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def touched(kind, folders) -> tuple[XToTouchPipeline, np.ndarray]:
    """A pipeline of the converted parts, and what it made in four steps: pixels (B, H, W, 3) in [0, 1]; for "vq"
    latents in their place, as near the middle between two entries of a codebook rounding makes another picture.
    """
    pipe = XToTouchPipeline(
        unet=UNet2DConditionModel.from_pretrained(folders[kind] / "unet"),
        scheduler=DDIMScheduler.from_pretrained(folders[kind] / "scheduler"),
        vae=read_vae(folders[kind]),
    )
    pipe.set_progress_bar_config(disable=True)
    output = pipe(condition_embeds=condition(), latents=latents_of(kind), num_inference_steps=4, guidance_scale=2.0,
                  output_type="latent" if kind == "vq" else "np")  # fmt: skip
    return pipe, np.asarray(output.images)


def as_pixels(decoded: Tensor) -> np.ndarray:
    return (decoded / 2 + 0.5).clamp(0, 1).permute(0, 2, 3, 1).numpy()


@torch.no_grad()
def test_a_pipeline_makes_what_diffusers_parts_make_by_hand(kind, touched):
    pipe, images = touched
    pipe.scheduler.set_timesteps(4)
    latents, token = latents_of(kind), condition()
    for time in pipe.scheduler.timesteps:
        without = pipe.unet(latents, time, torch.zeros_like(token)).sample
        guided = without + 2.0 * (pipe.unet(latents, time, token).sample - without)
        latents = pipe.scheduler.step(guided, time, latents).prev_sample
    decoded = None if kind == "vq" else as_pixels(pipe.vae.decode(latents / pipe.vae.config.scaling_factor).sample)
    wanted = latents.numpy() if decoded is None else decoded
    assert np.linalg.norm(images - wanted) <= 1e-5 * np.linalg.norm(wanted)


@torch.no_grad()
def test_a_pipeline_makes_what_the_published_networks_make(kind, touched):
    unet, vae, _ = networks_of(kind)
    alphas = torch.tensor(np.cumprod(1 - betas()))
    latents, token = latents_of(kind), condition()
    for time in (751, 501, 251, 1):
        now, before = alphas[time], alphas[max(time - 250, 0)]
        times = torch.full((2,), time)
        without = unet(latents, times, torch.zeros_like(token))
        noise = without + 2.0 * (unet(latents, times, token) - without)
        denoised = (latents - (1 - now).sqrt() * noise) / now.sqrt()  # equation 12 of Song et al. (2021)
        latents = (before.sqrt() * denoised + (1 - before).sqrt() * noise).float()
    decoded = None if kind == "vq" else as_pixels(vae.decode(latents / SCALES[kind]))
    np.testing.assert_allclose(touched[1], latents.numpy() if decoded is None else decoded, rtol=1e-4, atol=1e-4)


# What is written ------------------------------------------------------------------------------------------------------


def test_the_same_input_makes_the_same_bytes(files, folders, tmp_path, contents):
    for _ in range(2):  # the second one writes over the first
        convert_ldm(**files["vq"], output=tmp_path / "again", told=lambda line: None)
        assert contents(tmp_path / "again") == contents(folders["vq"])
    assert sorted(contents(folders["vq"])) == [
        "scheduler/scheduler_config.json", "unet/config.json", "unet/diffusion_pytorch_model.safetensors",
        "vae/config.json", "vae/diffusion_pytorch_model.safetensors",
    ]  # fmt: skip


def test_safetensors_make_the_same(files, folders, tmp_path, state, contents):
    save_file(state, tmp_path / "model.safetensors")
    convert_ldm(tmp_path / "model.safetensors", files["vq"]["config"], tmp_path / "out", told=lambda line: None)
    assert contents(tmp_path / "out") == contents(folders["vq"])


def test_weights_keep_their_dtype(tmp_path, state, settings):
    half = {key: tensor.half() if tensor.is_floating_point() else tensor for key, tensor in state.items()}
    convert_ldm(**write(tmp_path, half, settings), output=tmp_path / "out", told=lambda line: None)
    weights = load_file(tmp_path / "out" / "unet" / "diffusion_pytorch_model.safetensors")
    assert {tensor.dtype for tensor in weights.values()} == {torch.float16}


def test_it_says_what_was_used_ignored_and_missed(files, tmp_path):
    lines = []
    convert_ldm(**files["vq"], output=tmp_path / "out", told=lines.append)
    unet, vae, _ = networks_of("vq")
    count = len(unet.state_dict())
    in_vae = len([key for key in vae.state_dict() if not key.startswith("loss.")])
    assert lines == [
        f"Used: first_stage_model ({in_vae}), model ({count}), schedule (1)",
        f"Ignored: cond_stage_model (1), first_stage_model.loss (2), model_ema ({count + 2}), schedule (1)",
        "The checkpoint has moving averages of the UNet, which `ema` would use in place of its weights",
        "Missed: the encoder of conditions, cond_stage_model; a joint space takes its place",
        "Latents are scaled by 1, as the configuration says",
    ]


@pytest.mark.parametrize("measured", [False, True])
def test_a_scale_that_was_measured_is_in_the_checkpoint(tmp_path, state, settings, measured):
    settings["model"]["params"] |= {"scale_by_std": True}
    if measured:
        state["scale_factor"] = torch.tensor(0.75)
        convert_ldm(**write(tmp_path, state, settings), output=tmp_path / "out", told=lambda line: None)
        assert read_vae(tmp_path / "out").config.scaling_factor == 0.75
    else:
        with pytest.raises(InvalidInputError, match=r"no scale_factor that was measured"):
            convert_ldm(**write(tmp_path, state, settings), output=tmp_path / "out")


def test_the_command_converts(files, folders, tmp_path, contents):
    arguments = ["ldm", "--ldm", files["vq"]["ldm"], "--config", files["vq"]["config"], "-o", tmp_path / "out"]
    result = CliRunner().invoke(app, list(map(str, arguments)))
    assert result.exit_code == 0 and f"The model is in {tmp_path / 'out'}" in result.output
    assert contents(tmp_path / "out") == contents(folders["vq"])


# What is refused ------------------------------------------------------------------------------------------------------


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
        (b" " * 2**21, "has 2097152 bytes"),
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

    def full(folder: Path, files: dict, written: Callable[[int, int], object]) -> None:
        write_tensors(folder, files, written)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(compvis, "write_tensors", full)
    with pytest.raises(InvalidInputError, match=r"`output` cannot be written to .* No space left on device"):
        convert_ldm(**files["vq"], output=tmp_path / "out", ema=True, told=lambda line: None)
    assert contents(tmp_path) == before and len(list(tmp_path.iterdir())) == there
