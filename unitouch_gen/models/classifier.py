"""A classifier of materials and attributes that shares no weights with the joint space."""

from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from transformers import ResNetConfig, ResNetForImageClassification
from transformers.modeling_outputs import ImageClassifierOutputWithNoAttention

from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.models.relief import ConcatRelief

GRID = 4  # cells a side that features are pooled to for attributes, since the place of a contact is one of them


@dataclass
class ContactClassifierOutput(ImageClassifierOutputWithNoAttention):
    """Output of `ContactClassifier`.

    Attributes:
        logits: Of materials, (B, classes).
        attributes: Those that `config.attributes` names, in their units, (B, K); `None` if it names none.
        features: Pooled features that the material is classified by, (B, D).
    """

    logits: Tensor = None  # type: ignore[assignment]
    attributes: Tensor | None = None
    features: Tensor | None = None


class ContactClassifier(ResNetForImageClassification):
    """transformers' ResNet (He et al., 2016) with a second head for attributes, for images of any size.

    `config.attributes` names the attributes; `attribute_means` and `attribute_deviations` are their statistics in
    training. With `config.relief` the input is a touch and its relief, six channels.
    """

    def __init__(self, config: ResNetConfig):
        super().__init__(config)
        self.beside = ConcatRelief() if getattr(config, "relief", False) else nn.Identity()
        self.attributes = tuple(getattr(config, "attributes", ()))
        width = GRID**2 * list(config.hidden_sizes or ())[-1]
        self.reader = nn.Linear(width, len(self.attributes)) if self.attributes else None

    def forward(self, pixel_values: Tensor, **kwargs: Any) -> ContactClassifierOutput:
        """Classifies images (B, 3, H, W), normalised as for the joint space."""
        output = self.resnet(self.beside(pixel_values))
        attributes = None
        if self.reader is not None:
            mean, deviation = self.scale_of_attributes(pixel_values.device)
            pooled = F.adaptive_avg_pool2d(output.last_hidden_state, GRID).flatten(1)
            attributes = self.reader(pooled).float() * deviation + mean
        logits = self.classifier(output.pooler_output)
        features = output.pooler_output.flatten(1)
        return ContactClassifierOutput(logits=logits, attributes=attributes, features=features)

    @torch.no_grad()
    def observe(self, images: Tensor, batch_size: int = 256) -> ContactClassifierOutput:
        """Classifies images (N, 3, H, W) in [0, 1], in batches."""
        outputs = [self(normalise_pixels(batch)) for batch in images.split(batch_size)]
        joined = {key: torch.cat([output[key] for output in outputs]) for key in outputs[0]}
        return type(outputs[0])(**joined)

    def scale_of_attributes(self, device: torch.device | str = "cpu") -> tuple[Tensor, Tensor]:
        """Mean and deviation of each attribute in training, (K,)."""
        scale = torch.tensor([self.config.attribute_means, self.config.attribute_deviations], device=device)
        return scale[0], scale[1]
