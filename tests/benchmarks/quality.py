"""What a joint space and a family are worth on the world and on real touches, each figure beside its controls.

    python -m tests.benchmarks.quality --joint runs/image_text/model runs/touch/model --textures SCANS -o quality.json
        the joint space alone: sensors that nobody has seen, objects and scans held out
    python -m tests.benchmarks.quality --family runs/family --textures SCANS
        and what its pipelines make, judged by its classifiers
    python -m tests.benchmarks.quality --joint runs/touch/model --recordings FOLDER --calibration FOLDER
        and real touches: `gelsight_objects.zip` of `adaptation`, and the ball presses of `calibration`

Every seed is a world of its own, with objects, sensors and noise of its own. Figures are means over seeds.
"""

import argparse
import json
import warnings
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from statistics import mean
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from rich.console import Console
from torch import Tensor

from tests.benchmarks import adaptation
from tests.benchmarks.calibration import PRESSES
from tests.benchmarks.measuring import Figures, quiet
from unitouch_gen import weights
from unitouch_gen.conditioning import EmbeddingBank
from unitouch_gen.errors import InvalidInputError, UnfamiliarInputWarning
from unitouch_gen.evaluation.attributes import attribute_agreement, controlled_agreement
from unitouch_gen.evaluation.controls import (
    UNTRAINED,
    Controlled,
    class_means,
    others,
    relief_statistics,
    statistics,
    untrained_like,
)
from unitouch_gen.evaluation.generated import (
    AMONG,
    RELIEF,
    ClassifierEvaluation,
    Row,
    attribute_columns,
    beside_class_means,
    generate,
    in_batches,
    load_classifier,
)
from unitouch_gen.evaluation.retrieval import retrieval
from unitouch_gen.evaluation.zero_shot import ZeroShotTouchClassifier, accuracy, expected_calibration_error
from unitouch_gen.files import write_file
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.models.classifier import ContactClassifier
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.models.out_of_distribution import UNLIKE, UNTOUCHED
from unitouch_gen.training.data import DrawnContacts
from unitouch_gen.training.data.drawn import GROUP, library
from unitouch_gen.training.data.embedded import FIRST_SEED, touch_embeddings
from unitouch_gen.training.data.held import Held, float_pixels, held_of
from unitouch_gen.world import ATTRIBUTES, FIRST_OBJECT, MATERIAL_NAMES, SENSORS, World
from unitouch_gen.world.draws import SHAPES

SCAN_OBJECTS, SCAN_CONTACTS = 90, 3
"""Objects of scans held out, which take turns, each at a scale of its own, and contacts of each."""

STRENGTHS = (1e-4, 1e-2, 1e-1, 1.0, 1e1)
"""Of ridge regressions, for each sample; the best is taken for everyone alike."""

AT_ONCE = 256

COARSE = 8
"""Fields a side whose brightness is a picture's layout."""


def held_out(
    cache: Path,
    processor: UniTouchProcessor,
    seed: int,
    split: str,
    textures: str | None,
    sensor: str | None = None,
    objects: int = 16,
) -> Held:
    """The held-out contacts of a world, under drawn sensors, or under a named one and a drawn one."""
    source = DrawnContacts(0 if sensor is None else 1, sensor, 1, 1, seed, textures, objects)
    return held_of(cache, processor, source, split)


@dataclass
class JointSpace:
    """Encoders of one space, which may lie in several folders: each modality is of the first that has it. The bank of
    pictures lies beside the first."""

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
        """Unit embeddings (N, D) of uint8 pictures or touches, or of log-mel clips."""
        parts = torch.from_numpy(np.array(values)).split(AT_ONCE)
        if modality == "touch":
            rows = [touch_embeddings(self.models["touch"], part.float() / 255)[0] for part in parts]
        elif modality == "audio":
            rows = [self.models["audio"].get_audio_features(part.float()[:, None]) for part in parts]
        else:
            rows = [self.models["image"].get_image_features(normalise_pixels(part.float() / 255)) for part in parts]
        return F.normalize(torch.cat(rows).float(), dim=1)


