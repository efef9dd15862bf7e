"""Images that were generated of contacts, held to what is true of these (Section 4.6 of the paper and its supplement).

Classifiers that share no weights with what conditioned the generator read pictures and touches. Each figure stands
beside that of the mean embedding of a class, that of other contacts' images, and that of real images.
"""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import mean
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from tqdm.auto import tqdm

from unitouch_gen.errors import InvalidInputError, first_line
from unitouch_gen.evaluation.attributes import attribute_agreement, controlled_agreement
from unitouch_gen.evaluation.controls import Controlled, class_means, others
from unitouch_gen.evaluation.frechet import frechet_distance
from unitouch_gen.evaluation.retrieval import correlated, retrieval
from unitouch_gen.evaluation.tables import Table
from unitouch_gen.evaluation.zero_shot import accuracy
from unitouch_gen.models.classifier import ContactClassifier, ContactClassifierOutput
from unitouch_gen.world import ATTRIBUTES

AMONG = 64
"""Contacts that each one is to be told from, at most."""

IMAGES_AT_ONCE, CONDITIONS_AT_ONCE = 64, 256

RELIEF = ("slope", "steepness", "fine relief", "coarse relief")
"""Attributes of the relief: what a touch shows of a surface whatever it is made of."""

Row = dict[str, Controlled]


def load_classifier(folder: Path) -> ContactClassifier:
    """A classifier in float32."""
    return ContactClassifier.from_pretrained(folder, dtype=torch.float32).eval()


def generate(pipe: Any, seed: int, inputs: Mapping[str, Any], **options: Any) -> Tensor:
    """An image (N, 3, H, W) for each of N inputs, arguments of the pipeline's call beside its options, in batches."""
    images = []
    count = len(next(iter(inputs.values())))
    starts = range(0, count, IMAGES_AT_ONCE)
    for number, start in enumerate(tqdm(starts, desc="images", mininterval=5.0, leave=False, disable=len(starts) < 2)):
        part = {name: values[start : start + IMAGES_AT_ONCE] for name, values in inputs.items()}
        generator = torch.Generator().manual_seed(seed * 1_000 + number)
        images.append(pipe(**part, **options, generator=generator, output_type="pt").images)
    return torch.cat(images)


def in_batches(encode: Callable[..., Tensor], **inputs: Any) -> Tensor:
    """What `encode` makes of inputs, a few at a time."""
    (count,) = {len(values) for values in inputs.values()}
    starts = range(0, count, CONDITIONS_AT_ONCE)
    parts = ({name: part[start : start + CONDITIONS_AT_ONCE] for name, part in inputs.items()} for start in starts)
    return torch.cat([encode(**part) for part in parts])


