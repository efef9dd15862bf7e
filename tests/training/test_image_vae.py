"""The autoencoders' objective, their latents' scale, and latents computed once."""

import logging
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from diffusers import AutoencoderDC, VQModel

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models.autoencoders import CLASSES, encode_raw
from unitouch_gen.training.batches import ArrayDataset
from unitouch_gen.training.image_vae import (
    AutoencoderLoss,
    AutoencoderObjective,
    cached_latents,
    latent_scale,
    make_autoencoder,
    random_square,
    read_autoencoder,
    save_autoencoder,
    to_signed,
)

PICTURES = np.random.default_rng(0).integers(0, 256, (9, 3, 32, 32), dtype=np.uint8)
PLAIN = AutoencoderLoss(gradient_weight=0.0, latent_noise=0.0, latent_weight=0.0)


@pytest.fixture
def vae() -> AutoencoderDC:
    torch.manual_seed(0)
    return AutoencoderDC(
        latent_channels=4, encoder_block_types="ResBlock", decoder_block_types="ResBlock",
        encoder_block_out_channels=(8, 8), decoder_block_out_channels=(8, 8), encoder_layers_per_block=(1, 1),
        decoder_layers_per_block=(1, 1), encoder_qkv_multiscales=((), ()), decoder_qkv_multiscales=((), ()),
        scaling_factor=0.5,
    ).eval()  # fmt: skip


def test_latents_are_the_autoencoders_scaled(vae: AutoencoderDC, tmp_path: Path) -> None:
    latents = cached_latents(vae, [PICTURES[:4], PICTURES[4:]], "k", tmp_path / "new", batch_size=3)
    with torch.no_grad():
        expected = 0.5 * vae.encode(torch.from_numpy(PICTURES).float() / 127.5 - 1).latent
    torch.testing.assert_close(latents, expected)


def test_a_tiny_autoencoder_begins_as_a_thumbnail() -> None:
    sizes = {"encoder_block_out_channels": [8] * 4, "decoder_block_out_channels": [8] * 4}
    blocks = {"num_encoder_blocks": [0, 1, 1, 1], "num_decoder_blocks": [1, 1, 1, 0]}
    vae = make_autoencoder({"class": "AutoencoderTiny", "latent_channels": 4, **sizes, **blocks}).eval()
    ramp = torch.linspace(-0.6, 0.6, 128)
    picture = torch.stack([ramp.expand(128, 128), -ramp[:, None].expand(128, 128), torch.full((128, 128), 0.3)])[None]
    with torch.no_grad():
        latents = encode_raw(vae, picture)
        restored = vae.decode(latents).sample
    assert latents.shape == (1, 4, 16, 16)
    assert (restored - picture)[..., 24:-24, 24:-24].abs().max() < 0.06  # but for the latents' bound, and the rims


def test_a_crop_is_a_square_of_what_there_is() -> None:
    rows, columns = torch.arange(32)[:, None].expand(32, 32), torch.arange(32).expand(32, 32)
    images = torch.stack([rows, columns]).expand(3, 2, 32, 32)
    torch.manual_seed(0)
    corners = set()
    for _ in range(50):
        square = random_square(images, 24)
        assert square.shape == (3, 2, 24, 24)
        top, left = square[0, :, 0, 0].tolist()
        assert torch.equal(square, images[..., top : top + 24, left : left + 24])
        corners.add((top, left))
    assert len(corners) > 20 and max(max(corner) for corner in corners) == 8
    assert torch.equal(random_square(images, 40), images)


def test_latents_are_computed_once(vae: AutoencoderDC, tmp_path: Path) -> None:
    first = cached_latents(vae, [PICTURES], "k", tmp_path)
    assert torch.equal(cached_latents(vae, [], "k", tmp_path), first)  # no picture is looked at


def test_a_changed_autoencoder_has_its_latents_computed_anew(vae: AutoencoderDC, tmp_path: Path) -> None:
    first = cached_latents(vae, [PICTURES], "k", tmp_path)
    with torch.no_grad():
        next(vae.encoder.parameters()).mul_(1.5)
    assert not torch.equal(cached_latents(vae, [PICTURES], "k", tmp_path), first)


def test_latents_of_another_scale_are_computed_anew(vae: AutoencoderDC, tmp_path: Path) -> None:
    first = cached_latents(vae, [PICTURES], "k", tmp_path)
    vae.register_to_config(scaling_factor=0.25)
    torch.testing.assert_close(cached_latents(vae, [PICTURES], "k", tmp_path), first / 2)


def test_the_scale_gives_latents_unit_variance(vae: AutoencoderDC) -> None:
    dataset = ArrayDataset(pixels=PICTURES)
    with torch.no_grad():
        latents = vae.encode(to_signed(torch.from_numpy(PICTURES))).latent
    assert (latents * latent_scale(vae, dataset)).std().item() == pytest.approx(1.0, abs=1e-3)


def test_pixels_run_from_minus_one_to_one() -> None:
    assert to_signed(torch.tensor([0, 255], dtype=torch.uint8)).tolist() == [-1.0, 1.0]


