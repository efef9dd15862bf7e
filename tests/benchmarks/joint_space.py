"""What a joint space knows of contacts that nobody trained on, by sensor and split, each figure beside its controls.

    python -m tests.benchmarks.joint_space --joint unitouch_gen/weights/joint-next -o joint.json
    python -m tests.benchmarks.joint_space --joint runs/image_text/model runs/audio/model runs/touch/model \
        --touch-classifier runs/touch_classifier/model --picture-classifier runs/picture_classifier/model
        and how often the classifiers, trained with labels, name the same images
    python -m tests.benchmarks.joint_space --joint runs/touch/model --seeds 0 --two-digits digit_touchtouch.zip
        whether it knows a real object again under another DIGIT

Objects are held out: of the split "test" in the ranges of those to train on, of "beyond" outside of them. Each seed is
a world of its own; figures are means over seeds, spreads the largest less the least.
"""

import argparse
import csv
import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from rich.console import Console
from rich.table import Table
from sklearn.metrics import roc_auc_score
from torch import Tensor

from tests.benchmarks.measuring import Figures, attribute_agreement, cross_predicted, over_seeds
from unitouch_gen import weights
from unitouch_gen.conditioning import EmbeddingBank
from unitouch_gen.evaluation.contacts import Contacts, float_pixels, image_embeddings
from unitouch_gen.evaluation.controls import class_means, statistics, untrained_like, with_controls
from unitouch_gen.evaluation.metrics import calibration_error, retrieval, share_right
from unitouch_gen.evaluation.zero_shot import ZeroShotTouchClassifier, text_embeddings
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.models.classifier import ContactClassifier
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.training.data import DrawnContacts
from unitouch_gen.training.data.heldout import FIRST_SEED, world_contacts
from unitouch_gen.world import ATTRIBUTES, SENSORS

UNITS = ("D20118", "D20140")

NAMES = {"touch": "touch", "image": "picture", "audio": "sound", "text": "caption"}

GRAIN = ("grain x", "grain y")

AMONG = 50
"""Contacts of one material that a retrieval chooses from."""


def held_out(
    cache: Path,
    processor: UniTouchProcessor,
    seed: int,
    split: str,
    textures: str | None = None,
    sensor: str | None = None,
    objects: int = 16,
) -> tuple[DrawnContacts, Contacts]:
    """The held-out contacts of a world, under drawn sensors, or under a named one and a drawn one."""
    source = DrawnContacts(0 if sensor is None else 1, sensor, 1, 1, seed, textures, objects)
    return source, world_contacts(cache, processor, source, split)


@dataclass
class JointSpace:
    """Encoders of one space, which may lie in several folders: each modality is of the first that has it.

    The bank of pictures lies beside the first.
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
        embedding_bank = EmbeddingBank.from_pretrained(bank) if bank.is_dir() else None
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


def contact_rows(joint: JointSpace, contacts: Contacts, judges: Mapping[str, ContactClassifier]) -> Figures:
    """Figures of one split under one sensor. No sensor changes those of pictures, sounds, captions."""
    touch, second, picture = (
        joint.features(kind, values)
        for kind, values in (("touch", contacts.touch), ("touch", contacts.second), ("image", contacts.image))
    )
    embeds, material, rows = {"touch": touch, "image": picture}, contacts.material, {}
    if "audio" in joint.models:
        embeds["audio"] = joint.features("audio", contacts.audio)
    embeds["text"] = joint.features("text", contacts.text)
    for modality, features in embeds.items():
        row = material_rows(replace(joint, embedding_bank=None), modality, features, material)["material"]
        if modality in judges:
            images = {"touch": contacts.touch, "image": contacts.image}[modality]
            named = judges[modality].observe(float_pixels(images)).logits.argmax(dim=1)
            row["ceiling"] = share_right(named, material)
        rows[f"{NAMES[modality]}: material"] = row
    for name, gallery in {"the contact by another sensor": second, "its own picture": picture}.items():
        rows[f"{name}, among {AMONG} of its material"] = found_within(touch, gallery, material, AMONG)
    grain = contacts.attributes[:, 0, [ATTRIBUTES.index(name) for name in GRAIN]]
    read, usual = cross_predicted(touch, grain, contacts.objects % 5), grain.mean(dim=0).expand_as(grain)
    found = agreed(read, usual, grain, GRAIN)["grain within 20"]
    return rows | {"direction within 20 degrees, read linearly": found}


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
    size = joint.processor.image_size
    touches = np.stack([np.asarray(image.resize((size, size))) for image in images])
    pixels = normalise_pixels(float_pixels(touches).movedim(-1, 1))
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


def figures_of(joint: JointSpace, given: argparse.Namespace, cache: Path) -> Figures:
    folders = {"image": given.picture_classifier, "touch": given.touch_classifier}
    judges = {
        name: ContactClassifier.from_pretrained(folder, dtype=torch.float32)
        for name, folder in folders.items()
        if folder
    }
    seeds = [given.first_seed + number for number in range(given.seeds)]
    figures: Figures = {"seeds": seeds, "objects": given.objects}
    for split in given.splits:
        for sensor in given.sensors:
            name = None if sensor == "drawn" else sensor
            worlds = (held_out(cache, joint.processor, seed, split, None, name, given.objects)[1] for seed in seeds)
            figures[f"{split}: {sensor}"] = over_seeds([contact_rows(joint, world, judges) for world in worlds])
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.joint_space")
    parser.add_argument("--joint", nargs="+", type=Path, required=True, help="folders of the joint space")
    parser.add_argument("--touch-classifier", type=Path)
    parser.add_argument("--picture-classifier", type=Path)
    parser.add_argument("--splits", nargs="+", default=["test", "beyond"], choices=("val", "test", "beyond"))
    parser.add_argument("--sensors", nargs="+", default=["gelsight", "digit", "drawn"], choices=(*SENSORS, "drawn"))
    parser.add_argument("--seeds", type=int, default=3, help="worlds")
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--objects", type=int, default=12, help="held-out objects of each material")
    parser.add_argument("--cache", type=Path, help="where contacts are rendered to, and found again")
    parser.add_argument("--two-digits", type=Path, help="digit_touchtouch.zip")
    parser.add_argument("-o", "--output", type=Path, help="JSON file")
    given = parser.parse_args()
    joint = JointSpace.from_folders(given.joint)
    with TemporaryDirectory() as scratch:
        figures = figures_of(joint, given, given.cache or Path(scratch)) if given.seeds else {}
    if given.two_digits:
        figures["two digits"] = two_digits(joint, given.two_digits)
        for name, found in figures["two digits"].items():
            print(f"{name}: AUC {found['auc']:.3f} +- {found['spread']:.3f}, nearest {100 * found['nearest']:.0f} %")
    if given.output:
        given.output.write_text(json.dumps(figures, indent=2) + "\n")
    for name, rows in figures.items():
        if ": " in name:
            table = Table("%", "figure", "spread", "class mean", "shuffled", "with labels", title=name)
            for row, values in rows.items():
                cells = (values[key] for key in ("value", "spread", "class_mean", "shuffled", "ceiling"))
                table.add_row(row, *("-" if cell is None else f"{100 * cell:.1f}" for cell in cells))
            Console(width=120).print(table)


if __name__ == "__main__":
    main()