def beside_class_means(embeds: Tensor, labels: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    """Some rows of embeddings (N, ..., D), and of the mean embeddings of their classes, each as long as its own."""
    length = embeds.norm(dim=-1, keepdim=True)
    means = F.normalize(class_means(F.normalize(embeds, dim=-1), labels), dim=-1) * length
    return embeds[rows], means[rows]


def attribute_columns(classifier: ContactClassifier) -> list[int]:
    """Places in `ATTRIBUTES` of those that a classifier reads."""
    return [ATTRIBUTES.index(name) for name in classifier.attributes]


@dataclass
class ClassifierEvaluation:
    """Images of some contacts, what their classifier says of real ones, and where they are among all.

    Attributes:
        classifier: Of pictures or touches.
        rows: Of the contacts in the gallery.
        material: Of the gallery, int64 (N,) from 0.
        truth: Of the gallery, (N, K) of what the classifier reads; `None` where nobody measured it, and materials may
            be others than those that the classifier knows.
        seen: What it says of real images of all N contacts.
        met: The same of `rows` once more, under another lamp or sensor: what retrieval may reach; for `figures`.
    """

    classifier: ContactClassifier
    rows: Tensor
    material: Tensor
    truth: Tensor | None
    seen: Any  # a `ContactClassifierOutput` whose fields are all there
    met: Any = None

    def figures(self, name: str, made: Tensor, of_means: Tensor) -> Row:
        """Figures of images made of each contact, beside those of the mean embedding of its class."""
        rows, material, elsewhere = self.rows, self.material[self.rows], others(len(self.rows))
        seen: Any = self.classifier.observe(made)
        usual: Any = self.classifier.observe(of_means)
        rest, found = self.rest, self._found
        right = partial(accuracy, labels=material)
        apart = partial(frechet_distance, other=self.seen.features[rest])
        place = self._placed(seen)
        figures = {
            "material": Controlled(
                right(seen.logits), right(usual.logits), right(seen.logits[elsewhere]), right(self.seen.logits[rows])
            ),
            "contact within material": Controlled(
                found(place), found(self._placed(usual)), found(place[elsewhere]), found(self._placed(self.met))
            ),
            "Frechet distance": Controlled(
                apart(seen.features), apart(usual.features), None, apart(self.seen.features[rows])
            ),
        }
        if self.classifier.attributes and self.truth is not None:
            real = self.seen.attributes[rows]
            usual_truth = class_means(self.truth[rest], self.material[rest], material)
            figures |= controlled_agreement(
                seen.attributes, self.truth[rows], usual_truth, real, self.classifier.attributes
            )
        return {f"{name}: {key}": figure for key, figure in figures.items()}

    def measures(self, seen: Any) -> dict[str, float]:
        """Shares in percent and correlations x 100 of what the classifier says of images of the K contacts `rows`.

        "material" is what they are, "as real" what the classifier takes the real image for, "contact" how often it is
        found among others of its material by what is read, and "relief" the mean correlation of the relief's attributes
        with the truth, where the classifier reads any. "distance" is Frechet's to real images of other contacts. There
        is no "contact" where a material has one alone, and no "material" and "relief" without the truth.
        """
        rows, named = self.rows, seen.logits.argmax(dim=1)
        found = {
            "as real": 100.0 * (named == self.seen.logits[rows].argmax(dim=1)).double().mean().item(),
            "distance": frechet_distance(seen.features, self.seen.features[self.rest]),
        }
        if self._among > 1:
            found["contact"] = 100.0 * self._found(self._placed(seen))
        if self.truth is None:
            return found
        found["material"] = 100.0 * accuracy(seen.logits, self.material[rows])
        if places := [place for place, name in enumerate(self.classifier.attributes) if name in RELIEF]:
            names = [self.classifier.attributes[place] for place in places]
            agreed = attribute_agreement(seen.attributes[:, places], self.truth[rows][:, places], names)
            found["relief"] = 100.0 * mean(agreed.values())
        return found

    @property
    def rest(self) -> Tensor:
        """Which contacts of the gallery are none of `rows`, bool (N,)."""
        rest = torch.ones(len(self.material), dtype=torch.bool)
        rest[self.rows] = False
        return rest

    @property
    def _among(self) -> int:
        """Contacts of its material that each one is found among, itself one of them."""
        return min(AMONG, int(torch.bincount(self.material).min()))

    def _found(self, queries: Tensor) -> float:
        return retrieval(queries, self._placed(self.seen), self.material, self.rows, size=self._among)

    def _placed(self, seen: Any) -> Tensor:
        """What contacts are told apart by: attributes in units of their deviations, or features."""
        if seen.attributes is None:
            return seen.features
        return in_units(self.classifier, seen)


def in_units(classifier: ContactClassifier, seen: ContactClassifierOutput) -> Tensor:
    """Attributes (N, K) around their mean, in units of their deviations."""
    assert seen.attributes is not None
    mean_of, deviation = classifier.scale_of_attributes()
    return (seen.attributes - mean_of) / deviation


# Agreement of a picture with a touch ----------------------------------------------------------------------------------

COMPONENTS = 5
"""Dimensions of the space in which pictures and touches are compared."""


def readings(classifier: ContactClassifier, seen: ContactClassifierOutput) -> Tensor:
    """What a classifier says of images, (N, K): logarithms of probabilities, and attributes if it has any."""
    words = seen.logits.log_softmax(dim=1)
    return words if seen.attributes is None else torch.cat([words, in_units(classifier, seen)], dim=1)


def cvtp(known: tuple[Tensor, Tensor], touches: Tensor, images: Mapping[str, Tensor]) -> dict[str, float]:
    """Mean cosine between touches and the images made of them: contrastive visuo-tactile agreement (Yang et al., 2023).

    The paper's network is one that was trained on pairs, which an off-the-shelf one cannot be here. In its place stands
    the space in which the `readings` of two classifiers correlate most over pairs of other contacts, which shares no
    weights with a joint space.

    Args:
        known: Readings of touches (M, K) and of pictures (M, L) of the same contacts, that it is fitted to.
        touches: Readings (N, K).
        images: Readings (N, L) each, by what they are.
    """
    one, all_of_them = correlated("CCA", *known, touches, torch.cat(list(images.values())), COMPONENTS)
    others = all_of_them.split(len(touches))
    return {name: F.cosine_similarity(one, other).mean().item() for name, other in zip(images, others, strict=True)}


@torch.no_grad()
def inception_features(file: Path, images: Tensor) -> Tensor:
    """Features (N, 2048) of images (N, 3, H, W) in [0, 1] by the network that FIDs are of (Heusel et al., 2017).

    Args:
        file: `inception-2015-12-05.pt`, a TorchScript with the resizing of the original, as StyleGAN's metrics load it.
        images: Any number; FIDs of fewer than some thousand compare with those of as many alone.

    Raises:
        InvalidInputError: If it is no such file.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            network = torch.jit.load(str(file), map_location="cpu").eval()
        parts = [network((255.0 * part).round().byte(), return_features=True) for part in images.split(IMAGES_AT_ONCE)]
    except (RuntimeError, ValueError, OSError) as error:
        raise InvalidInputError(
            f"`inception` is {str(file)!r}, which is no TorchScript of the Inception network: {first_line(error)}"
        ) from error
    return torch.cat(parts).flatten(1).float()


# Tables ---------------------------------------------------------------------------------------------------------------

Figures = Mapping[str, Mapping[str, float]]
"""Figures of one seed, by row and column."""

PAPER = {
    "touch-to-image": {
        "Pix2Pix": {"CVTP": 0.09, "material": 0.15, "FID": 136.4},
        "VisGel": {"CVTP": 0.10, "material": 0.20, "FID": 128.3},
        "Vision-from-touch": {"CVTP": 0.35, "material": 0.25, "FID": 81.2},
        "ours, zero-shot": {"CVTP": 0.56, "material": 0.31, "FID": 103.11},
    },
    "x-to-touch": {"touches of pictures and of their captions": {"named alike, %": 55.3}},
}

TOUCH_TO_IMAGE = {
    "cvtp": "CVTP, x 100",
    "prompt": "as real by the paper's prompt, %",
    "as real": "as real by a classifier, %",
    "contact": "contact within its material, %",
    "relief": "correlation of the relief, x 100",
    "distance": "Frechet distance",
}
"""Columns of Table 5, by measure."""

X_TO_TOUCH = {
    "cvtp": "CVTP with the picture, x 100",
    "alike": "as of the picture, zero-shot, %",
    "alike by classifier": "as of the picture, classifier, %",
    "material": "material by a classifier, %",
    "contact": "contact within its material, %",
    "relief": "correlation of the relief, x 100",
    "distance": "Frechet distance",
}
"""Columns of the table of touches, by measure."""

MATERIAL_PROMPT = "material of {}"
"""What the supplement of the paper asks of pictures."""


def touch_to_image_table(seeds: Sequence[Figures], inception: bool = False, data: str | None = None) -> Table:
    """Table 5: pictures of touches, of one or several seeds.

    Args:
        seeds: Measures of `TOUCH_TO_IMAGE` by what was drawn.
        inception: Whether distances are of the Inception network's features.
        data: Name of the data set, in place of the world.
    """
    network = "the Inception network" if inception else "the classifier of pictures, as no Inception weights were named"
    return generated_table(
        "touch-to-image", "Pictures of touches (Table 5)", TOUCH_TO_IMAGE, seeds,
        [f"Distances are of features of {network}; they are of few pictures, and compare within this table alone.",
         "CVTP is by classifiers of pictures and of touches, which share no weights with what drew, but for the "
         "supervised diffusion, whose condition is regressed from the same classifier of touches.",
         f"As real: named as the real picture is, by {MATERIAL_PROMPT!r} or by a classifier. The encoder that is asked "
         "by the prompt is also what the generator was trained by.",
         "A known touch is of the training split, and its picture a real one.",
         "The supervised diffusion is the model's own, given a picture's embedding by ridge regression, over pairs of "
         "known sensors, from what a classifier of touches reads, or, in the next row, from the encoder's embedding.",
         *_of_data(data)],
    )  # fmt: skip


def x_to_touch_table(seeds: Sequence[Figures], data: str | None = None) -> Table:
    """Touches of pictures, captions, sounds, and of touches by another sensor; see `touch_to_image_table`."""
    return generated_table(
        "x-to-touch", "Touches of pictures, captions, sounds and other touches", X_TO_TOUCH, seeds,
        ["As of the picture: named as the touch that was made of the contact's picture is, which the picture's row "
         "holds to its caption's; zero-shot is by the joint space, as in the paper.",
         "CVTP is with the contact's real picture, by classifiers of pictures and of touches, and distances are of the "
         "latter's features. They share no weights with what drew.",
         *_of_data(data)],
    )  # fmt: skip


def _of_data(data: str | None) -> list[str]:
    """What a reader has to know of figures of a data set."""
    if data is None:
        return []
    return [
        f"Contacts are of the test split of {data!r}; what is known or fitted is of its training split. The "
        "classifiers were trained on the built-in world, and not on it: they are one yardstick for all rows."
    ]


def generated_table(
    name: str, title: str, columns: Mapping[str, str], seeds: Sequence[Figures], notes: Sequence[str]
) -> Table:
    """A table of measures that each have a unit of their own."""
    rows = {
        row: {
            column: [figures[row][measure] for figures in seeds]
            for measure, column in columns.items()
            if measure in seeds[0][row]
        }
        for row in seeds[0]
    }
    shown = {column: "" for column in columns.values() if any(column in row for row in rows.values())}
    falling = [columns["distance"]] if "distance" in columns else []
    beside = {row: [other for other in rows if other.startswith(f"{row}: ")] for row in rows}
    return Table(
        name, title, "each column its own", shown, rows, notes=notes, paper=PAPER[name],
        beside={row: others for row, others in beside.items() if others}, falling=falling,
    )  # fmt: skip
