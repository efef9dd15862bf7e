"""Zero-shot classification: features of any modality against the text of each class (Section 4.2 of the paper).

Its probabilities are a softmax over scores, such as cosines, at a temperature that is fitted to labelled samples and
falls where the scores of classes lie apart. Text was bound to pictures, and so were touches, but never to each other:
where there are embeddings of pictures, a touch is named as they are, each by how near it is.
"""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from scipy.optimize import minimize
from torch import Tensor

from unitouch_gen.errors import (
    InvalidInputError,
    InvalidTypeError,
    check_choice,
    check_integer,
    check_names,
    check_tensor,
    describe,
)
from unitouch_gen.models.config import EXPONENTS
from unitouch_gen.models.images import ImageInput
from unitouch_gen.models.joint import UniTouchModel
from unitouch_gen.models.out_of_distribution import UNTOUCHED
from unitouch_gen.models.processing import UniTouchProcessor
from unitouch_gen.world import MATERIAL_NAMES

if TYPE_CHECKING:
    from unitouch_gen.conditioning import EmbeddingBank

PROMPTS: dict[str, str] = {
    "image": "this looks like {}",
    "touch": "this feels like {}",
    "audio": "this looks like {}",
    "text": "this looks like {}",
}
"""The template of each modality. Touch reads as in the paper's Table "Prompt analysis"."""

BY_PICTURES = "touch by pictures"
"""What temperature and exponent of touches are called that are named as the pictures near to them are."""

TEMPERATURES = (1e-3, 1e3)
"""Between which the temperature of a calibrated softmax is looked for, in units of the deviation of all scores."""


@torch.no_grad()
def text_embeddings(model: UniTouchModel, processor: UniTouchProcessor, texts: Sequence[str]) -> Tensor:
    """Unit embeddings of texts, (N, D)."""
    inputs = {name: values.to(model.device) for name, values in processor.text(list(texts)).items()}
    return F.normalize(model.get_text_features(**inputs).float(), dim=-1)


def zero_shot_scores(features: Tensor, classes: Tensor) -> Tensor:
    """Cosine similarity of features (B, D), of any length, to unit class embeddings (classes, D)."""
    return F.normalize(features.float(), dim=-1) @ classes.T


def accuracy(scores: Tensor, labels: Tensor) -> float:
    """Share of rows (B, classes) whose largest score is at the label (B,)."""
    return (scores.argmax(dim=1) == labels).float().mean().item()


def calibrated_probabilities(scores: Tensor, temperature: float, exponent: float = 0.0) -> Tensor:
    """The softmax of scores at temperature / spread ** exponent, (B, classes), which keeps their order.

    One temperature for all samples (Guo et al., 2017) leaves those too sure whose classes are hardly told apart, and
    clear ones too unsure, so it may depend on the sample (Joy et al., 2023, "Sample-dependent adaptive temperature
    scaling"): here on the deviation of its scores over the classes. What was fitted to some classes is calibrated for
    these alone.

    Args:
        scores: Cosines, or other logits, (B, classes).
        temperature, exponent: See `fit_temperature`.
    """
    spread = scores.std(dim=1, keepdim=True, correction=0)
    return (scores * spread**exponent / temperature).softmax(dim=1)


