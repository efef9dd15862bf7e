"""Zero-shot classification: features of any modality against the text of each class (Section 4.2 of the paper)."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from unitouch_gen.errors import check_choice
from unitouch_gen.models.images import ImageInput
from unitouch_gen.models.joint import UniTouchModel
from unitouch_gen.models.processing import UniTouchProcessor
from unitouch_gen.world.collections import COLLECTION_MATERIALS

PROMPTS: dict[str, str] = {
    "image": "this looks like {}",
    "touch": "this feels like {}",
    "audio": "this looks like {}",
}
"""The template of each modality. Touch reads as in the paper's Table "Prompt analysis"."""


@torch.no_grad()
def class_embeddings(model: UniTouchModel, processor: UniTouchProcessor, names: Sequence[str], template: str) -> Tensor:
    """Unit text embeddings of a template filled with each class name, (classes, D)."""
    features = model.get_text_features(**processor.text([template.format(name) for name in names]))
    return F.normalize(features.float(), dim=-1)


def zero_shot_scores(features: Tensor, classes: Tensor) -> Tensor:
    """Cosine similarity of features (B, D), of any length, to unit class embeddings (classes, D)."""
    return F.normalize(features.float(), dim=-1) @ classes.T


def accuracy(scores: Tensor, labels: Tensor) -> float:
    """Share of rows (B, classes) whose largest score is at the label (B,)."""
    return (scores.argmax(dim=1) == labels).float().mean().item()


class MaterialNamer:
    """Names what a touch or a picture is of, by zero-shot classification.

    Args:
        model: With text and the modality that is asked about.
        processor: For both.
        materials: Class names.
    """

    def __init__(
        self, model: UniTouchModel, processor: UniTouchProcessor, materials: Sequence[str] = COLLECTION_MATERIALS
    ):
        self.model, self.processor, self.materials = model, processor, tuple(materials)

    @torch.no_grad()
    def touch(
        self, touch: ImageInput, sensor: str | Sequence[str | None] | None = None, top: int = 3
    ) -> list[dict[str, float]]:
        """The `top` materials of each touch with their softmax shares, best first."""
        pixels = self.processor.touch(touch)
        ids = self.model.sensor_ids(self.model.match_sensors(pixels, sensor))
        return self.name(self.model.get_touch_features(pixels, ids), "touch", top)

    @torch.no_grad()
    def image(self, images: ImageInput, top: int = 3) -> list[dict[str, float]]:
        """The `top` materials of each picture with their softmax shares, best first."""
        return self.name(self.model.get_image_features(self.processor.images(images)), "image", top)

    @torch.no_grad()
    def name(self, features: Tensor, modality: str, top: int = 3) -> list[dict[str, float]]:
        """The `top` materials of features (B, D), of any length, with the template of the modality they came from."""
        template = PROMPTS[check_choice("modality", modality, PROMPTS)]
        scores = zero_shot_scores(features, class_embeddings(self.model, self.processor, self.materials, template))
        shares = (scores / self.model.config.temperature).softmax(dim=1)
        best = shares.topk(min(top, len(self.materials)), dim=1)
        return [
            {self.materials[i]: share for i, share in zip(indices, values, strict=True)}
            for indices, values in zip(best.indices.tolist(), best.values.tolist(), strict=True)
        ]
