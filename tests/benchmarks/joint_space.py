"""What a joint space knows of contacts that nobody trained on, by sensor and split, each figure beside its controls.

    python -m tests.benchmarks.joint_space --joint unitouch_gen/weights/joint-next -o joint.json
    python -m tests.benchmarks.joint_space --joint runs/image_text/model runs/audio/model runs/touch/model \
        --touch-classifier runs/touch_classifier/model --picture-classifier runs/picture_classifier/model
        and how often the classifiers, trained with labels, name the same images
    python -m tests.benchmarks.joint_space --joint runs/touch/model --two-digits digit_touchtouch.zip
        and writes its embeddings of real DIGIT images, for `probe_two_digits.py`

Objects are held out: of the split "test" in the ranges of those to train on, of "beyond" outside of them. Each seed is
a world of its own; figures are means over seeds, spreads the largest less the least.
"""

import argparse
import csv
import io
import json
import zipfile
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from rich.console import Console
from rich.table import Table

from tests.benchmarks.measuring import Figures
from tests.benchmarks.quality import JointSpace, cross_predicted, held_out, over_seeds
from unitouch_gen.evaluation.attributes import controlled_agreement
from unitouch_gen.evaluation.controls import Controlled, class_means, others
from unitouch_gen.evaluation.generated import Row, load_classifier
from unitouch_gen.evaluation.retrieval import retrieval
from unitouch_gen.evaluation.zero_shot import ZeroShotTouchClassifier, accuracy
from unitouch_gen.models.classifier import ContactClassifier
from unitouch_gen.training.data.held import Held, float_pixels
from unitouch_gen.world import ATTRIBUTES, SENSORS

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
        find = partial(retrieval, gallery=gallery, labels=material, size=AMONG)
        others_ = touch[others(len(touch))]
        rows[f"{name}, among {AMONG} of its material"] = Controlled(
            find(touch), find(class_means(touch, material)), find(others_)
        )
    fifths = torch.from_numpy(np.asarray(seen.object) % 5)
    names = ("grain x", "grain y")
    grain = held.attributes[:, 0, [ATTRIBUTES.index(name) for name in names]]
    read, usual = cross_predicted(touch, grain, fifths), grain.mean(dim=0).expand_as(grain)
    agreed = controlled_agreement(read, grain, usual, None, names)
    return rows | {"direction within 20 degrees, read linearly": agreed["grain within 20"]}


@torch.no_grad()
def digit_embeddings(joint: JointSpace, archive: Path) -> np.ndarray:
    """Embeddings (N, D) of the images of `digit_touchtouch.zip`, in the order of its index."""
    size = joint.processor.image_size
    with zipfile.ZipFile(archive) as box:
        files = [row["file"] for row in csv.DictReader(io.TextIOWrapper(box.open("index.csv")))]
        images = [Image.open(io.BytesIO(box.read(file))).convert("RGB").resize((size, size)) for file in files]
    return joint.features("touch", np.stack([np.asarray(image) for image in images]).transpose(0, 3, 1, 2)).numpy()


def figures_of(given: argparse.Namespace, cache: Path) -> Figures:
    joint = JointSpace.from_folders(given.joint)
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
    parser.add_argument("--two-digits", type=Path, help="digit_touchtouch.zip; embeddings are written to --features")
    parser.add_argument("--features", type=Path, default=Path("two_digits.npy"))
    parser.add_argument("-o", "--output", type=Path, help="JSON file")
    given = parser.parse_args()
    if given.two_digits:
        np.save(given.features, digit_embeddings(JointSpace.from_folders(given.joint), given.two_digits))
    with TemporaryDirectory() as scratch:
        figures = figures_of(given, given.cache or Path(scratch)) if given.seeds else {}
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
