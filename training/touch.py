"""Touch bound to frozen images, with sensor tokens and in-batch sampling (Section 3 of the paper).

After training, `fit_distance` fits the distance by which touches unlike the training data are recognised.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
import torch.nn.functional as F
from pydantic import NonNegativeFloat, NonNegativeInt, model_validator
from torch import Tensor, nn

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.files import reading
from unitouch_gen.models import UniTouchModel
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.models.joint import Gaussians, RelativeDistance, touch_statistics
from unitouch_gen.models.sensor_bank import layout_distances
from unitouch_gen.training import batches
from unitouch_gen.training.batches import ArrayDataset, Batch, SamplerSettings, in_deviations, share_of
from unitouch_gen.training.data import Contacts, sensor_numbers
from unitouch_gen.training.losses import symmetric_info_nce
from unitouch_gen.training.recipe import Settings, Share
from unitouch_gen.training.stages import Recipe, Stage
from unitouch_gen.world import ATTRIBUTES, CELLS, MAPS

ABSTAINED = 0.046  # share of the training touches that are beyond the threshold


class TouchAugmentation(Settings):
    """Probabilities of permuting channels, as other lights would, and of blurring, as a softer gel would."""

    permute: Share
    blur: Share


class SensorSettings(Settings):
    tokens: NonNegativeInt | None = None  # of each sensor; null for the joint space's number, 0 for no sensor tokens


class LossWeights(Settings):
    """Weights of losses: the paper's, the distance of a touch to its picture, and three that need drawn contacts."""

    image: NonNegativeFloat = 1.0  # InfoNCE of touches and their pictures (Eq. 2-3)
    # 1 - cosine(touch, picture). InfoNCE asks only that other pictures are further away. It leaves touches in a region
    # of their own (Liang et al., 2022, "Mind the gap"), for which generators are not trained.
    cosine: NonNegativeFloat = 0.0
    touch: NonNegativeFloat = 0.0  # InfoNCE of the same contact under two sensors
    attributes: NonNegativeFloat = 0.0  # squared error of a contact's attributes, by a linear layer on its embedding
    maps: NonNegativeFloat = 0.0  # squared error of attributes in each part of the view, by one on the patch tokens

    @property
    def pairs(self) -> list[str]:
        """Names of the losses that need drawn contacts and have a weight above 0."""
        return [name for name in ("touch", "attributes", "maps") if getattr(self, name)]

    @model_validator(mode="after")
    def _has_a_loss(self) -> Self:
        if not (self.image or self.cosine or self.pairs):
            raise InvalidInputError(f"`objective` weighs nothing; give one of {[*type(self).model_fields]} a weight.")
        return self


class TouchRecipe(Recipe):
    sampler: SamplerSettings
    augment: TouchAugmentation
    objective: LossWeights = LossWeights()
    sensors: SensorSettings = SensorSettings()


class TouchEncoder(nn.Module):
    """The trained modules: touch transformer, sensor tokens, and linear layers for attributes and maps."""

    def __init__(self, model: UniTouchModel, weights: LossWeights):
        super().__init__()
        self.transformer = model.touch_model
        self.bank = model.sensor_bank
        config: Any = model.config.touch_config
        self.grid = config.grid
        self.reader = nn.Linear(config.projection_dim, len(ATTRIBUTES)) if weights.attributes else None
        self.mapper = nn.Linear(config.hidden_size, len(MAPS)) if weights.maps else None

    def forward(self, pixel_values: Tensor, sensor_ids: Tensor) -> tuple[Tensor, Tensor]:
        """Embeddings (B, D), and patch tokens pooled to the cells of the view, (B, width, 8, 8).

        Touches whose sensor id is below 0 get no sensor tokens.
        """
        tokens = self.bank.encode(self._tokens, self.transformer.stem(pixel_values), sensor_ids)
        # DistributedDataParallel waits for a gradient of every weight.
        tokens = tokens + 0.0 * self.bank.tokens.sum().to(tokens)
        patches = self.transformer.norm(tokens[:, 1:]).transpose(1, 2).unflatten(2, self.grid)
        embeds = self.transformer.embed(tokens)
        if self.transformer.texture is not None:
            embeds = embeds + self.transformer.texture(pixel_values)
        return embeds, F.adaptive_avg_pool2d(patches.float(), CELLS)

    def _tokens(self, stemmed: Tensor, prefix: Tensor | None = None) -> Tensor:
        """Tokens of class and patches, (B, 1 + patches, width), of the stem's output."""
        tokens = self.transformer.tokens(stemmed, prefix)
        patches = self.grid[0] * self.grid[1]
        return torch.cat([tokens[:, :1], tokens[:, -patches:]], dim=1)


