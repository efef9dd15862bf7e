"""Table 5 and Section 4.8 of the paper: pictures generated from touches, and touches from other modalities.

The classifiers that judge them share no weights with the generators, nor with the encoders of their conditions.
"""

from collections.abc import Callable, Mapping
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from unitouch_gen.evaluation.contacts import EvaluatedContacts, Splits
from unitouch_gen.evaluation.controls import Figures, class_means, with_controls
from unitouch_gen.evaluation.metrics import correlated, cosines, frechet_distance, retrieval, share_right
from unitouch_gen.models.classifier import ContactClassifier
from unitouch_gen.models.features import float_pixels, in_batches

Classifiers = Mapping[str, ContactClassifier]  # by "image" and "touch"
MADE_OF = {"image": "picture", "text": "caption", "audio": "sound", "touch": "touch by another sensor"}


def touch_to_image_table(
    pipe: Any, splits: Splits, classifiers: Classifiers, each: int, seed: int
) -> dict[str, Figures]:
    """Table 5: measures of pictures generated from the test split's touches, with their controls.

    Controls are pictures of the mean touch of a class and of another contact, and the real picture of the nearest touch
    of the training split. The ceiling is the real picture, in the world under another lamp. Measures are fitted to the
    split "train". `each` contacts of each material of "test" are used.
    """
    train = splits["train"]
    test = splits["test"]
    rows = sample_per_class(test, each)
    embeds = beside_class_means(pipe.encode_touch, "touch", test.touch, test, rows)
    images = {name: generate(pipe, seed, {"touch_embeds": values}) for name, values in embeds.items()}
    nearest = cosines(test.features["touch"][rows], train.features["touch"]).argmax(dim=1)
    images["real one of the nearest known touch"] = float_pixels(train.image[nearest.numpy()])
    images["ceiling"] = float_pixels(test.image[rows.numpy()]) if test.relit is None else test.relit()[rows]
    return with_controls(measures_of(splits, classifiers, "image", rows), images)


def x_to_touch_table(pipe: Any, splits: Splits, classifiers: Classifiers, each: int, seed: int) -> dict[str, Figures]:
    """Section 4.8: the same measures of touches from pictures, captions, sounds and touches by another sensor.

    The ceiling is the real touch, in the world by another sensor.
    """
    test = splits["test"]
    rows = sample_per_class(test, each)
    real = test.touch if test.second is None else test.second
    ceiling = float_pixels(real[rows.numpy()])
    measure = measures_of(splits, classifiers, "touch", rows)
    sensors = [test.sensors[row] for row in rows.tolist()]
    inputs: dict[str, Any] = {
        "image": test.image,
        "touch": test.second,
        "audio": test.sounds,
        "text": test.text or None,
    }
    figures = dict[str, Figures]()
    for modality in pipe.unitouch.known_modalities:
        values = inputs[modality]
        if values is None:
            continue
        if modality == "audio":
            values = values()
        embeds = beside_class_means(pipe.encode_condition, modality, values, test, rows)
        images = dict[str, Tensor]()
        for name, condition_embeds in embeds.items():
            images[name] = generate(pipe, seed, {"condition_embeds": condition_embeds, "sensor": sensors})
        images["ceiling"] = ceiling
        for name, row in with_controls(measure, images).items():
            figures[f"{MADE_OF[modality]}: {name}"] = row
    return figures


def sample_per_class(contacts: EvaluatedContacts, each: int) -> Tensor:
    """Rows of at most `each` contacts of every material, evenly spaced, without contacts that touch nothing."""
    is_touching = contacts.is_touching
    chosen = list[Tensor]()
    for material in contacts.material.unique():
        rows = torch.nonzero((contacts.material == material) & is_touching)[:, 0]
        if len(rows):
            places = torch.linspace(0, len(rows) - 1, each).long().unique()
            chosen.append(rows[places])
    return torch.cat(chosen)


