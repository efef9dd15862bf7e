"""A bank of image embeddings that ships with a checkpoint: where the bridge between the modalities finds its images."""

import torch
from diffusers import ConfigMixin, ModelMixin
from diffusers.configuration_utils import register_to_config
from torch import Tensor

from unitouch_gen.conditioning import bridge_nearest


class EmbeddingBank(ModelMixin, ConfigMixin):
    """Image embeddings of a training set, as directions.

    Args:
        size: N, of the embeddings.
        embedding_dim: D.
        neighbours, temperature, share: Of `bridge_nearest`, as a checkpoint found them best. The paper's release shares
            half; all of it is better for the built-in family.
    """

    @register_to_config
    def __init__(
        self,
        size: int,
        embedding_dim: int,
        neighbours: int = 10,
        temperature: float = 0.05,
        share: float = 1.0,
    ):
        super().__init__()
        self.register_buffer("embeds", torch.zeros(size, embedding_dim))

    @classmethod
    def of(cls, embeds: Tensor, **settings: float) -> "EmbeddingBank":
        """A bank of given embeddings (N, D), normalised here."""
        bank = cls(*embeds.shape, **settings)
        bank.embeds.copy_(torch.nn.functional.normalize(embeds.float(), dim=-1))
        return bank

    def bridge(self, embeds: Tensor) -> Tensor:
        """Embeddings (B, D) moved towards the nearest stored ones, their norms kept; see `bridge_nearest`."""
        settings = {key: self.config[key] for key in ("neighbours", "temperature", "share")}
        return bridge_nearest(embeds, self.embeds.to(embeds), **settings)
