"""What `unitouch-gen adapt` is worth on recordings of real sensors, beside what plain image statistics find.

    python -m tests.benchmarks --only adapt --recordings FOLDER

The folder holds `gelsight_objects.zip`, clips of objects as `CLIP_peak.jpg` and `CLIP_bg.jpg` with a `labels.csv` of
their hardness, roughness and bumps (0 to 2), and `digit_parts.zip`, contacts with parts of objects as
`PART_interaction_NUMBER.jpg`, or one of them. Half of the objects, or of the contacts of each part, is adapted on
without labels; figures are of the other half, which nothing is chosen by.
"""

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from zipfile import ZipFile

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from sklearn.linear_model import RidgeClassifierCV
from sklearn.metrics import recall_score
from sklearn.model_selection import LeaveOneGroupOut, cross_val_predict
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from tests.benchmarks.measuring import Figures
from unitouch_gen import weights
from unitouch_gen.evaluation.contacts import image_embeddings
from unitouch_gen.evaluation.controls import statistics, untrained_like
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.models.images import centre_rectangle
from unitouch_gen.training.adapt import adapt

GELSIGHT, DIGIT = "gelsight_objects.zip", "digit_parts.zip"
PROPERTIES = ("hardness", "roughness", "bumps")


def adapt_figures(recordings: Path) -> Figures:
    """Shares before and after, and what stands beside them, for each recording that is there."""
    measures: dict[str, Callable[[Path], Figures]] = {GELSIGHT: gelsight_figures, DIGIT: digit_figures}
    there = {name: measure for name, measure in measures.items() if (recordings / name).is_file()}
    return {name.removesuffix(".zip"): measure(recordings / name) for name, measure in there.items()}


@dataclass
class Clips:
    """Presses of objects: firmest frames and untouched gels (H, W, 3), objects, and properties, -1 where not known."""

    peaks: list[np.ndarray]
    gels: list[np.ndarray]
    objects: np.ndarray
    truth: dict[str, np.ndarray]

    @classmethod
    def read(cls, file: Path) -> "Clips":
        with ZipFile(file) as box:
            rows = list(csv.DictReader(io.TextIOWrapper(box.open("labels.csv"))))
            peaks, gels = ([_picture(box, f"{row['clip']}_{kind}.jpg") for row in rows] for kind in ("peak", "bg"))
        truth = {name: np.array([int(row[name] or -1) for row in rows]) for name in PROPERTIES}
        return cls(peaks, gels, np.array([row["object"] for row in rows]), truth)

    @property
    def labelled(self) -> np.ndarray:
        return self.truth["hardness"] >= 0

    def probed(self, features: Mapping[str, np.ndarray], rows: np.ndarray) -> Figures:
        """Balanced accuracy of each property by ridge probes of some clips, and of plain statistics of these."""
        differences = [self.peaks[row] - self.gels[row] for row in np.flatnonzero(rows)]
        truth, objects = {name: values[rows] for name, values in self.truth.items()}, self.objects[rows]
        found = {**features, "statistics": statistics(differences)}
        return {name: object_probes(values, truth, objects) for name, values in found.items()}


def object_probes(features: np.ndarray, truth: Mapping[str, np.ndarray], objects: np.ndarray) -> dict[str, float]:
    """Balanced accuracy of labels (N,) by ridge probes of features (N, D), each object (N,) predicted from the others.

    Beside it the "mean" of all labels, and its "deviation" over 200 draws of objects (Efron, 1979).
    """
    probe = make_pipeline(StandardScaler(), RidgeClassifierCV(np.logspace(-1, 5, 13), class_weight="balanced"))
    cut = {"groups": objects, "cv": LeaveOneGroupOut()}
    predicted = {name: cross_val_predict(probe, features, labels, **cut) for name, labels in truth.items()}

    def shares(rows: np.ndarray) -> dict[str, float]:
        return {
            name: float(
                recall_score(labels[rows], predicted[name][rows], labels=np.unique(labels[rows]), average="macro")
            )
            for name, labels in truth.items()
        }

    found = shares(np.arange(len(objects)))
    means = [np.mean(list(shares(rows).values())) for rows in _draws(objects)]
    return {**found, "mean": float(np.mean(list(found.values()))), "deviation": float(np.std(means))}


