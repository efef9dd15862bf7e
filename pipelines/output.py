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
            (B, C, h, w), by `output_type`. Samples whose return code is not SUCCESS are not among them.
        report: What the call did.
        embeds: What the network was conditioned on, also of samples that broke: for another call that should not
            encode its inputs again.
        encoded: Embeddings (B, D) of the touches that pictures were made of, before the bridge: what zero-shot
            classification takes. `None` elsewhere.
    """

    images: list[Image.Image] | np.ndarray | torch.Tensor
    report: RunReport
    embeds: torch.Tensor
    encoded: torch.Tensor | None = None
