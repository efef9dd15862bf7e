"""InfoNCE between two views of the same things (Eq. 1-3 of the paper)."""

import torch
import torch.nn.functional as F
from torch import Tensor


def info_nce(query: Tensor, key: Tensor, temperature: float | Tensor) -> Tensor:
    """Eq. 1: - 1/B sum_i log softmax_j(q_i . k_j / tau)_i on unit vectors.

    Args:
        query, key: Embeddings of B pairs, (B, D); normalised here.
        temperature: tau > 0.

    Relations:
        Cross-entropy of the similarity matrix against its diagonal; log B for unrelated views.
    """
    logits = F.normalize(query.float(), dim=-1) @ F.normalize(key.float(), dim=-1).T / temperature
    return F.cross_entropy(logits, torch.arange(len(logits), device=logits.device))


def symmetric_info_nce(a: Tensor, b: Tensor, temperature: float | Tensor) -> Tensor:
    """Eq. 2: L_{A -> B} + L_{B -> A}."""
    return info_nce(a, b, temperature) + info_nce(b, a, temperature)
