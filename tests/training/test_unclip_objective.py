"""What the unCLIP network is shown in training: labels, prompts, latents."""

from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers import AutoencoderDC, DDPMScheduler
from diffusers.models.embeddings import get_timestep_embedding
from diffusers.models.unets.unet_2d_condition import UNet2DConditionOutput
from torch import Tensor, nn

from unitouch_gen.encoders import UniTouchModel, UniTouchProcessor
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.training.data import ArrayDataset
from unitouch_gen.training.image_vae import AutoencoderObjective, latent_scale, to_signed
from unitouch_gen.training.unclip import QUALITY_PROMPT, UnclipObjective, cached_latents, fit_normalizer

COUNT, WIDTH, DROP = 600, 16, 0.25
CAPTION = "slick glass"
PICTURES = np.random.default_rng(0).integers(0, 256, (9, 3, 32, 32), dtype=np.uint8)


class Shown(nn.Module):
    """A network that predicts nothing, and keeps what it is shown."""

    def __init__(self) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.zeros(()))

    def forward(self, sample: Tensor, steps: Tensor, encoder_hidden_states: Tensor, class_labels: Tensor):
        self.steps, self.hidden, self.labels = steps, encoder_hidden_states, class_labels
        return UNet2DConditionOutput(sample=self.scale * sample)


def make(model: UniTouchModel, processor: UniTouchProcessor, embeds: Tensor, **options: float) -> UnclipObjective:
    noising = DDPMScheduler(beta_schedule="squaredcos_cap_v2")
    scheduler = DDPMScheduler(prediction_type="v_prediction", clip_sample=False)
    settings = {"drop": DROP, "caption_share": 0.2, "empty_share": 0.15, "gain": 0.7, "snr_gamma": 5.0, **options}
    text_encoder, captions = model.text_model.text_model, [CAPTION] * COUNT
    normalizer = fit_normalizer(embeds)
    return UnclipObjective(Shown(), text_encoder, processor, captions, normalizer, noising, scheduler, **settings)


@pytest.fixture
def embeds() -> Tensor:
    return 2.0 + torch.randn(COUNT, WIDTH, generator=torch.Generator().manual_seed(1))


def run(objective: UnclipObjective, embeds: Tensor) -> dict[str, Tensor]:
    torch.manual_seed(0)
    latents = torch.randn(COUNT, 4, 2, 2)
    return objective({"latents": latents, "image_embeds": embeds, "index": torch.arange(COUNT)})


@pytest.fixture
def shown(model: UniTouchModel, processor: UniTouchProcessor, embeds: Tensor) -> Shown:
    objective = make(model, processor, embeds)
    run(objective, embeds)
    return objective.trained


def dropped(shown: Shown) -> Tensor:
    return (shown.labels == 0).all(dim=1)


def distances(a: Tensor, b: Tensor) -> Tensor:
    return torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist")


# Labels ---------------------------------------------------------------------------------------------------------------


def test_a_sample_is_dropped_whole_or_not_at_all(shown: Shown) -> None:
    assert ((shown.labels[:, :WIDTH] == 0).any(dim=1) == dropped(shown)).all()


def test_as_many_samples_are_dropped_as_asked_for(shown: Shown) -> None:
    assert dropped(shown).float().mean().item() == pytest.approx(DROP, abs=4 * (DROP * (1 - DROP) / COUNT) ** 0.5)


def levels(shown: Shown) -> Tensor:
    """Noise levels of the samples that were kept, read back from their sinusoids."""
    table = get_timestep_embedding(torch.arange(1000), WIDTH, flip_sin_to_cos=True, downscale_freq_shift=0)
    gap = distances(shown.labels[~dropped(shown), WIDTH:], table)
    assert gap.min(dim=1).values.max() < 1e-4  # each is one of the table: within 0 to 999
    return gap.argmin(dim=1)


def test_half_of_the_samples_have_no_noise_level_and_the_others_low_ones(shown: Shown) -> None:
    found = levels(shown)
    # A level is 1000 u^2 with u uniform, floored, for half of the samples: below 1 for u < 0.0316.
    assert (found == 0).float().mean().item() == pytest.approx(0.5 + 0.5 * 0.0316, abs=0.09)
    assert found[found > 0].float().median().item() == pytest.approx(1000 * 0.516**2, abs=90)


def test_embeddings_without_a_noise_level_are_those_of_the_picture_times_a_gain(
    model: UniTouchModel, processor: UniTouchProcessor, embeds: Tensor
) -> None:
    objective = make(model, processor, embeds, drop=0.0)
    run(objective, embeds)
    shown: Shown = objective.trained
    clean = levels(shown) == 0
    gain = (shown.labels[clean, :WIDTH] * embeds[clean]).sum(1) / embeds[clean].square().sum(1)
    # Level 0 still adds a little noise: sqrt(1 - abar_0) = 0.006 standard deviations.
    assert gain.min() > 0.7 - 0.02 and gain.max() < 1.0 + 0.02
    assert gain.mean().item() == pytest.approx(0.85, abs=0.03)


def test_a_gain_of_one_leaves_the_scale_alone(
    model: UniTouchModel, processor: UniTouchProcessor, embeds: Tensor
) -> None:
    objective = make(model, processor, embeds, drop=0.0, gain=1.0)
    run(objective, embeds)
    clean = levels(objective.trained) == 0
    torch.testing.assert_close(objective.trained.labels[clean, :WIDTH], embeds[clean], atol=0.05, rtol=0.0)


