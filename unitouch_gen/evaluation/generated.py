"""Table 5 and Section 4.8 of the paper: pictures made of touches, and touches made of anything.

The classifiers that judge them share no weights with what drew them, nor with what that was conditioned on.
"""

from collections.abc import Callable, Mapping
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from unitouch_gen.evaluation.contacts import Contacts, Splits, float_pixels, in_batches
from unitouch_gen.evaluation.controls import Figures, class_means, with_controls
from unitouch_gen.evaluation.metrics import correlated, cosines, frechet_distance, retrieval, share_right
from unitouch_gen.models.classifier import ContactClassifier
from unitouch_gen.world import ATTRIBUTES

Classifiers = Mapping[str, ContactClassifier]  # of "image" and "touch"
MADE_OF = {"image": "picture", "text": "caption", "audio": "sound", "touch": "touch by another sensor"}


def touch_to_image_table(
    pipe: Any, splits: Splits, classifiers: Classifiers, each: int, seed: int
) -> dict[str, Figures]:
    """Table 5: measures of pictures of the test split's touches, with their controls.

    Controls are pictures of the mean touch of a class and of another contact, and the real picture of the nearest touch
    of the training split. The ceiling is the real picture, which the world shows under another lamp. Measures are
    fitted to the split "train", and `each` contacts of each material of "test" are drawn.
    """
    train = splits["train"]
    test = splits["test"]
    rows = some(test, each)
    embeds = beside_class_means(pipe.encode_touch, "touch", test.touch, test, rows)
    made = {name: generate(pipe, seed, {"touch_embeds": values}) for name, values in embeds.items()}
    nearest = cosines(test.features["touch"][rows], train.features["touch"]).argmax(dim=1)
    made["real one of the nearest known touch"] = float_pixels(train.image[nearest.numpy()])
    made["ceiling"] = float_pixels(test.image[rows.numpy()]) if test.relit is None else test.relit()[rows]
    return with_controls(measures_of(splits, classifiers, "image", rows), made)


def x_to_touch_table(pipe: Any, splits: Splits, classifiers: Classifiers, each: int, seed: int) -> dict[str, Figures]:
    """Section 4.8: the same of touches made of pictures, captions, sounds and touches by another sensor.

    The ceiling is the real touch, which the world shows by another sensor.
    """
    test = splits["test"]
    figures = dict[str, Figures]()
    rows = some(test, each)
    ceiling = float_pixels((test.touch if test.second is None else test.second)[rows.numpy()])
    measure = measures_of(splits, classifiers, "touch", rows)
    sensors = [test.sensors[row] for row in rows.tolist()]
    inputs = {"image": test.image, "touch": test.second, "audio": test.sounds, "text": test.text or None}
    for modality in [name for name in pipe.unitouch.known_modalities if inputs[name] is not None]:
        values: Any = inputs[modality]() if modality == "audio" else inputs[modality]
        embeds = beside_class_means(pipe.encode_condition, modality, values, test, rows)
        made = {name: generate(pipe, seed, {"condition_embeds": e, "sensor": sensors}) for name, e in embeds.items()}
        measured = with_controls(measure, {**made, "ceiling": ceiling})
        figures |= {f"{MADE_OF[modality]}: {name}": row for name, row in measured.items()}
    return figures


def some(contacts: Contacts, each: int) -> Tensor:
    """Rows of at most `each` contacts of every material, spread over them; where it is known, of such as touch."""
    touched = torch.ones(len(contacts.objects), dtype=torch.bool)
    if contacts.attributes is not None:
        touched = (contacts.attributes[:, :, ATTRIBUTES.index("cover")] > 0.01).all(dim=1)
    classes = [torch.nonzero((contacts.material == one) & touched)[:, 0] for one in contacts.material.unique()]
    return torch.cat([rows[torch.linspace(0, len(rows) - 1, each).long().unique()] for rows in classes if len(rows)])