# The joint space ------------------------------------------------------------------------------------------------------


def joint_rows(joint: JointSpace, held: Held, touch_classifier: ContactClassifier | None) -> Row:
    """Material by zero-shot, and contacts told from others of their material."""
    seen, material, rows = held.seen, held.material, Row()
    size = min(AMONG, int(torch.bincount(material).min()))
    embeds = {
        name: joint.features(name, getattr(seen, name)) for name in ("touch", "image", "audio") if name in joint.models
    }
    real = None if touch_classifier is None else touch_classifier.observe(float_pixels(seen.touch))
    if "text" in joint.models:
        classifier = ZeroShotTouchClassifier(joint.models["text"], joint.processor, joint.embedding_bank)
        for name, features in embeds.items():
            controlled = (features, class_means(features, material), features[others(len(features))])
            named = [classifier.probabilities(values, name) for values in controlled]
            bound = accuracy(real.logits, material) if real is not None and name == "touch" else None
            rows[f"{name}: material"] = Controlled(*(accuracy(shares, material) for shares in named), bound)
            errors = [expected_calibration_error(shares, material) for shares in named]
            rows[f"{name}: calibration error"] = Controlled(*errors)
    if "touch" in embeds:
        touch, second, truth = embeds["touch"], joint.features("touch", seen.second), held.attributes
        unit = (truth - truth.mean(dim=(0, 1))) / truth.std(dim=(0, 1))
        told = retrieval(unit[:, 0], unit[:, 1], material, size=size)  # by one who reads every attribute exactly
        rows["touch to its touch by another sensor, within material"] = found_within(
            touch, second, material, size, told
        )
        if "image" in embeds:
            rows["touch to its picture, within material"] = found_within(touch, embeds["image"], material, size)
        fifths = torch.from_numpy(np.asarray(seen.object) % 5)
        read, known = cross_predicted(touch, truth[:, 0], fifths), real is not None and touch_classifier.attributes
        usual = torch.empty_like(truth[:, 0])
        for fifth in fifths.unique():
            fit, asked = fifths != fifth, fifths == fifth
            usual[asked] = class_means(truth[fit, 0], material[fit], material[asked])
        agreed = controlled_agreement(read, truth[:, 0], usual, real.attributes if known else None, ATTRIBUTES)
        rows |= {f"touch, read linearly: {name}": figure for name, figure in agreed.items()}
    return rows


def found_within(
    queries: Tensor, gallery: Tensor, labels: Tensor, size: int, ceiling: float | None = None
) -> Controlled:
    find = partial(retrieval, gallery=gallery, labels=labels, size=size)
    return Controlled(find(queries), find(class_means(queries, labels)), find(queries[others(len(queries))]), ceiling)


def cross_predicted(features: Tensor, targets: Tensor, groups: Tensor) -> Tensor:
    """Targets (N, K) by ridge regression on features (N, D), each of the groups (N,) predicted from the others."""
    x = (features.double() - features.double().mean(dim=0)) / (features.double().std(dim=0) + 1e-6)
    y = targets.double()
    best, least = y, float("inf")
    for strength in STRENGTHS:
        predicted = torch.empty_like(y)
        for group in groups.unique():
            fit, asked = groups != group, groups == group
            centre = y[fit].mean(dim=0)
            gram = x[fit].T @ x[fit] + strength * int(fit.sum()) * torch.eye(x.shape[1], dtype=torch.float64)
            predicted[asked] = x[asked] @ torch.linalg.solve(gram, x[fit].T @ (y[fit] - centre)) + centre
        if (error := float(((predicted - y) ** 2).mean(dim=0).div(y.var(dim=0)).mean())) < least:
            best, least = predicted, error
    return best.to(targets)


# Scanned materials held out -------------------------------------------------------------------------------------------


