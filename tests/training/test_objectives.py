"""What each objective shows its network and asks of it, held to closed forms."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from diffusers import DDPMScheduler, VQModel
from diffusers.models.embeddings import get_timestep_embedding
from diffusers.models.unets.unet_2d_condition import UNet2DConditionOutput
from scipy.spatial.distance import mahalanobis
from scipy.stats import kstest
from torch import Tensor, nn

from tests.helpers.components import D as WIDTH
from tests.training.conftest import autoencoder
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import UniTouchConfig, UniTouchModel, UniTouchProcessor
from unitouch_gen.training import image_vae, touch, touch_ldm, unclip
from unitouch_gen.training.batches import ArrayDataset
from unitouch_gen.training.data import Contacts, DataConfig, columns_of, sensor_numbers
from unitouch_gen.training.image_vae import AutoencoderLoss, AutoencoderObjective, to_signed
from unitouch_gen.training.touch import LossWeights, TouchAugmentation, TouchObjective
from unitouch_gen.world import untouched_gel

COUNT, NORM = 600, 14.0
SCHEDULER = DDPMScheduler(prediction_type="v_prediction", clip_sample=False)
UNCLIP = unclip.UnclipSettings(
    condition_dropout=0.25, caption_share=0.2, empty_share=0.15, clean_share=0.4, gain=0.7, step_power=2.0
)
DIFFUSION = touch_ldm.TouchDiffusionSettings(condition_dropout=0, noisy_share=0, condition_noise=0, step_power=2.0)
PLAIN = AutoencoderLoss(gradient_weight=0.0, latent_noise=0.0, latent_weight=0.0)
STILL = TouchAugmentation(permute=0.0, blur=0.0)
PICTURES = np.random.default_rng(0).integers(0, 256, (9, 3, 32, 32), dtype=np.uint8)
EMBEDS = 2.0 + torch.randn(COUNT, WIDTH, generator=torch.Generator().manual_seed(1))


def vq() -> VQModel:
    torch.manual_seed(0)
    kinds = {"down_block_types": ("DownEncoderBlock2D",) * 2, "up_block_types": ("UpDecoderBlock2D",) * 2}
    return VQModel(**kinds, block_out_channels=(8, 8), norm_num_groups=4, latent_channels=3, num_vq_embeddings=16)


def make_unclip(model: UniTouchModel, processor: UniTouchProcessor, **changes: float) -> nn.Module:
    normalizer = unclip.fit_normalizer(EMBEDS)
    noising = DDPMScheduler(beta_schedule="squaredcos_cap_v2")
    texts = (["slick glass"] * COUNT, processor, model.text_model.text_model)
    return unclip.UnclipObjective(Shown(), SCHEDULER, UNCLIP.model_copy(update=changes), normalizer, noising, *texts)  # type: ignore[arg-type]


def make_touch_ldm(backgrounds: Tensor | None = None, **changes: float) -> nn.Module:
    settings = DIFFUSION.model_copy(update=changes)
    return touch_ldm.TouchDiffusionObjective(Shown(), SCHEDULER, NORM, settings, backgrounds)  # type: ignore[arg-type]


def test_touches_are_pulled_to_their_pictures_and_tokens_learn_from_their_own_sensor(model: UniTouchModel) -> None:
    objective = TouchObjective(model, STILL, LossWeights(cosine=3.0)).eval()
    pixels = torch.randn(2, 3, 32, 32)
    objective.augmented = lambda touch: touch  # type: ignore[method-assign]
    embeds = torch.randn(2, WIDTH)
    sensors = torch.tensor([1, -1])
    losses = objective({"touch": pixels, "sensor": sensors, "image_embeds": embeds})
    cosine = F.cosine_similarity(model.get_touch_features(pixels, sensors), embeds).mean()
    assert losses["cosine"].item() == pytest.approx(1.0 - cosine.item(), abs=1e-5)
    assert losses["loss"].item() == pytest.approx((losses["image"] + 3.0 * losses["cosine"]).item(), rel=1e-5)
    losses["loss"].backward()
    gradient = model.sensor_bank.tokens.grad
    assert gradient[1].abs().max() > 0
    assert gradient[0].abs().max() == 0


def test_a_prototype_is_the_mean_raw_image_of_its_sensor(model: UniTouchModel, split: Contacts) -> None:
    rng = np.random.default_rng(0)
    named = replace(split, sensors=["gelsight"] * len(split))
    others = [replace(named, touch=rng.integers(0, 256, (n, 3, 32, 32), np.uint8)) for n in (3, 8)]
    touch.set_prototypes(model, [others[0], split, others[1]])
    both = np.concatenate([other.touch for other in others])
    for name, touches in (("gelsight", both), ("digit", split.touch)):
        np.testing.assert_allclose(model.sensor_bank.prototype(name), touches.mean(axis=0) / 255, atol=1e-6)


def test_a_touch_encoder_starts_from_anothers_weights_and_keeps_tokens_of_sensors_by_name(
    tmp_path: Path, config: UniTouchConfig, model: UniTouchModel, joint: str
) -> None:
    model.save_pretrained(tmp_path / "whole")
    config.sensors = ["digit", "gelsight_r15"]
    fresh = UniTouchModel(config, modalities=("touch",))
    before = fresh.sensor_bank.tokens.detach().clone()
    touch.start_from(fresh, tmp_path / "whole")
    for name, tensor in model.touch_model.state_dict().items():
        assert torch.equal(fresh.touch_model.state_dict()[name], tensor)
    kept = fresh.sensor_bank.tokens
    known = model.sensor_bank
    assert torch.equal(kept[0], known.tokens[known.index("digit")])
    assert torch.equal(kept[1], before[1])
    with pytest.raises(InvalidInputError, match=r"`init` is .*: This model has no touch encoder"):
        touch.start_from(model, Path(joint))


def test_a_distance_that_knows_touches_from_pictures_is_kept_with_the_touch_encoder(model, processor, split, tmp_path):
    splits = [split, replace(split, sensors=["gelsight"] * len(split), touch=split.second)]
    touch.set_prototypes(model, splits, reaches=True)
    touch.fit_distance(model, splits)
    model.save_pretrained(tmp_path / "touch")
    again = UniTouchModel.from_pretrained(tmp_path / "touch")
    assert [*again.config.ood_thresholds] == ["touch"]
    reaches = again.config.sensor_reaches
    assert set(reaches) == {"gelsight", "digit"}
    assert 0.0 < reaches["digit"] < 0.3
    for column, low, high in (("touch", 0.0, 0.15), ("image", 0.5, 1.0)):
        reasons = again.encode_touches(processor.touch(torch.from_numpy(getattr(split, column)[:].copy()) / 255))[1]
        assert low <= sum(map(bool, reasons)) / len(reasons) <= high


def test_the_distance_is_mahalanobis_to_the_nearest_class() -> None:
    mixing = np.random.default_rng(0).normal(size=(6, 6)) * [1.0, 3.0, 0.1, 1.0, 10.0, 1.0]
    drawn = np.random.default_rng(1).normal(size=(620, 6)) @ mixing
    drawn[300:600] += mixing.sum(axis=0) * 4.0
    features = drawn[:600]
    labels = np.repeat([0, 1], 300)
    others = drawn[600:]
    means = [features[labels == label].mean(axis=0) for label in (0, 1)]
    residuals = features - np.stack(means)[labels]
    inverse = np.linalg.inv(residuals.T @ residuals / 600)
    gaussians = touch.fit_gaussians(torch.from_numpy(features), torch.from_numpy(labels), shrinkage=0.0)
    expected = [min(mahalanobis(row, mean, inverse) for mean in means) ** 2 for row in others]
    np.testing.assert_allclose(gaussians(torch.from_numpy(others)), expected, rtol=1e-3)
    halved = gaussians.half()(torch.from_numpy(others))
    np.testing.assert_allclose(halved, expected, rtol=0.05, atol=0.1)


def test_the_loss_of_an_autoencoder_is_the_error_of_pixels_and_of_their_differences() -> None:
    vae = autoencoder()
    batch = {"pixels": torch.from_numpy(PICTURES)}
    losses = AutoencoderObjective(vae, PLAIN.model_copy(update={"gradient_weight": 0.5, "latent_weight": 0.1}))(batch)
    pixels = to_signed(batch["pixels"])
    with torch.no_grad():
        latents = vae.encode(pixels).latents
        error = vae.decode(latents).sample - pixels
    across = error[..., 1:] - error[..., :-1]
    down = error[..., 1:, :] - error[..., :-1, :]
    edges = across.abs().mean() + down.abs().mean()
    expected = error.abs().mean() + 0.5 * edges + 0.1 * latents.square().mean()
    assert losses["loss"].item() == pytest.approx(expected.item(), rel=1e-5)
    psnr = -10 * np.log10((error / 2).square().mean().item())  # on pixels from 0 to 1
    assert losses["psnr"].item() == pytest.approx(psnr, abs=1e-3)


def test_the_error_of_features_is_that_of_a_stem_relative_to_what_it_sees() -> None:
    layer = nn.Conv2d(3, 4, 3)
    deviation = torch.tensor([0.26862954, 0.26130258, 0.27577711])[:, None, None]  # CLIP's
    shown, wanted = (torch.from_numpy(pictures).float() / 255 for pictures in (PICTURES[::-1].copy(), PICTURES))
    features = image_vae.StemFeatures([layer])
    with torch.no_grad():
        apart = F.conv2d((shown - wanted) / deviation, layer.weight).abs().mean(dim=(0, 2, 3))
        size = F.conv2d(wanted / deviation, layer.weight).transpose(0, 1).flatten(1).std(dim=1)  # of what varies
        for _ in range(2):
            error = image_vae.feature_error(features(shown), features(wanted)).item()
            assert error == pytest.approx((apart / size).mean().item(), rel=1e-2)
            layer.weight *= 7.0  # a stem that is as much louder
    assert image_vae.feature_error(features(wanted), features(wanted)).item() == 0.0


def test_the_error_of_contrast_sees_how_much_a_texture_varies_and_not_where() -> None:
    texture = torch.randn(2, 3, 16, 16, generator=torch.Generator().manual_seed(0))
    parts = texture.unflatten(2, (2, 8)).unflatten(4, (2, 8))  # 2 x 2 parts of 8 x 8
    within = parts.std(dim=(3, 5), correction=0)
    moved = parts.flip(3, 5).flatten(4, 5).flatten(2, 3)
    assert not torch.equal(moved, texture)
    assert image_vae.contrast_error([moved + 1.0], [texture]).item() == pytest.approx(0.0, abs=1e-5)
    expected = 0.5 * within.mean(dim=(0, 2, 3)) / texture.transpose(0, 1).flatten(1).std(dim=1)
    error = image_vae.contrast_error([0.5 * texture], [texture]).item()
    assert error == pytest.approx(expected.mean().item(), rel=1e-4)


def test_a_vq_model_pays_for_the_distance_to_its_codebook() -> None:
    vae = vq()
    pixels = to_signed(torch.from_numpy(PICTURES))
    loss = AutoencoderObjective(vae, PLAIN)({"pixels": torch.from_numpy(PICTURES)})["loss"].item()
    with torch.no_grad():
        latents = vae.encode(pixels).latents
        flat = latents.permute(0, 2, 3, 1).reshape(-1, 3)
        distance = torch.cdist(flat, vae.quantize.embedding.weight).min(dim=1).values.square().mean() / 3
        error = F.l1_loss(vae.decode(latents).sample, pixels)
    # van den Oord et al., 2017, Eq. 3, with beta = 0.25: both terms are the distance to the nearest code
    assert loss == pytest.approx((error + 1.25 * distance).item(), rel=1e-4)


def test_latents_are_scaled_to_unit_variance() -> None:
    vae = autoencoder(scaling_factor=0.5)
    pixels = torch.from_numpy(PICTURES)
    with torch.no_grad():
        raw = vae.encode(to_signed(pixels)).latents
    scale = image_vae.latent_scale(vae, ArrayDataset(pixels=PICTURES))
    assert (raw * scale).std().item() == pytest.approx(1.0, abs=1e-3)
    stage: Any = SimpleNamespace(computed_once=lambda _name, _option, _splits, make: make())
    latents = image_vae.cached_latents(stage, vae, "image", [], [PICTURES[:1], PICTURES[1:]])
    torch.testing.assert_close(latents, 0.5 * raw)


class Shown(nn.Module):
    """A network that predicts nothing, and keeps what it is shown."""

    def forward(self, sample: Tensor, steps: Tensor, encoder_hidden_states: Tensor, class_labels: Tensor):
        self.sample, self.hidden, self.labels = sample, encoder_hidden_states, class_labels
        return UNet2DConditionOutput(sample=torch.zeros_like(sample[:, :4]))


def shown(objective: nn.Module, embeds: Tensor = EMBEDS) -> Shown:
    torch.manual_seed(0)
    batch = {"image_embeds": embeds, "latents": torch.randn(COUNT, 4, 2, 2), "sensor": torch.arange(COUNT) % 3}
    objective({**batch, "index": torch.arange(COUNT), "background": torch.arange(COUNT) % 5})
    return objective.trained  # type: ignore[return-value]


def nearest(rows: Tensor, known: Tensor) -> np.ndarray:
    """Which of some vectors each row is."""
    gap = torch.cdist(rows, known, compute_mode="donot_use_mm_for_euclid_dist")
    assert gap.min(dim=1).values.max() < 1e-3
    return gap.argmin(dim=1).numpy()


LEVELS = get_timestep_embedding(torch.arange(1000), WIDTH, flip_sin_to_cos=True, downscale_freq_shift=0)


def test_unclip_drops_conditions_noises_embeddings_and_takes_prompts_as_asked(
    model: UniTouchModel, processor: UniTouchProcessor
) -> None:
    seen = shown(make_unclip(model, processor))
    dropped = (seen.labels == 0).all(dim=1)
    assert dropped.float().mean().item() == pytest.approx(0.25, abs=0.07)
    levels = nearest(seen.labels[~dropped, WIDTH:], LEVELS)
    assert (levels == 0).mean() == pytest.approx(0.4, abs=0.09)
    assert kstest(levels[levels > 0] / 1000, "uniform").pvalue > 1e-3
    with torch.no_grad():
        ids = processor.text(["", unclip.QUALITY_PROMPT, "slick glass"])["input_ids"]
        which = nearest(seen.hidden.flatten(1), model.text_model.text_model(ids).last_hidden_state.flatten(1))
    assert (which[dropped.numpy()] == 0).all()
    shares = np.bincount(which[~dropped.numpy()], minlength=3) / int((~dropped).sum())
    np.testing.assert_allclose(shares, [0.15, 0.65, 0.2], atol=0.09)


def test_embeddings_without_a_noise_level_are_those_of_the_picture_times_a_gain(
    model: UniTouchModel, processor: UniTouchProcessor
) -> None:
    seen = shown(make_unclip(model, processor, condition_dropout=0.0))
    clean = torch.from_numpy(nearest(seen.labels[:, WIDTH:], LEVELS) == 0)
    gain = (seen.labels[clean, :WIDTH] * EMBEDS[clean]).sum(1) / EMBEDS[clean].square().sum(1)
    # Level 0 still adds a little noise: sqrt(1 - abar_0) = 0.006 standard deviations.
    assert gain.min() > 0.68
    assert gain.max() < 1.02
    assert gain.mean().item() == pytest.approx(0.85, abs=0.03)


def test_the_condition_of_a_touch_is_one_token_of_the_joint_spaces_norm_or_zeros() -> None:
    backgrounds = torch.randn(5, 4, 2, 2)
    seen = shown(make_touch_ldm(backgrounds, condition_dropout=0.25))
    dropped = (seen.hidden == 0).all(dim=2)[:, 0]
    assert dropped.float().mean().item() == pytest.approx(0.25, abs=0.06)
    torch.testing.assert_close(seen.hidden[~dropped, 0], NORM * F.normalize(EMBEDS, dim=1)[~dropped])
    assert torch.equal(seen.labels, torch.arange(COUNT) % 3)  # named with and without a condition
    assert torch.equal(seen.sample[:, 4:], backgrounds[torch.arange(COUNT) % 5])  # behind the noise


def test_some_conditions_are_perturbed_and_keep_their_norm() -> None:
    wide = torch.randn(COUNT, 64, generator=torch.Generator().manual_seed(1))
    hidden = shown(make_touch_ldm(noisy_share=0.5, condition_noise=1.0), wide).hidden[:, 0]
    torch.testing.assert_close(hidden.norm(dim=1), torch.full((COUNT,), NORM))
    cosine = torch.cosine_similarity(hidden, wide, dim=1)
    assert (cosine > 1 - 1e-5).float().mean().item() == pytest.approx(0.5, abs=0.07)
    # A perturbation as long as the embedding and at right angles to it leaves a cosine of 1 / sqrt(2).
    assert 0.5 < cosine.min().item() < 0.72


def test_every_contact_knows_what_both_of_its_sensors_see_untouched(cache: Path, processor: UniTouchProcessor) -> None:
    config = DataConfig(drawn={"sensors": [None, "digit"], "objects": 1, "contacts_per_object": 2})
    sources = config.sources()
    size = processor.image_size
    splits = columns_of(sources, cache, config, processor, ("image", "touch"))
    gels = torch.cat([source.untouched("train", size).flatten(0, 1) for source in sources])
    for split, source, places in zip(splits, sources, touch_ldm.places_of(splits), strict=True):
        for row, place in enumerate(places):
            for which, sensor in enumerate(source.pair("train", row // 16)):
                assert row % 16 or torch.equal(gels[place + which], untouched_gel(sensor, size))
        assert len(places) == len(split)
        assert places[0] == places[15] == places[16] - 2
    assert sensor_numbers(splits, ["digit"], unnamed=1).tolist() == [1] * len(splits[0]) + [0] * len(splits[1])
