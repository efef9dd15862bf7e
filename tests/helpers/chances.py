"""Counts of independent draws, held to the chance that they are drawn with."""

from scipy.stats import binomtest


def has_chance(count: int, draws: int, chance: float) -> bool:
    """Whether a count is one that a fair run of draws has, but for one run in a thousand (two-sided binomial test)."""
    return bool(binomtest(int(count), int(draws), chance).pvalue > 1e-3)
