"""A UNet that was distilled: it takes the guidance scale and the number of steps as conditions (Meng et al., 2023)."""

import math
from collections.abc import Mapping
from typing import Any

import torch
from diffusers import UNet2DConditionModel
from diffusers.models.embeddings import get_timestep_embedding
from torch import Tensor, nn

from unitouch_gen.models.added_sensors import DOWN, UP

CONDITION_WIDTH = 64
"""Width of the embedded guidance scale and number of steps together."""

PROJECTION = "time_embedding.cond_proj.weight"
"""What the embedding goes through, which a teacher does not have."""

UPDATE = "student.safetensors"
"""File of what a student has in addition to its teacher."""


def is_distilled(network: Any) -> bool:
    """Whether a network takes the guidance scale and the number of steps as conditions."""
    return network.config.get("time_cond_proj_dim") is not None


def distilled_arguments(network: Any, guidance_scale: float | Tensor, steps: int, like: Tensor) -> dict[str, Tensor]:
    """`timestep_cond` (B, W) of a distilled network, nothing of others.

    One half tells the guidance scale (B,), or one for all, as diffusers embeds it; the other how many steps there are,
    since one of few has to lead further. Scales below 1 are no guidance, as 1 is. Device and dtype are those of `like`:
    a network has to look for its own, which takes a tenth of an evaluation.
    """
    if not is_distilled(network):
        return {}
    scales = torch.as_tensor(guidance_scale, dtype=torch.float32, device=like.device).reshape(-1).clamp(min=1.0)
    both = torch.stack([scales - 1.0, torch.full_like(scales, math.log2(steps))])
    embedded = get_timestep_embedding(
        1000.0 * both.flatten(), network.config.time_cond_proj_dim // 2, downscale_freq_shift=1
    )
    return {"timestep_cond": torch.cat(embedded.chunk(2), dim=1).to(like.dtype)}


def student_of(teacher: UNet2DConditionModel, update: Mapping[str, Tensor] | None = None) -> UNet2DConditionModel:
    """A copy of a network, in float32, that takes both conditions.

    Args:
        teacher: Stays as it is.
        update: What the student was trained to in addition: `PROJECTION`, and low-rank updates of layers (Hu et al.,
            2022), by their name and `DOWN` (r, in, ...) or `UP` (out, r, ...). Without it the student makes nothing of
            its conditions yet.
    """
    student: Any = UNet2DConditionModel.from_config(teacher.config, time_cond_proj_dim=CONDITION_WIDTH).float()
    missing, unexpected = student.load_state_dict(teacher.state_dict(), strict=False)
    assert missing == [PROJECTION] and not unexpected
    nn.init.zeros_(student.time_embedding.cond_proj.weight)
    known = dict(update or {})
    for name, value in known.items():
        if name == PROJECTION:
            student.time_embedding.cond_proj.weight.data.copy_(value)
        elif name.endswith(DOWN):
            weight = student.get_submodule(name.removesuffix(DOWN)).weight
            above = known[name.removesuffix(DOWN) + UP]
            weight.data += (above.float().flatten(1) @ value.float().flatten(1)).view_as(weight)
    return student
