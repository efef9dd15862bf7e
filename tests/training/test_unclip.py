"""What the unCLIP network is shown in training: labels, prompts, latents."""

import numpy as np
import pytest
import torch
from diffusers import DDPMScheduler
from diffusers.models.embeddings import get_timestep_embedding
from diffusers.models.unets.unet_2d_condition import UNet2DConditionOutput
from scipy.stats import kstest
from torch import Tensor, nn

from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.training.unclip import QUALITY_PROMPT, UnclipObjective, UnclipSettings, fit_normalizer

COUNT, WIDTH, DROPOUT = 600, 16, 0.25
CAPTION = "slick glass"


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
    shares = {
        "condition_dropout": DROPOUT,
        "caption_share": 0.2,
        "empty_share": 0.15,
        "clean_share": 0.4,
        "gain": 0.7,
        "snr_gamma": 5.0,
        **options,
    }
    text_encoder, captions = model.text_model.text_model, [CAPTION] * COUNT
    normalizer, settings = fit_normalizer(embeds), UnclipSettings(**shares)
    return UnclipObjective(Shown(), text_encoder, processor, captions, normalizer, noising, scheduler, settings)


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
    assert dropped(shown).float().mean().item() == pytest.approx(
        DROPOUT, abs=4 * (DROPOUT * (1 - DROPOUT) / COUNT) ** 0.5
    )


def levels(shown: Shown) -> Tensor:
    """Noise levels of the samples that were kept, read back from their sinusoids."""
    table = get_timestep_embedding(torch.arange(1000), WIDTH, flip_sin_to_cos=True, downscale_freq_shift=0)
    gap = distances(shown.labels[~dropped(shown), WIDTH:], table)
    assert gap.min(dim=1).values.max() < 1e-4  # each is one of the table: within 0 to 999
    return gap.argmin(dim=1)


def test_some_samples_have_no_noise_level_and_the_others_any(shown: Shown) -> None:
    found = levels(shown)
    assert (found == 0).float().mean().item() == pytest.approx(0.4, abs=0.09)
    noised = found[found > 0].double()
    assert kstest(noised / 1000, "uniform").pvalue > 1e-3


def test_embeddings_without_a_noise_level_are_those_of_the_picture_times_a_gain(
    model: UniTouchModel, processor: UniTouchProcessor, embeds: Tensor
) -> None:
    objective = make(model, processor, embeds, condition_dropout=0.0)
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
    objective = make(model, processor, embeds, condition_dropout=0.0, gain=1.0)
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


# Prompts ------------------------------------------------------------------------------------------------------------


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
