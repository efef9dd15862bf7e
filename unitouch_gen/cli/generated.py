"""What pipelines make of the world's contacts, measured for the tables `touch-to-image` and `x-to-touch`."""

import hashlib
import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from unitouch_gen import weights
from unitouch_gen.conditioning import match_norm
from unitouch_gen.errors import UnfamiliarInputWarning
from unitouch_gen.evaluation.contacts import EvaluationSet
from unitouch_gen.evaluation.controls import others
from unitouch_gen.evaluation.frechet import frechet_distance
from unitouch_gen.evaluation.generated import (
    MATERIAL_PROMPT,
    ClassifierEvaluation,
    attribute_columns,
    beside_class_means,
    cvtp,
    generate,
    in_batches,
    inception_features,
    load_classifier,
    readings,
)
from unitouch_gen.evaluation.probing import regressed, share_right
from unitouch_gen.evaluation.zero_shot import PROMPTS, class_embeddings, zero_shot_scores
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.models.classifier import ContactClassifier, ContactClassifierOutput
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.training.data.columns import computed_once, weights_hash
from unitouch_gen.training.data.embedded import AT_ONCE, encoder_hash, observed_once, touch_embeddings
from unitouch_gen.training.data.held import Held, float_pixels
from unitouch_gen.training.paired import PairObjective
from unitouch_gen.world import MATERIAL_NAMES

NAMES = {"image": "picture", "text": "caption", "audio": "sound", "touch": "touch by another sensor"}
"""What touches are made of."""

Figures = dict[str, dict[str, float]]

Images = dict[str, Tensor]
"""Images (K, 3, S, S) in [0, 1] of some contacts, by what they are."""

OF_ANOTHER = ": of another contact"
"""What a row of other contacts' images ends with."""

REGRESSED = {"diffusion, supervised": "supervised", "its own embedding, regressed": "touch"}
"""Rows of the pipeline's own network, conditioned on what pairs say of a picture's embedding, by the features of
touches that it is regressed from."""


@dataclass
class Generation:
    """A pipeline to be measured, and what measures it.

    Attributes:
        pipe: Touch to image, or anything to touch.
        joint, processor: Of the pipeline.
        cache: Folder of what is made and read.
        each: Contacts of each material that it is given.
        inception: File of the Inception network; see `inception_features`.
        classifiers: Of pictures and of touches, by modality; they share no weights with the pipeline.
    """

    pipe: Any
    joint: UniTouchModel
    processor: UniTouchProcessor
    cache: Path
    each: int
    inception: Path | None = None
    classifiers: Mapping[str, ContactClassifier] = field(
        default_factory=lambda: {
            "image": load_classifier(weights.PICTURE_CLASSIFIER),
            "touch": load_classifier(weights.TOUCH_CLASSIFIER),
        }
    )

    def seen_of(self, held: Held, modality: str) -> ContactClassifierOutput:
        """What a classifier says of real images of all contacts of a split."""
        key = f"{held.seen.fingerprint}-{modality}"
        return observed_once(self.classifiers[modality], getattr(held.seen, modality), key, self.cache)

    def made(self, key: str, make: Callable[[], Tensor], count: int) -> Tensor:
        """Images (K, 3, H, W) in [0, 1], made once for each state of the pipeline's networks and settings."""
        parts = {name: part for name, part in self.pipe.components.items() if name != "unitouch"}  # which `key` has
        told = [weights_hash(part) for _, part in sorted(parts.items()) if isinstance(part, torch.nn.Module)]
        told += [
            json.dumps(dict(one), sort_keys=True, default=str) for one in (self.pipe.scheduler.config, self.pipe.config)
        ]
        state = hashlib.sha256("".join(told).encode()).hexdigest()[:16]
        file = self.cache / f"made-{key}-{state}.safetensors"

        def compute(rows: Tensor) -> Tensor:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UnfamiliarInputWarning)  # which sensors drawn anew are
                images = make().float().cpu()
            size = (self.processor.image_size,) * 2  # that of real ones
            return (255.0 * F.interpolate(images, size, mode="bilinear", antialias=True)).round().byte()

        return computed_once(file, compute, [np.arange(count)], count).float() / 255

    def made_beside_means(
        self, key: str, encode: Callable[[], Tensor], draw: Callable[[Tensor], Tensor], labels: Tensor, rows: Tensor
    ) -> list[Tensor]:
        """Images of some rows of what is encoded, and of the mean embeddings of their classes."""
        conditions = cache(lambda: beside_class_means(encode().cpu(), labels, rows))  # only where an image is missing

        def make(place: int) -> Tensor:
            return draw(conditions()[place])

        return [self.made(f"{key}-{place}", partial(make, place), len(rows)) for place in range(2)]


