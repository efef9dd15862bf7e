"""A classifier that shares nothing with the joint space: names the material, and reads what can be measured."""

from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from transformers import ResNetConfig, ResNetForImageClassification
from transformers.modeling_outputs import ImageClassifierOutputWithNoAttention

from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.models.relief import BesideRelief

GRID = 4  # places a side that attributes are read from: where a contact lies is one of them


@dataclass
class ContactClassifierOutput(ImageClassifierOutputWithNoAttention):
    """`logits` of materials (B, classes); `attributes` as `config.attributes` names them, in their units, (B, K), or
    `None`; and the `features` that the material is named by, (B, D)."""

    logits: Tensor = None  # type: ignore[assignment]
    attributes: Tensor | None = None
    features: Tensor | None = None


class ContactClassifier(ResNetForImageClassification):
    """transformers' ResNet (He et al., 2016) with a second head, of images of any size.

    `config.attributes` names what is read, `attribute_means` and `attribute_deviations` are their statistics in
    training. With `config.relief` it sees touches beside their relief, which sensors share: six channels.
    """

    def __init__(self, config: ResNetConfig):
        super().__init__(config)
        self.beside = BesideRelief() if getattr(config, "relief", False) else nn.Identity()
        self.attributes = tuple(getattr(config, "attributes", ()))
        width = GRID**2 * list(config.hidden_sizes or ())[-1]
        self.reader = nn.Linear(width, len(self.attributes)) if self.attributes else None

    def forward(self, pixel_values: Tensor, **kwargs: Any) -> ContactClassifierOutput:
        """What is seen in images (B, 3, H, W), normalised as the joint space's."""
        seen = self.resnet(self.beside(pixel_values))
        attributes = None
        if self.reader is not None:
            mean, deviation = self.scale_of_attributes(pixel_values.device)
            read = self.reader(F.adaptive_avg_pool2d(seen.last_hidden_state, GRID).flatten(1))
            attributes = read.float() * deviation + mean
        logits = self.classifier(seen.pooler_output)
        features = seen.pooler_output.flatten(1)
        return ContactClassifierOutput(logits=logits, attributes=attributes, features=features)

    @torch.no_grad()
    def observe(self, images: Tensor, batch_size: int = 256) -> ContactClassifierOutput:
        """What is seen in images (N, 3, H, W) in [0, 1], a few at a time."""
        parts = [self(normalise_pixels(part)) for part in images.split(batch_size)]
        return type(parts[0])(**{key: torch.cat([part[key] for part in parts]) for key in parts[0]})

    def scale_of_attributes(self, device: torch.device | str = "cpu") -> tuple[Tensor, Tensor]:
        """Mean and deviation of each attribute in training, (K,)."""
        scale = torch.tensor([self.config.attribute_means, self.config.attribute_deviations], device=device)
        return scale[0], scale[1]
