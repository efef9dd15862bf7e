"""What a joint space and a family are worth on the world and on real touches, each figure beside its controls.

    python -m tests.benchmarks.quality --joint runs/touch/model -o quality.json
        the joint space alone: sensors that nobody has seen, objects held out
    python -m tests.benchmarks.quality --family runs/family --touched-by gelsight --photos FOLDER
        and what its pipelines make of a GelSight's touches, by the built-in classifiers; photos are restyled, too
    python -m tests.benchmarks.quality --joint runs/touch/model --recordings FOLDER
        and real touches: the `gelsight_objects.zip` of `clips`, and if it is there `objectfolder_dataPack.npz`, the
        ball presses of ObjectFolder 2.0 (github.com/rhgao/ObjectFolder, calibs/)

Every seed is a world of its own, with objects, sensors and noise of its own. Figures are means over seeds.
"""

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import mean
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from tests.benchmarks.clips import GELSIGHT, Clips, square_pixels
from tests.benchmarks.joint_space import JointSpace, agreed, found_within, held_out, material_rows
from tests.benchmarks.measuring import (
    Figures,
    attribute_agreement,
    cross_predicted,
    over_seeds,
    print_figures,
    quiet,
)
from unitouch_gen import weights
from unitouch_gen.evaluation.answers import caption_table
from unitouch_gen.evaluation.controls import class_means, statistics, untrained_like, with_controls
from unitouch_gen.evaluation.generated import beside_class_means, generate, sample_per_class
from unitouch_gen.evaluation.metrics import frechet_distance, retrieval, share_right
from unitouch_gen.models.classifier import ContactClassifier
from unitouch_gen.models.features import float_pixels
from unitouch_gen.models.images import centre_rectangle, load_images, normalise_pixels
from unitouch_gen.models.joint import UNLIKE, UNTOUCHED
from unitouch_gen.models.relief import relief
from unitouch_gen.pipelines.tiny import PIPELINES, TURBO
from unitouch_gen.training.data.contacts import Contacts
from unitouch_gen.training.data.heldout import FIRST_SEED
from unitouch_gen.world import ATTRIBUTES, MATERIAL_NAMES, SENSORS
from unitouch_gen.world.attributes import gaussian_blur

AMONG = 50
"""Contacts of its material that each one is found among, at most."""

RELIEF = ("slope", "steepness", "fine relief", "coarse relief")
"""Attributes of the relief: what a touch shows of a surface whatever it is made of."""

PRESSES = "objectfolder_dataPack.npz"

UNTRAINED = 5
"""Untrained encoders that a figure of few objects is the mean of: one by one they differ by several points."""


def joint_rows(joint: JointSpace, contacts: Contacts, touch_classifier: ContactClassifier) -> Figures:
    """Material by zero-shot, contacts told from others of their material, and what is read linearly off touches."""
    material = contacts.material
    truth = contacts.attributes
    rows = {}
    size = min(AMONG, int(torch.bincount(material).min()))
    embeds = {name: joint.features(name, getattr(contacts, name)) for name in joint.model.known_modalities}
    real: Any = touch_classifier.observe(float_pixels(contacts.touch))
    if "text" in embeds:
        for name, features in embeds.items():
            found = material_rows(joint, name, features, material)
            if name == "touch":
                found["material"]["ceiling"] = share_right(real.logits.argmax(dim=1), material)
            rows |= {f"{name}: {key}": row for key, row in found.items()}
    if "touch" not in embeds:
        return rows
    touch = embeds["touch"]
    unit = (truth - truth.mean(dim=(0, 1))) / truth.std(dim=(0, 1))
    found = found_within(touch, joint.features("touch", contacts.second), material, size)
    found["ceiling"] = retrieval(unit[:, 0], unit[:, 1], material, size=size)  # by who reads every attribute exactly
    rows["touch to its touch by another sensor, within material"] = found
    if "image" in embeds:
        rows["touch to its picture, within material"] = found_within(touch, embeds["image"], material, size)
    fifths = contacts.objects % 5
    usual = torch.empty_like(truth[:, 0])
    for fifth in fifths.unique():
        fit = fifths != fifth
        asked = fifths == fifth
        usual[asked] = class_means(truth[fit, 0], material[fit], material[asked])
    read = cross_predicted(touch, truth[:, 0], fifths)
    found = agreed(read, usual, truth[:, 0], ATTRIBUTES, real.attributes)
    return rows | {f"touch, read linearly: {name}": row for name, row in found.items()}


