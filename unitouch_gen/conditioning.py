"""From embeddings of the joint space to the conditioning of a denoising network.

The steps, in order: rescaling to the norm of image embeddings (`match_norm`), bridge (`bridge_nearest`), strength (a
factor; Section 4.4 of the paper), noising (`noise_embeddings`). InfoNCE fixes only directions: without the first step
the unCLIP's normaliser would see an embedding of the wrong scale.
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
from unitouch_gen.saving import saved_whole

QUALITY_PROMPT = "high quality"
"""The paper's prompt for touches: the most frequent training prompt, and the default."""


def match_norm(embeds: Tensor, norm: float) -> Tensor:
    """Each embedding (..., D) scaled to an L2 norm; the zero vector stays zero."""
    length = embeds.norm(dim=-1, keepdim=True)
    return norm * embeds / torch.where(length > 0, length, 1.0)


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
        noise_level: l, int64 (B,), from 0 to the scheduler's last timestep. 0 still adds a little noise.
        noise: n, unit variance, (B, D).
        normalizer: Mean and standard deviation of the embeddings the UNet was trained on.
        scheduler: The noise schedule of the embedding, not of the latents.

    Returns:
        (B, 2 D).
    """
    mean = normalizer.mean.to(embeds)
    std = normalizer.std.to(embeds)
    scaled = (embeds - mean) / std
    noised = scheduler.add_noise(scaled, noise=noise, timesteps=noise_level) * std + mean  # type: ignore[attr-defined]
    level = get_timestep_embedding(noise_level, embeds.shape[-1], flip_sin_to_cos=True, downscale_freq_shift=0)
    return torch.cat([noised, level.to(noised)], dim=1)


def bridge_nearest(embeds: Tensor, directions: Tensor, neighbours: int, temperature: float, share: float) -> Tensor:
    """Moves embeddings of any modality towards their nearest image embeddings, keeping their norms.

    p = normalise(sum_k softmax(cos_k / temperature) d_k) over the K nearest stored directions d_k, then
    e <- |e| normalise((1 - share) e / |e| + share p): the refinement in the paper's release, where K = 10, the
    temperature 1/20 and the share 1/2.

    Args:
        embeds: e, (B, D).
        directions: Unit vectors (N, D).
        neighbours: K, at most N.
        temperature: Softmax temperature of the cosines, > 0.
        share: Share of the neighbours, from 0 (unchanged) to 1.
    """
    unit = match_norm(embeds, 1.0)
    cosines, rows = (unit @ directions.T).topk(min(neighbours, len(directions)), dim=-1)
    weights = (cosines / temperature).softmax(dim=-1)
    nearest = match_norm((weights[..., None] * directions[rows]).sum(dim=-2), 1.0)
    return match_norm((1.0 - share) * unit + share * nearest, 1.0) * embeds.norm(dim=-1, keepdim=True)


def mix_linear(embeds: Tensor, weights: Tensor) -> Tensor:
    """e = sum_i w_i e_i (Section 4.4 of the paper: touch 0.3, image 0.7).

    Args:
        embeds: Embeddings of equal norm, (N, ..., D).
        weights: Weights that sum to 1, (N,).
    """
    return torch.einsum("n...d,n->...d", embeds, weights.to(embeds))


def mix_to_norm(embeds: Tensor, weights: Tensor) -> Tensor:
    """`mix_linear`, rescaled to the norm of its parts (averaging shrinks the norm)."""
    return match_norm(mix_linear(embeds, weights), 1.0) * embeds.norm(dim=-1).amax(dim=0)[..., None]


class StoredCondition(ModelMixin, ConfigMixin):
    """Conditioning stored with a checkpoint, in buffers."""

    save_pretrained = saved_whole(ModelMixin.save_pretrained)


class SensorBackgrounds(StoredCondition):
    """Background latents (scaled) of each known sensor, untouched.

    Args:
        count: K, number of sensors.
        channels, height, width: C, h and w of the latents.
    """

    @register_to_config
    def __init__(self, count: int, channels: int, height: int, width: int):
        super().__init__()
        self.register_buffer("latents", torch.zeros(count, channels, height, width))

    @classmethod
    def of(cls, latents: Tensor) -> "SensorBackgrounds":
        """Stores latents (K, C, h, w), in the order of the sensors."""
        backgrounds = cls(*latents.shape)
        backgrounds.latents.copy_(latents)
        return backgrounds


class EmbeddingBank(StoredCondition):
    """Directions of a training set's image embeddings.

    Args:
        size: N, number of embeddings.
        embedding_dim: D.
        neighbours, temperature, share: See `bridge_nearest`; share 0.5 in the paper's release, 1.0 built in.
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
        """A bank of embeddings (N, D), which are normalised here."""
        bank = cls(*embeds.shape, **settings)
        bank.embeds.copy_(torch.nn.functional.normalize(embeds.float(), dim=-1))
        return bank

    def bridge(self, embeds: Tensor) -> Tensor:
        """`bridge_nearest` of embeddings (B, D), with the bank's settings."""
        settings = {key: self.config[key] for key in ("neighbours", "temperature", "share")}
        return bridge_nearest(embeds, self.embeds.to(embeds), **settings)
