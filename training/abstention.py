"""Fits what a joint space does not know: which touches are unlike those of its training, and how sure its names are.

    python -m unitouch_gen.training.abstention --joint runs/family/joint --cache runs/cache

Statistics are of what it was trained on, temperatures and the threshold of what was held out. No weight changes.
"""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import torch.nn.functional as F
from safetensors import safe_open
from scipy.optimize import minimize
from torch import Tensor
from typer import Option

from unitouch_gen.conditioning import EmbeddingBank
from unitouch_gen.errors import InvalidInputError, check_number
from unitouch_gen.evaluation.metrics import calibration_error
from unitouch_gen.evaluation.zero_shot import ZeroShotTouchClassifier, calibrated_probabilities
from unitouch_gen.models import MODALITIES, UniTouchModel, UniTouchProcessor
from unitouch_gen.models.config import EXPONENTS
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.models.out_of_distribution import Gaussians, RelativeDistance
from unitouch_gen.models.sensors import layout_distances
from unitouch_gen.training.data import DataConfig, RecordSet, Rendered, columns_of, material_names
from unitouch_gen.training.data.columns import NEEDS
from unitouch_gen.training.recipe import read, read_recipe
from unitouch_gen.training.stages import run_command
from unitouch_gen.weights import EMBEDDING_BANK
from unitouch_gen.world import ATTRIBUTES

FEWEST, MOST = 50, 500
"""The least touches that a threshold is taken of; and samples looked at of each source and split."""


def fit_gaussians(features: Tensor, labels: Tensor, shrinkage: float = 0.1) -> Gaussians:
    """Gaussians of one covariance, one for each class.

    Args:
        features: (N, F).
        labels: Class of each, int64 (N,).
        shrinkage: Share of the covariance, of features in units of their deviation, that is the unit matrix.
    """
    values = features.double()
    names, rows = labels.unique(return_inverse=True)
    means = torch.stack([values[rows == row].mean(dim=0) for row in range(len(names))])
    deviation = values.std(dim=0).clamp_min(1e-6)
    residuals = (values - means[rows]) / deviation
    covariance = residuals.T @ residuals / len(residuals)
    scale, axes = torch.linalg.eigh((1.0 - shrinkage) * covariance + shrinkage * torch.eye(len(covariance)).double())
    return Gaussians(means.float(), (axes * scale.rsqrt() / deviation[:, None]).float())


def fit_distance(model: UniTouchModel, train: Sequence[Rendered], held: Sequence[Rendered], share: float) -> str:
    """Fits the distance of touches, and the threshold that a share of held-out touches is beyond."""

    def statistics(splits: Sequence[Rendered], column: str) -> Tensor:
        return torch.cat([model.touch_statistics(part) for part in parts_of(splits, column)]).cpu()

    def pressed(splits: Sequence[Rendered]) -> Tensor:
        """Whether anything presses into the gel of each touch, as far as it is known."""
        cover = ATTRIBUTES.index("cover")
        known = [np.ones(len(one)) if one.attributes is None else one.attributes[:, 0, cover] for one in splits]
        return torch.from_numpy(np.concatenate(known)) > 0.0

    rows, materials = pressed(train), torch.from_numpy(np.concatenate([split.material for split in train]))
    pictures = statistics(train, "image")
    known = fit_gaussians(statistics(train, "touch")[rows], materials[rows])
    distance = RelativeDistance(known, fit_gaussians(pictures, torch.zeros(len(pictures))))
    far = distance(statistics(held, "touch")[pressed(held)])
    if len(far) < FEWEST:
        raise InvalidInputError(f"`data` holds out {len(far)} touches for a threshold; {FEWEST} are the least.")
    threshold = far.quantile(1.0 - share).item()
    model.out_of_distribution["touch"] = distance
    model.config.ood_thresholds = {"touch": {"foreign": threshold}}
    found = (distance(statistics(held, "image")) > threshold).float().mean()
    return f"abstains on {share:.1%} of touches and {found:.1%} of pictures"


def parts_of(splits: Sequence[Rendered], column: str) -> Iterator[Any]:
    """A column of splits, 256 rows at a time: captions, log-mels, or pixel values of pictures and touches."""
    for split in splits:
        for start in range(0, len(split), 256):
            part = getattr(split, column)[start : start + 256]
            part = part if column == "text" else torch.from_numpy(np.array(part)).float()
            yield normalise_pixels(part / 255) if column in ("image", "touch") else part


