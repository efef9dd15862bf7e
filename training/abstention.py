"""What a joint space does not know: fits temperatures, out-of-distribution scores and reaches of sensors to it.

    python -m unitouch_gen.training.abstention --joint runs/family/joint --cache runs/cache

Statistics are of what it was trained on, temperatures and thresholds of what was held out of that. Nothing is trained,
and no weight changes.
"""

import random
import string
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from sklearn.linear_model import LogisticRegression
from sklearn.preprocessing import StandardScaler
from torch import Tensor
from tqdm.auto import tqdm
from typer import Option

from unitouch_gen.conditioning import EmbeddingBank
from unitouch_gen.errors import InvalidInputError, check_number
from unitouch_gen.evaluation.zero_shot import (
    ZeroShotTouchClassifier,
    accuracy,
    calibrated_probabilities,
    expected_calibration_error,
    fit_temperature,
)
from unitouch_gen.files import open_weights
from unitouch_gen.models import MODALITIES, SensorBank, UniTouchModel, UniTouchProcessor
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.models.out_of_distribution import KNOWN, Direction, Gaussians, OutOfDistribution
from unitouch_gen.models.sensors import layout_distances
from unitouch_gen.training.data import DataConfig, RecordSet, Rendered, columns_of, material_names
from unitouch_gen.training.data.columns import NEEDS
from unitouch_gen.training.recipe import read_recipe, read_section
from unitouch_gen.training.stages import run_command, set_textures
from unitouch_gen.weights import EMBEDDING_BANK
from unitouch_gen.world import ATTRIBUTES

AT_ONCE = 256
"""Samples that are embedded at once."""

FEWEST = 50
"""Samples that a threshold is taken of, at least; and touches of nothing that are told from others."""

MOST = 500
"""Samples of each source and split that are looked at."""

SHRINKAGE = 0.1
"""Share of each covariance that is the unit matrix, in units of the features' deviations."""

PENALTY, MOST_ROUNDS = 0.003, 3000
"""Inverse strength of the ridge on the direction of gels at rest, and rounds of its fit."""

LEAST_DEVIATION = 1e-3
"""Features that deviate less are taken for constant, as weights in half precision end at 65,504."""

NONSENSE = 200
"""Strings of letters that are tried as captions."""

COVER = ATTRIBUTES.index("cover")


class Samples:
    """The samples of one split, and their features by what encoder sees what column.

    Args:
        model, processor: The joint space.
        splits: With columns of some modalities; `MOST` of each are looked at.

    Attributes:
        captions: All of the splits'.
        text: Of those samples that are looked at.
    """

    def __init__(self, model: UniTouchModel, processor: UniTouchProcessor, splits: Sequence[Rendered]):
        self.model, self.processor = model, processor
        self.splits = [split.thinned(min(MOST, len(split))) for split in splits]
        self.material = torch.from_numpy(np.concatenate([split.material for split in self.splits]))
        self.captions, self.text = ([line for split in some for line in split.text] for some in (splits, self.splits))

    def pixels(self, column: str) -> Tensor:
        """uint8 pictures or touches, (N, 3, S, S)."""
        return torch.from_numpy(np.concatenate([np.asarray(getattr(split, column)) for split in self.splits]))

    def sensors(self) -> list[str | None]:
        """Sensor of each touch; `None` for drawn ones."""
        return [split.sensor for split in self.splits for _ in range(len(split))]

    def touched(self, which: int) -> Tensor:
        """Whether anything presses into the gel of each first (0) or second (1) touch, as far as it is known, (N,)."""
        known = [
            np.ones(len(split), dtype=bool) if split.attributes is None else split.attributes[:, which, COVER] > 0.0
            for split in self.splits
        ]
        return torch.from_numpy(np.concatenate(known))

    @torch.no_grad()
    def embed(self, modality: str, values: Any) -> tuple[Tensor, Tensor]:
        """Embeddings (N, D) and features of out-of-distribution scores (N, F) of what an encoder sees.

        Args:
            modality: Whose encoder.
            values: uint8 pictures or touches (N, 3, S, S), log-mels (N, 1, mel_bins, frames), or captions.
        """
        embeds, features = [], []
        for start in tqdm(range(0, len(values), AT_ONCE), desc=modality, mininterval=5.0, leave=False):
            part = values[start : start + AT_ONCE]
            pixels = None
            if modality == "text":
                inputs: dict[str, Any] = dict(self.processor.text(part))
            elif modality == "audio":
                inputs = {"input_values": part[:, None].float()}
            else:
                pixels = normalise_pixels(part.float() / 255)
                inputs = {"pixel_values": pixels}
            found = getattr(self.model, f"get_{modality}_features")(**inputs)
            embeds.append(found.cpu().float())
            features.append(self.model.ood_features(modality, found, pixels).cpu())
        return torch.cat(embeds), torch.cat(features)