class Scans(World):
    """Flat contacts with scanned materials of the split "test", which take turns by object."""

    def __init__(self, seed: int, **options: Any):
        super().__init__(seed, **options)
        assert self.textures is not None
        numbers = [number for group in self.textures.by_split["test"].values() for number in group]
        self.held = [number for number in numbers if self.textures.textures[number].material in MATERIAL_NAMES]
        if not self.held:
            raise InvalidInputError("`textures` holds no material of the split 'test'; a class needs three of them.")

    def names(self) -> tuple[Tensor, Tensor, Tensor]:
        """Material, object and contact of each, (N,); objects are of trained ranges, as the materials are held out."""
        grid = torch.cartesian_prod(torch.arange(SCAN_OBJECTS), torch.arange(SCAN_CONTACTS))
        scans = [self.textures.textures[self.held[number % len(self.held)]] for number in grid[:, 0].tolist()]  # type: ignore[union-attr]
        material = torch.tensor([MATERIAL_NAMES.index(scan.material) for scan in scans])
        return material, FIRST_OBJECT["val"] + grid[:, 0], grid[:, 1]

    def draw(self, material: Tensor, object_: Tensor, contact: Tensor) -> Any:
        draws = super().draw(material, object_, contact)
        texture = torch.tensor(
            [self.held[number % len(self.held)] for number in (object_ - FIRST_OBJECT["val"]).tolist()]
        )
        flat = torch.full_like(draws.shape, list(SHAPES).index("flat"))
        return draws.but(texture=texture, shape=flat)


@dataclass
class Patches:
    """Patches of scanned materials: pictures and touches (N, 3, S, S), attributes (N, 13) by sensor."""

    scan: Tensor
    image: Tensor
    touch: Tensor
    by_sensor: dict[str, tuple[Tensor, Tensor]]


