"""Checkpoints in CompVis' layout, against the same networks in plain PyTorch: see networks.py."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
import typer
from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel, VQModel
from safetensors.torch import load_file, save_file
from torch import Tensor
from typer.testing import CliRunner

from tests.helpers.compvis_checkpoints import END, SCALES, START, STEPS, UNETS, WIDTH, betas, networks_of, write
from unitouch_gen.cli.convert_ldm import convert_ldm as command
from unitouch_gen.convert.ldm import convert_ldm
from unitouch_gen.convert.ldm_config import read_layout
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.pipelines import XToTouchPipeline


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
    app = typer.Typer()
    app.command()(command)
    arguments = ["--ldm", files["vq"]["ldm"], "--config", files["vq"]["config"], "-o", tmp_path / "out"]
    result = CliRunner().invoke(app, list(map(str, arguments)))
    assert result.exit_code == 0 and f"The model is in {tmp_path / 'out'}" in result.output
    assert contents(tmp_path / "out") == contents(folders["vq"])
