"""Pictures of touches and touches of anything, measured as in the paper's Table 5 and Section 4.8.

The classifiers that read them share no weights with what drew them, nor with what that was conditioned on.
"""

from collections.abc import Callable, Mapping
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from tqdm.auto import tqdm

from unitouch_gen.evaluation.contacts import Contacts, Splits, float_pixels, in_batches
from unitouch_gen.evaluation.controls import Figures, class_means, with_controls
from unitouch_gen.evaluation.metrics import correlated, frechet_distance, regressed, retrieval, retrieve, share_right
from unitouch_gen.models.classifier import ContactClassifier
from unitouch_gen.world import ATTRIBUTES

Classifiers = Mapping[str, ContactClassifier]
"""Of the modalities "image" and "touch"."""

Images = dict[str, Tensor]
"""Images (K, 3, H, W) in [0, 1] of the same contacts, by what they are."""

MADE_OF = {"image": "picture", "text": "caption", "audio": "sound", "touch": "touch by another sensor"}


def touch_to_image_table(
    pipe: Any, splits: Splits, classifiers: Classifiers, each: int, seed: int
) -> tuple[dict[str, Figures], Images]:
    """Table 5: `measures_of` pictures of the test split's touches, beside their controls; and the pictures.

    These are pictures of the mean touch of a class and of another contact, the real picture of the nearest known touch,
    and diffusion of what ridge regression says of a picture by a supervised classifier's features of the touch. The
    ceiling is the real picture, which the world shows under another lamp.

    Args:
        pipe: A touch-to-image pipeline.
        splits: "train", which all is fitted to, and "test", with pictures and the features of `embed`.
        classifiers: Which read the images.
        each: Contacts of each material that pictures are made of.
        seed: Of the noise.
    """
    train, test = splits["train"], splits["test"]
    rows = some(test, each)
    embeds = beside_class_means(pipe.encode_touch, "touch", test.touch, test, rows)
    made = {name: generate(pipe, seed, {"touch_embeds": values}) for name, values in embeds.items()}
    nearest = retrieve(test.features["touch"][rows], train.features["touch"], 1)[0][:, 0]
    made["real one of the nearest known touch"] = float_pixels(train.image[nearest.numpy()])
    if "image" in train.features:
        guessed = regressed(train.features["supervised"], train.features["image"], test.features["supervised"][rows])
        guessed = F.normalize(guessed, dim=1) * pipe.unitouch.config.embedding_norm
        made["supervised diffusion"] = generate(pipe, seed, {"touch_embeds": guessed}, bridge=False)
    real = float_pixels(test.image[rows.numpy()])
    made["ceiling"] = real if test.relit is None else test.relit()[rows]
    measure = measures_of(splits, classifiers, "image", rows)
    return with_controls(measure, made), {"touch": float_pixels(test.touch[rows.numpy()]), "real": real, **made}


def x_to_touch_table(
    pipe: Any, splits: Splits, classifiers: Classifiers, each: int, seed: int
) -> tuple[dict[str, Figures], Images]:
    """Section 4.8: the same of touches of pictures, captions, sounds and touches by another sensor.

    The ceiling is the real touch, which the world shows by another sensor.
    """
    test, figures = splits["test"], dict[str, Figures]()
    rows = some(test, each)
    real = float_pixels(test.touch[rows.numpy()])
    again = real if test.second is None else float_pixels(test.second[rows.numpy()])
    measure = measures_of(splits, classifiers, "touch", rows)
    sensors, images = [test.sensors[row] for row in rows.tolist()], {"real touch": real}
    inputs = {"image": test.image, "touch": test.second, "audio": test.sounds, "text": test.text or None}
    for modality in [name for name in pipe.unitouch.known_modalities if inputs[name] is not None]:
        values: Any = inputs[modality]() if modality == "audio" else inputs[modality]
        embeds = beside_class_means(pipe.encode_condition, modality, values, test, rows)
        made = {name: generate(pipe, seed, {"condition_embeds": e, "sensor": sensors}) for name, e in embeds.items()}
        measured = with_controls(measure, {**made, "ceiling": again})
        figures |= {f"{MADE_OF[modality]}: {name}": row for name, row in measured.items()}
        images[MADE_OF[modality]] = made["value"]
    return figures, images


# What is drawn --------------------------------------------------------------------------------------------------------


