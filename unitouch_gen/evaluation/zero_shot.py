"""Zero-shot classification: features of any modality against the text of each class (Section 4.2 of the paper).

Its probabilities are a softmax over cosines, at a temperature that is fitted to labelled samples.
"""

import math
from collections.abc import Mapping, Sequence

import torch
import torch.nn.functional as F
from scipy.optimize import minimize_scalar
from torch import Tensor

from unitouch_gen.errors import check_choice, check_integer, check_tensor
from unitouch_gen.models.images import ImageInput
from unitouch_gen.models.joint import UniTouchModel
from unitouch_gen.models.out_of_distribution import UNTOUCHED
from unitouch_gen.models.processing import UniTouchProcessor
from unitouch_gen.world import MATERIAL_NAMES

PROMPTS: dict[str, str] = {
    "image": "this looks like {}",
    "touch": "this feels like {}",
    "audio": "this looks like {}",
    "text": "this looks like {}",
}
"""The template of each modality. Touch reads as in the paper's Table "Prompt analysis"."""

TEMPERATURES = (1e-3, 10.0)
"""Between which the temperature of a calibrated softmax over cosines is looked for."""


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


def fit_temperature(scores: Tensor, labels: Tensor) -> float:
    """The temperature at which softmax(scores / temperature) has the least Brier score (1950, Eq. 2) of the labels.

    The likelihood, which is usual (Guo et al., 2017), is ruled by the few labels that hardly get any probability, where
    classes are not told apart: most confidences were then too small.

    Args:
        scores: Cosines (N, classes) of samples that nothing was trained on.
        labels: int64 (N,).

    Raises:
        InvalidInputError, InvalidTypeError: If shapes do not fit.
    """
    check_tensor("scores", scores, "N", "classes")
    check_tensor("labels", labels, len(scores), integers=True)
    cosines, truth = scores.double(), F.one_hot(labels, scores.shape[1]).double()
    low_high = [torch.tensor(end).log().item() for end in TEMPERATURES]

    def loss(logarithm: float) -> float:
        return ((cosines / math.exp(logarithm)).softmax(dim=1) - truth).square().sum(dim=1).mean().item()

    found = minimize_scalar(loss, bounds=low_high, method="bounded", options={"xatol": 1e-4})
    return torch.tensor(found.x).exp().item()


def expected_calibration_error(probabilities: Tensor, labels: Tensor, bins: int = 15) -> float:
    """How far confidence is from accuracy, on average: sum_b n_b / N abs(acc_b - conf_b) (Guo et al., 2017, Eq. 3).

    Args:
        probabilities: (N, classes), rows that sum to 1.
        labels: int64 (N,).
        bins: Equal ones that the confidence, the largest probability of a row, is divided into.

    Raises:
        InvalidInputError, InvalidTypeError: If shapes do not fit, or there are no bins.
    """
    check_tensor("probabilities", probabilities, "N", "classes")
    check_tensor("labels", labels, len(probabilities), integers=True)
    check_integer("bins", bins, 1, 10**6)
    confidence, chosen = probabilities.double().max(dim=1)
    excess = confidence - (chosen == labels).double()
    rows = (confidence * bins).ceil().long().clamp(1, bins) - 1
    return torch.zeros(bins, dtype=torch.double).index_add(0, rows, excess).abs().sum().item() / len(labels)


class Named(dict[str, float]):
    """Materials with their probabilities, best first; `str` says it in words.

    Attributes:
        unknown: Why the model abstains from naming it, such as "unlike anything known"; `None` where it does not.
    """

    def __init__(self, materials: Mapping[str, float], unknown: str | None = None):
        super().__init__(materials)
        self.unknown = unknown

    def __str__(self) -> str:
        if self.unknown is None or not self:
            return self.unknown or ", ".join(f"{name} {share:.0%}" for name, share in self.items())
        return self.unknown if self.unknown == UNTOUCHED else f"{self.unknown} (nearest: {next(iter(self))})"


class MaterialNamer:
    """Names what a touch or a picture is of, by zero-shot classification, or says that the model does not know it.

    Args:
        model: With text and the modality that is asked about.
        processor: For both.
        materials: Class names.
    """

    def __init__(self, model: UniTouchModel, processor: UniTouchProcessor, materials: Sequence[str] = MATERIAL_NAMES):
        self.model, self.processor, self.materials = model, processor, tuple(materials)

    @torch.no_grad()
    def touch(self, touch: ImageInput, sensor: str | Sequence[str | None] | None = None, top: int = 3) -> list[Named]:
        """The `top` materials of each touch with their probabilities, best first."""
        pixels = self.processor.touch(touch)
        features = self.model.get_touch_features(
            pixels, self.model.sensor_ids(self.model.match_sensors(pixels, sensor))
        )
        return self.name(features, "touch", top, unknown=self.model.abstains("touch", features, pixels))

    @torch.no_grad()
    def image(self, images: ImageInput, top: int = 3) -> list[Named]:
        """The `top` materials of each picture with their probabilities, best first."""
        features = self.model.get_image_features(self.processor.images(images))
        return self.name(features, "image", top, unknown=self.model.abstains("image", features))

    @torch.no_grad()
    def name(self, features: Tensor, modality: str, top: int = 3, *, unknown: Sequence[str | None] = ()) -> list[Named]:
        """The `top` materials of embeddings.

        Args:
            features: (B, D), of any length.
            modality: That they came from; its template and temperature are used.
            top: Materials of each.
            unknown: What `UniTouchModel.abstains` says of each; nothing where it is empty.
        """
        template = PROMPTS[check_choice("modality", modality, PROMPTS)]
        scores = zero_shot_scores(features, class_embeddings(self.model, self.processor, self.materials, template))
        config = self.model.config
        shares = (scores / config.temperatures.get(modality, config.temperature)).softmax(dim=1)
        best = shares.topk(min(top, len(self.materials)), dim=1)
        return [
            Named({self.materials[i]: share for i, share in zip(indices, values, strict=True)}, reason)
            for indices, values, reason in zip(
                best.indices.tolist(), best.values.tolist(), unknown or [None] * len(features), strict=True
            )
        ]
