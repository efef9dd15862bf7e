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

from tests.benchmarks.measuring import Figures
from unitouch_gen import weights
from unitouch_gen.evaluation.controls import statistics
from unitouch_gen.evaluation.probing import object_probes
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.models.images import centre_rectangle, normalise_pixels
from unitouch_gen.training.adapt import adapt

GELSIGHT, DIGIT = "gelsight_objects.zip", "digit_parts.zip"
PROPERTIES = ("hardness", "roughness", "bumps")
CLASSES = 3


def adapt_figures(recordings: Path) -> Figures:
    """Percentages before and after, and what stands beside them, for each recording that is there."""
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
        """What features of some clips tell, beside plain statistics of these clips."""
        differences = [self.peaks[row] - self.gels[row] for row in np.flatnonzero(rows)]
        truth, objects = {name: values[rows] for name, values in self.truth.items()}, self.objects[rows]
        found = {**features, "statistics": statistics(differences)}
        return {name: object_probes(values, truth, objects) for name, values in found.items()}


def gelsight_figures(file: Path, seed: int = 0) -> Figures:
    """Mean balanced accuracy of ridge probes of three properties, each object predicted from the others."""
    clips = Clips.read(file)
    names = np.unique(clips.objects)
    adapted_on = np.isin(clips.objects, np.random.default_rng(seed).permutation(names)[: len(names) // 2])
    held = clips.labelled & ~adapted_on
    side = _side()
    touches, untouched = square_pixels(clips.peaks, side), square_pixels(clips.gels, side)
    found = _embeddings(touches[adapted_on], touches[held], untouched[held])
    return {"objects": len(np.unique(clips.objects[held])), "chance": 1 / CLASSES, **clips.probed(found, held)}


def digit_figures(file: Path, seed: int = 0) -> Figures:
    """How often the nearest other touch is of the same part."""
    with ZipFile(file) as box:
        files = sorted(name for name in box.namelist() if "_interaction_" in name)
        pictures = [_picture(box, name) for name in files]
    parts = np.array([name.partition("_interaction_")[0] for name in files])
    rng, adapted_on = np.random.default_rng(seed), np.zeros(len(parts), dtype=bool)
    for part in np.unique(parts):
        rows = np.flatnonzero(parts == part)
        adapted_on[rng.permutation(rows)[: len(rows) // 2]] = True
    touches, held = square_pixels(pictures, _side()), ~adapted_on
    found = _embeddings(touches[adapted_on], touches[held])
    usual = np.mean([pictures[row] for row in np.flatnonzero(adapted_on)], axis=0)
    plain = statistics([pictures[row] - usual for row in np.flatnonzero(held)])
    found["statistics"] = (plain - plain.mean(axis=0)) / (plain.std(axis=0) + 1e-6)
    same = parts[held][:, None] == parts[held][None, :]
    measured = {name: nearest(features, parts[held]) for name, features in found.items()}
    return {"touches": int(held.sum()), "parts": len(np.unique(parts)),
            "chance": float((same.sum() - len(same)) / (len(same) * (len(same) - 1))), **measured}  # fmt: skip


def _side() -> int:
    """Of what the built-in encoder sees, pixels."""
    return UniTouchProcessor.from_pretrained(weights.JOINT).image_size


def _embeddings(adapted_on: np.ndarray, held: np.ndarray, untouched: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Embeddings of held-out touches: before, after, of an untrained encoder, and of what the gel alone gives away."""
    model = UniTouchModel.from_pretrained(weights.JOINT)
    found = {"before": _features(model, held)}
    if untouched is not None:
        found["background"] = _features(model, untouched)
    torch.manual_seed(0)
    untrained = UniTouchModel(model.config, modalities=("touch",)).eval()
    found["untrained"] = _features(untrained, held, sensor=0)
    with TemporaryDirectory() as folder:
        adapt(model, "mine", adapted_on).save(file := Path(folder) / "mine.safetensors")
        model.load_sensor(file)
        found["after"] = _features(model, held, sensor=model.sensors.index("mine"))
    return found


@torch.no_grad()
def _features(model: UniTouchModel, touches: np.ndarray, sensor: int | None = None) -> np.ndarray:
    """(N, D) by one sensor's tokens, or by those of the sensor that looks most like it."""
    pixels = normalise_pixels(torch.from_numpy(touches).float() / 255)
    ids = None if sensor is None else torch.full((len(pixels),), sensor)
    return F.normalize(model.get_touch_features(pixels, ids), dim=1).double().numpy()


def _picture(box: ZipFile, name: str) -> np.ndarray:
    with Image.open(io.BytesIO(box.read(name))) as image:
        return np.asarray(image.convert("RGB"), np.float32)


def square_pixels(pictures: Sequence[np.ndarray], size: int) -> np.ndarray:
    """uint8 (N, 3, S, S)."""
    squares = [centre_rectangle(torch.from_numpy(picture / 255).permute(2, 0, 1), size, size) for picture in pictures]
    return (torch.stack(squares) * 255).round().byte().numpy()


def nearest(features: np.ndarray, parts: np.ndarray, draws: int = 200) -> Figures:
    """Share whose nearest other is of the same part, by cosine, with its deviation over draws of parts."""
    unit = features / np.linalg.norm(features, axis=1, keepdims=True)
    cosine = unit @ unit.T
    np.fill_diagonal(cosine, -2.0)
    hit = parts[cosine.argmax(axis=1)] == parts
    rng, names = np.random.default_rng(0), np.unique(parts)
    by_part = {name: hit[parts == name] for name in names}
    means = [np.concatenate([by_part[name] for name in rng.choice(names, len(names))]).mean() for _ in range(draws)]
    return {"mean": float(hit.mean()), "deviation": float(np.std(means))}
