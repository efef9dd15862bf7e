"""Deep supervised cross-modal retrieval (Zhen et al., 2019): small networks to a space where classes lie apart."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

HIDDEN, WIDTH = 256, 64  # smaller than the paper's, and trained for less, as contacts are few
EPOCHS, BATCH_SIZE, LEARNING_RATE = 20, 256, 2e-3
PAIRWISE, INVARIANCE = 1e-3, 1e-1
"""Weights of the losses, lambda and eta of the paper."""


def dscmr(
    one: Tensor, other: Tensor, labels: Tensor, queries: Tensor, gallery: Tensor, seed: int = 0
) -> tuple[Tensor, Tensor]:
    """Queries and gallery in a space that was learned from labelled pairs of two modalities.

    Args:
        one, other: Features of pairs, (M, D) and (M, E).
        labels: Of the pairs, int64 (M,).
        queries: Of the first modality, (Q, D).
        gallery: Of the other, (N, E).
        seed: Of weights and batches.

    Returns:
        (Q, K) and (N, K), to be compared by cosine.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        shared = nn.Linear(HIDDEN, WIDTH)  # by both modalities
        sides = [nn.Sequential(nn.Linear(part.shape[1], HIDDEN), nn.ReLU(), shared) for part in (one, other)]
        classes, known = labels.unique(return_inverse=True)
        classify = nn.Linear(WIDTH, len(classes), bias=False)
        first, second = _in_deviations(one, one), _in_deviations(other, other)
        layers = nn.ModuleList([*sides, classify])
        optimiser = torch.optim.Adam(layers.parameters(), LEARNING_RATE)
        with torch.enable_grad():
            for _ in range(EPOCHS):
                for rows in torch.randperm(len(known)).split(BATCH_SIZE):
                    u, v = sides[0](first[rows]), sides[1](second[rows])
                    loss = dscmr_loss(u, v, classify(u), classify(v), known[rows])
                    optimiser.zero_grad()
                    loss.backward()
                    optimiser.step()
    with torch.no_grad():
        return sides[0](_in_deviations(queries, one)), sides[1](_in_deviations(gallery, other))


def _in_deviations(features: Tensor, fitted: Tensor) -> Tensor:
    """Features (N, D) around the means of those fitted (M, D), in units of their deviations."""
    return (features.float() - fitted.float().mean(0)) / (fitted.float().std(0) + 1e-6)


def dscmr_loss(u: Tensor, v: Tensor, named_u: Tensor, named_v: Tensor, labels: Tensor) -> Tensor:
    """J1 + lambda J2 + eta J3 of Zhen et al.: labels read linearly off both, likeness of pairs within and across
    modalities, and u near v.

    Args:
        u, v: Of both modalities in the common space, (B, K).
        named_u, named_v: What the shared linear map makes of them, (B, C).
        labels: int64 (B,).
    """
    truth = F.one_hot(labels, named_u.shape[1]).float()
    discrimination = (named_u - truth).norm() + (named_v - truth).norm()
    alike = (labels[:, None] == labels[None]).float()

    def likelihood(a: Tensor, b: Tensor) -> Tensor:
        gamma = 0.5 * F.normalize(a, dim=1) @ F.normalize(b, dim=1).T
        return (F.softplus(gamma) - alike * gamma).mean()

    pairwise = likelihood(u, v) + likelihood(u, u) + likelihood(v, v)
    return (discrimination + INVARIANCE * (u - v).norm()) / len(u) + PAIRWISE * pairwise
