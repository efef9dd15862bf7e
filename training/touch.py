"""Stage 3, touch bound to frozen images, with sensor tokens and in-batch sampling (Section 3 of the paper).

python -m unitouch_gen.training.touch --joint runs/image_text/model --output runs/touch
"""

from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
import torch.nn.functional as F
from pydantic import NonNegativeFloat, NonNegativeInt, model_validator
from torch import Tensor, nn

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import UniTouchModel
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.training.batches import (
    ArrayDataset,
    Batch,
    InBatchSampler,
    add_noise,
    blur_some,
    in_deviations,
    jitter_colours,
    permute_channels,
    share_of,
    shift_pixels,
    turn_and_flip,
)
from unitouch_gen.training.data import Rendered, image_embeddings, sensor_numbers, shown
from unitouch_gen.training.losses import symmetric_info_nce
from unitouch_gen.training.recipe import Settings, Share
from unitouch_gen.training.stages import Stage, run, save_modalities
from unitouch_gen.training.watching import Watch, on_device_of, pixels_of, retrieval
from unitouch_gen.world import ATTRIBUTES, CELLS, MAPS

CHUNK = 1024
"""Images in memory at once, where they are averaged."""


class TouchAugmentation(Settings):
    """Probabilities of turning and mirroring, exchanging colours, and softening: other lights and gels."""

    turn: Share
    permute: Share
    blur: Share


class SamplerSettings(Settings):
    """The share of a batch from one data set, null for batches that are uniform over all; see `InBatchSampler`."""

    sigma: Share | None


class SensorSettings(Settings):
    """How many tokens each sensor has: the joint space's number where it is null, and 0 trains without sensors."""

    tokens: NonNegativeInt | None = None


class LossWeights(Settings):
    """Weights of the paper's loss, and of others: one that places what that orders, three that drawn sensors allow.

    Attributes:
        image: Of touches and their pictures (Eq. 2-3).
        cosine: One less the cosine of a touch and its picture, summed over both touches of a pair. InfoNCE asks only
            that others are further, and leaves touches far from all pictures (Liang et al., 2022, "Mind the gap"),
            where generators have seen nothing. Grasps have none, as their pictures show what came of them.
        touch: InfoNCE of the same contact under two sensors.
        attributes: Squared error of what can be measured of a contact, read linearly off its embedding, in units of its
            deviation; no words of materials.
        maps: The same of what can be measured in each part of the view, read off the patches' tokens.
    """

    image: NonNegativeFloat = 1.0
    cosine: NonNegativeFloat = 0.0
    touch: NonNegativeFloat = 0.0
    attributes: NonNegativeFloat = 0.0
    maps: NonNegativeFloat = 0.0

    @property
    def pairs(self) -> bool:
        """Whether anything weighs that only drawn contacts have."""
        return bool(self.touch or self.attributes or self.maps)

    @model_validator(mode="after")
    def _something_is_weighed(self) -> Self:
        if not (self.image or self.cosine or self.pairs):
            raise InvalidInputError(
                "`objective` weighs nothing; give `image`, `cosine`, `touch`, `attributes` or `maps` a weight above 0."
            )
        return self


class TouchEncoder(nn.Module):
    """What is trained: the touch transformer, the sensor tokens, and what reads measures off embeddings and patches."""

    def __init__(self, model: UniTouchModel, weights: LossWeights):
        super().__init__()
        self.transformer, self.bank = model.touch_model, model.sensor_bank
        config: Any = model.config.touch_config
        self.grid = config.grid
        self.reader = nn.Linear(config.projection_dim, len(ATTRIBUTES)) if weights.attributes else None
        self.mapper = nn.Linear(config.hidden_size, len(MAPS)) if weights.maps else None

    def forward(self, pixel_values: Tensor, sensor_ids: Tensor) -> Tensor:
        """Embeddings (B, D); those of sensors below 0 have no tokens."""
        return self.features(pixel_values, sensor_ids)[0]

    def features(self, pixel_values: Tensor, sensor_ids: Tensor) -> tuple[Tensor, Tensor]:
        """Embeddings (B, D), and what patches say of their cells of the view, (B, width, 8, 8)."""
        tokens = self.bank.encode(self._tokens, pixel_values, sensor_ids)
        tokens = tokens + 0.0 * self.bank.tokens.sum().to(tokens)  # processes wait for a gradient of every weight
        patches = tokens[:, 1:].transpose(1, 2).unflatten(2, self.grid)
        return self.transformer.projection(tokens[:, 0]), F.adaptive_avg_pool2d(patches.float(), CELLS)

    def _tokens(self, pixel_values: Tensor, prefix: Tensor | None = None) -> Tensor:
        """Normalised tokens of class and patches, (B, 1 + patches, width)."""
        x, patches = self.transformer.tokens(pixel_values, prefix), self.grid[0] * self.grid[1]
        return self.transformer.norm(torch.cat([x[:, :1], x[:, -patches:]], dim=1))