def test_peak_signal_to_noise_is_on_pixels_from_zero_to_one(vae: AutoencoderDC) -> None:
    objective = AutoencoderObjective(vae, PLAIN)
    batch = {"pixels": torch.from_numpy(PICTURES)}
    with torch.no_grad():
        restored = vae.decode(vae.encode(to_signed(batch["pixels"])).latent).sample
    error = ((restored + 1) / 2 - batch["pixels"] / 255).square().mean().item()
    assert objective(batch)["psnr"].item() == pytest.approx(-10 * np.log10(error), abs=1e-3)


def test_the_loss_is_the_error_of_pixels_and_of_their_differences(vae: AutoencoderDC) -> None:
    batch = {"pixels": torch.from_numpy(PICTURES)}
    pixels = to_signed(batch["pixels"])
    loss = AutoencoderObjective(vae, PLAIN.model_copy(update={"gradient_weight": 0.5}))(batch)["loss"].item()
    with torch.no_grad():
        error = vae.decode(vae.encode(pixels).latent).sample - pixels
    across = (error[..., 1:] - error[..., :-1]).abs().mean()
    down = (error[..., 1:, :] - error[..., :-1, :]).abs().mean()
    assert loss == pytest.approx((error.abs().mean() + 0.5 * (across + down)).item(), rel=1e-5)


def test_a_vq_model_pays_for_the_distance_to_its_codebook() -> None:
    torch.manual_seed(0)
    kinds = {"down_block_types": ("DownEncoderBlock2D",) * 2, "up_block_types": ("UpDecoderBlock2D",) * 2}
    vae = VQModel(**kinds, block_out_channels=(8, 8), norm_num_groups=4, latent_channels=3, num_vq_embeddings=16)
    pixels = to_signed(torch.from_numpy(PICTURES))
    loss = AutoencoderObjective(vae, PLAIN)({"pixels": torch.from_numpy(PICTURES)})["loss"].item()
    with torch.no_grad():
        latents = vae.encode(pixels).latents
        codes = vae.quantize.embedding.weight  # (16, 3)
        flat = latents.permute(0, 2, 3, 1).reshape(-1, 3)
        distance = torch.cdist(flat, codes).min(dim=1).values.square().mean() / 3
        error = F.l1_loss(vae.decode(latents).sample, pixels)
    # van den Oord et al., 2017, Eq. 3, with beta = 0.25: both terms are the distance to the nearest code
    assert loss == pytest.approx((error + 1.25 * distance).item(), rel=1e-4)


KL = {
    "class": "AutoencoderKL", "latent_channels": 4, "block_out_channels": [8, 16, 16], "norm_num_groups": 4,
    "down_block_types": ["DownEncoderBlock2D"] * 3, "up_block_types": ["UpDecoderBlock2D"] * 3,
}  # fmt: skip


def test_a_kl_model_pays_for_its_divergence_from_unit_normal_latents() -> None:
    torch.manual_seed(0)
    vae = make_autoencoder(KL)
    batch = {"pixels": torch.from_numpy(PICTURES)}
    found = AutoencoderObjective(vae, PLAIN)(batch)["latent"].item()
    with torch.no_grad():
        mine = vae.encode(to_signed(batch["pixels"])).latent_dist
    normal = torch.distributions.Normal
    expected = torch.distributions.kl_divergence(normal(mine.mean, mine.std), normal(0.0, 1.0)).mean().item()
    assert found == pytest.approx(expected, rel=1e-5)


def test_a_new_kl_model_passes_pictures_on() -> None:
    torch.manual_seed(0)
    vae = make_autoencoder(KL)
    with torch.no_grad():
        mine = vae.encode(to_signed(torch.from_numpy(PICTURES))).latent_dist
        pixels = vae.decode(mine.mode()).sample
    # Latents differ between places far more than by their noise, and so do pixels.
    assert mine.mean.std() > 3 * mine.std.mean() and 0.1 < pixels.std(dim=(-2, -1)).mean() < 10.0


@pytest.mark.parametrize("kind", CLASSES)
def test_every_kind_is_read_back(vae: AutoencoderDC, tmp_path: Path, kind: str, caplog) -> None:
    small = {"block_out_channels": (8,), "norm_num_groups": 4}
    tiny = {"encoder_block_out_channels": (8,) * 4, "decoder_block_out_channels": (8,) * 4}
    made = vae if kind == "AutoencoderDC" else CLASSES[kind](**(tiny if kind == "AutoencoderTiny" else small))
    save_autoencoder(made, tmp_path / "vae")
    logger = logging.getLogger("diffusers")
    logger.addHandler(caplog.handler)
    found = read_autoencoder(tmp_path / "vae")
    logger.removeHandler(caplog.handler)
    assert type(found) is type(made) and not caplog.messages
    assert all(torch.equal(value, found.state_dict()[name]) for name, value in made.state_dict().items())


def test_what_is_no_autoencoder_is_not_read(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"holds no config\.json"):
        read_autoencoder(tmp_path)
    (tmp_path / "config.json").write_text('{"_class_name": "UNet2DModel"}')
    with pytest.raises(InvalidInputError, match="`vae` is 'UNet2DModel'; it has to be one of 'AutoencoderKL'"):
        read_autoencoder(tmp_path)