class TouchObjective(nn.Module):
    """Eq. 2-3: L_{T -> V} + L_{V -> T} of touches and frozen embeddings of their pictures, and other losses."""

    def __init__(self, model: UniTouchModel, augment: TouchAugmentation, weights: LossWeights | None = None):
        super().__init__()
        self.weights = weights or LossWeights()
        self.trained = TouchEncoder(model, self.weights)
        self.temperature = model.config.temperature
        self.augment = augment

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        encoder = self.trained
        touch, patches = encoder(self.augmented(batch["touch"]), batch["sensor"])
        picture = batch["image_embeds"]
        losses = {
            "image": symmetric_info_nce(touch, picture, self.temperature),
            "cosine": cosine_distance(touch, picture),
        }
        if self.weights.pairs:
            no_sensor = torch.full_like(batch["sensor"], -1)
            second, second_patches = encoder(self.augmented(batch["second"]), no_sensor)
            losses["image"] = 0.5 * (losses["image"] + symmetric_info_nce(second, picture, self.temperature))
            losses["cosine"] = losses["cosine"] + cosine_distance(second, picture)
            losses["touch"] = symmetric_info_nce(touch, second, self.temperature)
            if encoder.reader is not None:
                attributes = encoder.reader(torch.stack([touch, second], dim=1).float())  # (B, 2, K)
                losses["attributes"] = F.mse_loss(attributes, batch["attributes"])
            if encoder.mapper is not None:
                both_patches = torch.stack([patches, second_patches], dim=1).movedim(2, -1)  # (B, 2, 8, 8, width)
                maps = encoder.mapper(both_patches).movedim(-1, 2)  # (B, 2, 4, 8, 8)
                losses["maps"] = F.mse_loss(maps, batch["maps"].float())
        weighted = [getattr(self.weights, name) * loss for name, loss in losses.items()]
        detached = {name: loss.detach() for name, loss in losses.items()}
        return {"loss": torch.stack(weighted).sum(), **detached}

    def augmented(self, touch: Tensor) -> Tensor:
        """Pixel values (B, 3, S, S) of uint8 touches, as under other lights and gels."""
        pixels = batches.shift_pixels(touch.float() / 255, 4)
        pixels = batches.permute_channels(pixels, self.augment.permute)
        pixels = batches.blur_some(pixels, self.augment.blur)
        pixels = batches.jitter_colours(pixels, gain=0.15, offset=0.08)
        pixels = batches.add_noise(pixels, 0.02)
        return normalise_pixels(pixels)


def cosine_distance(a: Tensor, b: Tensor) -> Tensor:
    """The mean of 1 - cosine of embeddings (B, D)."""
    return (1.0 - F.cosine_similarity(a.float(), b.float(), dim=1)).mean()


def start_from(model: UniTouchModel, folder: Path) -> None:
    """Copies the touch encoder of another model, and the tokens of the sensors that both models name."""
    with reading("init", folder):
        transformer, bank = UniTouchModel.from_pretrained(folder).load("touch")
    try:
        model.touch_model.load_state_dict(transformer.state_dict())
    except RuntimeError as error:
        why = str(error).splitlines()[-1].strip()
        raise InvalidInputError(f"`init` is {str(folder)!r}, which does not fit the joint space: {why}") from error
    for name in set(bank.names) & set(model.sensor_bank.names):
        if bank.tokens.shape[1:] == model.sensor_bank.tokens.shape[1:]:
            model.sensor_bank.tokens.data[model.sensor_bank.index(name)] = bank.tokens[bank.index(name)]


def spread(values: Any, count: int = 500) -> Any:
    """At most `count` rows, evenly spaced."""
    return values[np.unique(np.linspace(0, len(values) - 1, count).astype(int))]


def set_prototypes(model: UniTouchModel, splits: list[Contacts], reaches: bool = False) -> None:
    """Sets each sensor's prototype to the mean of its raw training images.

    With `reaches`, also sets the distance within which nearly all of these images are. Touches beyond it get no sensor
    tokens, so the encoder has to be trained without tokens, too.
    """
    model.config.sensor_reaches = {}
    for name in model.sensor_bank.names:
        touches = [split.touch for split in splits if split.sensors[0] == name]
        total = sum(images.sum(axis=0, dtype=np.float64) for images in touches)
        mean = total / sum(map(len, touches)) / 255.0
        pixels = torch.from_numpy(np.asarray(mean, dtype=np.float32))
        model.sensor_bank.set_prototype(name, F.adaptive_avg_pool2d(pixels, model.config.prototype_size))
        if reaches:
            sample = torch.from_numpy(np.concatenate([spread(images) for images in touches])) / 255
            distances = layout_distances(sample, model.sensor_bank.prototype(name))
            model.config.sensor_reaches[name] = distances.quantile(1.0 - ABSTAINED / 2).item()


