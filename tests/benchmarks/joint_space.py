"""What a joint space knows of contacts that nobody trained on, and of real objects under another sensor.

    python -m tests.benchmarks.joint_space --joint runs/touch/model --two-digits digit_touchtouch.zip
        whether it knows a real object again under another DIGIT

`quality` measures the rest. Objects are held out: of the split "test" in the ranges of those to train on, of "beyond"
outside of them.
"""

import argparse
import csv
import io
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from sklearn.metrics import roc_auc_score
from torch import Tensor

from tests.benchmarks.measuring import Figures, attribute_agreement
from unitouch_gen import weights
from unitouch_gen.conditioning import EmbeddingBank
from unitouch_gen.evaluation.contacts import Contacts, image_embeddings
from unitouch_gen.evaluation.controls import class_means, statistics, untrained_like, with_controls
from unitouch_gen.evaluation.metrics import calibration_error, retrieval, share_right
from unitouch_gen.evaluation.zero_shot import ZeroShotTouchClassifier, text_embeddings
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.training.data import DrawnContacts
from unitouch_gen.training.data.heldout import world_contacts

UNITS = ("D20118", "D20140")


def held_out(
    cache: Path,
    processor: UniTouchProcessor,
    seed: int,
    split: str,
    sensor: str | None = None,
    objects: int = 16,
) -> Contacts:
    """The held-out contacts of a world, under drawn sensors, or under a named one and a drawn one."""
    source = DrawnContacts(0 if sensor is None else 1, sensor, 1, 1, seed, objects)
    return world_contacts(cache, processor, source, split)


@dataclass
class JointSpace:
    """Encoders of one space, which may lie in several folders: each modality is of the first that has it.

    The bank of pictures lies beside the first, if that is `joint` of a family: another space there has another bank.
    """

    models: dict[str, UniTouchModel]
    processor: UniTouchProcessor
    embedding_bank: EmbeddingBank | None = None

    @classmethod
    def from_folders(cls, folders: Sequence[Path]) -> "JointSpace":
        models: dict[str, UniTouchModel] = {}
        for folder in folders:
            model = UniTouchModel.from_pretrained(folder).eval()
            models = {**dict.fromkeys(model.known_modalities, model), **models}
        bank = folders[0].parent / weights.EMBEDDING_BANK.name  # as families hold it
        own = folders[0].name == weights.JOINT.name and bank.is_dir()
        embedding_bank = EmbeddingBank.from_pretrained(bank) if own else None
        return cls(models, UniTouchProcessor.from_pretrained(folders[0]), embedding_bank)

    @torch.no_grad()
    def features(self, modality: str, values: Any) -> Tensor:
        """Unit embeddings (N, D) of pictures or touches, of log-mel clips, or of captions."""
        model = self.models[modality]
        if modality == "text":
            return text_embeddings(model, self.processor, values)
        if modality == "audio":
            parts = torch.from_numpy(np.array(values)).split(256)
            return F.normalize(torch.cat([model.get_audio_features(part.float()[:, None]) for part in parts]), dim=1)
        return F.normalize(image_embeddings(model, modality, values), dim=1)


def material_rows(joint: JointSpace, modality: str, features: Tensor, material: Tensor) -> Figures:
    """The share of embeddings whose "material" is named right, and the "calibration error" of its probabilities."""
    classifier = ZeroShotTouchClassifier(joint.models["text"], joint.processor, joint.embedding_bank)

    def measure(values: Tensor) -> dict[str, float]:
        shares = classifier.probabilities(values, modality)
        right = share_right(shares.argmax(dim=1), material)
        return {"material": right, "calibration error": calibration_error(shares, material)}

    return with_controls(measure, {"value": features, "class_mean": class_means(features, material)})


def found_within(queries: Tensor, gallery: Tensor, labels: Tensor, size: int) -> Figures:
    """The share of contacts that are found among so many of their class."""

    def measure(values: Tensor) -> dict[str, float]:
        return {"found": retrieval(values, gallery, labels, size=size)}

    return with_controls(measure, {"value": queries, "class_mean": class_means(queries, labels)})["found"]