@dataclass
class Pairs:
    """What pairs of touches and pictures by known sensors of a world are fitted by.

    Attributes:
        sets: The pairs, embedded, in their split "train"; none where the joint space has no pictures.
        networks: Trained on them, by row.
    """

    sets: Sequence[EvaluationSet]
    networks: Mapping[str, PairObjective]

    def condition(self, one: EvaluationSet, name: str) -> Tensor:
        """Embeddings (N, D) of pictures, by ridge regression from features of touches, by their name."""
        known = [each.splits["train"].features for each in self.sets]
        touches, pictures = (torch.cat([features[side] for features in known]) for side in (name, "image"))
        return regressed(touches, pictures, one.splits["test"].features[name])


def picture_figures(
    setting: Generation, splits: Mapping[str, Held], one: EvaluationSet, pairs: Pairs
) -> tuple[Figures, Images]:
    """Measures of `TOUCH_TO_IMAGE`, by what the pictures are of, and the pictures.

    Args:
        setting: Of a touch-to-image pipeline.
        splits: Contacts of a world.
        one: The same, embedded.
        pairs: What supervised rows are fitted by.
    """
    held, known = splits["test"], splits["train"]
    rows, pipe, seed = held.some(setting.each), setting.pipe, held.source.seed
    size, count = held.seen.image.shape[-1], len(rows)
    key = f"{held.seen.fingerprint}-{setting.each}"

    own, usual = setting.made_beside_means(
        f"{key}-touch-{encoder_hash(pipe.unitouch, 'touch')}",
        lambda: in_batches(pipe.encode_touch, touch=float_pixels(held.seen.touch)),
        lambda embeds: generate(pipe, seed, {"touch_embeds": embeds}),
        held.material,
        rows,
    )
    again = setting.made(f"{key}-relit", lambda: held.relit(size)[rows], count)
    touched = float_pixels(held.seen.touch[rows.numpy()])
    by_pairs = {row: network.draw(touched) for row, network in pairs.networks.items()}
    for row, name in REGRESSED.items() if pairs.sets else ():
        embeds = match_norm(pairs.condition(one, name)[rows], pipe.unitouch.config.embedding_norm)
        state = hashlib.sha256(embeds.numpy().round(2).tobytes()).hexdigest()[:16]
        by_pairs[row] = setting.made(f"{key}-{state}", partial(generate, pipe, seed, {"touch_embeds": embeds}), count)
    nearest = (
        F.normalize(one.splits["test"].features["touch"][rows], dim=1)
        @ F.normalize(one.splits["train"].features["touch"], dim=1).T
    )
    shown = {
        "picture of the touch": own,
        "picture of the touch: mean of its class": usual,
        f"picture of the touch{OF_ANOTHER}": own[others(count)],
        "picture of the touch: real one of the nearest known touch": float_pixels(
            known.seen.image[nearest.argmax(dim=1).numpy()]
        ),
        **{f"picture of the touch: {row}": images for row, images in by_pairs.items()},
        "real picture under another lamp": again,
    }
    truth, classifiers = held.attributes.mean(dim=1), setting.classifiers
    real, felt = setting.seen_of(held, "image"), setting.seen_of(held, "touch")
    judged = ClassifierEvaluation(
        classifiers["image"], rows, held.material, truth[:, attribute_columns(classifiers["image"])], real,
        classifiers["image"].observe(again),
    )  # fmt: skip
    one_side, other_side = (readings(classifiers[name], setting.seen_of(known, name)) for name in ("touch", "image"))
    touches = readings(classifiers["touch"], felt)[rows]
    named = partial(_named, setting, "image", MATERIAL_PROMPT)
    expected = named(float_pixels(held.seen.image[rows.numpy()]))
    inception = None if setting.inception is None else partial(inception_features, setting.inception)
    far = None if inception is None else inception(float_pixels(held.seen.image[judged.rest.numpy()]))
    said, figures = {name: classifiers["image"].observe(images) for name, images in shown.items()}, {}
    agreed = cvtp(
        (one_side, other_side), touches, {name: readings(classifiers["image"], seen) for name, seen in said.items()}
    )
    for name, images in shown.items():
        measures = judged.measures(said[name])
        measures["distance"] = measures.pop("Frechet distance")
        measures["cvtp"] = 100.0 * agreed[name]
        measures["prompt"] = 100.0 * share_right(named(images), expected)
        if inception is not None and far is not None:
            measures["distance"] = frechet_distance(inception(images), far)
        figures[name] = measures
    return figures, {"touch": touched, "real picture": float_pixels(held.seen.image[rows.numpy()]), **_own(shown)}


