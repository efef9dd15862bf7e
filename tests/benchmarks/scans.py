"""What a family knows of scanned surfaces and recorded sounds that nothing was trained on, beside its controls.

    python -m tests.benchmarks.scans --family runs/family -o scans.json
        a joint space, and what its pipelines make of photos and touches
    python -m tests.benchmarks.scans --joint runs/texture/model
        a joint space alone

The collection holds out 45 surfaces with heights. Surfaces that may be of one asset count once, which leaves 43 of 15
materials; glass and rubber have none. Every seed is a world of its own that draws sizes, places and noise of five flat
contacts of each. One is found among 40 if it comes first among 40 different surfaces, as expected over all draws of the
others. Materials are named among all 17, and shares are balanced over the 15.
"""

import argparse
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import mean
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from sklearn.linear_model import RidgeCV
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from torch import Tensor
from torch.nn import functional as F
from tqdm.auto import tqdm

from tests.benchmarks.joint_space import JointSpace
from tests.benchmarks.measuring import Figures, over_seeds, print_figures, quiet
from unitouch_gen import weights
from unitouch_gen.errors import UnfamiliarInputWarning
from unitouch_gen.evaluation.controls import class_means, others
from unitouch_gen.evaluation.generated import generate
from unitouch_gen.evaluation.metrics import cosines, frechet_distance, linear_probe, retrieval, share_right
from unitouch_gen.evaluation.zero_shot import PROMPTS
from unitouch_gen.models.autoencoders import decode, encode
from unitouch_gen.models.classifier import ContactClassifier
from unitouch_gen.models.features import float_pixels, in_batches
from unitouch_gen.models.images import local_mean
from unitouch_gen.models.texture import TextureTrunk
from unitouch_gen.training.data import DrawnContacts
from unitouch_gen.training.data.contacts import SPLITS, Contacts
from unitouch_gen.training.data.heldout import FIRST_SEED, world_contacts
from unitouch_gen.training.texture import read_trunk, texture_statistics
from unitouch_gen.world import MATERIAL_NAMES, SAMPLE_RATE, SENSORS, Sensor, World
from unitouch_gen.world.draws import SHAPES, Draws
from unitouch_gen.world.recordings import recordings
from unitouch_gen.world.scans import scanned_surfaces, surfaces_of

AMONG = 40
"""Surfaces that each one is found among."""

FIRST = 5
"""Places within which a spectrum counts as found."""

ROUNDS = 5
"""Contacts of each held-out object."""

ENCODERS = {"image": "image", "touch": "touch", "second": "touch"}
"""Columns of contacts, and the encoder of each: pictures, touches by a GelSight, touches by a DIGIT."""

NAMED = {"image": "image", "touch": "touch", "second": "touch by a DIGIT"}

FOUND = {
    "touch to its picture": ("touch", "image"),
    "touch by a DIGIT to its picture": ("second", "image"),
    "touch to its touch by a DIGIT": ("touch", "second"),
}
"""What is found by what: columns of the queries and of the gallery."""

RECORDED = "recorded sound: material"


# Contacts -------------------------------------------------------------------------------------------------------------


class FlatFaces(World):
    """The same contacts, all of flat faces: edges and bodies would tell them apart whatever their surface."""

    def draw(self, material: Tensor, object_: Tensor, contact: Tensor) -> Draws:
        draws = super().draw(material, object_, contact)
        return draws.but(shape=torch.full_like(draws.shape, list(SHAPES).index("flat")))


@dataclass(frozen=True)
class TwoSensors(DrawnContacts):
    """Flat contacts of a GelSight, each touched by a DIGIT, too."""

    def world(self, size: int = 128, kind: type[World] = FlatFaces) -> World:
        return super().world(size, FlatFaces)

    def pair(self, split: str, group: int) -> tuple[Sensor, Sensor]:
        return SENSORS["gelsight"], SENSORS["digit"]


def scanned_contacts(seed: int, train_objects: int, number: int = 0) -> TwoSensors:
    """Scanned objects of a world; those held out of each material show all of its surfaces."""
    most = max(len(surfaces_of(material, "test")) for material in range(len(MATERIAL_NAMES)))
    return TwoSensors(number, "gelsight", train_objects, 2, seed, most, scanned=1.0)