def generate(pipe: Any, seed: int, inputs: Mapping[str, Any], **options: Any) -> Tensor:
    """An image (N, 3, H, W) for each of N inputs, arguments of the pipeline's call beside its options, in batches."""

    def draw(rows: slice) -> Tensor:
        part = {name: values[rows] for name, values in inputs.items()}
        generator = torch.Generator().manual_seed(1_000 * seed + rows.start // 64)
        return pipe(**part, **options, generator=generator, output_type="pt").images

    return in_batches(len(next(iter(inputs.values()))), draw, 64)


def beside_class_means(
    encode: Callable[..., Tensor], name: str, inputs: Any, contacts: Contacts, rows: Tensor
) -> dict[str, Tensor]:
    """Embeddings of some rows, and if all are labelled the means over their classes, each as long as the row's own."""
    read: Any = float_pixels if name in ("image", "touch") else lambda values: values
    embeds = in_batches(len(inputs), lambda part: encode(**{name: read(inputs[part])}))
    if bool((contacts.material < 0).any()):
        return {"value": embeds[rows]}
    means = F.normalize(class_means(F.normalize(embeds, dim=-1), contacts.material), dim=-1)
    return {"value": embeds[rows], "class_mean": (means * embeds.norm(dim=-1, keepdim=True))[rows]}


def measures_of(splits: Splits, classifiers: Classifiers, modality: str, rows: Tensor) -> Callable[[Tensor], Figures]:
    """The measures of images (K, 3, H, W) that were made of K rows of the test split.

    - "CVTP" (Yang et al., 2023): mean cosine of touches and pictures. The paper trained a network on pairs; here it is
      the space in which what two classifiers read of the training split's pairs correlates most.
    - "as real": share that is classified as the real image is.
    - "contact": share that is nearest to its own real image among those of a material.
    - "distance": Frechet's to real images of other contacts.
    """
    train = splits["train"]
    test = splits["test"]
    classifier = classifiers[modality]
    other = "touch" if modality == "image" else "image"
    real = getattr(test, modality)
    material = test.material.unique(return_inverse=True)[1]
    remaining = sorted({*range(len(real))} - {*rows.tolist()})
    size = min(64, int(torch.bincount(material).min()))
    gallery, features = read(classifier, real)
    paired = train.image is not None and test.image is not None
    if paired:
        known = (read(classifiers[other], getattr(train, other))[0], read(classifier, getattr(train, modality))[0])
        partners = read(classifiers[other], getattr(test, other)[rows.numpy()])[0]

    def named(readings: Tensor) -> Tensor:
        return readings[:, : classifier.config.num_labels].argmax(dim=1)

    def measure(images: Tensor) -> Figures:
        images = F.interpolate(images, real.shape[-2:], mode="bilinear", antialias=True)
        readings, own_features = read(classifier, images)
        found = {"as real": share_right(named(readings), named(gallery[rows]))}
        if paired:
            found["CVTP"] = F.cosine_similarity(*correlated("CCA", known, partners, readings, 5)).mean().item()
        if size > 1:
            found[f"contact, among {size}"] = retrieval(readings, gallery, material, rows, size=size)
        return {**found, "distance": frechet_distance(own_features, features[remaining])}

    return measure


def read(classifier: ContactClassifier, images: Any) -> tuple[Tensor, Tensor]:
    """What a classifier says of N images: log-probabilities of C materials and K attributes in deviations from their
    means, (N, C + K), and features (N, D)."""
    mean, deviation = classifier.scale_of_attributes()

    def observe(part: slice) -> Tensor:
        said: Any = classifier.observe(float_pixels(images[part]))
        return torch.cat([said.logits.log_softmax(dim=1), (said.attributes - mean) / deviation, said.features], dim=1)

    found = in_batches(len(images), observe)
    width = int(classifier.config.num_labels or 0) + len(mean)
    return found[:, :width], found[:, width:]
