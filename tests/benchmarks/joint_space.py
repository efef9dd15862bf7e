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
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from rich.console import Console
from rich.table import Table
from sklearn.metrics import roc_auc_score

from tests.benchmarks.measuring import Figures
from tests.benchmarks.quality import JointSpace, cross_predicted, found_within, held_out, over_seeds
from unitouch_gen.evaluation.attributes import controlled_agreement
from unitouch_gen.evaluation.controls import Controlled, class_means, others, statistics, untrained_like
from unitouch_gen.evaluation.generated import Row, load_classifier
from unitouch_gen.evaluation.zero_shot import ZeroShotTouchClassifier, accuracy
from unitouch_gen.models.classifier import ContactClassifier
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.training.data.held import Held, float_pixels
from unitouch_gen.world import ATTRIBUTES, SENSORS

UNITS = ("D20118", "D20140")

AT_ONCE = 128

AMONG = 50
"""Contacts of one material that a retrieval chooses from."""


def contact_rows(joint: JointSpace, held: Held, judges: dict[str, ContactClassifier]) -> Row:
    """Figures of one split under one sensor. No sensor changes those of pictures, sounds, captions."""
    seen, material, rows = held.seen, held.material, Row()
    touch, second, image = (
        joint.features(kind, values)
        for kind, values in (("touch", seen.touch), ("touch", seen.second), ("image", seen.image))
    )
    embeds = {"touch": touch, "picture": image}
    if "audio" in joint.models:
        embeds["sound"] = joint.features("audio", seen.audio)
    with torch.no_grad():
        tokens = joint.processor.text(list(seen.text))["input_ids"]
        embeds["caption"] = F.normalize(joint.models["text"].get_text_features(tokens).float(), dim=1)
    name_of = ZeroShotTouchClassifier(joint.models["text"], joint.processor)
    kinds = {"picture": "image", "sound": "audio", "caption": "text"}
    for name, features in embeds.items():
        controlled = (features, class_means(features, material), features[others(len(features))])
        found = [accuracy(name_of.probabilities(each, kinds.get(name, name)), material) for each in controlled]
        judge = judges.get(kinds.get(name, name))
        pixels = {"touch": seen.touch, "picture": seen.image}.get(name)
        ceiling = None if judge is None else accuracy(judge.observe(float_pixels(pixels)).logits, material)
        rows[f"{name}: material"] = Controlled(*found, ceiling)
    for name, gallery in {"the contact by another sensor": second, "its own picture": image}.items():
        rows[f"{name}, among {AMONG} of its material"] = found_within(touch, gallery, material, AMONG)
    fifths = torch.from_numpy(np.asarray(seen.object) % 5)
    names = ("grain x", "grain y")
    grain = held.attributes[:, 0, [ATTRIBUTES.index(name) for name in names]]
    read, usual = cross_predicted(touch, grain, fifths), grain.mean(dim=0).expand_as(grain)
    agreed = controlled_agreement(read, grain, usual, None, names)
    return rows | {"direction within 20 degrees, read linearly": agreed["grain within 20"]}


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
    pixels = torch.from_numpy(np.stack([np.asarray(image.resize((size, size))) for image in images]))
    pixels = normalise_pixels(pixels.movedim(-1, 1).float() / 255)
    objects, first = np.array([row["object"] for row in rows]), np.array([row["unit"] == UNITS[0] for row in rows])
    mean = {unit: pixels[torch.from_numpy(first == unit)].mean(dim=0) for unit in (True, False)}
    pairs = zip(pixels, first.tolist(), strict=True)
    changes = [(128.0 * (one - mean[unit])).movedim(0, -1).numpy() for one, unit in pairs]
    models = {"touch encoder": joint.models["touch"]}
    models |= {f"untrained {seed}": untrained_like(joint.models["touch"], seed) for seed in range(3)}
    features = {
        name: torch.cat([model.get_touch_features(part) for part in pixels.split(AT_ONCE)]).double().numpy()
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
    judges = {name: load_classifier(folder) for name, folder in folders.items() if folder}
    seeds = [given.first_seed + number for number in range(given.seeds)]
    figures: Figures = {"seeds": seeds, "objects": given.objects}
    for split in given.splits:
        for sensor in given.sensors:
            rows = []
            for seed in seeds:
                name = None if sensor == "drawn" else sensor
                held = held_out(cache, joint.processor, seed, split, None, name, given.objects)
                rows.append(contact_rows(joint, held, judges))
            figures[f"{split}: {sensor}"] = over_seeds(rows)
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.joint_space")
    parser.add_argument("--joint", nargs="+", type=Path, required=True, help="folders of the joint space")
    parser.add_argument("--touch-classifier", type=Path)
    parser.add_argument("--picture-classifier", type=Path)
    parser.add_argument("--splits", nargs="+", default=["test", "beyond"], choices=("val", "test", "beyond"))
    parser.add_argument("--sensors", nargs="+", default=["gelsight", "digit", "drawn"], choices=(*SENSORS, "drawn"))
    parser.add_argument("--seeds", type=int, default=3, help="worlds")
    parser.add_argument("--first-seed", type=int, default=1000)
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