# What is generated ----------------------------------------------------------------------------------------------------


def image_rows(
    classifier: ContactClassifier,
    contacts: Contacts,
    modality: str,
    rows: Tensor,
    made: Mapping[str, Tensor],
    again: Tensor,
) -> Figures:
    """Figures of images that were `made` of some rows of contacts, by what a classifier reads.

    The ceiling is the real image; that of finding a contact is the image `again`, under another lamp or sensor. The
    class mean of attributes is what a class can tell of them: the mean truth of its other contacts.
    """
    real = float_pixels(getattr(contacts, modality))
    material = contacts.material
    columns = [ATTRIBUTES.index(name) for name in classifier.attributes]
    truth = (contacts.attributes.mean(dim=1) if modality == "image" else contacts.attributes[:, 0])[:, columns]
    scale = classifier.scale_of_attributes()
    rest = torch.ones(len(material), dtype=torch.bool)
    rest[rows] = False
    seen: Any = classifier.observe(real)
    size = min(AMONG, int(torch.bincount(material).min()))

    def placed(said: Any) -> Tensor:
        return said.features if said.attributes is None else (said.attributes - scale[0]) / scale[1]

    def found(said: Any) -> float:
        return retrieval(placed(said), placed(seen), material, rows, size=size)

    def measure(images: Tensor) -> dict[str, float]:
        said: Any = classifier.observe(images)
        read = attribute_agreement(said.attributes, truth[rows], classifier.attributes) if columns else {}
        return {
            "material": share_right(said.logits.argmax(dim=1), material[rows]),
            "contact within material": found(said),
            "Frechet distance": frechet_distance(said.features, seen.features[rest]),
            **read,
        }

    figures = with_controls(measure, {**made, "ceiling": real[rows]})
    figures["contact within material"]["ceiling"] = found(classifier.observe(again))
    del figures["Frechet distance"]["shuffled"]  # the same images
    usual = class_means(truth[rest], material[rest], material[rows])
    for name, value in attribute_agreement(usual, truth[rows], classifier.attributes).items() if columns else ():
        figures[name]["class_mean"] = value
    return figures


def touch_to_image_rows(
    pipe: Any, classifier: Any, contacts: Contacts, seed: int, each: int, **options: Any
) -> Figures:
    """Pictures of touches by sensors that nobody has seen."""
    rows = sample_per_class(contacts, each)
    embeds = beside_class_means(pipe.encode_touch, "touch", contacts.touch, contacts, rows)
    made = {name: generate(pipe, seed, {"touch_embeds": values}, **options) for name, values in embeds.items()}
    found = image_rows(classifier, contacts, "image", rows, made, contacts.relit()[rows])
    return {f"touch to picture: {name}": row for name, row in found.items()}


def x_to_touch_rows(pipe: Any, classifier: Any, contacts: Contacts, seed: int, each: int, **options: Any) -> Figures:
    """Touches by a named sensor, of pictures, captions, sounds and bare words: the materials' names."""
    rows = sample_per_class(contacts, each)
    figures = {}
    options["sensor"] = contacts.sensors[0]
    words = [MATERIAL_NAMES[number].replace("_", " ") for number in contacts.material.tolist()]
    inputs = {"photo": contacts.image, "caption": contacts.text, "sound": contacts.sounds(), "word": words}
    for name, values in inputs.items():
        modality = {"photo": "image", "sound": "audio"}.get(name, "text")
        embeds = beside_class_means(pipe.encode_condition, modality, values, contacts, rows)
        made = {key: generate(pipe, seed, {"condition_embeds": one}, **options) for key, one in embeds.items()}
        found = image_rows(classifier, contacts, "touch", rows, made, float_pixels(contacts.second)[rows])
        figures |= {f"{name} to touch: {key}": row for key, row in found.items()}
    return figures