def rounds_of(source: DrawnContacts) -> Tensor:
    """Rows of held-out contacts, int64 (R, G): R contacts of one object of each of G surfaces.

    Of surfaces that may be of one asset, one is taken.
    """
    _, objects, contacts = (values.tolist() for values in source.contacts("test"))
    groups = {surface.name: surface.group for surface in scanned_surfaces()}
    rows: dict[str, dict[int, dict[int, int]]] = {}
    for row, name in enumerate(source.surfaces("test")):
        shown = rows.setdefault(groups[str(name)], {}).setdefault(objects[row], {})
        shown[contacts[row]] = row
    first = [of_objects[min(of_objects)] for of_objects in rows.values()]
    return torch.tensor([[one[contact] for contact in range(ROUNDS)] for one in first]).T


@dataclass
class Seen:
    """Contacts of a split and, by column of `ENCODERS`, embeddings (N, D) and the trunk's statistics (N, 528)."""

    contacts: Contacts
    embeds: dict[str, Tensor] = field(default_factory=dict)
    statistics: dict[str, Tensor] = field(default_factory=dict)  # empty where there is no trunk


def see(joint: JointSpace, trunk: TextureTrunk | None, contacts: Contacts) -> Seen:
    seen = Seen(contacts)
    for column, encoder in ENCODERS.items():
        images = getattr(contacts, column)
        seen.embeds[column] = joint.features(encoder, images)
        if trunk is not None:
            seen.statistics[column] = texture_statistics(trunk, images)
    return seen


# What the joint space knows -------------------------------------------------------------------------------------------


def named_row(
    joint: JointSpace,
    encoder: str,
    embeds: Mapping[str, Tensor],
    materials: Mapping[str, Tensor],
    statistics: Mapping[str, Tensor] | None = None,
) -> dict[str, float]:
    """Share of the split "test" whose material is named by text, beside its controls; by split (N, D) and int64 (N,).

    The class mean is that of the training split's embeddings of the true material. The ceiling is a linear probe of the
    embeddings, the teacher the same probe of the trunk's statistics. Both are fitted to the training split.
    """
    known = materials["test"]
    texts = joint.features("text", [PROMPTS[encoder].format(name) for name in MATERIAL_NAMES])
    named = cosines(embeds["test"], texts).argmax(dim=1)
    means = class_means(embeds["train"], materials["train"], known)
    predicted = {
        "value": named,
        "class_mean": cosines(means, texts).argmax(dim=1),
        "shuffled": named[others(len(named))],
        "ceiling": probed(embeds, materials),
    }
    if statistics is not None:
        predicted["teacher"] = probed(statistics, materials)
    row = {name: share_right(labels, known, balanced=True) for name, labels in predicted.items()}
    return {**row, "chance": 1 / len(MATERIAL_NAMES)}


def probed(features: Mapping[str, Tensor], materials: Mapping[str, Tensor]) -> Tensor:
    """Materials (N,) of the split "test" by a linear probe; features and labels by split."""
    train, val, test = (features[split] for split in SPLITS)
    return linear_probe(train, materials["train"], val, materials["val"], test, balanced=True)


def found_among(queries: Tensor, gallery: Tensor, first: int = 1) -> float:
    """Share of queries (R, G, D) whose own surface is among the `first` of 40 in its round of the gallery."""
    labels = torch.zeros(gallery.shape[1], dtype=torch.int64)
    rounds = zip(queries, gallery, strict=True)
    return mean(retrieval(one, other, labels, size=AMONG, first=first) for one, other in rounds)


def found_row(queries: Tensor, gallery: Tensor, means: Tensor, first: int = 1) -> dict[str, float]:
    """`found_among`, beside its controls.

    Args:
        queries: Of the first E rounds, (E, G, D).
        gallery: Of all R rounds, (R, G, D), at least two.
        means: What stands for the material alone, (E, G, D).
        first: Places that count.

    Returns:
        The ceiling is what the gallery holds of another contact of the same surface.
    """
    rounds, surfaces = queries.shape[:2]
    stored = gallery[:rounds]
    columns = {
        "value": queries,
        "class_mean": means,
        "shuffled": queries[:, others(surfaces)],
        "ceiling": gallery.roll(1, 0)[:rounds],
    }
    row = {name: found_among(values, stored, first) for name, values in columns.items()}
    return {**row, "chance": first / AMONG}