def fit_temperature(scores: Tensor, labels: Tensor) -> tuple[float, float]:
    """Temperature and exponent of the `calibrated_probabilities` with the least Brier score (1950, Eq. 2).

    The likelihood, which is usual, is ruled by the few labels that hardly get any probability, where classes are not
    told apart: most confidences were then too small.

    Args:
        scores: Cosines, or other logits, (N, classes) of samples that nothing was trained on.
        labels: int64 (N,), from 0 to classes - 1.

    Raises:
        InvalidInputError, InvalidTypeError: If shapes or labels do not fit.
    """
    check_tensor("scores", scores, "N", "classes")
    check_tensor("labels", labels, len(scores), integers=True)
    classes = scores.shape[1]
    if len(labels) and not 0 <= int(labels.min()) <= int(labels.max()) < classes:
        raise InvalidInputError(
            f"`labels` go from {labels.min()} to {labels.max()}, but `scores` are of {classes} classes."
        )
    unit = scores.double().std(correction=0).clamp_min(torch.finfo(torch.float32).tiny).item()
    scores, truth = scores.double() / unit, F.one_hot(labels, classes).double()

    def loss(values: Sequence[float]) -> float:
        probabilities = calibrated_probabilities(scores, math.exp(values[0]), values[1])
        return (probabilities - truth).square().sum(dim=1).mean().item()

    ends = [math.log(end) for end in TEMPERATURES]
    simplex = [[-1.0, 0.0], [1.0, 0.0], [-1.0, 1.5]]
    options = {"xatol": 1e-4, "initial_simplex": simplex}
    found = minimize(loss, simplex[0], method="Nelder-Mead", bounds=[ends, EXPONENTS], options=options).x
    temperature, exponent = math.exp(found[0]), float(found[1])
    return temperature * unit ** (1.0 + exponent), exponent


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