def restyled_rows(pipe: Any, classifier: Any, contacts: Contacts, seed: int, each: int, **options: Any) -> Figures:
    """Photos restyled by touches of other materials, by default and as in the paper, and as they were.

    "layout kept" is the correlation of the brightness with the photo's on 8 x 8 fields, "relief of the touch" the mean
    correlation of what is read off the picture with the touch's, and its ceiling that of the touch's own picture;
    "material of the touch" and "of the photo" are the shares that are named so.
    """
    rows = sample_per_class(contacts, each)
    touched = rows.roll(each)
    names = [name for name in RELIEF if name in classifier.attributes]
    photos = float_pixels(contacts.image)[rows]
    touches = float_pixels(contacts.touch)[touched]
    truth = contacts.attributes.mean(dim=1)[touched][:, [ATTRIBUTES.index(name) for name in names]]

    def measure(images: Tensor) -> dict[str, float]:
        coarse = (F.adaptive_avg_pool2d(values.mean(dim=1), 8).flatten(1) for values in (images, photos))
        kept = F.cosine_similarity(*(values - values.mean(dim=1, keepdim=True) for values in coarse)).mean().item()
        said: Any = classifier.observe(images)
        read = said.attributes[:, [classifier.attributes.index(name) for name in names]]
        named = {"touch": contacts.material[touched], "photo": contacts.material[rows]}
        shares = {f"material of the {of}": share_right(said.logits.argmax(dim=1), what) for of, what in named.items()}
        relief = mean(attribute_agreement(read, truth, names).values())
        return {"layout kept": kept, "relief of the touch": relief, **shares}

    restyle = partial(generate, pipe, seed, {"image": photos, "touch": touches}, **options)
    shown = {
        "photo as it was": photos,
        "restyled photo": restyle(),
        "restyled as in the paper": restyle(layout=None),
    }
    figures = {}
    for name, images in shown.items():
        found = with_controls(measure, {"value": images, "ceiling": float_pixels(contacts.image)[touched]})
        del found["layout kept"]["ceiling"]
        figures |= {f"{name}: {key}": row for key, row in found.items()}
    return figures


ANSWERED = {"value": "touch", "usual": "most frequent answer", "shuffled": "shuffled touches", "ceiling": "picture"}
"""Columns of answers, and rows of `caption_table`."""


def answer_rows(pipe: Any, joint: JointSpace, contacts: Contacts, each: int) -> Figures:
    """Answers about touches that are put in zero-shot; the reference is asked about the pictures."""
    contacts.features = {name: joint.features(name, getattr(contacts, name)) for name in ("touch", "image")}
    splits = {"train": contacts, "test": contacts}
    rows = caption_table(pipe, splits, lambda texts: joint.features("text", texts), each)
    return {f"answer: {name}": {key: rows[row][name] for key, row in ANSWERED.items()} for name in rows["touch"]}


def photo_figures(pipes: Mapping[str, Any], contacts: Contacts, photos: Path, seed: int) -> Figures:
    """Whole photos restyled by touches, by default: "layout" is the correlation of brightness with the photo's, and
    "colours" that of all three channels, blurred by 6 of 128 pixels; "detail" the median energy of what has changed and
    is finer than that, over the energy of what is finer in the touch's own picture."""
    files = sorted(file for file in photos.iterdir() if file.suffix in (".jpg", ".png"))
    touches = float_pixels(contacts.touch)[sample_per_class(contacts, 1)[: len(files)]]
    shown = torch.stack([centre_rectangle(image, 128, 128) for image in load_images("photos", files)])[: len(touches)]
    made = generate(pipes["stylization"], seed, {"image": shown, "touch": touches})
    own = generate(pipes["touch-to-image"], seed, {"touch": touches})

    def coarse(images: Tensor) -> Tensor:
        return gaussian_blur(images.flatten(0, 1), 6.0).unflatten(0, images.shape[:2])

    def alike(channels: Callable[[Tensor], Tensor]) -> float:
        one, other = (channels(coarse(images)).flatten(1) for images in (shown, made))
        return (
            F.cosine_similarity(*(values - values.mean(dim=1, keepdim=True) for values in (one, other))).mean().item()
        )

    changed, fine = ((images - coarse(images)).square().mean(dim=(1, 2, 3)) for images in (made - shown, own))
    found = {"layout": alike(lambda images: images.mean(dim=1)), "colours": alike(lambda images: images)}
    return {"photos": len(shown), **found, "detail": (changed / fine).median().item()}


# Real touches ---------------------------------------------------------------------------------------------------------


