"""Fits what a joint space does not know: which touches are unlike those of its training.

    python -m unitouch_gen.training.abstention --joint runs/family/joint --cache runs/cache

Statistics are of what it was trained on, the threshold of what was held out. No weight changes.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from safetensors import safe_open
from torch import Tensor
from typer import Option

from unitouch_gen.models import MODALITIES, UniTouchModel, UniTouchProcessor
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.models.out_of_distribution import Gaussians, RelativeDistance
from unitouch_gen.models.sensors import layout_distances
from unitouch_gen.training.data import DataConfig, Rendered, columns_of
from unitouch_gen.training.recipe import read, read_recipe
from unitouch_gen.training.stages import run_command
from unitouch_gen.world import ATTRIBUTES

Splits = Sequence[Rendered]


def inputs_of(splits: Splits, modality: str, processor: UniTouchProcessor) -> Iterator[Tensor]:
    """What the encoder of a modality takes, 256 samples at a time."""
    for split in splits:
        for start in range(0, len(split), 256):
            part = getattr(split, modality)[start : start + 256]
            if modality == "text":
                yield processor.text(part)["input_ids"]
            else:
                values = torch.from_numpy(np.array(part)).float()
                yield values[:, None] if modality == "audio" else normalise_pixels(values / 255)


def fit_gaussians(features: Tensor, labels: Tensor, shrinkage: float = 0.1) -> Gaussians:
    """Gaussians of one covariance around the mean of each class, of features (N, F) with int64 labels (N,).

    `shrinkage` is the share of the covariance, of features in units of their deviation, that is the unit matrix.
    """
    values = features.double()
    names, rows = labels.unique(return_inverse=True)
    means = torch.stack([values[rows == row].mean(dim=0) for row in range(len(names))])
    deviation = values.std(dim=0).clamp_min(1e-6)
    residuals = (values - means[rows]) / deviation
    covariance = residuals.T @ residuals / len(residuals)
    scale, axes = torch.linalg.eigh((1.0 - shrinkage) * covariance + shrinkage * torch.eye(len(covariance)).double())
    return Gaussians(means.float(), (axes * scale.rsqrt() / deviation[:, None]).float())


def fit_distance(model: UniTouchModel, processor: UniTouchProcessor, train: Splits, held: Splits, share: float) -> None:
    """Fits the distance of touches, and the threshold that a share of held-out touches is beyond."""

    def statistics(splits: Splits, column: str) -> Tensor:
        return torch.cat([model.get_touch_statistics(part) for part in inputs_of(splits, column, processor)]).cpu()

    def pressed(splits: Splits) -> Tensor:
        """Whether anything presses into the gel of each touch, as far as it is known, (N,)."""
        cover = ATTRIBUTES.index("cover")
        known = [np.ones(len(one)) if one.attributes is None else one.attributes[:, 0, cover] for one in splits]
        return torch.from_numpy(np.concatenate(known)) > 0.0

    rows, materials = pressed(train), torch.from_numpy(np.concatenate([split.material for split in train]))
    known, pictures = fit_gaussians(statistics(train, "touch")[rows], materials[rows]), statistics(train, "image")
    distance = RelativeDistance(known, fit_gaussians(pictures, torch.zeros(len(pictures))))
    far = distance(statistics(held, "touch")[pressed(held)])
    model.out_of_distribution["touch"] = distance
    model.config.ood_thresholds = {"touch": {"foreign": far.quantile(1.0 - share).item()}}


def fit_reaches(model: UniTouchModel, held: Splits, share: float) -> None:
    """Fits how far each sensor's own touches lie from its prototype: all but a share of those that were held out."""
    _, bank = model.load("touch")
    for name in {split.sensor for split in held} & {*bank.names}:
        own = torch.from_numpy(np.concatenate([split.touch for split in held if split.sensor == name])) / 255
        reach = layout_distances(own, bank.prototype(name).float()).quantile(1.0 - share).item()
        model.config.sensor_reaches = {**model.config.sensor_reaches, name: reach}
    bank.reaches = dict(model.config.sensor_reaches)


def abstention(
    *,
    joint: Annotated[Path, Option(help="Folder of the joint space, such as `joint` of a family; it is written to.")],
    recipe: Annotated[str, Option(help="Its `data` is fitted to.")] = "touch",
    overrides: Annotated[list[str] | None, Option("--set", metavar="SECTION.KEY=VALUE")] = None,
    share: Annotated[float, Option(min=0.001, max=0.5, help="Share of known touches on which it abstains.")] = 0.046,
    cache: Annotated[Path, Option(help="What was rendered.")] = Path("runs/cache"),
) -> None:
    """Fits what a joint space does not know, and writes it into its folder: no weight changes."""
    data = read(DataConfig, read_recipe(recipe, overrides or ()).get("data"), "data")
    model, processor = UniTouchModel.from_pretrained(joint), UniTouchProcessor.from_pretrained(joint)
    needs, sources, most = (*MODALITIES, "material"), data.sources(), 500  # samples of each source and split
    train = columns_of(sources, cache, data, processor, needs)
    held = columns_of(data.held_out(most), cache, data, processor, needs, "val")
    train, held = ([one.thinned(min(most, len(one))) for one in splits] for splits in (train, held))
    fit_distance(model, processor, train, held, share)
    if data.drawn is not None:  # an encoder that has seen touches without a sensor's tokens
        fit_reaches(model, held, share / 2)
    with safe_open(next(joint.glob("model*.safetensors")), framework="pt") as stored:
        dtype = stored.get_tensor(next(key for key in stored.keys() if key.endswith("weight"))).dtype  # noqa: SIM118
    model.to(dtype).save_pretrained(joint)  # type: ignore[arg-type]


if __name__ == "__main__":
    run_command("abstention", abstention)