def read_linearly(known: tuple[Tensor, Tensor], asked: Tensor, gallery: Tensor) -> tuple[Tensor, Tensor]:
    """Queries (N, D) as ridge regression brings them to a gallery (M, E), and the gallery, in deviations.

    It is fitted to known pairs, (K, D) and (K, E).
    """
    source, target = (part.double().numpy() for part in known)
    scaler = StandardScaler().fit(target)
    ridge = make_pipeline(StandardScaler(), RidgeCV(np.logspace(0, 6, 13))).fit(source, scaler.transform(target))
    predicted = ridge.predict(asked.double().numpy())
    stored = scaler.transform(gallery.double().numpy())
    return torch.from_numpy(predicted), torch.from_numpy(stored)


def joint_rows(joint: JointSpace, splits: Mapping[str, Seen], rounds: Tensor) -> Figures:
    """Materials by text; and pictures and touches of the same contact, each found among 40 surfaces."""
    rows = {"train": slice(None), "val": slice(None), "test": rounds.flatten()}
    materials = {split: splits[split].contacts.material[rows[split]] for split in SPLITS}
    train = splits["train"]
    test = splits["test"]
    figures = Figures()
    for column, name in NAMED.items():
        embeds = {split: splits[split].embeds[column][rows[split]] for split in SPLITS}
        statistics = None
        if test.statistics:
            statistics = {split: splits[split].statistics[column][rows[split]] for split in SPLITS}
        figures[f"{name}: material"] = named_row(joint, ENCODERS[column], embeds, materials, statistics)
    for name, (column, other) in FOUND.items():
        means = class_means(train.embeds[column], materials["train"], materials["test"]).unflatten(0, rounds.shape)
        row = found_row(test.embeds[column][rounds], test.embeds[other][rounds], means)
        if test.statistics:
            known = (train.statistics[column], train.statistics[other])
            asked = (values[rows["test"]] for values in (test.statistics[column], test.statistics[other]))
            read, stored = (values.unflatten(0, rounds.shape) for values in read_linearly(known, *asked))
            row["teacher"] = found_among(read, stored)
        figures[f"{name}, among {AMONG}"] = row
    return figures


def sound_figures(joint: JointSpace) -> tuple[dict[str, float], dict[str, int]]:
    """Materials of recorded hits of kinds that are held out, named by text; and how many there are.

    Sounds are as they were recorded, so no seed changes them. The collection holds out one kind of hit, with five
    takes, of each of four materials: glass, metal, tile and wood.
    """
    takes = {split: [one for one in recordings() if one.split == split] for split in SPLITS}
    embeds = dict[str, Tensor]()
    materials = dict[str, Tensor]()
    for split, found in takes.items():
        clips = joint.processor.sounds([(one.samples, SAMPLE_RATE) for one in found])
        embeds[split] = joint.features("audio", clips[:, 0])
        materials[split] = torch.tensor([MATERIAL_NAMES.index(one.material) for one in found])
    heldout = takes["test"]
    count = {
        "takes": len(heldout),
        "kinds": len({one.group for one in heldout}),
        "materials": len({one.material for one in heldout}),
    }
    return named_row(joint, "audio", embeds, materials), count


# What is generated ----------------------------------------------------------------------------------------------------


