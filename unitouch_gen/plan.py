"""What one request needs of a pipeline, told from its arguments alone: the plan, made before anything is loaded."""

from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any

from torch import Tensor

UNCONDITIONAL = "unconditional branch"

WORK_ALONE = (UNCONDITIONAL, "noise augmentation")
"""Parts of a request for which no weights are read."""


@dataclass(frozen=True)
class Plan:
    """What a request needs. `XToTouchPipeline.plan(text="rough brick")` and its like make one.

    A part is `None` where the pipeline has no such part, and so cannot leave it out.

    Attributes:
        modalities: Whose encoders of the joint space run.
        known_modalities: Whose encoders the pipeline has.
        text_encoder: Whether prompts are encoded.
        embedding_bank: Whether conditions are moved towards stored image embeddings.
        noise: Whether noise is added to the embedding. unCLIP models always do: at level 0, too, diffusers' schedules
            add a little, and draw it from the call's generator before the latents.
        guidance: Where the unconditional branch runs, as shares (low, high) of the noise levels; `None` where it never
            does. A scale that the checkpoint chooses counts as one above 1.
        vae: Whether pictures are made of latents, or latents of pictures.
    """

    modalities: tuple[str, ...]
    known_modalities: tuple[str, ...]
    text_encoder: bool | None = None
    embedding_bank: bool | None = None
    noise: bool | None = None
    guidance: tuple[float, float] | None = (0.0, 1.0)
    vae: bool = True

    @property
    def parts(self) -> dict[str, bool]:
        """Whether the request needs it, of each part that the pipeline has, by the names of run reports."""
        parts: list[tuple[str, bool | None]] = [
            *((f"{modality} encoder", modality in self.modalities) for modality in self.known_modalities),
            ("prompt encoder", self.text_encoder),
            ("bank of image embeddings", self.embedding_bank),
            ("noise augmentation", self.noise),
            (UNCONDITIONAL, self.guidance is not None),
            ("VAE", self.vae),
        ]
        return {part: needed for part, needed in parts if needed is not None}

    @property
    def left_out(self) -> list[str]:
        """What the request does not need, in words."""
        return [part for part, needed in self.parts.items() if not needed]

    @property
    def components(self) -> dict[str, bool]:
        """Whether the request needs it, of each component of the pipeline that a plan may leave out."""
        optional = {
            "unitouch": bool(self.modalities),
            "processor": bool(self.modalities),
            "tokenizer": self.text_encoder,
            "text_encoder": self.text_encoder,
            "embedding_bank": self.embedding_bank,
            "vae": self.vae,
        }
        return {name: needed for name, needed in optional.items() if needed is not None}

    def beyond(self, other: "Plan") -> list[str]:
        """What this plan needs weights for and the other one left out, in words."""
        return [part for part in other.left_out if self.parts.get(part) and part not in WORK_ALONE]

    def branches(self, timesteps: Sequence[float] | Tensor, last: int) -> list[int]:
        """How many branches of guidance the evaluation at each timestep holds, 1 or 2.

        Args:
            timesteps: Of the solver.
            last: Timestep of noise alone.
        """
        if self.guidance is None:
            return [1] * len(timesteps)
        low, high = (share * last for share in self.guidance)
        return [2 if low <= float(timestep) <= high else 1 for timestep in timesteps]


def guidance_of(scale: Any, interval: Any) -> tuple[float, float] | None:
    """`Plan.guidance` of a request. What cannot be used is for the call to refuse, and counts as guidance everywhere.

    Args:
        scale: `guidance_scale`, or `None` for the checkpoint's own.
        interval: `guidance_interval`.
    """
    if isinstance(scale, Real) and scale <= 1.0:
        return None
    if isinstance(interval, list | tuple) and len(interval) == 2 and all(isinstance(end, Real) for end in interval):
        return float(interval[0]), float(interval[1])
    return 0.0, 1.0