def some(contacts: Contacts, each: int) -> Tensor:
    """Rows of at most `each` contacts of every material, spread over them; where it is known, of such as touch."""
    touched = torch.ones(len(contacts.objects), dtype=torch.bool)
    if contacts.attributes is not None:
        touched = (contacts.attributes[:, :, ATTRIBUTES.index("cover")] > 0.01).all(dim=1)
    classes = [torch.nonzero((contacts.material == one) & touched)[:, 0] for one in contacts.material.unique()]
    return torch.cat([rows[torch.linspace(0, len(rows) - 1, each).long().unique()] for rows in classes if len(rows)])


def generate(pipe: Any, seed: int, inputs: Mapping[str, Any], **options: Any) -> Tensor:
    """An image (N, 3, H, W) for each of N inputs, arguments of the pipeline's call beside its options, in batches."""
    images = []
    for start in tqdm(range(0, len(next(iter(inputs.values()))), 64), desc="images", mininterval=5.0, leave=False):
        part = {name: values[start : start + 64] for name, values in inputs.items()}
        generator = torch.Generator().manual_seed(1_000 * seed + start // 64)
        images.append(pipe(**part, **options, generator=generator, output_type="pt").images.float().cpu())
    return torch.cat(images)


def beside_class_means(
    encode: Callable[..., Tensor], name: str, inputs: Any, contacts: Contacts, rows: Tensor
) -> dict[str, Tensor]:
    """Embeddings of some rows, and if all are labelled the means over their classes, each as long as the row's own."""

    def encoded(part: slice) -> Tensor:
        return encode(**{name: inputs[part] if name in ("text", "audio") else float_pixels(inputs[part])})

    embeds = in_batches(len(inputs), encoded)
    if bool((contacts.material < 0).any()):
        return {"value": embeds[rows]}
    means = F.normalize(class_means(F.normalize(embeds, dim=-1), contacts.material), dim=-1)
    return {"value": embeds[rows], "class_mean": (means * embeds.norm(dim=-1, keepdim=True))[rows]}


# What is measured -----------------------------------------------------------------------------------------------------


def measures_of(splits: Splits, classifiers: Classifiers, modality: str, rows: Tensor) -> Callable[[Tensor], Figures]:
    """What measures images (K, 3, H, W) that were made of some rows of the test split.

    "CVTP" (Yang et al., 2023) is the mean cosine of touches and pictures in the space in which what two classifiers
    read of them correlates most over pairs of the training split; the paper's network was trained on pairs instead.
    "as real" is the share that is named as the real image is, "contact" the share that is nearest to its own real image
    among those of a material, "distance" Frechet's to real images of other contacts.
    """
    train, test, classifier = splits["train"], splits["test"], classifiers[modality]
    other, paired = "touch" if modality == "image" else "image", train.image is not None and test.image is not None
    real, material = getattr(test, modality), test.material.unique(return_inverse=True)[1]
    others, size = sorted({*range(len(real))} - {*rows.tolist()}), min(64, int(torch.bincount(material).min()))

    def readings(name: str, images: Any) -> Tensor:
        """All that a classifier reads, (N, C + K): log-probabilities of C materials, and attributes in deviations."""
        mean, deviation = classifiers[name].scale_of_attributes()

        def read(part: slice) -> Tensor:
            said: Any = classifiers[name].observe(float_pixels(images[part]))
            return torch.cat([said.logits.log_softmax(dim=1), (said.attributes - mean) / deviation], dim=1)

        return in_batches(len(images), read)

    def features(images: Any) -> Tensor:
        return in_batches(len(images), lambda part: classifier.observe(float_pixels(images[part])).features)

    def named(read: Tensor) -> Tensor:
        return read[:, : classifier.config.num_labels].argmax(dim=1)

    gallery, apart = readings(modality, real), features(real)[others]
    if paired:
        known = tuple(readings(name, getattr(train, name)) for name in (other, modality))
        partners = readings(other, getattr(test, other)[rows.numpy()])

    def measure(images: Tensor) -> Figures:
        images = F.interpolate(images, real.shape[-2:], mode="bilinear", antialias=True)
        read = readings(modality, images)
        found = {"as real": share_right(named(read), named(gallery[rows]))}
        if paired:
            pairs = correlated("CCA", known, partners, read, components=5)  # type: ignore[arg-type]
            found["CVTP"] = F.cosine_similarity(*pairs).mean().item()
        if size > 1:
            found[f"contact, among {size}"] = retrieval(read, gallery, material, rows, size=size)
        return {**found, "distance": frechet_distance(features(images), apart)}

    return measure