def known_inputs(samples: Samples, modality: str) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Embeddings (N, D), features (N, F) and materials (N,) of known inputs, and features of gels at rest."""
    if modality != "touch":
        values: Any = samples.text if modality == "text" else samples.pixels(modality)
        embeds, features = samples.embed(modality, values)
        return embeds, features, samples.material, features[:0]
    columns = ["touch"] if any(split.second is None for split in samples.splits) else ["touch", "second"]
    parts = [samples.embed("touch", samples.pixels(column)) for column in columns]
    touched = torch.cat([samples.touched(number) for number in range(len(columns))])
    embeds, features = (torch.cat(part) for part in zip(*parts, strict=True))
    material = samples.material.repeat(len(columns))
    return embeds[touched], features[touched], material[touched], features[~touched]


def fit_modality(
    modality: str, train: Samples, held: Samples, names: Sequence[str], share: float, bank: EmbeddingBank | None
) -> dict[str, float]:
    """Fits temperature and scores of one modality into the model, and returns what was measured on what was held out.

    The temperature is left out where no materials are known.
    """
    model, processor = train.model, train.processor
    _, features, material, at_rest = known_inputs(train, modality)
    embeds, validation, labels, rest = known_inputs(held, modality)
    if len(validation) < FEWEST:
        raise InvalidInputError(f"`data` holds out {len(validation)} samples for thresholds; {FEWEST} are the least.")
    groups: dict[str, Gaussians | Direction] = {KNOWN: Gaussians.of(features, material, SHRINKAGE)}
    other = {"touch": "image", "image": "touch"}.get(modality)
    if other is not None and getattr(train.splits[0], other) is None:  # data sets may hold one of them alone
        other = None
    if other is not None:
        _, foreign = train.embed(modality, train.pixels(other))
        groups["foreign"] = Gaussians.of(foreign, None, SHRINKAGE)
    if len(at_rest) >= FEWEST:
        groups["untouched"] = direction_of(at_rest, features)
    vocabulary = vocabulary_of(train) if modality == "text" else None
    scores = OutOfDistribution.of(groups, validation, share, vocabulary)
    model.out_of_distribution[modality] = scores
    model.config.ood_thresholds = {**model.config.ood_thresholds, modality: scores.thresholds}
    figures = {"abstains on known": share_of(scores.reasons(validation))}
    if other is not None:
        _, foreign = held.embed(modality, held.pixels(other))
        figures[f"abstains on {'pictures' if other == 'image' else 'touches'}"] = share_of(scores.reasons(foreign))
    if len(rest):
        figures["abstains on gels at rest"] = share_of(scores.reasons(rest))
    if modality == "text":
        for kind, texts in (("known", held.text), ("nonsense", nonsense())):
            with torch.no_grad():
                inputs = processor.text(texts)
                found = model.abstains("text", model.get_text_features(**inputs), input_ids=inputs["input_ids"])
            figures[f"abstains on {kind}"] = share_of(found)
    if bool((labels >= 0).all()) and "text" in model.known_modalities:
        figures |= fit_temperatures(modality, model, processor, embeds, labels, names, bank)
    return figures


def fit_temperatures(
    modality: str,
    model: UniTouchModel,
    processor: UniTouchProcessor,
    embeds: Tensor,
    labels: Tensor,
    names: Sequence[str],
    bank: EmbeddingBank | None,
) -> dict[str, float]:
    """Fits the temperature of a modality to every other sample, and that of touches by pictures where there is a bank;
    returns what they are worth on the rest."""
    figures: dict[str, float] = {}
    for each in (None, bank) if modality == "touch" and bank is not None else (None,):
        classifier = ZeroShotTouchClassifier(model, processor, each)
        scores, name = classifier.scores(embeds, modality, names), classifier.fitted_as(modality)
        before = classifier.probabilities(embeds, modality, names)[1::2]
        temperature, exponent = fit_temperature(scores[::2], labels[::2])
        model.config.temperatures = {**model.config.temperatures, name: temperature}
        model.config.temperature_exponents = {**model.config.temperature_exponents, name: exponent}
        after = calibrated_probabilities(scores[1::2], temperature, exponent)
        told = "" if each is None else ", by pictures"
        figures |= {
            f"temperature{told}": temperature,
            f"exponent{told}": exponent,
            f"accuracy{told}": accuracy(after, labels[1::2]),
            f"calibration error{told}": expected_calibration_error(after, labels[1::2]),
            f"calibration error before{told}": expected_calibration_error(before, labels[1::2]),
        }
    return figures


def direction_of(some: Tensor, others: Tensor) -> Direction:
    """Where some features (N, F) lie apart from others (M, F): a logistic regression, as if they were as many."""
    rows, which = torch.cat([some, others]).double().numpy(), [True] * len(some) + [False] * len(others)
    scaler = StandardScaler().fit(rows)
    scaler.scale_ = np.maximum(scaler.scale_, LEAST_DEVIATION)
    fitted = LogisticRegression(C=PENALTY, class_weight="balanced", max_iter=MOST_ROUNDS)
    weight = fitted.fit(scaler.transform(rows), which).coef_[0] / scaler.scale_
    return Direction.of(torch.from_numpy(scaler.mean_), torch.from_numpy(weight))


def share_of(reasons: Sequence[str | None]) -> float:
    """Share of inputs that the model abstains from naming."""
    return sum(reason is not None for reason in reasons) / len(reasons)


def vocabulary_of(samples: Samples) -> Tensor:
    """Which tokens the captions of a split have, bool (V,)."""
    seen = torch.zeros(samples.model.config.text_config.vocab_size, dtype=torch.bool)  # type: ignore[union-attr]
    for start in range(0, len(samples.captions), AT_ONCE):
        seen[samples.processor.text(samples.captions[start : start + AT_ONCE])["input_ids"].flatten()] = True
    return seen


def nonsense() -> list[str]:
    """One to five words of three to eight letters, each drawn alike."""
    draw = random.Random(0)
    words = [["".join(draw.choices(string.ascii_lowercase, k=draw.randint(3, 8))) for _ in range(draw.randint(1, 5))]
             for _ in range(NONSENSE)]  # fmt: skip
    return [" ".join(some) for some in words]


def fit_reaches(model: UniTouchModel, samples: Samples, share: float) -> dict[str, float]:
    """How far each sensor's own touches lie from its prototype: all but a share of those that were held out."""
    bank: SensorBank = model.load("touch")[1]
    sensors, touches = samples.sensors(), samples.pixels("touch")
    reaches = {}
    for index, name in enumerate(bank.names):
        rows = [row for row, sensor in enumerate(sensors) if sensor == name]
        if len(rows) < FEWEST or not bool(bank.known[index]):
            continue
        distances = layout_distances(touches[rows].float() / 255, bank.prototype(name).float())
        reaches[name] = distances.quantile(1.0 - share).item()
    return reaches


