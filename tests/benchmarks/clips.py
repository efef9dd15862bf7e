"""Clips of objects pressed by a real GelSight, and probes of their properties.

`gelsight_objects.zip` holds them as `CLIP_peak.jpg` and `CLIP_bg.jpg`, with a `labels.csv` of the objects' hardness,
roughness and bumps (0 to 2).
"""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import torch
from PIL import Image
from sklearn.linear_model import RidgeClassifierCV
from sklearn.metrics import recall_score
from sklearn.model_selection import LeaveOneGroupOut, cross_val_predict
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from tests.benchmarks.measuring import Figures
from unitouch_gen.evaluation.controls import statistics
from unitouch_gen.models.images import centre_rectangle

GELSIGHT = "gelsight_objects.zip"
PROPERTIES = ("hardness", "roughness", "bumps")


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

    def probed(self, features: Mapping[str, np.ndarray]) -> Figures:
        """Balanced accuracy of each property by ridge probes of labelled clips, and of plain statistics of these."""
        rows = self.labelled
        differences = [self.peaks[row] - self.gels[row] for row in np.flatnonzero(rows)]
        truth = {name: values[rows] for name, values in self.truth.items()}
        objects = self.objects[rows]
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
        pairs = {name: (labels[rows], predicted[name][rows]) for name, labels in truth.items()}
        return {
            name: float(recall_score(true, found, labels=np.unique(true), average="macro"))
            for name, (true, found) in pairs.items()
        }

    found = shares(np.arange(len(objects)))
    rng = np.random.default_rng(0)
    names = np.unique(objects)
    rows_of = {name: np.flatnonzero(objects == name) for name in names}
    draws = [np.concatenate([rows_of[name] for name in rng.choice(names, len(names))]) for _ in range(200)]
    means = [np.mean(list(shares(rows).values())) for rows in draws]
    return {**found, "mean": float(np.mean(list(found.values()))), "deviation": float(np.std(means))}


def _picture(box: ZipFile, name: str) -> np.ndarray:
    with Image.open(io.BytesIO(box.read(name))) as image:
        return np.asarray(image.convert("RGB"), np.float32)


def square_pixels(pictures: Sequence[np.ndarray], size: int) -> np.ndarray:
    """uint8 (N, 3, S, S)."""
    squares = [centre_rectangle(torch.from_numpy(picture / 255).permute(2, 0, 1), size, size) for picture in pictures]
    return (torch.stack(squares) * 255).round().byte().numpy()
