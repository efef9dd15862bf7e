"""What a joint space knows of contacts that nobody trained on.

Objects are held out: of the split "test" in the ranges of those to train on, of "beyond" outside of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from tests.benchmarks.measuring import Figures, attribute_agreement
from unitouch_gen.evaluation.controls import class_means, with_controls
from unitouch_gen.evaluation.metrics import retrieval, share_right
from unitouch_gen.evaluation.zero_shot import PROMPTS
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.models.features import image_embeddings, text_embeddings
from unitouch_gen.training.data import DrawnContacts
from unitouch_gen.training.data.contacts import Contacts
from unitouch_gen.training.data.heldout import world_contacts
from unitouch_gen.world import MATERIAL_NAMES


def held_out(
    cache: Path, processor: UniTouchProcessor, seed: int, split: str, sensor: str | None = None, objects: int = 16
) -> Contacts:
    """The held-out contacts of a world, under drawn sensors, or under a named one and a drawn one."""
    source = DrawnContacts(0 if sensor is None else 1, sensor, 1, 1, seed, objects)
    return world_contacts(cache, processor, source, split)


@dataclass
class JointSpace:
    """Encoders and what prepares their inputs."""

    model: UniTouchModel
    processor: UniTouchProcessor

    @classmethod
    def from_folder(cls, folder: Path) -> "JointSpace":
        return cls(UniTouchModel.from_pretrained(folder), UniTouchProcessor.from_pretrained(folder))

    @torch.no_grad()
    def features(self, modality: str, values: Any) -> Tensor:
        """Unit embeddings (N, D) of pictures or touches, of log-mel clips, or of captions."""
        if modality == "text":
            return text_embeddings(self.model, self.processor, values)
        if modality == "audio":
            parts = torch.from_numpy(np.array(values)).float()[:, None].split(256)
            return F.normalize(torch.cat([self.model.get_audio_features(part) for part in parts]), dim=1)
        return F.normalize(image_embeddings(self.model, modality, values), dim=1)


def material_rows(joint: JointSpace, modality: str, features: Tensor, material: Tensor) -> Figures:
    """The share of embeddings whose "material" is named right."""
    texts = [PROMPTS[modality].format(name) for name in MATERIAL_NAMES]
    classes = text_embeddings(joint.model, joint.processor, texts)

    def measure(values: Tensor) -> dict[str, float]:
        return {"material": share_right((F.normalize(values.float(), dim=-1) @ classes.T).argmax(dim=1), material)}

    return with_controls(measure, {"value": features, "class_mean": class_means(features, material)})


def found_within(queries: Tensor, gallery: Tensor, labels: Tensor, size: int) -> Figures:
    """The share of contacts that are found among so many of their class."""

    def measure(values: Tensor) -> dict[str, float]:
        return {"found": retrieval(values, gallery, labels, size=size)}

    return with_controls(measure, {"value": queries, "class_mean": class_means(queries, labels)})["found"]


def agreed(read: Tensor, usual: Tensor, truth: Tensor, names: Sequence[str], real: Tensor) -> Figures:
    """`attribute_agreement` of what is read (N, K), beside the best that a class can tell and what real images say."""
    columns = {"value": read, "class_mean": usual, "ceiling": real}
    return with_controls(lambda values: attribute_agreement(values, truth, names), columns)