def log_spectrum(images: Tensor) -> Tensor:
    """The log spectrum of textures: images (N, 3, S, S) in [0, 1] -> (N, S / 4 * S / 8), S a multiple of 8.

    The grey level less its mean over 33 x 33 pixels, under a Hann window; the log of its Fourier power, averaged over
    4 x 4 frequencies. Rows are frequencies from top to bottom, in the order of `torch.fft.fft2`, columns those from
    left to right that are not negative, as images are real. It does not see where in the picture a texture lies, and
    has no network of ours in it.
    """
    size = images.shape[-1]
    grey = images.mean(dim=1, keepdim=True)
    window = torch.hann_window(size)
    detail = (grey - local_mean(grey, 16)) * window[:, None] * window
    power = torch.fft.rfft2(detail).abs().square()[..., : size // 2]
    return F.avg_pool2d(power, 4).clamp_min(1e-12).log().flatten(1)


def spectra_of(images: Any) -> Tensor:
    """Log spectra (N, K) of uint8 images (N, 3, S, S)."""
    return in_batches(len(images), lambda rows: log_spectrum(float_pixels(images[rows])))


def centred_spectra(images: Tensor) -> Tensor:
    """Log spectra (R, G, K) of R rounds of images (R, G, 3, S, S), less their mean over all of them."""
    spectra = log_spectrum(images.flatten(0, 1)).unflatten(0, images.shape[:2])
    return spectra - spectra.mean(dim=(0, 1))


def spectrum_row(made: Tensor, real: Tensor, rebuilt: Tensor, means: Tensor) -> dict[str, float]:
    """Share of images whose spectrum finds that of the true one among the first five of 40, beside its controls.

    Args:
        made: Generated images of the first E rounds, (E, G, 3, S, S).
        real: True images of all R rounds, (R, G, 3, S, S).
        rebuilt: The true ones of the first E rounds, encoded and decoded by the generator's autoencoder.
        means: The mean spectrum of each surface's material over the training split, (G, K).
    """
    stored = centred_spectra(real)
    of_material = (means - means.mean(dim=0)).expand(len(made), -1, -1)
    row = found_row(centred_spectra(made), stored, of_material, FIRST)
    row["reconstruction"] = found_among(centred_spectra(rebuilt), stored[: len(made)], FIRST)
    return row


@torch.no_grad()
def reconstructed(vae: Any, images: Tensor) -> Tensor:
    """Images (N, 3, S, S) in [0, 1], encoded and decoded."""
    return in_batches(len(images), lambda rows: as_stored(decode(vae, encode(vae, 2 * images[rows] - 1)) / 2 + 0.5), 32)


def as_stored(images: Tensor) -> Tensor:
    """Images in [0, 1] as files hold them, in 256 levels."""
    return (images.clamp(0.0, 1.0) * 255.0).round() / 255.0


@dataclass(frozen=True)
class Made:
    """What a pipeline makes: its name and its argument; columns of contacts that it takes and is held to."""

    pipeline: str
    argument: str
    taken: str
    truth: str
    options: Mapping[str, Any] = field(default_factory=dict)


MADE = {
    "photo to touch": Made("x-to-touch", "image", "image", "touch", {"sensor": "gelsight"}),
    "touch to picture": Made("touch-to-image", "touch", "touch", "image"),
}


def made_images(pipe: Any, name: str, given: Tensor, seed: int) -> Tensor:
    """What a pipeline of `MADE` makes of R rounds of contacts (R, G, 3, S, S)."""
    one = MADE[name]
    rounds = tqdm(given, f"world {seed}, {name}", mininterval=5)
    images = [
        generate(pipe, ROUNDS * seed + number, {one.argument: part}, **one.options)
        for number, part in enumerate(rounds)
    ]
    return as_stored(torch.stack(images))


def pictures_of_others(source: DrawnContacts, size: int) -> Tensor:
    """Pictures of other contacts of the same surfaces as those of `source`, (R, G, 3, S, S) in [0, 1]."""
    others = replace(source, number=source.number + 1)
    images = torch.cat([scene.image for scene, _ in others.rendered("test", size, "image")])
    return as_stored(images)[rounds_of(others)]


def frechet_row(classifier: ContactClassifier, pictures: Mapping[str, Tensor], real: Tensor) -> dict[str, float]:
    """Frechet distances of as many pictures (N, 3, S, S) to real ones, in the features of a classifier.

    The ceiling is that of two halves of the held-out pictures.
    """
    stored = classifier.observe(real).features
    return {name: frechet_distance(classifier.observe(one).features, stored) for name, one in pictures.items()}


# The command ----------------------------------------------------------------------------------------------------------


def measure(given: argparse.Namespace, cache: Path) -> Figures:
    """All that can be measured of a joint space, or of a family."""
    joint = JointSpace.from_folder(given.joint)
    trunk = read_trunk(given.trunk or given.joint)
    if trunk is None:
        print("Left out: the teacher's features, as this joint space has no trunk (--trunk FOLDER).", flush=True)
    pipes = {name: quiet(one.pipeline, family=given.family) for name, one in MADE.items() if given.family}
    seeds = [given.first_seed + number for number in range(given.seeds)]
    size = joint.processor.image_size
    rows = list[Figures]()

    def contacts_of(seed: int, split: str) -> Contacts:
        return world_contacts(cache, joint.processor, scanned_contacts(seed, given.train_objects), split)

    splits = {split: see(joint, trunk, contacts_of(seeds[0], split)) for split in ("train", "val")}
    train = splits["train"].contacts
    spectra = {one.truth: spectra_of(getattr(train, one.truth)) for name, one in MADE.items() if name in pipes}
    pictures: dict[str, list[Tensor]] = {"value": [], "ceiling": [], "reconstruction": [], "others": []}
    for seed in seeds:
        source = scanned_contacts(seed, given.train_objects)
        splits["test"] = see(joint, trunk, contacts_of(seed, "test"))
        contacts = splits["test"].contacts
        rounds = rounds_of(source)
        found = joint_rows(joint, splits, rounds)
        for name, pipe in pipes.items():
            one = MADE[name]
            taken, truth = (float_pixels(getattr(contacts, column))[rounds] for column in (one.taken, one.truth))
            made = made_images(pipe, name, taken[: given.each], seed)
            rebuilt = reconstructed(pipe.vae, truth[: given.each].flatten(0, 1)).view(made.shape)
            means = class_means(spectra[one.truth], train.material, contacts.material[rounds[0]])
            found[f"{name}: spectrum"] = spectrum_row(made, truth, rebuilt, means)
            if one.truth == "image":
                compared = {"value": made, "ceiling": truth, "reconstruction": rebuilt}
                compared["others"] = pictures_of_others(source, size)
                for key, images in compared.items():
                    pictures[key].append(images[: given.each].flatten(0, 1))
        rows.append(found)
        print(f"world {seed}:", {name: round(row["value"], 3) for name, row in found.items()}, flush=True)
    figures = over_seeds(rows)
    if pipes:
        classifier = ContactClassifier.from_pretrained(given.picture_classifier, dtype=torch.float32)
        real = torch.cat(pictures.pop("others"))
        shown = {name: torch.cat(parts) for name, parts in pictures.items()}
        figures["touch to picture: Frechet distance"] = frechet_row(classifier, shown, real)
    counts = {"surfaces": rounds.shape[1], "among": AMONG, "materials": len(contacts.material[rounds].unique())}
    if "audio" in joint.model.known_modalities:
        figures[RECORDED], counts["recorded"] = sound_figures(joint)
    return {"of": counts, "seeds": seeds, "each": given.each, "rows": figures}


def scans_figures(seeds: int, each: int, trunk: Path | None = None) -> Figures:
    """Figures of the built-in family; images are made of `each` contacts of each surface."""
    words = ["--family", str(weights.FAMILY), "--seeds", str(seeds), "--each", str(each)]
    words += [] if trunk is None else ["--trunk", str(trunk)]
    with TemporaryDirectory() as scratch, warnings.catch_warnings():
        warnings.simplefilter("ignore", UnfamiliarInputWarning)
        return measure(arguments(words), Path(scratch))


def arguments(words: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.scans")
    parser.add_argument("--joint", type=Path, help="folder of the joint space; the family's if left out")
    parser.add_argument("--family", type=Path, help="folder with the layout of the built-in one: what it makes")
    parser.add_argument("--trunk", type=Path, help="folder of a joint space with the teacher's trunk; `--joint`")
    parser.add_argument("--picture-classifier", type=Path, default=weights.PICTURE_CLASSIFIER, help="folder")
    parser.add_argument("--seeds", type=int, default=3, help="worlds")
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument(
        "--each", type=int, default=ROUNDS, choices=range(1, ROUNDS + 1), help="contacts of each surface to generate of"
    )
    parser.add_argument(
        "--train-objects", type=int, default=64, help="objects of each material, two contacts each, that probes see"
    )
    parser.add_argument("--cache", type=Path, help="where contacts are rendered to, and found again")
    parser.add_argument("-o", "--output", type=Path, help="JSON file")
    given = parser.parse_args(words)
    if given.joint is None and given.family is None:
        parser.error("name `--joint` or `--family`.")
    given.joint = given.joint or given.family / weights.JOINT.name
    return given


def main(words: Sequence[str] | None = None) -> None:
    print_figures(arguments(words), measure)


if __name__ == "__main__":
    main()