class ZeroShotTouchClassifier:
    """Names what touches are of, among labels in words, by a joint space alone; or says that it does not know them.

    Args:
        model: With touch and text.
        processor: Of both; that of the model's folder if left out.
        embedding_bank: Of pictures. With it, p(label | touch) = sum_k p(picture k | touch) p(label | picture k), the
            first by `EmbeddingBank.nearness`; without, a softmax over the touch's own cosines with the labels.

    Raises:
        InvalidInputError: If the processor has no tokenizer, none came and the model was not read from a folder, or the
            bank is of another width than the model's embeddings.

    Example:
        >>> from unitouch_gen.pipelines.tiny import joint_space
        >>> from unitouch_gen import example
        >>> from unitouch_gen.conditioning import EmbeddingBank
        >>> from unitouch_gen.weights import EMBEDDING_BANK
        >>> classifier = ZeroShotTouchClassifier(*joint_space(), EmbeddingBank.from_pretrained(EMBEDDING_BANK))
        >>> [named] = classifier(example("brick"), ["brick", "grass"], template="this feels like {}")
        >>> sorted(named)
        ['brick', 'grass']
    """

    def __init__(
        self,
        model: UniTouchModel,
        processor: UniTouchProcessor | None = None,
        embedding_bank: "EmbeddingBank | None" = None,
    ):
        if processor is None:
            if model.source is None:
                raise InvalidInputError("`processor` is None, and the model has no folder to read one from; pass one.")
            processor = UniTouchProcessor.from_pretrained(model.source)
        if processor.tokenizer is None:
            raise InvalidInputError("`processor` has no tokenizer, so no label can be read; pass one that has.")
        width = None if embedding_bank is None else embedding_bank.config["embedding_dim"]
        if width not in (None, model.config.projection_dim):
            raise InvalidInputError(
                f"`embedding_bank` has embeddings of width {width}, the model of {model.config.projection_dim}; pass "
                "one of the model's own images."
            )
        self.model, self.processor, self.embedding_bank = model, processor, embedding_bank

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
            template: What they are put into, with one {}; the paper's, of `PROMPTS`, if left out.
            sensor: Which one took them, by name; the one whose prototype is nearest if left out.
            top: How many labels of each; all if left out.

        Raises:
            InvalidInputError, InvalidTypeError: If touches cannot be read, or there are no such labels, template or
                sensor.
        """
        labels, template = check_labels(labels), check_template(template or PROMPTS["touch"])
        pixels = self.processor.touch(touch).to(self.model.device)
        matches = self.model.match_sensors(pixels, sensor)
        features = self.model.get_touch_features(pixels, self.model.sensor_ids(matches))
        unknown = self.model.unknown_touches(pixels)
        return self.name(features, "touch", labels, template, top=top, unknown=unknown)

    @torch.no_grad()
    def name(
        self,
        features: Tensor,
        modality: str,
        labels: Sequence[str] = MATERIAL_NAMES,
        template: str | None = None,
        *,
        top: int | None = 3,
        unknown: Sequence[str | None] = (),
    ) -> list[Named]:
        """The labels of embeddings with their probabilities, best first.

        Args:
            features: (B, D), of any length.
            modality: That they came from; its template and temperature are used, and for touches the bank.
            labels: Classes in words, two or more.
            template: What they are put into; that of the modality if left out.
            top: How many labels of each; all if it is `None`.
            unknown: What `UniTouchModel.unknown_touches` says of each; nothing where it is empty.
        """
        shares = self.probabilities(features, modality, labels, template)
        best = shares.topk(min(top or len(labels), len(labels)), dim=1)
        return [
            Named({labels[i]: share for i, share in zip(indices, values, strict=True)}, reason)
            for indices, values, reason in zip(
                best.indices.tolist(), best.values.tolist(), unknown or [None] * len(features), strict=True
            )
        ]

    def probabilities(
        self,
        features: Tensor,
        modality: str,
        labels: Sequence[str] = MATERIAL_NAMES,
        template: str | None = None,
    ) -> Tensor:
        """Probabilities of labels, (B, labels), in their order; see `name` for the arguments."""
        return self._calibrated(self.fitted_as(modality), self.scores(features, modality, labels, template))

    def _calibrated(self, fitted_as: str, scores: Tensor) -> Tensor:
        """Probabilities of scores (B, labels), by what was fitted of that name."""
        config = self.model.config
        temperature = config.temperatures.get(fitted_as, 1.0 if fitted_as == BY_PICTURES else config.temperature)
        return calibrated_probabilities(scores, temperature, config.temperature_exponents.get(fitted_as, 0.0))

    def scores(
        self,
        features: Tensor,
        modality: str,
        labels: Sequence[str] = MATERIAL_NAMES,
        template: str | None = None,
    ) -> Tensor:
        """What probabilities are a softmax of, at a temperature: cosines with labels, or of touches, with a bank, the
        logarithms of sum_k p(picture k | touch) p(label | picture k), (B, labels). See `name` for the arguments."""
        template = template or PROMPTS[check_choice("modality", modality, PROMPTS)]
        classes = text_embeddings(self.model, self.processor, [template.format(label) for label in labels])
        bank = self.embedding_bank
        if modality != "touch" or bank is None:
            return zero_shot_scores(features, classes)
        of_pictures = self._calibrated("image", zero_shot_scores(bank.embeds.to(classes), classes))
        shares = bank.nearness(features.to(classes)) @ of_pictures
        return shares.clamp_min(torch.finfo(shares.dtype).tiny).log()

    def fitted_as(self, modality: str) -> str:
        """What the temperature of a modality is called among `UniTouchConfig.temperatures`."""
        return BY_PICTURES if modality == "touch" and self.embedding_bank is not None else modality

    @property
    def calibrated(self) -> bool:
        """Whether the probabilities of touches are calibrated: for labels like those that this was fitted to."""
        return self.fitted_as("touch") in self.model.config.temperatures


def check_labels(labels: Sequence[str]) -> tuple[str, ...]:
    """Labels of classes.

    Raises:
        InvalidInputError, InvalidTypeError: If they are no texts, fewer than two, blank, or one comes twice.
    """
    names = check_names("labels", labels)
    wrong = [name for place, name in enumerate(names) if not name.strip() or name in names[:place]]
    if wrong or len(names) < 2:
        what = f"holds {wrong[0]!r}, which is blank or comes twice" if wrong else f"is {names}"
        raise InvalidInputError(f"`labels` {what}; pass two or more names, each once.")
    return tuple(names)


def check_template(template: str) -> str:
    """A text with one place for a label.

    Raises:
        InvalidInputError, InvalidTypeError: If it is none.
    """
    if not isinstance(template, str):
        raise InvalidTypeError(f"`template` is {describe(template)}; pass a text such as {PROMPTS['touch']!r}.")
    if template.count("{}") != 1 or template.count("{") != 1 or template.count("}") != 1:
        raise InvalidInputError(f"`template` is {template!r}; write {{}} once, where the label goes.")
    return template
