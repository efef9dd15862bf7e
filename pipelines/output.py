"""What the pipelines return."""

from dataclasses import dataclass

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
        encoded: Touch embeddings (B, D) before the bridge, for zero-shot classification. `None` without touches.
    """

    images: list[Image.Image] | np.ndarray | torch.Tensor
    report: RunReport
    embeds: torch.Tensor
    encoded: torch.Tensor | None = None