def abstention(
    *,
    joint: Annotated[Path, Option(help="Folder of the joint space, such as `joint` of a family; it is written to.")],
    recipe: Annotated[
        str, Option(help="Its `data` is fitted to: a YAML file, or a name in training/recipes.")
    ] = "touch",
    overrides: Annotated[
        list[str] | None, Option("--set", metavar="SECTION.KEY=VALUE", help="Override the recipe.")
    ] = None,
    textures: Annotated[Path | None, Option(help="Folder of scanned materials for `data.drawn`.")] = None,
    share: Annotated[float, Option(help="Share of known inputs on which the model abstains, about.")] = 0.046,
    cache: Annotated[Path, Option(help="What was rendered.")] = Path("runs/cache"),
) -> None:
    """Fits what a joint space does not know, and writes it into its folder: no weight changes.

    A bank of image embeddings that lies beside it, as in a family, is what touches are named by as well.
    """
    check_number("share", share, 0.001, 0.5)
    settings = read_recipe(recipe, overrides or ())
    if textures is not None:
        set_textures(settings, textures)
    data = read_section(settings, "data", DataConfig)
    data.check_named()
    model, processor = UniTouchModel.from_pretrained(joint), UniTouchProcessor.from_pretrained(joint)
    place = joint.parent / EMBEDDING_BANK.name
    bank = EmbeddingBank.from_pretrained(place) if place.is_dir() else None
    sources, held_out = data.sources(), data.held_out(MOST)
    records = [one for source in (*sources, *held_out) if isinstance(source, RecordSet) for one in source.records]
    needs = [
        name
        for name in (*model.known_modalities, "material")
        if all(NEEDS[name](record) is not None for record in records)
    ]
    modalities = [name for name in MODALITIES if name in needs]
    train, held = (
        Samples(model, processor, parts)
        for parts in (
            columns_of(sources, cache, data, processor, needs),
            columns_of(held_out, cache, data, processor, needs, "val"),
        )
    )
    if data.drawn is not None and "touch" in modalities:  # an encoder that has seen touches without a sensor's tokens
        model.config.sensor_reaches = fit_reaches(model, held, share / 2)
        model.load("touch")[1].reaches = dict(model.config.sensor_reaches)
    for modality in modalities:  # touches last, as they are named by how pictures are
        figures = fit_modality(modality, train, held, material_names(sources), share, bank)
        print(f"{modality}: {', '.join(f'{name} {value:.3g}' for name, value in figures.items())}")
    model.to(dtype_of(next(iter(model.stored())))).save_pretrained(joint)  # type: ignore[arg-type]


def dtype_of(file: Path) -> torch.dtype:
    """Dtype of the floating-point tensors in a file."""
    with open_weights(file) as stored:
        tensors = (stored.get_tensor(key) for key in stored.keys())  # noqa: SIM118 - not a dict
        return next(tensor.dtype for tensor in tensors if tensor.is_floating_point())


if __name__ == "__main__":
    run_command("abstention", abstention)