def _draws(groups: np.ndarray) -> list[np.ndarray]:
    """Rows of 200 draws of groups, with replacement."""
    rng, names = np.random.default_rng(0), np.unique(groups)
    rows_of = {name: np.flatnonzero(groups == name) for name in names}
    return [np.concatenate([rows_of[name] for name in rng.choice(names, len(names))]) for _ in range(200)]


def gelsight_figures(file: Path) -> Figures:
    """Mean balanced accuracy of ridge probes of three properties, each object predicted from the others."""
    clips = Clips.read(file)
    names = np.unique(clips.objects)
    adapted_on = np.isin(clips.objects, np.random.default_rng(0).permutation(names)[: len(names) // 2])
    held = clips.labelled & ~adapted_on
    touches, untouched = (square_pixels(frames, _side()) for frames in (clips.peaks, clips.gels))
    found = _embeddings(touches[adapted_on], touches[held], untouched[held])
    return {"objects": len(np.unique(clips.objects[held])), "chance": 1 / 3, **clips.probed(found, held)}


def digit_figures(file: Path) -> Figures:
    """How often the nearest other touch, by cosine, is of the same part, with its deviation over draws of parts."""
    with ZipFile(file) as box:
        files = sorted(name for name in box.namelist() if "_interaction_" in name)
        pictures = [_picture(box, name) for name in files]
    parts = np.array([name.partition("_interaction_")[0] for name in files])
    rng, adapted_on = np.random.default_rng(0), np.zeros(len(parts), dtype=bool)
    for part in np.unique(parts):
        rows = np.flatnonzero(parts == part)
        adapted_on[rng.permutation(rows)[: len(rows) // 2]] = True
    touches, held = square_pixels(pictures, _side()), ~adapted_on
    found = _embeddings(touches[adapted_on], touches[held])
    usual = np.mean([pictures[row] for row in np.flatnonzero(adapted_on)], axis=0)
    plain = statistics([pictures[row] - usual for row in np.flatnonzero(held)])
    found["statistics"] = StandardScaler().fit_transform(plain)
    same, measured = parts[held][:, None] == parts[held][None, :], {}
    for name, features in found.items():
        unit = features / np.linalg.norm(features, axis=1, keepdims=True)
        hit = parts[held][(unit @ unit.T - 3.0 * np.eye(len(unit))).argmax(axis=1)] == parts[held]
        deviation = np.std([hit[rows].mean() for rows in _draws(parts[held])])
        measured[name] = {"mean": float(hit.mean()), "deviation": float(deviation)}
    chance = float((same.sum() - len(same)) / (len(same) * (len(same) - 1)))
    return {"touches": int(held.sum()), "parts": len(np.unique(parts)), "chance": chance, **measured}


def _side() -> int:
    """Of what the built-in encoder sees, pixels."""
    return UniTouchProcessor.from_pretrained(weights.JOINT).image_size


def _embeddings(adapted_on: np.ndarray, held: np.ndarray, untouched: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Embeddings of held-out touches: before, after, of an untrained encoder, and of what the gel alone gives away."""
    model = UniTouchModel.from_pretrained(weights.JOINT)
    found = {"before": image_embeddings(model, "touch", held)}
    if untouched is not None:
        found["background"] = image_embeddings(model, "touch", untouched)
    found["untrained"] = image_embeddings(untrained_like(model), "touch", held)
    with TemporaryDirectory() as folder:
        adapt(model, "mine", adapted_on).save(file := Path(folder) / "mine.safetensors")
        model.load_sensor(file)
        found["after"] = image_embeddings(model, "touch", held, ["mine"] * len(held))
    return {name: F.normalize(features, dim=1).double().numpy() for name, features in found.items()}


def _picture(box: ZipFile, name: str) -> np.ndarray:
    with Image.open(io.BytesIO(box.read(name))) as image:
        return np.asarray(image.convert("RGB"), np.float32)


def square_pixels(pictures: Sequence[np.ndarray], size: int) -> np.ndarray:
    """uint8 (N, 3, S, S)."""
    squares = [centre_rectangle(torch.from_numpy(picture / 255).permute(2, 0, 1), size, size) for picture in pictures]
    return (torch.stack(squares) * 255).round().byte().numpy()
