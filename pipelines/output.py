"""What the pipelines return."""

from dataclasses import dataclass, field

import numpy as np
import torch
from diffusers.utils import BaseOutput
from PIL import Image

from unitouch_gen.sampling import RunReport


@dataclass
class UniTouchPipelineOutput(BaseOutput):
    """Output of the generating pipelines.

    Args:
        images: PIL images, or an array (B, H, W, 3) in [0, 1], or a tensor (B, 3, H, W) in [0, 1], or latents
            (B, C, h, w), by `output_type`; of the samples that are finite.
        report: What the call did.
        embeds: Embeddings that conditioned the network, of all samples; pass them to another call to skip encoding.
    """

    images: list[Image.Image] | np.ndarray | torch.Tensor
    report: RunReport
    embeds: torch.Tensor


@dataclass
class AnswerReport(RunReport):
    """What a call of `TouchToTextPipeline` did."""

    prompt_tokens: list[int] = field(default_factory=list)  #: of each question, as it was put
    tokens: list[int] = field(default_factory=list)  #: of each answer, without its end

    def __str__(self) -> str:
        stages = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in self.seconds.items())
        return f"{sum(self.tokens)} tokens, {sum(self.seconds.values()):.2f} s ({stages})"


@dataclass
class TouchToTextPipelineOutput(BaseOutput):
    """Output of `TouchToTextPipeline`.

    Args:
        texts: Answers, those of one input together.
        report: What the call did.
        embeds: Embeddings (B, D) that the answers are about; pass them to another call to skip encoding.
    """

    texts: list[str]
    report: AnswerReport
    embeds: torch.Tensor
