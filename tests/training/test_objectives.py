"""What each objective shows its network and asks of it, held to closed forms, and what it must not touch."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from diffusers import AutoencoderDC, DDPMScheduler, UNet2DConditionModel, VQModel
from diffusers.models.embeddings import get_timestep_embedding
from diffusers.models.unets.unet_2d_condition import UNet2DConditionOutput
from scipy.stats import kstest
from torch import Tensor, nn
from transformers import ResNetConfig

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import UniTouchConfig, UniTouchModel, UniTouchProcessor
from unitouch_gen.models.autoencoders import CLASSES, encode_raw
from unitouch_gen.models.classifier import ContactClassifier, ContactClassifierOutput
from unitouch_gen.training.audio import AudioObjective
from unitouch_gen.training.batches import ArrayDataset, ShuffledSampler
from unitouch_gen.training.data import DataConfig, Rendered, columns_of
from unitouch_gen.training.image_text import ImageTextObjective
from unitouch_gen.training.image_vae import (
    AutoencoderLoss,
    AutoencoderObjective,
    cached_latents,
    latent_scale,
    make_autoencoder,
    random_square,
    read_autoencoder,
    to_signed,
)
from unitouch_gen.training.picture_classifier import SHOWN, ClassifierAugmentation, ClassifierObjective, columns
from unitouch_gen.training.touch import (
    LossWeights,
    TouchAugmentation,
    TouchObjective,
    pairs_of,
    set_prototypes,
    start_from,
)
from unitouch_gen.training.touch_ldm import (
    TouchDiffusionObjective,
    TouchDiffusionSettings,
    class_labels,
    places_of,
    untouched_gels,
)
from unitouch_gen.training.trainer import Trainer, TrainerConfig
from unitouch_gen.training.unclip import QUALITY_PROMPT, UnclipObjective, UnclipSettings, fit_normalizer
from unitouch_gen.world import ATTRIBUTES, SENSORS, untouched_gel

COUNT, WIDTH, NORM = 600, 16, 14.0
SCHEDULER = DDPMScheduler(prediction_type="v_prediction", clip_sample=False)
NOISING = DDPMScheduler(beta_schedule="squaredcos_cap_v2")
UNCLIP = UnclipSettings(
    condition_dropout=0.25, caption_share=0.2, empty_share=0.15, clean_share=0.4, gain=0.7, snr_gamma=5.0
)
DIFFUSION = TouchDiffusionSettings(condition_dropout=0.0, noisy_share=0.0, condition_noise=0.0, snr_gamma=5.0)
PLAIN = AutoencoderLoss(gradient_weight=0.0, latent_noise=0.0, latent_weight=0.0)
STILL = TouchAugmentation(turn=0.0, permute=0.0, blur=0.0)
PICTURES = np.random.default_rng(0).integers(0, 256, (9, 3, 32, 32), dtype=np.uint8)


def unet(**conditions: object) -> UNet2DConditionModel:
    return UNet2DConditionModel(
        sample_size=8, block_out_channels=(8, 16), layers_per_block=1, cross_attention_dim=WIDTH, attention_head_dim=2,
        down_block_types=("DownBlock2D", "CrossAttnDownBlock2D"), up_block_types=("CrossAttnUpBlock2D", "UpBlock2D"),
        norm_num_groups=4, **conditions,
    )  # fmt: skip


def autoencoder() -> AutoencoderDC:
    blocks = {f"{part}_{name}": value for part in ("encoder", "decoder") for name, value in
              {"block_types": "ResBlock", "block_out_channels": (8, 8), "layers_per_block": (1, 1),
               "qkv_multiscales": ((), ())}.items()}  # fmt: skip
    torch.manual_seed(0)
    return AutoencoderDC(latent_channels=4, scaling_factor=0.5, **blocks).eval()


def vq() -> VQModel:
    kinds = {"down_block_types": ("DownEncoderBlock2D",) * 2, "up_block_types": ("UpDecoderBlock2D",) * 2}
    return VQModel(**kinds, block_out_channels=(8, 8), norm_num_groups=4, latent_channels=3, num_vq_embeddings=16)


def unclip(model: UniTouchModel, processor: UniTouchProcessor, network: nn.Module, **changes: float) -> UnclipObjective:
    embeds = 2.0 + torch.randn(COUNT, WIDTH, generator=torch.Generator().manual_seed(1))
    settings, text_encoder = UNCLIP.model_copy(update=changes), model.text_model.text_model
    made = (network, SCHEDULER, settings, fit_normalizer(embeds), NOISING, ["slick glass"] * COUNT, processor)
    return UnclipObjective(*made, text_encoder)


# What is trained changes, and what is frozen stays --------------------------------------------------------------------


def pair(model: UniTouchModel) -> UniTouchModel:
    """With image and text alone, as the first stage has it."""
    for name in ("audio_model", "touch_model", "sensor_bank"):
        delattr(model, name)
    return model


OBJECTIVES: dict[str, Callable[[UniTouchModel, UniTouchProcessor], Any]] = {
    "image_text": lambda model, processor: ImageTextObjective(pair(model), 0.07, 1.0, 1.0),
    "audio": lambda model, processor: AudioObjective(model),
    "touch": lambda model, processor: TouchObjective(
        model, STILL, LossWeights(cosine=1, touch=1, attributes=1, maps=1)
    ),
    "image_vae": lambda model, processor: AutoencoderObjective(autoencoder(), PLAIN, 16),
    "touch_vae": lambda model, processor: AutoencoderObjective(vq(), PLAIN),
    "unclip": lambda model, processor: unclip(
        model, processor, unet(class_embed_type="projection", projection_class_embeddings_input_dim=2 * WIDTH)
    ),
    "classifier": lambda model, processor: ClassifierObjective(
        ContactClassifier(
            ResNetConfig(embedding_size=8, hidden_sizes=[8], depths=[1], layer_type="basic", num_labels=4)
        ),
        ClassifierAugmentation(mirror=0.5, blur=0.4, noise=0.05),
    ),
    "touch_ldm": lambda model, processor: TouchDiffusionObjective(unet(num_class_embeds=2), SCHEDULER, NORM, DIFFUSION),
}


@pytest.mark.parametrize("name", OBJECTIVES)
def test_what_is_trained_changes_and_nothing_else(
    name: str, model: UniTouchModel, processor: UniTouchProcessor, tmp_path: Path
) -> None:
    rng, generator, count = np.random.default_rng(0), torch.Generator().manual_seed(0), 12
    images = {key: rng.integers(0, 256, (count, 3, 32, 32), np.uint8) for key in ("image", "touch", "second", "pixels")}
    dataset = ArrayDataset(
        **images,
        audio=rng.standard_normal((count, 1, 16, 24)).astype(np.float16),
        material=rng.integers(0, 4, count),
        sensor=rng.integers(0, 2, count),
        attributes=rng.standard_normal((count, *([2, 13] if name == "touch" else [11]))).astype(np.float32),
        maps=rng.standard_normal((count, 2, 4, 8, 8)).astype(np.float16),
        image_embeds=torch.randn(count, WIDTH, generator=generator),
        before=torch.randn(count, WIDTH, generator=generator),
        latents=torch.randn(count, 4, 8, 8, generator=generator),
        index=torch.arange(count),
        shown=np.ones(count, dtype=np.float32),
        input_ids=processor.text(["rough brick", "slick glass"] * 6)["input_ids"][:, None],
    )
    objective = OBJECTIVES[name](model, processor)
    losses = objective(dataset[range(6)])
    assert all(value.ndim == 0 and bool(value.isfinite()) for value in losses.values())
    assert [key for key, value in losses.items() if value.requires_grad] == ["loss"]
    assert name == "image_text" or all(key.startswith("trained.") for key in objective.state_dict())  # in a checkpoint
    trained = dict(objective.trained.named_parameters())
    ids = {id(parameter) for parameter in trained.values()}
    frozen = {key: value for key, value in model.named_parameters() if id(value) not in ids}
    before = {key: value.detach().clone() for key, value in (trained | frozen).items()}
    config = TrainerConfig(steps=2, batch_size=6, learning_rate=1e-2, warmup=0, weight_decay=0.1, trackers=[])
    Trainer(objective, dataset, ShuffledSampler(count, 6), config, tmp_path).fit()
    # Cross-attention over one token is that token's value: what asks for it has no say.
    idle = ("norm2.", "attn2.to_q.", "attn2.to_k.") if name == "touch_ldm" else ()
    same = {key for key, value in trained.items() if torch.equal(before[key], value)}
    assert {key for key in same if not any(word in key for word in idle)} == set()
    assert all(torch.equal(before[key], value) and value.grad is None for key, value in frozen.items())


# Touch ----------------------------------------------------------------------------------------------------------------


def test_sensor_tokens_of_a_sensor_learn_from_its_own_images(model: UniTouchModel) -> None:
    batch = {"touch": torch.from_numpy(PICTURES), "sensor": torch.ones(9, dtype=torch.int64)}
    batch |= {"image_embeds": torch.randn(9, WIDTH), "shown": torch.ones(9)}
    TouchObjective(model, STILL)(batch)["loss"].backward()
    gradient = model.sensor_bank.tokens.grad
    assert gradient[1].abs().max() > 0 and gradient[0].abs().max() == 0


def test_touches_alone_with_their_picture_cost_what_the_cosine_says(model: UniTouchModel) -> None:
    objective = TouchObjective(model, STILL, LossWeights(cosine=3.0)).eval()
    objective.augmented = lambda touch: touch  # type: ignore[method-assign]
    pixels, near = torch.randn(2, 3, 32, 32), torch.tensor([1.0, 0.0])
    batch = {"touch": pixels, "sensor": torch.tensor([0, -1]), "image_embeds": torch.randn(2, WIDTH), "shown": near}
    losses = objective(batch)
    touch = model.get_touch_features(pixels[:1], torch.tensor([0]))
    cosine = F.cosine_similarity(touch, batch["image_embeds"][:1])
    assert losses["cosine"].item() == pytest.approx((1.0 - cosine.item()) / 2, abs=1e-5)
    assert losses["loss"].item() == pytest.approx((losses["image"] + 3.0 * losses["cosine"]).item(), rel=1e-5)


def test_a_prototype_is_the_mean_raw_image_of_its_sensor(model: UniTouchModel, split: Rendered) -> None:
    rng = np.random.default_rng(0)
    others = [replace(split, sensor="gelsight", touch=rng.integers(0, 256, (n, 3, 32, 32), np.uint8)) for n in (3, 8)]
    set_prototypes(model, [others[0], split, others[1]])
    both = np.concatenate([other.touch for other in others])
    np.testing.assert_allclose(model.sensor_bank.prototype("gelsight"), both.mean(axis=0) / 255, atol=1e-6)
    np.testing.assert_allclose(model.sensor_bank.prototype("digit"), split.touch.mean(axis=0) / 255, atol=1e-6)


def test_a_touch_encoder_starts_from_anothers_weights_and_keeps_tokens_of_sensors_by_name(
    tmp_path: Path, config: UniTouchConfig, model: UniTouchModel, joint: str
) -> None:
    model.save_pretrained(tmp_path / "whole")
    config.sensors = ["digit", "gelsight_r15"]
    fresh = UniTouchModel(config, modalities=("touch",))
    before = fresh.sensor_bank.tokens.detach().clone()
    start_from(fresh, tmp_path / "whole")
    for name, tensor in model.touch_model.state_dict().items():
        assert torch.equal(fresh.touch_model.state_dict()[name], tensor)
    kept, known = fresh.sensor_bank.tokens, model.sensor_bank
    assert torch.equal(kept[0], known.tokens[known.index("digit")]) and torch.equal(kept[1], before[1])
    with pytest.raises(InvalidInputError, match=r"`init` is .*, which holds no touch encoder"):
        start_from(model, Path(joint))


def test_measures_of_sources_without_any_are_refused(split: Rendered) -> None:
    recorded = replace(split, attributes=None, second=None)
    with pytest.raises(InvalidInputError, match=r"which only `data\.drawn` has; set `objective\.attributes` to 0"):
        columns([recorded], "touch", ATTRIBUTES)
    with pytest.raises(InvalidInputError, match=r"which only `data\.drawn` has; set these to 0"):
        pairs_of([split, recorded], LossWeights(touch=1.0))


# Autoencoders ---------------------------------------------------------------------------------------------------------


def test_the_loss_of_an_autoencoder_is_the_error_of_pixels_and_of_their_differences() -> None:
    vae, batch = autoencoder(), {"pixels": torch.from_numpy(PICTURES)}
    losses = AutoencoderObjective(vae, PLAIN.model_copy(update={"gradient_weight": 0.5, "latent_weight": 0.1}))(batch)
    pixels = to_signed(batch["pixels"])
    assert (pixels.min(), pixels.max()) == (-1.0, 1.0)
    with torch.no_grad():
        latents = vae.encode(pixels).latent
        error = vae.decode(latents).sample - pixels
    across = (error[..., 1:] - error[..., :-1]).abs().mean()
    down = (error[..., 1:, :] - error[..., :-1, :]).abs().mean()
    expected = error.abs().mean() + 0.5 * (across + down) + 0.1 * latents.square().mean()
    assert losses["loss"].item() == pytest.approx(expected.item(), rel=1e-5)
    psnr = -10 * np.log10((error / 2).square().mean().item())  # on pixels from 0 to 1
    assert losses["psnr"].item() == pytest.approx(psnr, abs=1e-3)


def test_a_vq_model_pays_for_the_distance_to_its_codebook() -> None:
    torch.manual_seed(0)
    vae, pixels = vq(), to_signed(torch.from_numpy(PICTURES))
    loss = AutoencoderObjective(vae, PLAIN)({"pixels": torch.from_numpy(PICTURES)})["loss"].item()
    with torch.no_grad():
        latents = vae.encode(pixels).latents
        flat = latents.permute(0, 2, 3, 1).reshape(-1, 3)
        distance = torch.cdist(flat, vae.quantize.embedding.weight).min(dim=1).values.square().mean() / 3
        error = F.l1_loss(vae.decode(latents).sample, pixels)
    # van den Oord et al., 2017, Eq. 3, with beta = 0.25: both terms are the distance to the nearest code
    assert loss == pytest.approx((error + 1.25 * distance).item(), rel=1e-4)


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
    rows, across = torch.arange(32)[:, None].expand(32, 32), torch.arange(32).expand(32, 32)
    images, corners = torch.stack([rows, across]).expand(3, 2, 32, 32), set()
    torch.manual_seed(0)
    for _ in range(50):
        square = random_square(images, 24)
        top, left = square[0, :, 0, 0].tolist()
        assert torch.equal(square, images[..., top : top + 24, left : left + 24]) and square.shape[-1] == 24
        corners.add((top, left))
    assert len(corners) > 20 and torch.equal(random_square(images, 40), images)


def test_latents_are_scaled_to_unit_variance_and_computed_once_for_each_state_of_the_weights(tmp_path: Path) -> None:
    vae, pixels = autoencoder(), torch.from_numpy(PICTURES)
    with torch.no_grad():
        raw = vae.encode(to_signed(pixels)).latent
    assert (raw * latent_scale(vae, ArrayDataset(pixels=PICTURES))).std().item() == pytest.approx(1.0, abs=1e-3)
    latents = cached_latents(vae, [PICTURES[:4], PICTURES[4:]], "k", tmp_path / "new", batch_size=3)
    torch.testing.assert_close(latents, 0.5 * raw)
    assert torch.equal(cached_latents(vae, [], "k", tmp_path / "new"), latents)  # no picture is looked at
    vae.register_to_config(scaling_factor=0.25)
    torch.testing.assert_close(cached_latents(vae, [PICTURES], "k", tmp_path / "new"), latents / 2)
    with torch.no_grad():
        next(vae.encoder.parameters()).mul_(1.5)
    assert not torch.allclose(cached_latents(vae, [PICTURES], "k", tmp_path / "new"), latents / 2)


@pytest.mark.parametrize("kind", CLASSES)
def test_every_kind_of_autoencoder_is_read_back(tmp_path: Path, kind: str) -> None:
    small = {"block_out_channels": (8,), "norm_num_groups": 4}
    tiny = {"encoder_block_out_channels": (8,) * 4, "decoder_block_out_channels": (8,) * 4}
    made = autoencoder() if kind == "AutoencoderDC" else CLASSES[kind](**(tiny if kind == "AutoencoderTiny" else small))
    made.save_pretrained(tmp_path)
    found = read_autoencoder(tmp_path)
    assert type(found) is type(made) and not any(parameter.requires_grad for parameter in found.parameters())
    assert all(torch.equal(value, found.state_dict()[name]) for name, value in made.state_dict().items())
    (tmp_path / "config.json").write_text('{"_class_name": "UNet2DModel"}')
    with pytest.raises(InvalidInputError, match="`vae` is 'UNet2DModel'; it has to be one of 'AutoencoderKL'"):
        read_autoencoder(tmp_path)


# Classifiers ----------------------------------------------------------------------------------------------------------


def test_touches_of_both_sensors_have_their_own_attributes_and_pictures_the_mean(split: Rendered) -> None:
    data, count = columns([split], "touch", ATTRIBUTES), len(split)
    batch = data[range(len(data))]
    for first, touch, column in ((0, split.touch, 0), (count, split.second, 1)):
        rows = slice(first, first + count)
        np.testing.assert_array_equal(batch["pixels"][rows], touch)
        np.testing.assert_array_equal(batch["attributes"][rows], np.asarray(split.attributes)[:, column])
        np.testing.assert_array_equal(batch["material"][rows], split.material)
    found = columns([split], "image", ("cover", "compliance"))[range(count)]["attributes"]
    np.testing.assert_allclose(found, np.asarray(split.attributes)[:, :, [0, -1]].mean(axis=1), rtol=1e-6)
    assert {*ATTRIBUTES} - {*SHOWN["image"]} == {"depth", "load"}


class Brightest(nn.Module):
    """Reads where an image is brightest, from -1, left, to 1."""

    attributes = ("place x", "place y")

    def scale_of_attributes(self, device: torch.device) -> tuple[Tensor, Tensor]:
        return torch.tensor([0.1, -0.2]), torch.tensor([0.5, 2.0])

    def forward(self, pixels: Tensor) -> ContactClassifierOutput:
        row, column = np.unravel_index(pixels.mean(dim=1).flatten(1).argmax(dim=1), (16, 16))
        place = torch.from_numpy((np.stack([column, row], axis=1) + 0.5) / 8 - 1.0).float()
        return ContactClassifierOutput(logits=torch.zeros(len(place), 2), attributes=place)


@pytest.mark.parametrize("mirror", [0.0, 0.5, 1.0])
def test_what_changes_in_a_mirror_changes_with_the_image(mirror: float) -> None:
    pixels = torch.zeros(8, 3, 16, 16, dtype=torch.uint8)
    pixels[:, :, 3, 13] = 250
    truth = torch.tensor([[13.5 / 8 - 1.0, 3.5 / 8 - 1.0]]).expand(8, 2)
    augment = ClassifierAugmentation(mirror=mirror, blur=0.0, noise=0.0, shift=0)
    batch = {"pixels": pixels, "material": torch.zeros(8, dtype=torch.int64), "attributes": truth}
    assert ClassifierObjective(Brightest(), augment, 1.0)(batch)["attributes"] < 1e-6  # type: ignore[arg-type]


# What the generators are shown ----------------------------------------------------------------------------------------


class Shown(nn.Module):
    """A network that predicts nothing, and keeps what it is shown."""

    def forward(self, sample: Tensor, steps: Tensor, encoder_hidden_states: Tensor, class_labels: Tensor):
        self.sample, self.hidden, self.labels = sample, encoder_hidden_states, class_labels
        return UNet2DConditionOutput(sample=torch.zeros_like(sample[:, :4]))


@pytest.fixture
def embeds() -> Tensor:
    return 2.0 + torch.randn(COUNT, WIDTH, generator=torch.Generator().manual_seed(1))


def shown(objective: nn.Module, embeds: Tensor) -> Shown:
    torch.manual_seed(0)
    batch = {"image_embeds": embeds, "latents": torch.randn(COUNT, 4, 2, 2), "sensor": torch.arange(COUNT) % 3}
    objective({**batch, "index": torch.arange(COUNT), "background": torch.arange(COUNT) % 5})
    return objective.trained  # type: ignore[return-value]


def nearest(rows: Tensor, known: Tensor) -> np.ndarray:
    """Which of some vectors each row is."""
    gap = torch.cdist(rows, known, compute_mode="donot_use_mm_for_euclid_dist")
    assert gap.min(dim=1).values.max() < 1e-3
    return gap.argmin(dim=1).numpy()


def levels(labels: Tensor) -> np.ndarray:
    """Noise levels, read back from their sinusoids."""
    table = get_timestep_embedding(torch.arange(1000), WIDTH, flip_sin_to_cos=True, downscale_freq_shift=0)
    return nearest(labels[:, WIDTH:], table)


def test_unclip_drops_conditions_and_noises_embeddings_as_asked(
    model: UniTouchModel, processor: UniTouchProcessor, embeds: Tensor
) -> None:
    seen = shown(unclip(model, processor, Shown()), embeds)
    dropped = (seen.labels == 0).all(dim=1)
    assert ((seen.labels[:, :WIDTH] == 0).any(dim=1) == dropped).all()  # whole or not at all
    assert dropped.float().mean().item() == pytest.approx(0.25, abs=0.07)
    found = levels(seen.labels[~dropped])
    assert (found == 0).mean() == pytest.approx(0.4, abs=0.09)
    assert kstest(found[found > 0] / 1000, "uniform").pvalue > 1e-3
    with torch.no_grad():
        ids = processor.text(["", QUALITY_PROMPT, "slick glass"])["input_ids"]
        which = nearest(seen.hidden.flatten(1), model.text_model.text_model(ids).last_hidden_state.flatten(1))
    assert (which[dropped.numpy()] == 0).all()
    shares = np.bincount(which[~dropped.numpy()], minlength=3) / int((~dropped).sum())
    np.testing.assert_allclose(shares, [0.15, 0.65, 0.2], atol=0.09)


@pytest.mark.parametrize("low", [0.7, 1.0])
def test_embeddings_without_a_noise_level_are_those_of_the_picture_times_a_gain(
    low: float, model: UniTouchModel, processor: UniTouchProcessor, embeds: Tensor
) -> None:
    seen = shown(unclip(model, processor, Shown(), condition_dropout=0.0, gain=low), embeds)
    clean = torch.from_numpy(levels(seen.labels) == 0)
    gain = (seen.labels[clean, :WIDTH] * embeds[clean]).sum(1) / embeds[clean].square().sum(1)
    # Level 0 still adds a little noise: sqrt(1 - abar_0) = 0.006 standard deviations.
    assert gain.min() > low - 0.02 and gain.max() < 1.02
    assert gain.mean().item() == pytest.approx((1.0 + low) / 2, abs=0.03)


def test_the_normaliser_makes_embeddings_standard(embeds: Tensor) -> None:
    standard = fit_normalizer(embeds).scale(embeds)
    torch.testing.assert_close(standard.mean(dim=0), torch.zeros(WIDTH), atol=1e-5, rtol=0.0)
    torch.testing.assert_close(standard.std(dim=0), torch.ones(WIDTH))
    assert bool(fit_normalizer(torch.ones(8, 4)).scale(torch.ones(1, 4)).isfinite().all())


def touch_ldm(backgrounds: Tensor | None = None, **changes: float) -> TouchDiffusionObjective:
    return TouchDiffusionObjective(Shown(), SCHEDULER, NORM, DIFFUSION.model_copy(update=changes), backgrounds)  # type: ignore[arg-type]


def test_the_condition_of_a_touch_is_one_token_of_the_joint_spaces_norm_or_zeros(embeds: Tensor) -> None:
    seen = shown(touch_ldm(), embeds)
    torch.testing.assert_close(seen.hidden, NORM * F.normalize(embeds, dim=1)[:, None])
    seen = shown(touch_ldm(condition_dropout=0.25), embeds)
    dropped = (seen.hidden == 0).flatten(1)
    assert (dropped.any(dim=1) == dropped.all(dim=1)).all()
    assert dropped.all(dim=1).float().mean().item() == pytest.approx(0.25, abs=0.06)
    assert torch.equal(seen.labels, torch.arange(COUNT) % 3)  # named with and without a condition


def test_some_conditions_are_perturbed_and_keep_their_norm() -> None:
    wide = torch.randn(COUNT, 64, generator=torch.Generator().manual_seed(1))
    hidden = shown(touch_ldm(noisy_share=0.5, condition_noise=1.0), wide).hidden[:, 0]
    torch.testing.assert_close(hidden.norm(dim=1), torch.full((COUNT,), NORM))
    cosine = torch.cosine_similarity(hidden, wide, dim=1)
    assert (cosine > 1 - 1e-5).float().mean().item() == pytest.approx(0.5, abs=0.07)
    # A perturbation as long as the embedding and at right angles to it leaves a cosine of 1 / sqrt(2).
    assert 0.5 < cosine.min().item() < 0.72


def test_the_background_of_each_sample_lies_behind_its_noise(embeds: Tensor) -> None:
    backgrounds = torch.randn(5, 4, 2, 2)
    assert torch.equal(shown(touch_ldm(backgrounds), embeds).sample[:, 4:], backgrounds[torch.arange(COUNT) % 5])


def test_every_contact_knows_what_both_of_its_sensors_see_untouched(cache: Path, processor: UniTouchProcessor) -> None:
    config = DataConfig(drawn={"sensors": [None, "digit"], "objects": 1, "contacts_per_object": 2})
    splits = columns_of(config.sources(), cache, config, processor, ("image", "touch"))
    gels = np.concatenate([untouched_gels(split)[:] for split in splits])
    for split, places in zip(splits, places_of(splits), strict=True):
        for which in (0, 1):
            assert np.array_equal(gels[places + which], split.untouched[:][:, which])
    digit = (untouched_gel(SENSORS["digit"], processor.image_size) * 255).round().byte().numpy()
    assert (gels[places_of(splits)[1]] == digit).all() and not (gels[places_of(splits)[0]] == digit).all()
    assert class_labels(splits, ["digit"]).tolist() == [1] * len(splits[0]) + [0] * len(splits[1])