class TouchObjective(nn.Module):
    """Eq. 2-3: L_{T -> V} + L_{V -> T} between touches and the frozen embeddings of their pictures, and what else has a
    weight.

    Args:
        model: With a fresh touch encoder.
        augment: Done to the touches.
        weights: Of the losses.
    """

    def __init__(self, model: UniTouchModel, augment: TouchAugmentation, weights: LossWeights | None = None):
        super().__init__()
        self.weights = weights or LossWeights()
        self.trained = TouchEncoder(model, self.weights)
        self.temperature, self.augment = model.config.temperature, augment

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        trained, weights = self.trained, self.weights
        touch, patches = trained.features(self.augmented(batch["touch"]), batch["sensor"])
        picture, near = batch["image_embeds"], batch["shown"]
        parts = {
            "image": symmetric_info_nce(touch, picture, self.temperature),
            "cosine": cosine_distance(touch, picture, near),
        }
        if weights.pairs:
            unnamed = torch.full_like(batch["sensor"], -1)
            second, other_patches = trained.features(self.augmented(batch["second"]), unnamed)
            parts["cosine"] = parts["cosine"] + cosine_distance(second, picture, near)
            parts["touch"] = symmetric_info_nce(touch, second, self.temperature)
            if trained.reader is not None:
                read = trained.reader(torch.stack([touch, second], dim=1).float())
                parts["attributes"] = F.mse_loss(read, batch["attributes"])
            if trained.mapper is not None:
                both = torch.stack([patches, other_patches], dim=1).movedim(2, -1)  # (B, 2, 8, 8, width)
                parts["maps"] = F.mse_loss(trained.mapper(both).movedim(-1, 2), batch["maps"].float())
        loss = torch.stack([getattr(weights, name) * part for name, part in parts.items()]).sum()
        return {"loss": loss, **{name: part.detach() for name, part in parts.items()}}

    def augmented(self, touch: Tensor) -> Tensor:
        """Pixel values (B, 3, S, S) of uint8 touches under other lights and gels."""
        raw = shift_pixels(touch.float() / 255, 4)
        raw = permute_channels(turn_and_flip(raw, self.augment.turn), self.augment.permute)
        raw = add_noise(jitter_colours(blur_some(raw, self.augment.blur), gain=0.15, offset=0.08), 0.02)
        return normalise_pixels(raw)


def cosine_distance(a: Tensor, b: Tensor, weight: Tensor) -> Tensor:
    """One less the cosine of embeddings (B, D), each weighed (B,); the mean over all of them."""
    return (weight * (1.0 - F.cosine_similarity(a.float(), b.float(), dim=1))).mean()


def start_from(model: UniTouchModel, folder: Path) -> None:
    """Gives a fresh touch encoder the weights of another model's; sensors that one has tokens for keep them.

    Raises:
        InvalidInputError: If the other model has no touch encoder, or one of other sizes.
    """
    other = UniTouchModel.from_pretrained(folder)
    if "touch" not in other.known_modalities:
        raise InvalidInputError(
            f"`init` is {str(folder)!r}, which holds no touch encoder; it has {', '.join(other.known_modalities)}."
        )
    transformer, bank = other.load("touch")
    try:
        model.touch_model.load_state_dict(transformer.state_dict())
    except RuntimeError as error:
        raise InvalidInputError(
            f"`init` is {str(folder)!r}, whose touch encoder has other sizes than the joint space's config: "
            f"{str(error).splitlines()[1].strip()}"
        ) from error
    for name in set(bank.names) & set(model.sensor_bank.names):
        if bank.tokens.shape[1:] == model.sensor_bank.tokens.shape[1:]:
            model.sensor_bank.tokens.data[model.sensor_bank.index(name)] = bank.tokens[bank.index(name)]