def patches(source: DrawnContacts, size: int, sensors: Sequence[str]) -> Patches:
    """Patches of materials held out, under a drawn sensor and under named ones."""
    world = Scans(source.seed, textures=library(source.textures), image_size=size)
    names = world.names()
    images, touches, named = [], [], defaultdict[str, list[tuple[Tensor, Tensor]]](list)
    for start in range(0, len(names[0]), GROUP):
        first, _ = source.pair("test", 10**4 + start // GROUP)  # that no contact of the world is under
        scene = world.render(
            *(part[start : start + GROUP] for part in names),
            modalities=("image", "touch", "attributes"),
            sensors=[first, *(SENSORS[name] for name in sensors)],
        )
        images.append(scene.image)
        touches.append(scene.touch[first.name])
        for name in sensors:
            named[name].append((scene.touch[name], scene.attributes[name]))
    return Patches(
        (names[1] - FIRST_OBJECT["val"]) % len(world.held),
        torch.cat(images),  # type: ignore[arg-type]
        torch.cat(touches),
        {name: tuple(map(torch.cat, zip(*parts, strict=True))) for name, parts in named.items()},  # type: ignore[misc]
    )


def scan_rows(joint: JointSpace, shown: Patches) -> Row:
    """Touches to their own picture among patches of all scans; the class mean is that of a scan."""
    touch, image = (
        joint.features(name, (values * 255).round().byte().numpy())
        for name, values in (("touch", shown.touch), ("image", shown.image))
    )
    together = torch.zeros_like(shown.scan)
    find = partial(retrieval, gallery=image, labels=together, size=min(AMONG, len(image)))
    by_scan, other = class_means(touch, shown.scan), touch[others(len(touch))]
    return {"scan: touch to its own picture": Controlled(find(touch), find(by_scan), find(other))}


# What is generated ----------------------------------------------------------------------------------------------------


def touch_to_image_rows(pipe: Any, classifier: ContactClassifier, held: Held, each: int, **options: Any) -> Row:
    """Pictures of touches by sensors that nobody has seen."""
    rows, image = held.some(each), float_pixels(held.seen.image)
    truth = held.attributes.mean(dim=1)[:, attribute_columns(classifier)]
    again = held.relit(image.shape[-1])[rows]
    judged = ClassifierEvaluation(
        classifier, rows, held.material, truth, classifier.observe(image), classifier.observe(again)
    )
    embeds = in_batches(pipe.encode_touch, touch=float_pixels(held.seen.touch))
    made = [
        generate(pipe, held.source.seed, {"touch_embeds": values}, **options)
        for values in beside_class_means(embeds, held.material, rows)
    ]
    return judged.figures("touch to picture", *made)


def x_to_touch_rows(
    pipe: Any,
    classifier: ContactClassifier,
    held: Held,
    each: int,
    modalities: Sequence[str] = ("image", "text", "audio"),
    **options: Any,
) -> Row:
    """Touches by a named sensor, of pictures, captions and sounds."""
    seen, rows, figures = held.seen, held.some(each), Row()
    judged = ClassifierEvaluation(
        classifier, rows, held.material, held.attributes[:, 0, attribute_columns(classifier)],
        classifier.observe(float_pixels(seen.touch)), classifier.observe(float_pixels(seen.second)[rows]),
    )  # fmt: skip
    inputs: dict[str, Callable[[], Any]] = {
        "image": lambda: float_pixels(seen.image), "text": lambda: seen.text, "audio": held.sounds,
    }  # fmt: skip
    for modality in modalities:
        embeds = in_batches(pipe.encode_condition, **{modality: inputs[modality]()})
        made = [
            generate(pipe, held.source.seed, {"condition_embeds": one}, sensor=held.source.sensor, **options)
            for one in beside_class_means(embeds, held.material, rows)
        ]
        figures |= judged.figures(f"{NAMES[modality]} to touch", *made)
    return figures


NAMES = {"image": "photo", "text": "caption", "audio": "sound"}


def restyled_rows(pipe: Any, classifier: ContactClassifier, held: Held, each: int, **options: Any) -> Row:
    """Photos restyled by touches of other materials, by default and from noise alone, and as they were.

    Of the layout it is the correlation of the brightness with the photo's; of the relief the mean correlation of what
    is read from the picture with what is true of the touch, and the ceiling is that of the touch's own picture.
    """
    rows = held.some(each)
    touched, names = rows.roll(each), [name for name in RELIEF if name in classifier.attributes]
    photos, touches = float_pixels(held.seen.image)[rows], float_pixels(held.seen.touch)[touched]
    truth = held.attributes.mean(dim=1)[touched][:, [ATTRIBUTES.index(name) for name in names]]

    def relief_in(images: Tensor) -> float:
        read = classifier.observe(images).attributes[:, [classifier.attributes.index(name) for name in names]]
        return mean(attribute_agreement(read, truth, names).values())

    restyle = partial(generate, pipe, held.source.seed, {"image": photos, "touch": touches}, **options)
    shown = {
        "photo as it was": photos, "restyled photo": restyle(), "restyled from noise": restyle(init_strength=1.0),
    }  # fmt: skip
    elsewhere, figures = others(len(rows)), Row()
    for name, images in shown.items():
        kept = [layout_kept(images, values) for values in (photos, photos[elsewhere])]
        figures[f"{name}: layout kept"] = Controlled(kept[0], None, kept[1])
        if names:
            real = float_pixels(held.seen.image)[touched]
            seen = [relief_in(values) for values in (images, images[elsewhere], real)]
            figures[f"{name}: relief of the touch"] = Controlled(seen[0], None, *seen[1:])
    return figures


def layout_kept(made: Tensor, photos: Tensor) -> float:
    """Mean correlation of the brightness of images (N, 3, H, W) with that of as many others, on 8 x 8 fields."""
    coarse = (F.adaptive_avg_pool2d(values.mean(dim=1), COARSE).flatten(1) for values in (made, photos))
    return F.cosine_similarity(*(values - values.mean(dim=1, keepdim=True) for values in coarse)).mean().item()


def photo_rows(pipe: Any, classifier: ContactClassifier, shown: Patches, sensor: str, each: int, **options: Any) -> Row:
    """Touches of pictures of scans held out, against those of their height maps; the class mean is that of a scan."""
    rows = torch.cat([torch.nonzero(shown.scan == number)[:each, 0] for number in shown.scan.unique()])
    touch, truth = (values[rows] for values in shown.by_sensor[sensor])
    seed = int(options.pop("seed"))
    made = generate(pipe, seed, {"image": shown.image[rows]}, sensor=sensor, **options)
    seen, real = classifier.observe(made), classifier.observe(touch)
    one, other = seen.logits.argmax(dim=1), real.logits.argmax(dim=1)
    alike = [(values == other).float().mean().item() for values in (one, one[others(len(one))])]
    figures = {"scan, photo to touch: named as its touch": Controlled(alike[0], None, alike[1])}
    if classifier.attributes:
        rest = torch.ones(len(shown.scan), dtype=torch.bool)
        rest[rows] = False
        usual = class_means(shown.by_sensor[sensor][1][rest], shown.scan[rest], shown.scan[rows])
        columns = attribute_columns(classifier)
        agreed = controlled_agreement(
            seen.attributes, truth[:, columns], usual[:, columns], real.attributes, classifier.attributes
        )
        figures |= {f"scan, photo to touch: {key}": figure for key, figure in agreed.items()}
    return figures


# Real touches ---------------------------------------------------------------------------------------------------------


def real_figures(joint: JointSpace, recordings: Path | None, calibration: Path | None) -> Figures:
    """Probes of real touches, beside plain statistics, the untouched gel and untrained encoders."""
    figures: Figures = {}
    untrained = {
        f"untrained {seed}": JointSpace({"touch": untrained_like(joint.models["touch"], seed)}, joint.processor)
        for seed in range(UNTRAINED)
    }
    size = joint.processor.image_size
    if recordings is not None:
        clips = adaptation.Clips.read(recordings / adaptation.GELSIGHT)
        peaks, gels = (adaptation.square_pixels(frames, size)[clips.labelled] for frames in (clips.peaks, clips.gels))
        found = {
            "touch encoder": joint.features("touch", peaks),
            "untouched gel": joint.features("touch", gels),
            **{name: encoder.features("touch", peaks) for name, encoder in untrained.items()},
            "statistics of the relief": torch.from_numpy(relief_statistics(float_pixels(peaks))),
        }
        doubles = {name: features.double().numpy() for name, features in found.items()}
        count = {"touches": len(peaks), "objects": len(np.unique(clips.objects[clips.labelled]))}
        seen = {"touches": clips.peaks, "untouched gels": clips.gels}
        figures["abstention"] = {
            name: abstained(joint, adaptation.square_pixels(frames, size)) for name, frames in seen.items()
        }
        figures["recordings"] = {"of": count, **of_untrained(clips.probed(doubles, clips.labelled), "mean")}
    if calibration is not None:
        with np.load(calibration / PRESSES) as pack:
            frames = [frame.astype(np.float32) for frame in pack["imgs"]]
            rest = pack["f0"].astype(np.float32)
            place = torch.from_numpy(pack["touch_center"].astype(np.float64))
        pixels = adaptation.square_pixels(frames, size)
        found = {
            "touch encoder": joint.features("touch", pixels),
            **{name: encoder.features("touch", pixels) for name, encoder in untrained.items()},
            "statistics": torch.from_numpy(statistics([frame - rest for frame in frames])),
            "statistics of the relief": torch.from_numpy(relief_statistics(float_pixels(pixels))),
        }
        balls = {name: _balls(features, place) for name, features in found.items()}
        figures["ball presses"] = {"of": {"touches": len(place)}, **of_untrained(balls, "place")}
    return figures


@torch.no_grad()
def abstained(joint: JointSpace, touches: Any) -> dict[str, float]:
    """Shares of uint8 touches (N, 3, S, S) that are called untouched, and unlike anything known."""
    model, reasons = joint.models["touch"], list[str | None]()
    for part in torch.from_numpy(touches).split(AT_ONCE):
        pixels = normalise_pixels(part.float() / 255)
        reasons += model.unknown_touches(pixels)
    return {"touches": len(touches)} | {reason: reasons.count(reason) / len(touches) for reason in (UNTOUCHED, UNLIKE)}


def of_untrained(figures: Mapping[str, Mapping[str, float]], told: str) -> Figures:
    """The means of all untrained encoders in the place of each one's figures, and the bounds of what is `told`."""
    each = [one for name, one in figures.items() if name.startswith("untrained")]
    rest = {name: one for name, one in figures.items() if not name.startswith("untrained")}
    means = {key: mean(one[key] for one in each) for key in each[0]}
    least, most = (bound(one[told] for one in each) for bound in (min, max))
    return {**rest, "untrained": {**means, "least": least, "most": most}}


def _balls(features: Tensor, place: Tensor) -> dict[str, float]:
    """R^2 of both coordinates, each ball predicted from the others. Radii tell nothing: 47 of the 49 are the same."""
    errors = cross_predicted(features, place, torch.arange(len(place))) - place
    return {"place": (1.0 - errors.square().mean(dim=0) / place.var(dim=0, correction=0)).mean().item()}


# The command ----------------------------------------------------------------------------------------------------------


def over_seeds(rows: Sequence[Row]) -> dict[str, dict[str, float | None]]:
    """Means over seeds, and the spread of the figure: its largest less its least."""
    figures = {}
    for name in rows[0]:
        each = [asdict(row[name]) for row in rows]
        means = {key: None if value is None else mean(one[key] for one in each) for key, value in each[0].items()}
        values = [one["value"] for one in each]
        figures[name] = {**means, "spread": max(values) - min(values)}
    return figures


def measure(given: argparse.Namespace, cache: Path) -> Figures:
    """All that can be measured of what was given."""
    joint = JointSpace.from_folders(given.joint)
    classifiers = {name: load_classifier(folder) for name, folder in given.classifiers.items()}
    size, textures = joint.processor.image_size, given.textures and str(given.textures)
    pipes = {} if given.family is None else {
        name: quiet(name, family=given.family) for name in ("touch-to-image", "stylization", "x-to-touch")
    }  # fmt: skip
    sensor = next((name for name in pipes["x-to-touch"].config.sensors if name in SENSORS), None) if pipes else None
    options = {} if given.steps is None else {"num_inference_steps": given.steps}
    seeds = [given.first_seed + number for number in range(given.seeds)]
    figures: Figures = {"split": given.split, "seeds": seeds, "sensor": sensor, "textures": textures is not None}
    if given.recordings or given.calibration:
        figures["real"] = real_figures(joint, given.recordings, given.calibration)
    rows = []
    for seed in seeds:
        held = held_out(cache, joint.processor, seed, given.split, textures, objects=given.objects)
        found = joint_rows(joint, held, classifiers.get("touch"))
        if textures is not None and {"touch", "image"} <= set(joint.models):
            shown = patches(held.source, size, [] if sensor is None else [sensor])
            found |= scan_rows(joint, shown)
        if pipes:
            judge = classifiers["image"]
            found |= touch_to_image_rows(pipes["touch-to-image"], judge, held, given.each, **options)
            found |= restyled_rows(pipes["stylization"], judge, held, given.each, **options)
        if sensor is not None:
            by_name = held_out(cache, joint.processor, seed, given.split, textures, sensor, given.objects)
            to_touch, judge = pipes["x-to-touch"], classifiers["touch"]
            found |= x_to_touch_rows(to_touch, judge, by_name, given.each, **options)
            if textures is not None:
                found |= photo_rows(to_touch, judge, shown, sensor, given.each, seed=seed, **options)
        rows.append(found)
    return {**figures, "rows": over_seeds(rows)}


def quality_figures(textures: Path | None, recordings: Path | None, calibration: Path | None, seeds: int) -> Figures:
    """All that can be measured of the built-in family on the split that nothing was chosen by."""
    words: list[Any] = ["--family", weights.FAMILY, "--seeds", seeds, "--each", 4, "--objects", 10]
    for option, folder in {"textures": textures, "recordings": recordings, "calibration": calibration}.items():
        words += [] if folder is None else [f"--{option}", folder]
    with TemporaryDirectory() as scratch:
        return measure(arguments([str(word) for word in words]), Path(scratch))


def printed(figures: Figures) -> str:
    """A line for each figure."""

    def digits(value: float | None) -> str:
        return "-" if value is None else f"{value:.3f}"

    keys = ("value", "spread", "class_mean", "shuffled", "ceiling")
    lines = [f"Split {figures['split']}, worlds {figures['seeds']}: figure, {', '.join(keys)}"]
    lines += [f"{name}: {', '.join(digits(row[key]) for key in keys)}" for name, row in figures["rows"].items()]
    for name, found in figures.get("real", {}).items():
        for key, row in found.items():
            lines.append(f"{name}, {key}: {', '.join(f'{what} {digits(value)}' for what, value in row.items())}")
    return "\n".join(lines)


def arguments(words: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.quality")
    parser.add_argument("--joint", nargs="+", type=Path, help="folders of the joint space; the family's if left out")
    parser.add_argument("--family", type=Path, help="folder with the layout of the built-in one: what it makes")
    parser.add_argument("--picture-classifier", type=Path, help="folder; the family's if left out")
    parser.add_argument("--touch-classifier", type=Path, help="folder; the family's if left out")
    parser.add_argument("--textures", type=Path, help="folder of scanned materials")
    parser.add_argument("--recordings", type=Path, help=f"folder with {adaptation.GELSIGHT}")
    parser.add_argument("--calibration", type=Path, help=f"folder with {PRESSES}")
    parser.add_argument("--split", default="test", choices=("val", "test"))
    parser.add_argument("--seeds", type=int, default=3, help="worlds")
    parser.add_argument("--objects", type=int, default=16, help="held-out objects of each material")
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--each", type=int, default=8, help="contacts of each material that are generated from")
    parser.add_argument("--steps", type=int, help="of the samplers; the family's own if left out")
    parser.add_argument("--cache", type=Path, help="where contacts are rendered to, and found again")
    parser.add_argument("-o", "--output", type=Path, help="JSON file")
    given = parser.parse_args(words)
    if given.joint is None and given.family is None:
        parser.error("name `--joint` or `--family`.")
    given.joint = given.joint or [given.family / weights.JOINT.name]
    given.classifiers = {}
    for modality, own, folder in (
        ("image", given.picture_classifier, weights.PICTURE_CLASSIFIER),
        ("touch", given.touch_classifier, weights.TOUCH_CLASSIFIER),
    ):
        if chosen := own or (given.family and given.family / folder.name):
            given.classifiers[modality] = chosen
    for option, file in {"recordings": adaptation.GELSIGHT, "calibration": PRESSES}.items():
        folder = getattr(given, option)
        if folder is not None and not (folder / file).is_file():
            parser.error(f"`--{option}` is {str(folder)!r}, which holds no {file}.")
    return given


def main(words: Sequence[str] | None = None) -> None:
    given = arguments(words)
    warnings.simplefilter("ignore", UnfamiliarInputWarning)  # which sensors drawn anew are
    with TemporaryDirectory() as scratch:
        figures = measure(given, given.cache or Path(scratch))
    if given.output is not None:
        write_file("output", given.output, json.dumps(figures, indent=2) + "\n")
    Console(width=160, soft_wrap=True).print(printed(figures), markup=False, highlight=False)


if __name__ == "__main__":
    main()