def test_the_normaliser_makes_embeddings_standard(embeds: Tensor) -> None:
    standard = fit_normalizer(embeds).scale(embeds)
    torch.testing.assert_close(standard.mean(dim=0), torch.zeros(WIDTH), atol=1e-5, rtol=0.0)
    torch.testing.assert_close(standard.std(dim=0), torch.ones(WIDTH))


def test_a_dimension_without_spread_is_not_divided_by_zero() -> None:
    normalizer = fit_normalizer(torch.ones(8, 4))
    assert bool(torch.isfinite(normalizer.scale(torch.ones(1, 4))).all())


# Prompts and steps ----------------------------------------------------------------------------------------------------


def prompts(shown: Shown, model: UniTouchModel, processor: UniTouchProcessor) -> np.ndarray:
    """Which of "", the quality prompt and the caption each sample was shown."""
    ids = processor.text(["", QUALITY_PROMPT, CAPTION])["input_ids"]
    with torch.no_grad():
        known = model.text_model.text_model(ids).last_hidden_state.flatten(1)
    gap = distances(shown.hidden.flatten(1), known)
    assert gap.min(dim=1).values.max() < 1e-3
    return gap.argmin(dim=1).numpy()


def test_dropped_samples_have_no_prompt(shown: Shown, model: UniTouchModel, processor: UniTouchProcessor) -> None:
    assert (prompts(shown, model, processor)[dropped(shown).numpy()] == 0).all()


def test_prompts_have_the_shares_asked_for(shown: Shown, model: UniTouchModel, processor: UniTouchProcessor) -> None:
    kept = prompts(shown, model, processor)[~dropped(shown).numpy()]
    np.testing.assert_allclose(np.bincount(kept, minlength=3) / len(kept), [0.15, 0.65, 0.2], atol=0.09)


def test_all_steps_of_the_schedule_are_trained(shown: Shown) -> None:
    assert shown.steps.min() >= 0 and shown.steps.max() < 1000
    np.testing.assert_allclose(np.bincount(shown.steps // 250, minlength=4) / COUNT, 0.25, atol=0.08)


def test_a_prediction_of_zero_costs_the_targets_size(
    model: UniTouchModel, processor: UniTouchProcessor, embeds: Tensor
) -> None:
    # v = sqrt(abar) n - sqrt(1 - abar) x has unit variance when noise and latents have.
    assert run(make(model, processor, embeds), embeds)["mse"].item() == pytest.approx(1.0, abs=0.1)


def test_weights_are_min_snr_for_v_prediction(
    model: UniTouchModel, processor: UniTouchProcessor, embeds: Tensor
) -> None:
    objective = make(model, processor, embeds, snr_gamma=2.0)
    loss = run(objective, embeds)["loss"].item()
    alpha_bar = objective.scheduler.alphas_cumprod[objective.trained.steps]
    snr = alpha_bar / (1 - alpha_bar)  # Hang et al., 2023: min(SNR, gamma) / (SNR + 1) times an error of 1
    assert loss == pytest.approx((snr.clamp(max=2.0) / (snr + 1)).mean().item(), rel=0.1)


def test_a_schedule_of_another_prediction_is_refused(
    model: UniTouchModel, processor: UniTouchProcessor, embeds: Tensor
) -> None:
    noising = DDPMScheduler(beta_schedule="squaredcos_cap_v2")
    with pytest.raises(InvalidInputError, match="`scheduler` predicts 'epsilon'"):
        UnclipObjective(
            Shown(), model.text_model.text_model, processor, [], fit_normalizer(embeds), noising, DDPMScheduler(),
            drop=0.1, caption_share=0.2, empty_share=0.1, gain=0.7, snr_gamma=5.0,
        )  # fmt: skip


# Latents --------------------------------------------------------------------------------------------------------------


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


def test_latents_are_computed_once(vae: AutoencoderDC, tmp_path: Path) -> None:
    first = cached_latents(vae, [PICTURES], "k", tmp_path)
    assert torch.equal(cached_latents(vae, [], "k", tmp_path), first)  # no picture is looked at


def test_a_changed_autoencoder_has_its_latents_computed_anew(vae: AutoencoderDC, tmp_path: Path) -> None:
    first = cached_latents(vae, [PICTURES], "k", tmp_path)
    with torch.no_grad():
        next(vae.encoder.parameters()).mul_(1.5)
    assert not torch.equal(cached_latents(vae, [PICTURES], "k", tmp_path), first)


def test_the_scale_gives_latents_unit_variance(vae: AutoencoderDC) -> None:
    dataset = ArrayDataset(image=PICTURES)
    with torch.no_grad():
        latents = vae.encode(to_signed(torch.from_numpy(PICTURES))).latent
    assert (latents * latent_scale(vae, dataset)).std().item() == pytest.approx(1.0, abs=1e-3)


def test_pixels_run_from_minus_one_to_one() -> None:
    assert to_signed(torch.tensor([0, 255], dtype=torch.uint8)).tolist() == [-1.0, 1.0]


def test_peak_signal_to_noise_is_on_pixels_from_zero_to_one(vae: AutoencoderDC) -> None:
    objective = AutoencoderObjective(vae, gradient_weight=0.0, latent_noise=0.0, latent_weight=0.0)
    batch = {"image": torch.from_numpy(PICTURES)}
    with torch.no_grad():
        restored = vae.decode(vae.encode(to_signed(batch["image"])).latent).sample
    error = ((restored + 1) / 2 - batch["image"] / 255).square().mean().item()
    assert objective(batch)["psnr"].item() == pytest.approx(-10 * np.log10(error), abs=1e-3)