def real_figures(joint: JointSpace, recordings: Path) -> Figures:
    """Probes of real touches, beside plain statistics, the untouched gel and untrained encoders."""
    spaces = {"touch encoder": joint.model}
    spaces |= {f"untrained {seed}": untrained_like(joint.model, seed) for seed in range(UNTRAINED)}
    size = joint.processor.image_size
    figures = {}

    def embedded(pixels: np.ndarray) -> dict[str, np.ndarray]:
        found = {
            name: replace(joint, model=model).features("touch", pixels).double().numpy()
            for name, model in spaces.items()
        }
        reliefs = relief(normalise_pixels(float_pixels(pixels))).movedim(1, -1).numpy()
        return found | {"statistics of the relief": statistics([128.0 + 20.0 * one for one in reliefs])}

    clips = Clips.read(recordings / GELSIGHT)
    peaks, gels = (square_pixels(frames, size) for frames in (clips.peaks, clips.gels))
    features = embedded(peaks[clips.labelled])
    features["untouched gel"] = joint.features("touch", gels[clips.labelled]).double().numpy()
    count = {"touches": int(clips.labelled.sum()), "objects": len(np.unique(clips.objects[clips.labelled]))}
    figures["abstention"] = {"touches": abstained(joint, peaks), "untouched gels": abstained(joint, gels)}
    figures["recordings"] = {"of": count, **of_untrained(clips.probed(features), "mean")}
    if (presses := next(recordings.rglob(PRESSES), None)) is not None:
        with np.load(presses) as pack:
            frames = [frame.astype(np.float32) for frame in pack["imgs"]]
            rest = pack["f0"].astype(np.float32)
            place = torch.from_numpy(pack["touch_center"].astype(np.float64))
        features = embedded(square_pixels(frames, size))
        features["statistics"] = statistics([frame - rest for frame in frames])
        balls = {}
        for name, values in features.items():  # R^2 of both coordinates, each ball predicted from the others
            error = cross_predicted(torch.from_numpy(values), place, torch.arange(len(place))) - place
            balls[name] = {"place": (1.0 - error.square().mean(dim=0) / place.var(dim=0, correction=0)).mean().item()}
        figures["ball presses"] = {"of": {"touches": len(place)}, **of_untrained(balls, "place")}
    return figures


@torch.no_grad()
def abstained(joint: JointSpace, touches: np.ndarray) -> dict[str, float]:
    """Shares of uint8 touches (N, 3, S, S) that are called untouched, and unlike anything known."""
    model = joint.model
    reasons = list[str | None]()
    for part in torch.from_numpy(touches).split(256):
        reasons += model.encode_touches(normalise_pixels(part.float() / 255))[1]
    return {"touches": len(touches)} | {reason: reasons.count(reason) / len(touches) for reason in (UNTOUCHED, UNLIKE)}


def of_untrained(figures: Mapping[str, Mapping[str, float]], told: str) -> Figures:
    """The means of all untrained encoders in the place of each one's figures, and the bounds of what is `told`."""
    each = [one for name, one in figures.items() if name.startswith("untrained")]
    remaining = {name: one for name, one in figures.items() if not name.startswith("untrained")}
    means = {key: mean(one[key] for one in each) for key in each[0]}
    least, most = (bound(one[told] for one in each) for bound in (min, max))
    return {**remaining, "untrained": {**means, "least": least, "most": most}}


TURBO_ROWS: dict[str, tuple[Callable[..., Figures], str]] = {
    "touch-to-image": (touch_to_image_rows, "image"),
    "x-to-touch": (x_to_touch_rows, "touch"),
}
"""How a distilled pipeline is measured: the function, and what its classifier reads."""


# The command ----------------------------------------------------------------------------------------------------------