@torch.no_grad()
def fit_temperatures(
    model: UniTouchModel,
    processor: UniTouchProcessor,
    modality: str,
    held: Sequence[Rendered],
    names: Sequence[str],
    bank: EmbeddingBank | None,
) -> str:
    """Fits the temperature of a modality to every other sample, and that of touches by pictures if there is a bank."""
    labels = torch.from_numpy(np.concatenate([split.material for split in held]))
    encode, parts, told = getattr(model, f"get_{modality}_features"), [], []
    for part in parts_of(held, modality):
        inputs = processor.text(part)["input_ids"] if modality == "text" else part
        parts.append(encode(inputs[:, None] if modality == "audio" else inputs).float().cpu())
    embeds = torch.cat(parts)
    for each in (None, bank) if modality == "touch" and bank is not None else (None,):
        classifier = ZeroShotTouchClassifier(model, processor, each)
        name, scores = classifier.fitted_as(modality), classifier.scores(embeds, modality, names)
        temperature, exponent = fit_temperature(scores[::2], labels[::2])
        model.config.temperatures = {**model.config.temperatures, name: temperature}
        model.config.temperature_exponents = {**model.config.temperature_exponents, name: exponent}
        shares = classifier.probabilities(embeds[1::2], modality, names)
        told.append(f"{name}: calibration error {calibration_error(shares, labels[1::2]):.3g}")
    return ", ".join(told)


def fit_temperature(scores: Tensor, labels: Tensor) -> tuple[float, float]:
    """Temperature and exponent of the `calibrated_probabilities` with the least Brier score (1950, Eq. 2).

    The likelihood, which is usual, is ruled by the few labels that hardly get any probability where classes are not
    told apart: most confidences were then too small.

    Args:
        scores: Cosines or other logits, (N, C), of samples that nothing was trained on.
        labels: int64 (N,), from 0 to C - 1.
    """
    unit = scores.double().std(correction=0).clamp_min(torch.finfo(torch.float32).tiny).item()
    scores, truth = scores.double() / unit, F.one_hot(labels, scores.shape[1]).double()

    def brier(values: Sequence[float]) -> float:
        probabilities = calibrated_probabilities(scores, math.exp(values[0]), values[1])
        return (probabilities - truth).square().sum(dim=1).mean().item()

    simplex = [[-1.0, 0.0], [1.0, 0.0], [-1.0, 1.5]]
    bounds = [(math.log(1e-3), math.log(1e3)), EXPONENTS]
    options = {"xatol": 1e-4, "initial_simplex": simplex}
    found = minimize(brier, simplex[0], method="Nelder-Mead", bounds=bounds, options=options).x
    temperature, exponent = math.exp(found[0]), float(found[1])
    return temperature * unit ** (1.0 + exponent), exponent


def fit_reaches(model: UniTouchModel, held: Sequence[Rendered], share: float) -> dict[str, float]:
    """How far each sensor's own touches lie from its prototype: all but a share of those that were held out."""
    _, bank = model.load("touch")
    reaches = {}
    for name in (name for name in bank.names if bool(bank.known[bank.index(name)])):
        touches = [split.touch for split in held if split.sensor == name]
        if sum(map(len, touches)) >= FEWEST:
            found = torch.from_numpy(np.concatenate(touches)).float() / 255
            reaches[name] = layout_distances(found, bank.prototype(name).float()).quantile(1.0 - share).item()
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
    share: Annotated[float, Option(help="Share of known touches on which the model abstains, about.")] = 0.046,
    cache: Annotated[Path, Option(help="What was rendered.")] = Path("runs/cache"),
) -> None:
    """Fits what a joint space does not know, and writes it into its folder: no weight changes.

    A bank of image embeddings beside it, as in a family, is what touches are named by as well.
    """
    check_number("share", share, 0.001, 0.5)
    data = read(DataConfig, read_recipe(recipe, overrides or ()).get("data"), "data")
    sources, held_out = data.sources(), data.held_out(MOST)
    model, processor = UniTouchModel.from_pretrained(joint), UniTouchProcessor.from_pretrained(joint)
    place = joint.parent / EMBEDDING_BANK.name
    bank = EmbeddingBank.from_pretrained(place) if place.is_dir() else None
    records = [one for source in (*sources, *held_out) if isinstance(source, RecordSet) for one in source.records]
    known = (*model.known_modalities, "material")
    needs = [name for name in known if all(NEEDS[name](record) is not None for record in records)]
    train = columns_of(sources, cache, data, processor, needs)
    held = columns_of(held_out, cache, data, processor, needs, "val")
    train, held = ([split.thinned(min(MOST, len(split))) for split in splits] for splits in (train, held))
    if data.drawn is not None and "touch" in needs:  # an encoder that has seen touches without a sensor's tokens
        model.config.sensor_reaches = fit_reaches(model, held, share / 2)
        model.load("touch")[1].reaches = dict(model.config.sensor_reaches)
    if {"touch", "image"} <= set(needs):
        print(fit_distance(model, train, held, share))
    named = "text" in needs and all((split.material >= 0).all() for split in held)
    for modality in MODALITIES if named else ():  # touches last, as they are named by pictures
        if modality in needs:
            print(fit_temperatures(model, processor, modality, held, material_names(sources), bank))
    with safe_open(next(joint.glob("model*.safetensors")), framework="pt") as stored:
        dtype = stored.get_tensor(next(key for key in stored.keys() if key.endswith("weight"))).dtype  # noqa: SIM118
    model.to(dtype).save_pretrained(joint)  # type: ignore[arg-type]


if __name__ == "__main__":
    run_command("abstention", abstention)