def touch_figures(setting: Generation, held: Held) -> tuple[Figures, Images]:
    """Measures of `X_TO_TOUCH`, by what the touches are of, and the touches.

    Args:
        setting: Of an X-to-touch pipeline.
        held: Contacts of a world, by a sensor of the pipeline.
    """
    pipe, source, seen = setting.pipe, held.source, held.seen
    rows = held.some(setting.each)
    count, key = len(rows), f"{seen.fingerprint}-{setting.each}-{source.sensor}"
    inputs: dict[str, Callable[[], Any]] = {
        "image": lambda: float_pixels(seen.image),
        "text": lambda: seen.text,
        "audio": held.sounds,
        "touch": lambda: float_pixels(seen.second),
    }

    def encode(modality: str) -> Tensor:
        return in_batches(pipe.encode_condition, **{modality: inputs[modality]()})

    made = {}
    for modality in (name for name in inputs if name in setting.joint.known_modalities):
        name = NAMES[modality]
        made[name], made[f"{name}: mean of its class"] = setting.made_beside_means(
            f"{key}-{modality}-{encoder_hash(pipe.unitouch, modality)}",
            partial(encode, modality),
            lambda embeds: generate(pipe, source.seed, {"condition_embeds": embeds}, sensor=source.sensor),
            held.material,
            rows,
        )
        made[f"{name}{OF_ANOTHER}"] = made[name][others(count)]
    classifier, second = setting.classifiers["touch"], seen.second
    assert second is not None
    again = classifier.observe(float_pixels(second[rows.numpy()]))
    truth = held.attributes[:, 0, attribute_columns(classifier)]
    judged = ClassifierEvaluation(classifier, rows, held.material, truth, setting.seen_of(held, "touch"), again)
    made["real touch"] = float_pixels(seen.touch[rows.numpy()])
    said = {name: classifier.observe(images) for name, images in made.items()}
    named = {name: _named(setting, "touch", PROMPTS["touch"], images, source.sensor) for name, images in made.items()}
    figures = {name: judged.measures(seen) for name, seen in said.items()}
    figures["real touch"]["contact"] = judged.measures(again)["contact"]  # by another sensor: itself is always found
    for name, measures in figures.items():
        reference = NAMES["text" if name.startswith(NAMES["image"]) else "image"]
        if reference in said:
            words = (said[one].logits.argmax(dim=1) for one in (name, reference))
            measures["alike"] = 100.0 * share_right(named[name], named[reference])
            measures["alike by classifier"] = 100.0 * share_right(*words)
    return figures, {"real picture": float_pixels(seen.image[rows.numpy()]), **_own(made)}


def _own(shown: Images) -> Images:
    """Those that were not made of another contact: these are the same once more."""
    return {name: images for name, images in shown.items() if not name.endswith(OF_ANOTHER)}


@torch.no_grad()
def _named(setting: Generation, modality: str, template: str, images: Tensor, sensor: str | None = None) -> Tensor:
    """Materials (N,) of images, zero-shot by the joint space."""
    joint = setting.joint
    if modality == "touch":
        features, _ = touch_embeddings(joint, images, [sensor if sensor in joint.sensors else None] * len(images))
    else:
        parts = (normalise_pixels(part).to(joint.device) for part in images.split(AT_ONCE))
        features = torch.cat([joint.get_image_features(part) for part in parts]).float().cpu()
    classes = class_embeddings(joint, setting.processor, MATERIAL_NAMES, template).cpu()
    return zero_shot_scores(features, classes).argmax(dim=1)