def generate(pipe: Any, seed: int, inputs: Mapping[str, Any], **options: Any) -> Tensor:
    """An image (N, 3, H, W) for each of N rows of `inputs`, arguments of the pipeline's call, in batches."""

    def draw(rows: slice) -> Tensor:
        batch = {name: values[rows] for name, values in inputs.items()}
        generator = torch.Generator().manual_seed(1_000 * seed + rows.start // 64)
        return pipe(**batch, **options, generator=generator, output_type="pt").images

    count = len(next(iter(inputs.values())))
    return in_batches(count, draw, size=64)


def beside_class_means(
    encode: Callable[..., Tensor], name: str, inputs: Any, contacts: EvaluatedContacts, rows: Tensor
) -> dict[str, Tensor]:
    """Embeddings of some rows and, if all are labelled, the means of their classes with the norm of the row's own."""

    def encode_batch(batch: slice) -> Tensor:
        values = float_pixels(inputs[batch]) if name in ("image", "touch") else inputs[batch]
        return encode(**{name: values})

    embeds = in_batches(len(inputs), encode_batch)
    if bool((contacts.material < 0).any()):
        return {"value": embeds[rows]}
    directions = F.normalize(class_means(F.normalize(embeds, dim=-1), contacts.material), dim=-1)
    means = directions * embeds.norm(dim=-1, keepdim=True)
    return {"value": embeds[rows], "class_mean": means[rows]}


def measures_of(splits: Splits, classifiers: Classifiers, modality: str, rows: Tensor) -> Callable[[Tensor], Figures]:
    """The measures of images (K, 3, H, W) that were generated for K rows of the test split.

    - "CVTP" (Yang et al., 2023): mean cosine of touches and pictures. The paper trained a network on pairs. Here the
      space is that in which readings of two classifiers on the training split's pairs correlate most.
    - "as real": share that is classified as the real image is.
    - "contact": share that is nearest to its own real image among those of a material.
    - "distance": Frechet distance to real images of other contacts.
    """
    train = splits["train"]
    test = splits["test"]
    other = "touch" if modality == "image" else "image"
    classifier = classifiers[modality]
    other_classifier = classifiers[other]
    real = getattr(test, modality)
    _, material = test.material.unique(return_inverse=True)
    other_rows = sorted({*range(len(real))} - {*rows.tolist()})
    size = min(64, int(torch.bincount(material).min()))
    gallery, features = read(classifier, real)
    paired = train.image is not None and test.image is not None
    if paired:
        other_readings, _ = read(other_classifier, getattr(train, other))
        own_readings, _ = read(classifier, getattr(train, modality))
        partners, _ = read(other_classifier, getattr(test, other)[rows.numpy()])

    def material_of(readings: Tensor) -> Tensor:
        return readings[:, : classifier.config.num_labels].argmax(dim=1)

    def measure(images: Tensor) -> Figures:
        images = F.interpolate(images, real.shape[-2:], mode="bilinear", antialias=True)
        readings, image_features = read(classifier, images)
        figures = {"as real": share_right(material_of(readings), material_of(gallery[rows]))}
        if paired:
            pairs = (other_readings, own_readings)
            correlates = correlated("CCA", pairs, partners, readings, components=5)
            figures["CVTP"] = F.cosine_similarity(*correlates).mean().item()
        if size > 1:
            figures[f"contact, among {size}"] = retrieval(readings, gallery, material, rows, size=size)
        figures["distance"] = frechet_distance(image_features, features[other_rows])
        return figures

    return measure


def read(classifier: ContactClassifier, images: Any) -> tuple[Tensor, Tensor]:
    """A classifier's readings of N images, (N, C + K), and features (N, D).

    Readings are log-probabilities of C materials, and K attributes in deviations from their means.
    """
    mean, deviation = classifier.scale_of_attributes()

    def observe(batch: slice) -> Tensor:
        output: Any = classifier.observe(float_pixels(images[batch]))
        attributes = (output.attributes - mean) / deviation
        return torch.cat([output.logits.log_softmax(dim=1), attributes, output.features], dim=1)

    columns = in_batches(len(images), observe)
    width = int(classifier.config.num_labels or 0) + len(mean)
    return columns[:, :width], columns[:, width:]