def fit_gaussians(features: Tensor, labels: Tensor, shrinkage: float = 0.1) -> Gaussians:
    """Gaussians of one covariance around the mean of each class, of features (N, F) with int64 labels (N,).

    The covariance, of features in units of their deviation, is shrunk towards the unit matrix by `shrinkage`.
    """
    values = features.double()
    classes, class_of_row = labels.unique(return_inverse=True)
    means = torch.stack([values[class_of_row == number].mean(dim=0) for number in range(len(classes))])
    deviation = values.std(dim=0).clamp_min(1e-6)
    residuals = (values - means[class_of_row]) / deviation
    covariance = residuals.T @ residuals / len(residuals)
    unit = torch.eye(len(covariance)).double()
    scale, axes = torch.linalg.eigh((1.0 - shrinkage) * covariance + shrinkage * unit)
    return Gaussians(means.float(), (axes * scale.rsqrt() / deviation[:, None]).float())


@torch.no_grad()
def fit_distance(model: UniTouchModel, splits: Sequence[Contacts]) -> None:
    """Fits the distance of touches to the training data, by material where these are known, and its threshold."""
    stem = model.touch_model.stem
    weight = model.touch_model.projection.weight

    def statistics(images: Iterable[np.ndarray]) -> Tensor:
        sample = torch.from_numpy(np.concatenate([spread(column) for column in images]))
        rows = list[Tensor]()
        for part in sample.split(256):
            pixels = normalise_pixels(part.float() / 255)
            rows.append(touch_statistics(stem(pixels.to(weight)), pixels))
        return torch.cat(rows).cpu()

    cover = ATTRIBUTES.index("cover")
    covers = list[Tensor]()
    materials_of = list[Tensor]()
    for split in splits:
        if split.attributes is None:
            # Every data set numbers its materials in its own way, so all of them are one class.
            covers.append(torch.ones(len(split)))
            materials_of.append(torch.full((len(split),), -1))
        else:
            covers.append(split.attributes[:, 0, cover])
            materials_of.append(split.material)
    touching = torch.cat([*map(spread, covers)]) > 0.0  # touches of nothing tell nothing about a material
    materials = torch.cat([*map(spread, materials_of)])[touching]
    touches = statistics(split.touch for split in splits)[touching]
    pictures = statistics(split.image for split in splits)
    distance = RelativeDistance(fit_gaussians(touches, materials), fit_gaussians(pictures, torch.zeros(len(pictures))))
    model.out_of_distribution["touch"] = distance
    model.config.ood_thresholds = {"touch": {"foreign": distance(touches).quantile(1.0 - ABSTAINED).item()}}


def pairs_of(splits: list[Contacts]) -> dict[str, Any]:
    """Columns of second touches, attributes (N, 2, 13) and maps (N, 2, 4, 8, 8), the latter two as z-scores."""
    attributes = torch.cat([split.attributes for split in splits]).numpy()
    maps = np.concatenate([split.maps for split in splits])
    return {
        "second": [split.second for split in splits],
        "attributes": in_deviations(attributes, (0, 1)),
        "maps": in_deviations(maps, (0, 1, 3, 4)).astype(np.float16),
    }


def main(stage: Stage, recipe: TouchRecipe) -> None:
    stage.check_drawn(*recipe.objective.pairs)
    share_of(recipe.sampler.sigma, stage.trainer.batch_size, len(stage.sources))  # raises before anything is decoded
    model = stage.joint_space("image")
    splits = stage.splits("image", "touch", "sensor")
    embeds = stage.image_embeddings(model, splits)
    model.config.sensors = []
    if recipe.sensors.tokens != 0:
        sensors = dict.fromkeys(name for split in splits for name in split.sensors)
        model.config.sensors = [name for name in sensors if name is not None]
    model.config.sensor_tokens = recipe.sensors.tokens or model.config.sensor_tokens
    model.add("touch")
    if "init" in stage.folders:
        start_from(model, stage.folders["init"])
    elif model.touch_model.texture is not None:
        vision: Any = model.vision_model
        model.touch_model.texture.load_state_dict(vision.texture.state_dict())  # begins as that of pictures
    set_prototypes(model, splits, reaches=bool(recipe.objective.pairs))

    columns: dict[str, Any] = {
        "image_embeds": embeds,
        "sensor": sensor_numbers(splits, model.config.sensors),
        "touch": [split.touch for split in splits],
    }
    if recipe.objective.pairs:
        columns |= pairs_of(splits)
    objective = TouchObjective(model, recipe.augment, recipe.objective)
    stage.fit(objective, ArrayDataset(**columns), stage.sampler(recipe.sampler, splits, embeds))
    fit_distance(model, splits)
    with stage.saving() as folder:
        model.save_pretrained(folder)
        stage.processor.save_pretrained(folder)