def set_prototypes(model: UniTouchModel, splits: list[Rendered]) -> None:
    """Each sensor's prototype: the mean of all raw images it took in training."""
    for name in model.sensor_bank.names:
        parts = [split.touch for split in splits if split.sensor == name]
        chunks = (part[start : start + CHUNK] for part in parts for start in range(0, len(part), CHUNK))
        total = sum(chunk.sum(axis=0, dtype=np.float64) for chunk in chunks)
        mean = total / sum(len(part) for part in parts) / 255.0
        pixels = torch.from_numpy(np.asarray(mean, dtype=np.float32))
        model.sensor_bank.set_prototype(name, F.adaptive_avg_pool2d(pixels, model.config.prototype_size))


def pairs_of(splits: list[Rendered], weights: LossWeights) -> dict[str, Any]:
    """Second touches, attributes (N, 2, 13) and maps (N, 2, 4, 8, 8) around their mean in units of their deviation.

    Raises:
        InvalidInputError: If they have a weight, and some split has none.
    """
    if not weights.pairs:
        return {}
    if any(split.second is None for split in splits):
        raise InvalidInputError(
            "`objective` weighs pairs of touches, attributes or maps, which only `data.drawn` has; set these to 0, or "
            "train on drawn contacts alone."
        )
    return {
        "second": [split.second for split in splits],
        "attributes": in_deviations(_joined(split.attributes for split in splits), (0, 1)),
        "maps": in_deviations(_joined(split.maps for split in splits), (0, 1, 3, 4)).astype(np.float16),
    }


def _joined(measures: Iterable[np.ndarray | None]) -> np.ndarray:
    return np.concatenate([values for values in measures if values is not None])


def watch_retrieval(model: UniTouchModel, encoder: TouchEncoder, held: list[Rendered]) -> Watch:
    """Retrieval of pictures by touches."""
    touches, pictures = (normalise_pixels(pixels_of(held, name).float() / 255) for name in ("touch", "image"))
    sensors = torch.from_numpy(sensor_numbers(held, model.config.sensors))
    with torch.no_grad():
        embeds = model.get_image_features(pictures)
    return lambda: retrieval(encoder(*on_device_of(encoder, touches, sensors)), embeds)


def main(stage: Stage) -> None:
    augment = stage.section("augment", TouchAugmentation)
    sigma = stage.section("sampler", SamplerSettings).sigma
    weights = stage.settings("objective", LossWeights)
    share_of(sigma, stage.trainer.batch_size, len(stage.sources))  # refused before anything is decoded
    processor = stage.processor()
    model = UniTouchModel.from_pretrained(stage.folders["joint"], modalities=("image",))
    tokens = stage.settings("sensors", SensorSettings).tokens
    needs = ("image", "touch", "sensor")
    splits = stage.splits(processor, *needs)
    embeds = image_embeddings(model, [split.image for split in splits], stage.key(splits), stage.cache)
    named = list(dict.fromkeys(split.sensor for split in splits if split.sensor is not None))
    model.config.sensors = [] if tokens == 0 else named
    model.config.sensor_tokens = tokens or model.config.sensor_tokens
    model.add("touch")
    if stage.init is not None:
        start_from(model, stage.init)
    set_prototypes(model, splits)

    sensor = sensor_numbers(splits, model.config.sensors)
    sizes = [len(split) for split in splits]
    columns: dict[str, Any] = {"image_embeds": embeds, "sensor": sensor, "shown": shown(stage.sources, splits)}
    columns["touch"] = [split.touch for split in splits]
    dataset = ArrayDataset(**columns, **pairs_of(splits, weights))
    sampler = InBatchSampler(sizes, stage.trainer.batch_size, sigma, stage.trainer.seed)
    objective = TouchObjective(model, augment, weights)
    watch = stage.watching(partial(watch_retrieval, model, objective.trained), processor, *needs)
    stage.fit(objective, dataset, sampler, watch)
    with stage.saving() as folder:
        save_modalities(model, ("touch",), processor, folder)


if __name__ == "__main__":
    run("touch", main)