def measure(given: argparse.Namespace, cache: Path) -> Figures:
    """All that can be measured of what was given."""
    joint = JointSpace.from_folder(given.joint)
    folders = {"image": given.picture_classifier, "touch": given.touch_classifier}
    judges = {name: ContactClassifier.from_pretrained(place, dtype=torch.float32) for name, place in folders.items()}
    pipes = {name: quiet(name, family=given.family) for name in given.pipelines if given.family}
    seeds = [given.first_seed + number for number in range(given.seeds)]
    figures: Figures = {"split": given.split, "seeds": seeds, "touched_by": given.touched_by or "drawn"}
    if given.recordings:
        figures["real"] = real_figures(joint, given.recordings)
    rows = []
    for seed in seeds:
        contacts = held_out(cache, joint.processor, seed, given.split, given.touched_by, given.objects)
        found = joint_rows(joint, contacts, judges["touch"])
        drawn = (seed, given.each)
        if "touch-to-image" in pipes:
            found |= touch_to_image_rows(pipes["touch-to-image"], judges["image"], contacts, *drawn)
        if "stylization" in pipes:
            found |= restyled_rows(pipes["stylization"], judges["image"], contacts, *drawn)
        if "x-to-touch" in pipes and given.touched_by:
            found |= x_to_touch_rows(pipes["x-to-touch"], judges["touch"], contacts, *drawn)
        for name in [name for name in TURBO if name in pipes and given.touched_by]:
            rows_of, classifier = TURBO_ROWS[TURBO[name]]
            made = rows_of(pipes[name], judges[classifier], contacts, *drawn)
            found |= {f"in four evaluations, {key}": row for key, row in made.items()}
        if "touch-to-text" in pipes:
            found |= answer_rows(pipes["touch-to-text"], joint, contacts, given.each)
        if given.photos and seed == seeds[0]:
            figures["photos"] = photo_figures(pipes, contacts, given.photos, seed)
        rows.append(found)
    return {**figures, "rows": over_seeds(rows) if rows else {}}


def quality_figures(recordings: Path | None, photos: Path | None, seeds: int) -> Figures:
    """All that can be measured of the built-in family on the split that nothing was chosen by: of a GelSight's touches
    in range, and under "drawn" and "beyond" by sensors drawn anew, and beyond the ranges of training."""
    words = ["--family", str(weights.FAMILY), "--seeds", str(seeds), "--each", "4", "--objects", "12"]
    named = ["--touched-by", "gelsight"]
    for option, folder in {"--recordings": recordings, "--photos": photos}.items():
        named += [] if folder is None else [option, str(folder)]
    fewer = ["--pipelines", "touch-to-image", "touch-to-text"]
    with TemporaryDirectory() as scratch:
        figures = measure(arguments([*words, *named]), Path(scratch))
        figures["drawn"] = measure(arguments([*words, *fewer]), Path(scratch))["rows"]
        beyond = [*fewer, "x-to-touch", "--touched-by", "gelsight", "--split", "beyond"]
        figures["beyond"] = measure(arguments([*words, *beyond]), Path(scratch))["rows"]
    return figures


def arguments(words: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.quality")
    parser.add_argument("--joint", type=Path, help="folder of the joint space; the family's if left out")
    parser.add_argument("--family", type=Path, help="folder with the layout of the built-in one: what it makes")
    parser.add_argument("--picture-classifier", type=Path, default=weights.PICTURE_CLASSIFIER, help="folder")
    parser.add_argument("--touch-classifier", type=Path, default=weights.TOUCH_CLASSIFIER, help="folder")
    parser.add_argument("--recordings", type=Path, help=f"folder with {GELSIGHT}, and perhaps {PRESSES}")
    parser.add_argument("--touched-by", choices=SENSORS, help="whose touches are read; drawn ones if left out")
    parser.add_argument("--split", default="test", choices=("val", "test", "beyond"))
    parser.add_argument("--seeds", type=int, default=3, help="worlds")
    parser.add_argument("--objects", type=int, default=16, help="held-out objects of each material")
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--each", type=int, default=8, help="contacts of each material that are generated from")
    parser.add_argument(
        "--pipelines", nargs="+", choices=[*PIPELINES, *TURBO], help="whose figures; all of the family if left out"
    )
    parser.add_argument("--photos", type=Path, help="folder of whole photos to restyle")
    parser.add_argument("--cache", type=Path, help="where contacts are rendered to, and found again")
    parser.add_argument("-o", "--output", type=Path, help="JSON file")
    given = parser.parse_args(words)
    if given.joint is None and given.family is None:
        parser.error("name `--joint` or `--family`.")
    distilled = [name for name, of in TURBO.items() if given.family and (given.family / of / "turbo").is_dir()]
    given.pipelines = given.pipelines or [*PIPELINES, *distilled]
    given.joint = given.joint or given.family / weights.JOINT.name
    return given


def main(words: Sequence[str] | None = None) -> None:
    print_figures(arguments(words), measure)


if __name__ == "__main__":
    main()
