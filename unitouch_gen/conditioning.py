"""From embeddings of the joint space to what a denoising network is conditioned on.

The steps, in order: bring every embedding to the norm of the space's image embeddings (`match_norm`), gain
(`apply_strength`), noising (`noise_embeddings`). InfoNCE fixes only directions, so without the first step the
normaliser of the unCLIP would see an embedding of the wrong scale.
"""

import sys

import torch
from diffusers import ConfigMixin, ModelMixin
from diffusers.configuration_utils import register_to_config
from diffusers.models.embeddings import get_timestep_embedding
from diffusers.pipelines.stable_diffusion.stable_unclip_image_normalizer import StableUnCLIPImageNormalizer
from diffusers.schedulers.scheduling_utils import SchedulerMixin
from torch import Tensor

from unitouch_gen.errors import check_integer, check_number
from unitouch_gen.files import saved_whole

QUALITY_PROMPT = "high quality"
"""The paper's prompt beside a touch: training shows it most, and pipelines take it where none is given."""


def match_norm(embeds: Tensor, norm: float) -> Tensor:
    """Each embedding (..., D) scaled to an L2 norm; the zero vector stays zero."""
    length = embeds.norm(dim=-1, keepdim=True)
    return norm * embeds / torch.where(length > 0, length, 1.0)


def apply_strength(embeds: Tensor, strength: float) -> Tensor:
    """e <- s e (Section 4.4 of the paper: s = 0.75 for touch-to-image)."""
    return strength * embeds


def noise_embeddings(
    embeds: Tensor,
    noise_level: Tensor,
    noise: Tensor,
    normalizer: StableUnCLIPImageNormalizer,
    scheduler: SchedulerMixin,
) -> Tensor:
    """Noised embeddings with their noise level: the class labels of an unCLIP UNet.

    c = [ unscale(sqrt(abar_l) scale(e) + sqrt(1 - abar_l) n) | sinusoid(l) ], as in
    `StableUnCLIPImg2ImgPipeline.noise_image_embeddings`.

    Args:
        embeds: e, (B, D).
        noise_level: l, int64 (B,), each from 0 to the scheduler's last step. 0 still adds a little noise.
        noise: n, unit variance, (B, D).
        normalizer: Mean and standard deviation of the embeddings the UNet was trained on.
        scheduler: Of the noising, not of the latents.

    Returns:
        (B, 2 D).
    """
    mean, std = normalizer.mean.to(embeds), normalizer.std.to(embeds)
    noised = scheduler.add_noise((embeds - mean) / std, noise=noise, timesteps=noise_level) * std + mean  # type: ignore[attr-defined]
    level = get_timestep_embedding(noise_level, embeds.shape[-1], flip_sin_to_cos=True, downscale_freq_shift=0)
    return torch.cat([noised, level.to(noised)], dim=1)


def bridge_nearest(embeds: Tensor, embedding_bank: Tensor, neighbours: int, temperature: float, share: float) -> Tensor:
    """Moves embeddings of any modality towards their nearest image embeddings, keeping their norms.

    p = normalise(sum_k softmax(cos_k / temperature) d_k) over the K nearest stored directions d_k, then
    e <- |e| normalise((1 - share) e / |e| + share p): the refinement in the paper's release, where K = 10, the
    temperature 1/20 and the share 1/2.

    Args:
        embeds: e, (B, D).
        embedding_bank: Unit vectors (N, D).
        neighbours: K, at most N.
        temperature: Of the softmax over cosines, > 0.
        share: Of the neighbours, from 0 (`embeds` as they are) to 1.
    """
    unit = match_norm(embeds, 1.0)
    cosines, rows = (unit @ embedding_bank.T).topk(min(neighbours, len(embedding_bank)), dim=-1)
    weights = (cosines / temperature).softmax(dim=-1)
    nearest = match_norm((weights[..., None] * embedding_bank[rows]).sum(dim=-2), 1.0)
    return match_norm((1.0 - share) * unit + share * nearest, 1.0) * embeds.norm(dim=-1, keepdim=True)


