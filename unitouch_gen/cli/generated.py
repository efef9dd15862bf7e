"""What pipelines make of contacts of the world or of a data set, for the tables `touch-to-image` and `x-to-touch`."""

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
from unitouch_gen.errors import InvalidInputError, UnfamiliarInputWarning, first_of
from unitouch_gen.evaluation.contacts import EvaluationSet
from unitouch_gen.evaluation.controls import others
from unitouch_gen.evaluation.frechet import frechet_distance
from unitouch_gen.evaluation.generated import (
    COMPONENTS,
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
from unitouch_gen.evaluation.zero_shot import PROMPTS, text_embeddings, zero_shot_scores
from unitouch_gen.models import UniTouchProcessor
from unitouch_gen.models.classifier import ContactClassifier, ContactClassifierOutput
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.training.data.columns import computed_once, weights_hash
from unitouch_gen.training.data.embedded import AT_ONCE, encoder_hash, known, observed_once, touch_embeddings
from unitouch_gen.training.data.held import Held, HeldOut, float_pixels, spread
from unitouch_gen.training.data.records import MATERIAL, RecordSet

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


def check_held(name: str, data: RecordSet, one: EvaluationSet, pipe: Any, each: int) -> None:
    """Refuses a data set that nothing could be measured on.

    Args:
        name: Of the table.
        data: As `open_dataset` gives it.
        one: Its splits "train" and "test", as `listed_set` gives them.
        pipe: What the table is of.
        each: Contacts of each material that it is given.

    Raises:
        InvalidInputError: If nothing keeps its splits apart, its touches have no pictures, or nothing else that touches
            could be made of, a split has too few, or the pipeline draws touches by other sensors.
    """
    train, test = (one.splits[split] for split in ("train", "test"))
    if data.split("test").chosen == data.split("train").chosen:
        raise InvalidInputError(
            f"{data} has neither splits nor objects nor recordings that keep them apart; {name!r} needs contacts "
            "that nothing was fitted to, so give its table a column `split` or `object`."
        )
    if name == "touch-to-image" and not all("image" in part.features for part in (train, test)):
        raise InvalidInputError(
            f"{data} has no picture of every touch that the model knows; {name!r} is of such pairs."
        )
    if name == "x-to-touch":
        if not {*test.features} & {*NAMES} - {"touch"}:
            raise InvalidInputError(
                f"{data} has no pictures, captions or sounds of all its touches that the model knows; {name!r} draws "
                "touches of such."
            )
        felt, drawn = {record.sensor for record in data.records}, pipe.config.sensors or ()
        if other := felt - {*drawn}:
            by = first_of(sorted(name or "a sensor that it does not name" for name in other), ", ")
            raise InvalidInputError(
                f"{data} was felt by {by}, but the model draws touches by "
                f"{', '.join(drawn) or 'no sensor with a name'}; pass a data set by one of these, or its name as "
                "`--sensor` if it was."
            )
    if len(train) <= COMPONENTS:
        raise InvalidInputError(
            f"{data} has {len(train)} contacts in its train split; {COMPONENTS + 1} are the least that {name!r} is "
            "fitted to."
        )
    count = len(spread(test.labels.get(MATERIAL, torch.full((len(test),), -1)), each))
    if min(count, len(test) - count) < 2:
        raise InvalidInputError(
            f"`--each` is {each}, which draws {count} of the {len(test)} contacts in the test split of {data}; Frechet "
            "distances are of two or more that are drawn, and of two or more others."
        )


@dataclass
class Generation:
    """A pipeline to be measured, and what measures it.

    Attributes:
        pipe: Touch to image, or anything to touch.
        processor: Of the pipeline.
        cache: Folder of what is made and read.
        each: Contacts of each material that it is given.
        inception: File of the Inception network; see `inception_features`.
        classifiers: Of pictures and of touches, by modality; they share no weights with the pipeline.
    """

    pipe: Any
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

    def seen_of(self, held: HeldOut, modality: str) -> ContactClassifierOutput:
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

    def made_beside_controls(
        self, row: str, key: str, encode: Callable[[], Tensor], draw: Callable[[Tensor], Tensor], held: HeldOut,
        rows: Tensor,
    ) -> Images:  # fmt: skip
        """Images of some rows of what is encoded, of other contacts, and of means of classes where all are labelled."""
        labelled = bool((held.material >= 0).all())

        @cache  # only where an image is missing
        def conditions() -> Sequence[Tensor]:
            embeds = encode().cpu()
            return beside_class_means(embeds, held.material, rows) if labelled else (embeds[rows],)

        def make(place: int) -> Tensor:
            return draw(conditions()[place])

        names = (row, f"{row}: mean of its class") if labelled else (row,)
        made = {name: self.made(f"{key}-{place}", partial(make, place), len(rows)) for place, name in enumerate(names)}
        return {**made, f"{row}{OF_ANOTHER}": made[row][others(len(rows))]}


def picture_embeddings(pairs: Sequence[EvaluationSet], one: EvaluationSet, name: str) -> Tensor:
    """Embeddings (N, D) of pictures of the test split, by ridge regression from features of touches, by their name."""
    known = [each.splits["train"].features for each in pairs]
    touches, pictures = (torch.cat([features[side] for features in known]) for side in (name, "image"))
    return regressed(touches, pictures, one.splits["test"].features[name])


def picture_figures(
    setting: Generation, splits: Mapping[str, HeldOut], one: EvaluationSet, pairs: Sequence[EvaluationSet]
) -> tuple[Figures, Images]:
    """Measures of `TOUCH_TO_IMAGE`, by what the pictures are of, and the pictures.

    Args:
        setting: Of a touch-to-image pipeline.
        splits: Contacts of a world or of a data set.
        one: The same, embedded.
        pairs: What rows are regressed from, in their split "train"; none where the joint space has no pictures.
    """
    held, known, classifier = splits["test"], splits["train"], setting.classifiers["image"]
    rows, pipe, seed = held.some(setting.each), setting.pipe, held.seed
    count, key = len(rows), f"{held.seen.fingerprint}-{setting.each}"
    touched, pictures = (float_pixels(values[rows.numpy()]) for values in (held.seen.touch, held.seen.image))

    by_pairs: Images = {}
    for row, name in REGRESSED.items() if pairs else ():
        embeds = match_norm(picture_embeddings(pairs, one, name)[rows], pipe.unitouch.config.embedding_norm)
        state = hashlib.sha256(embeds.numpy().round(2).tobytes()).hexdigest()[:16]
        draw = partial(generate, pipe, seed, {"touch_embeds": embeds}, bridge=False)  # they are of pictures already
        by_pairs[row] = setting.made(f"{key}-{state}", draw, count)
    nearest = (
        F.normalize(one.splits["test"].features["touch"][rows], dim=1)
        @ F.normalize(one.splits["train"].features["touch"], dim=1).T
    )
    shown = {
        **setting.made_beside_controls(
            "picture of the touch",
            f"{key}-touch-{encoder_hash(pipe.unitouch, 'touch')}",
            lambda: in_batches(pipe.encode_touch, touch=float_pixels(held.seen.touch)),
            lambda embeds: generate(pipe, seed, {"touch_embeds": embeds}),
            held,
            rows,
        ),
        "picture of the touch: real one of the nearest known touch": float_pixels(
            known.seen.image[nearest.argmax(dim=1).numpy()]
        ),
        **{f"picture of the touch: {row}": images for row, images in by_pairs.items()},
    }
    truth = None
    if isinstance(held, Held):
        truth = held.attributes.mean(dim=1)[:, attribute_columns(classifier)]
        relit = partial(held.relit, held.seen.image.shape[-1])
        shown["real picture under another lamp"] = setting.made(f"{key}-relit", lambda: relit()[rows], count)
    else:
        shown["real picture"] = pictures
    judged = ClassifierEvaluation(classifier, rows, _numbers(held), truth, setting.seen_of(held, "image"))
    said = {name: classifier.observe(images) for name, images in shown.items()}
    agreed = _agreement(setting, splits, rows, ("touch", "image"), said)
    named = {name: _named(setting, held, rows, "image", MATERIAL_PROMPT, images) for name, images in shown.items()}
    expected = _named(setting, held, rows, "image", MATERIAL_PROMPT, pictures)
    inception = None if setting.inception is None else partial(inception_features, setting.inception)
    far = None if inception is None else inception(float_pixels(held.seen.image[judged.rest.numpy()]))
    figures = {}
    for name, images in shown.items():
        measures = {**judged.measures(said[name]), "cvtp": 100.0 * agreed[name]}
        if (words := named[name]) is not None and expected is not None:
            measures["prompt"] = 100.0 * share_right(words, expected)
        if inception is not None and far is not None:
            measures["distance"] = frechet_distance(inception(images), far)
        figures[name] = measures
    for itself in ("as real", "prompt", "contact"):  # which a picture always agrees with
        figures.get("real picture", {}).pop(itself, None)
    return _without_repeats(figures), {"touch": touched, "real picture": pictures, **_own(shown)}


def touch_figures(setting: Generation, splits: Mapping[str, HeldOut]) -> tuple[Figures, Images]:
    """Measures of `X_TO_TOUCH`, by what the touches are of, and the touches.

    Args:
        setting: Of an X-to-touch pipeline.
        splits: Contacts of a world or of a data set, by sensors of the pipeline.
    """
    held, pipe, classifier = splits["test"], setting.pipe, setting.classifiers["touch"]
    seen, rows = held.seen, held.some(setting.each)
    key, sensors = f"{seen.fingerprint}-{setting.each}-{held.source.sensor}", held.sensors_of(rows)
    inputs: dict[str, tuple[bool, Callable[[], Any]]] = {
        "image": (seen.image is not None, lambda: float_pixels(seen.image)),
        "text": (all(seen.text), lambda: seen.text),
        "audio": (seen.audio is not None, held.sounds),
        "touch": (seen.second is not None, lambda: float_pixels(seen.second)),
    }

    def encode(modality: str) -> Tensor:
        return in_batches(pipe.encode_condition, **{modality: inputs[modality][1]()})

    made: Images = {}
    bridged = pipe.embedding_bank is not None
    for modality in (name for name, (there, _) in inputs.items() if there and name in pipe.unitouch.known_modalities):
        made |= setting.made_beside_controls(
            NAMES[modality],
            f"{key}-{modality}-{encoder_hash(pipe.unitouch, modality)}{'-bridged' * bridged}",
            partial(encode, modality),
            lambda embeds: generate(pipe, held.seed, {"condition_embeds": embeds, "sensor": sensors}),
            held,
            rows,
        )
    made["real touch"] = float_pixels(seen.touch[rows.numpy()])
    truth = held.attributes[:, 0, attribute_columns(classifier)] if isinstance(held, Held) else None
    judged = ClassifierEvaluation(classifier, rows, _numbers(held), truth, setting.seen_of(held, "touch"))
    said = {name: classifier.observe(images) for name, images in made.items()}
    named = {name: _named(setting, held, rows, "touch", PROMPTS["touch"], images) for name, images in made.items()}
    figures = {name: judged.measures(seen) for name, seen in said.items()}
    figures["real touch"].pop("contact", None)  # itself is always found
    if seen.second is not None:  # by another sensor
        again = judged.measures(classifier.observe(float_pixels(seen.second[rows.numpy()])))
        figures["real touch"]["contact"] = again["contact"]
    pictured = all(split.seen.image is not None for split in splits.values())
    agreed = _agreement(setting, splits, rows, ("image", "touch"), said) if pictured else {}
    for name, measures in figures.items():
        if name in agreed:
            measures["cvtp"] = 100.0 * agreed[name]
        reference = NAMES["text" if name.startswith(NAMES["image"]) else "image"]
        if reference in said:
            words = (said[one].logits.argmax(dim=1) for one in (name, reference))
            measures["alike by classifier"] = 100.0 * share_right(*words)
            one, other = named[name], named[reference]
            if one is not None and other is not None:
                measures["alike"] = 100.0 * share_right(one, other)
    examples = {} if seen.image is None else {"real picture": float_pixels(seen.image[rows.numpy()])}
    return _without_repeats(figures), {**examples, **_own(made)}


def _numbers(held: HeldOut) -> Tensor:
    """Materials (N,) numbered from 0 without gaps; contacts of unknown ones are one more."""
    return held.material.unique(return_inverse=True)[1]


def _agreement(
    setting: Generation, splits: Mapping[str, HeldOut], rows: Tensor, sides: tuple[str, str],
    said: Mapping[str, ContactClassifierOutput],
) -> dict[str, float]:  # fmt: skip
    """`cvtp` of real images of one modality with those that were made of the other, of which this was said."""
    one, other = sides
    first, second = (readings(setting.classifiers[side], setting.seen_of(splits["train"], side)) for side in sides)
    asked = readings(setting.classifiers[one], setting.seen_of(splits["test"], one))[rows]
    return cvtp(
        (first, second), asked, {name: readings(setting.classifiers[other], seen) for name, seen in said.items()}
    )


def _without_repeats(figures: Figures) -> Figures:
    """Measures without the Frechet distance of other contacts' images, which are the same set once more."""
    return {
        row: {name: value for name, value in measures.items() if not (name == "distance" and row.endswith(OF_ANOTHER))}
        for row, measures in figures.items()
    }


def _own(shown: Images) -> Images:
    """Those that were not made of another contact: these are the same once more."""
    return {name: images for name, images in shown.items() if not name.endswith(OF_ANOTHER)}


@torch.no_grad()
def _named(
    setting: Generation, held: HeldOut, rows: Tensor, modality: str, template: str, images: Tensor
) -> Tensor | None:
    """Materials (N,) of images of some contacts, zero-shot by the joint space; `None` without names or encoders."""
    joint, names = setting.pipe.unitouch, held.source.materials
    if len(names) < 2 or not {modality, "text"} <= {*joint.known_modalities}:
        return None
    if modality == "touch":
        features, _ = touch_embeddings(joint, images, known(joint, held.sensors_of(rows)))
    else:
        parts = (normalise_pixels(part).to(joint.device) for part in images.split(AT_ONCE))
        features = torch.cat([joint.get_image_features(part) for part in parts]).float().cpu()
    classes = text_embeddings(joint, setting.processor, [template.format(name) for name in names]).cpu()
    return zero_shot_scores(features, classes).argmax(dim=1)