def agreed(read: Tensor, usual: Tensor, truth: Tensor, names: Sequence[str], real: Tensor | None = None) -> Figures:
    """`attribute_agreement` of what is read (N, K), beside the best that a class can tell and what real images say."""
    columns = {"value": read, "class_mean": usual, **({} if real is None else {"ceiling": real})}
    return with_controls(lambda values: attribute_agreement(values, truth, names), columns)


@torch.no_grad()
def two_digits(joint: JointSpace, archive: Path) -> Figures:
    """Whether an object is known again under another DIGIT: real recordings, of which nothing is trained on.

    Features are standardised within each unit, which takes the unit's own colours away from everyone alike.

    Args:
        joint: With touch; it is not told the sensor and retrieves none.
        archive: `digit_touchtouch.zip`, whose index.csv names file, unit and object of each image.

    Returns:
        By encoder, the area under the ROC curve of same-object pairs against others ("auc", mean over objects, and its
        standard error "spread"), and the share of images whose nearest of the other unit is of the same object
        ("nearest"). Objects filmed on another day (`hdmi_*`, `usb_*`) are left out.
    """
    with zipfile.ZipFile(archive) as box:
        index = list(csv.DictReader(io.TextIOWrapper(box.open("index.csv"))))
        rows = [row for row in index if row["unit"] in UNITS and not row["object"].startswith(("hdmi", "usb"))]
        images = [Image.open(io.BytesIO(box.read(row["file"]))).convert("RGB") for row in rows]
    pixels = joint.processor.touch(images)
    objects, first = np.array([row["object"] for row in rows]), np.array([row["unit"] == UNITS[0] for row in rows])
    mean = {unit: pixels[torch.from_numpy(first == unit)].mean(dim=0) for unit in (True, False)}
    pairs = zip(pixels, first.tolist(), strict=True)
    changes = [(128.0 * (one - mean[unit])).movedim(0, -1).numpy() for one, unit in pairs]
    models = {"touch encoder": joint.models["touch"]}
    models |= {f"untrained {seed}": untrained_like(joint.models["touch"], seed) for seed in range(3)}
    features = {
        name: torch.cat([model.get_touch_features(part) for part in pixels.split(128)]).double().numpy()
        for name, model in models.items()
    }
    features["statistics"] = np.log1p(np.abs(found := statistics(changes))) * np.sign(found)
    features["8 x 8 pixels"] = F.adaptive_avg_pool2d(pixels, 8).flatten(1).double().numpy()
    return {name: _known_again(values, objects, first) for name, values in features.items()}


def _known_again(features: np.ndarray, objects: np.ndarray, first: np.ndarray) -> dict[str, float]:
    for rows in (first, ~first):
        features[rows] = (features[rows] - features[rows].mean(0)) / (features[rows].std(0) + 1e-6)
    features /= np.linalg.norm(features, axis=1, keepdims=True) + 1e-9
    alike, same = features[first] @ features[~first].T, objects[first][:, None] == objects[~first][None]
    named = objects[first]
    both = sorted(set(named) & set(objects[~first]))
    scores = [roc_auc_score(same[named == one].ravel(), alike[named == one].ravel()) for one in both]
    nearest = [(objects[~first][alike[named == one].argmax(1)] == one).mean() for one in both]
    return {
        "auc": float(np.mean(scores)),
        "spread": float(np.std(scores) / len(scores) ** 0.5),
        "nearest": float(np.mean(nearest)),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.joint_space")
    parser.add_argument("--joint", nargs="+", type=Path, required=True, help="folders of the joint space")
    parser.add_argument("--two-digits", type=Path, required=True, help="digit_touchtouch.zip")
    given = parser.parse_args()
    for name, found in two_digits(JointSpace.from_folders(given.joint), given.two_digits).items():
        print(f"{name}: AUC {found['auc']:.3f} +- {found['spread']:.3f}, nearest {100 * found['nearest']:.0f} %")