def mix_linear(embeds: Tensor, weights: Tensor) -> Tensor:
    """e = sum_i w_i e_i (Section 4.4 of the paper: touch 0.3, image 0.7).

    Args:
        embeds: Of one norm, (N, ..., D).
        weights: Summing to 1, (N,).
    """
    return torch.einsum("n...d,n->...d", embeds, weights.to(embeds))


def mix_to_norm(embeds: Tensor, weights: Tensor) -> Tensor:
    """`mix_linear`, brought back to the norm of its parts: a sum of embeddings that differ is shorter than they are."""
    return match_norm(mix_linear(embeds, weights), 1.0) * embeds.norm(dim=-1).amax(dim=0)[..., None]


def mix_spherical(embeds: Tensor, weights: Tensor) -> Tensor:
    """Weighted mean on the sphere (Buss & Fillmore, 2001, Algorithm A1), which for two embeddings is slerp."""
    norm = embeds.norm(dim=-1).amax(dim=0)[..., None]
    unit = match_norm(embeds.double(), 1.0)
    mean = match_norm(mix_linear(unit, weights), 1.0)
    for _ in range(30):  # the fixed point converges linearly; for two embeddings, one is exact
        cosine = (unit * mean).sum(dim=-1, keepdim=True).clamp(-1.0, 1.0)
        tangent = unit - cosine * mean
        angle = cosine.arccos()
        step = mix_linear(tangent * torch.where(angle > 1e-12, angle / angle.sin().clamp_min(1e-12), 1.0), weights)
        length = step.norm(dim=-1, keepdim=True)
        mean = length.cos() * mean + torch.where(length > 1e-12, length.sin() / length.clamp_min(1e-12), 1.0) * step
    return match_norm(mean, 1.0).to(embeds) * norm


class StoredCondition(ModelMixin, ConfigMixin):
    """Something to condition on that is kept with a checkpoint, in buffers."""

    save_pretrained = saved_whole(ModelMixin.save_pretrained)


class SensorBackgrounds(StoredCondition):
    """What the sensors that a network knows by name see untouched, as scaled latents of its autoencoder.

    Args:
        count: K, of the sensors.
        channels, height, width: C, h and w of the latents.
    """

    @register_to_config
    def __init__(self, count: int, channels: int, height: int, width: int):
        super().__init__()
        self.register_buffer("latents", torch.zeros(count, channels, height, width))

    @classmethod
    def of(cls, latents: Tensor) -> "SensorBackgrounds":
        """Given latents (K, C, h, w), in the order of the sensors."""
        backgrounds = cls(*latents.shape)
        backgrounds.latents.copy_(latents)
        return backgrounds


class EmbeddingBank(StoredCondition):
    """Image embeddings of a training set, as directions.

    Args:
        size: N, of the embeddings.
        embedding_dim: D.
        neighbours, temperature, share: Of `bridge_nearest`. The paper's release shares half; the built-in family all.
    """

    @register_to_config
    def __init__(
        self, size: int, embedding_dim: int, neighbours: int = 10, temperature: float = 0.05, share: float = 1.0
    ):
        super().__init__()
        check_integer("neighbours", neighbours, 1)
        check_number("temperature", temperature, sys.float_info.min)
        check_number("share", share, 0.0, 1.0)
        self.register_buffer("embeds", torch.zeros(size, embedding_dim))

    @classmethod
    def of(cls, embeds: Tensor, **settings: float) -> "EmbeddingBank":
        """A bank of given embeddings (N, D), normalised here."""
        bank = cls(*embeds.shape, **settings)
        bank.embeds.copy_(torch.nn.functional.normalize(embeds.float(), dim=-1))
        return bank

    def nearness(self, embeds: Tensor) -> Tensor:
        """How near embeddings (B, D) are to stored ones, (B, N): a softmax over cosines, at the bank's temperature."""
        return (match_norm(embeds, 1.0) @ self.embeds.to(embeds).T / self.config["temperature"]).softmax(dim=-1)

    def bridge(self, embeds: Tensor) -> Tensor:
        """Embeddings (B, D) moved towards the nearest stored ones, their norms kept; see `bridge_nearest`."""
        settings = {key: self.config[key] for key in ("neighbours", "temperature", "share")}
        return bridge_nearest(embeds, self.embeds.to(embeds), **settings)
