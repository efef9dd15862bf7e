"""What the exact eliminations of `diffusion.eliminate` save of a UNet's time, and what they change."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from tests.benchmarks import Figures
from tests.benchmarks.turns import in_turns, ratio_of, seconds_of
from unitouch_gen.eliminate import eliminated
from unitouch_gen.numerics.pipeline_subject import PipelineSubject

TIMESTEPS = (999.0, 500.0, 20.0)
ROWS = (2, 16)
"""Of a batch, both branches of guidance: one sample, and eight."""


@torch.no_grad()
def elimination_figures(subject: PipelineSubject, rows: Sequence[int] = ROWS, repeats: int = 15) -> Figures:
    """Ratio of the seconds without and with them, in turns, and the largest difference of predictions, by rows.

    Args:
        subject: Of at least half as many samples as the most rows.
        rows: Of a batch, even.
        repeats: Turns, of one evaluation at each of `TIMESTEPS`.
    """
    network = subject.network("float32")
    figures: Figures = {}
    for number in rows:
        part = list(range(number // 2))
        conditions = subject.bound(subject.guidance_scale, part).arguments
        state = torch.cat([subject.noise[part]] * 2)
        figures[f"{number} rows"] = _compared(network, state, conditions, repeats)
    return figures


def _compared(network: Any, state: Tensor, conditions: dict[str, Any], repeats: int) -> Figures:
    """The figures of one batch (B, C, h, w)."""
    hidden, labels = conditions["encoder_hidden_states"], conditions.get("class_labels")

    def plain() -> list[Tensor]:
        return [network(state, timestep, **conditions)[0] for timestep in TIMESTEPS]

    with eliminated(network, hidden, labels) as left:

        def lean() -> list[Tensor]:
            return [left(state, timestep, hidden, labels) for timestep in TIMESTEPS]

        calls = {"plain": plain, "lean": lean}
        seen = in_turns({name: partial(seconds_of, call) for name, call in calls.items()}, repeats)
        differences = [(one - other).abs().max().item() for one, other in zip(lean(), plain(), strict=True)]
    return {**ratio_of(seen["plain"], seen["lean"]), "difference": max(differences)}
