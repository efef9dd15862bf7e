"""Zero-shot classification: touches against the text of each class (Section 4.2 of the paper).

Probabilities are a softmax over cosines at the temperature of training (Eq. 1). They are not calibrated.
"""

from collections.abc import Mapping, Sequence

import torch
import torch.nn.functional as F

from unitouch_gen.errors import InvalidInputError, check_kind, check_texts
from unitouch_gen.models.features import text_embeddings
from unitouch_gen.models.images import ImageInput
from unitouch_gen.models.joint import UNTOUCHED, UniTouchModel
from unitouch_gen.models.processing import UniTouchProcessor
from unitouch_gen.world.materials import MATERIAL_NAMES

PROMPTS = {**dict.fromkeys(("image", "audio", "text"), "this looks like {}"), "touch": "this feels like {}"}
"""The template of each modality; that of touch is the paper's (Table 7)."""


class Named(dict[str, float]):
    """Labels with their probabilities, best first; `str` puts them in words.

    Attributes:
        unknown: Why the model does not name the touch, such as "unlike anything known"; else `None`.
    """

    def __init__(self, labels: Mapping[str, float], unknown: str | None = None):
        super().__init__(labels)
        self.unknown = unknown

    def __str__(self) -> str:
        if self.unknown is None:
            return ", ".join(f"{name} {probability:.0%}" for name, probability in self.items())
        if self.unknown == UNTOUCHED:
            return self.unknown
        return f"{self.unknown} (nearest: {next(iter(self))})"


class ZeroShotTouchClassifier:
    """Classifies touches among labels in words, by a joint space alone, or abstains if they are out of distribution.

    Args:
        model: With encoders of touch and text.
        processor: Of both modalities.

    Example:
        >>> from unitouch_gen.pipelines.tiny import joint_space
        >>> from unitouch_gen import example
        >>> classifier = ZeroShotTouchClassifier(*joint_space())
        >>> [named] = classifier(example("brick"), ["brick", "grass"], template="this feels like {}")
        >>> sorted(named)
        ['brick', 'grass']
    """

    def __init__(self, model: UniTouchModel, processor: UniTouchProcessor):
        self.model = model
        self.processor = processor

    @torch.no_grad()
    def __call__(
        self,
        touch: ImageInput,
        labels: Sequence[str] = MATERIAL_NAMES,
        template: str | None = None,
        *,
        sensor: str | Sequence[str | None] | None = None,
        top: int | None = None,
    ) -> list[Named]:
        """The labels of each touch with their probabilities, best first.

        Args:
            touch: One or several touches, as pipelines take them.
            labels: Classes in words, two or more.
            template: Prompt with one {} for the label; the paper's if left out.
            sensor: Name of the sensor, or one for each touch; the one with the nearest prototype if left out.
            top: Number of labels for each touch; all if left out.

        Raises:
            InvalidInputError, InvalidTypeError: If an argument cannot be used.
        """
        names = check_texts("labels", labels)
        template = template or PROMPTS["touch"]
        if len(names) < 2 or len({*names}) < len(names) or not all(name.strip() for name in names):
            raise InvalidInputError(f"`labels` is {names}; pass two or more names, each once and none of them blank.")
        if [check_kind("template", template, str).count(part) for part in ("{}", "{", "}")] != [1, 1, 1]:
            raise InvalidInputError(f"`template` is {template!r}; write {{}} once, where the label goes.")
        pixels = self.processor.touch(touch).to(self.model.device)
        matches = self.model.match_sensors(pixels, sensor)
        texts = text_embeddings(self.model, self.processor, [template.format(name) for name in names])
        features, unknown = self.model.encode_touches(pixels, self.model.sensor_ids(matches))
        cosines = F.normalize(features.float(), dim=-1) @ texts.T
        probabilities = (cosines / self.model.config.temperature).softmax(dim=1)
        best = probabilities.topk(min(top or len(names), len(names)))
        results = list[Named]()
        for indices, values, reason in zip(best.indices.tolist(), best.values.tolist(), unknown, strict=True):
            by_label = {names[index]: value for index, value in zip(indices, values, strict=True)}
            results.append(Named(by_label, reason))
        return results
