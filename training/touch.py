"""Stage 3, touch bound to frozen images, with sensor tokens and in-batch sampling (Section 3 of the paper).

At its end it fits the distance that tells which touches are unlike those the encoder was trained on.
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
from unitouch_gen.models.sensors import layout_distances
from unitouch_gen.training import batches
from unitouch_gen.training.batches import ArrayDataset, Batch, SamplerSettings, in_deviations, share_of
from unitouch_gen.training.data import Contacts, sensor_numbers
from unitouch_gen.training.losses import symmetric_info_nce
from unitouch_gen.training.recipe import Settings, Share
from unitouch_gen.training.stages import Recipe, Stage
from unitouch_gen.world import ATTRIBUTES, CELLS, MAPS

ABSTAINED = 0.046  # share of the touches of training that are beyond the threshold


class TouchAugmentation(Settings):
    """Probabilities of exchanging colours, and of softening: other lights and gels."""

    permute: Share
    blur: Share


class SensorSettings(Settings):
    tokens: NonNegativeInt | None = None  # of each; null for the joint space's number, 0 trains without sensors


class LossWeights(Settings):
    """Weights of losses: the paper's, the distance of a touch to its picture, and three that need drawn contacts."""

    image: NonNegativeFloat = 1.0  # InfoNCE of touches and their pictures (Eq. 2-3)
    # 1 - cosine(touch, picture). InfoNCE asks only that others are further, and leaves touches far from all pictures
    # (Liang et al., 2022, "Mind the gap"), where generators have seen nothing.
    cosine: NonNegativeFloat = 0.0
    touch: NonNegativeFloat = 0.0  # InfoNCE of the same contact under two sensors
    attributes: NonNegativeFloat = 0.0  # squared error of a contact's measures, read linearly off its embedding
    maps: NonNegativeFloat = 0.0  # the same of measures in each part of the view, read off the patches' tokens

    @property
    def pairs(self) -> list[str]:
        """The weights above 0 of what only drawn contacts have."""
        return [name for name in ("touch", "attributes", "maps") if getattr(self, name)]

    @model_validator(mode="after")
    def _something_is_weighed(self) -> Self:
        if not (self.image or self.cosine or self.pairs):
            raise InvalidInputError(f"`objective` weighs nothing; give one of {[*type(self).model_fields]} a weight.")
        return self


class TouchRecipe(Recipe):
    sampler: SamplerSettings
    augment: TouchAugmentation
    objective: LossWeights = LossWeights()
    sensors: SensorSettings = SensorSettings()


class TouchEncoder(nn.Module):
    """What is trained: the touch transformer, the sensor tokens, and what reads measures off embeddings and patches."""

    def __init__(self, model: UniTouchModel, weights: LossWeights):
        super().__init__()
        self.transformer = model.touch_model
        self.bank = model.sensor_bank
        config: Any = model.config.touch_config
        self.grid = config.grid
        self.reader = nn.Linear(config.projection_dim, len(ATTRIBUTES)) if weights.attributes else None
        self.mapper = nn.Linear(config.hidden_size, len(MAPS)) if weights.maps else None

    def forward(self, pixel_values: Tensor, sensor_ids: Tensor) -> tuple[Tensor, Tensor]:
        """Embeddings (B, D), and what patches say of their cells of the view, (B, width, 8, 8).

        Those of sensors below 0 have no tokens.
        """
        tokens = self.bank.encode(self._tokens, self.transformer.stem(pixel_values), sensor_ids)
        tokens = tokens + 0.0 * self.bank.tokens.sum().to(tokens)  # processes wait for a gradient of every weight
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
    """Eq. 2-3: L_{T -> V} + L_{V -> T} between touches and frozen embeddings of their pictures, and other losses."""

    def __init__(self, model: UniTouchModel, augment: TouchAugmentation, weights: LossWeights | None = None):
        super().__init__()
        self.weights = weights or LossWeights()
        self.trained = TouchEncoder(model, self.weights)
        self.temperature = model.config.temperature
        self.augment = augment

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        trained = self.trained
        weights = self.weights
        touch, patches = trained(self.augmented(batch["touch"]), batch["sensor"])
        picture = batch["image_embeds"]
        parts = {"image": symmetric_info_nce(touch, picture, self.temperature)}
        parts["cosine"] = cosine_distance(touch, picture)
        if weights.pairs:
            unnamed = torch.full_like(batch["sensor"], -1)
            second, other_patches = trained(self.augmented(batch["second"]), unnamed)
            parts["image"] = 0.5 * (parts["image"] + symmetric_info_nce(second, picture, self.temperature))
            parts["cosine"] = parts["cosine"] + cosine_distance(second, picture)
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
        raw = batches.permute_channels(batches.shift_pixels(touch.float() / 255, 4), self.augment.permute)
        raw = batches.blur_some(raw, self.augment.blur)
        return normalise_pixels(batches.add_noise(batches.jitter_colours(raw, gain=0.15, offset=0.08), 0.02))


def cosine_distance(a: Tensor, b: Tensor) -> Tensor:
    """The mean of 1 - cosine of embeddings (B, D)."""
    return (1.0 - F.cosine_similarity(a.float(), b.float(), dim=1)).mean()


def start_from(model: UniTouchModel, folder: Path) -> None:
    """Gives a fresh touch encoder the weights of another model's; sensors that one has tokens for keep them."""
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
    """At most `count` rows, spread over all."""
    return values[np.unique(np.linspace(0, len(values) - 1, count).astype(int))]


def set_prototypes(model: UniTouchModel, splits: list[Contacts], reaches: bool = False) -> None:
    """Each sensor's prototype: the mean of all raw images it took in training.

    With `reaches`, also the distance that nearly all of these are within. Touches beyond it get no tokens, so the
    encoder has to be trained without tokens, too.
    """
    model.config.sensor_reaches = {}
    for name in model.sensor_bank.names:
        parts = [split.touch for split in splits if split.sensors[0] == name]
        mean = sum(part.sum(axis=0, dtype=np.float64) for part in parts) / sum(map(len, parts)) / 255.0
        pixels = torch.from_numpy(np.asarray(mean, dtype=np.float32))
        model.sensor_bank.set_prototype(name, F.adaptive_avg_pool2d(pixels, model.config.prototype_size))
        if reaches:
            own = torch.from_numpy(np.concatenate([spread(part) for part in parts])) / 255
            distances = layout_distances(own, model.sensor_bank.prototype(name))
            model.config.sensor_reaches[name] = distances.quantile(1.0 - ABSTAINED / 2).item()


def fit_gaussians(features: Tensor, labels: Tensor, shrinkage: float = 0.1) -> Gaussians:
    """Gaussians of one covariance around the mean of each class, of features (N, F) with int64 labels (N,).

    `shrinkage` is the share of the covariance, of features in units of their deviation, that is the unit matrix.
    """
    values = features.double()
    names, rows = labels.unique(return_inverse=True)
    means = torch.stack([values[rows == row].mean(dim=0) for row in range(len(names))])
    deviation = values.std(dim=0).clamp_min(1e-6)
    residuals = (values - means[rows]) / deviation
    covariance = residuals.T @ residuals / len(residuals)
    scale, axes = torch.linalg.eigh((1.0 - shrinkage) * covariance + shrinkage * torch.eye(len(covariance)).double())
    return Gaussians(means.float(), (axes * scale.rsqrt() / deviation[:, None]).float())


@torch.no_grad()
def fit_distance(model: UniTouchModel, splits: Sequence[Contacts]) -> None:
    """Gives a model the distance of touches, by class where materials are known, and its threshold."""
    stem = model.touch_model.stem
    weight = model.touch_model.projection.weight

    def statistics(images: Iterable[np.ndarray]) -> Tensor:
        pixels = torch.from_numpy(np.concatenate([spread(part) for part in images]))
        parts = (normalise_pixels(part.float() / 255) for part in pixels.split(256))
        return torch.cat([touch_statistics(stem(part.to(weight)), part) for part in parts]).cpu()

    cover = ATTRIBUTES.index("cover")  # what touches nothing is not known by its touch
    pressed = [torch.ones(len(one)) if one.attributes is None else one.attributes[:, 0, cover] for one in splits]
    rows = torch.cat([*map(spread, pressed)]) > 0.0
    # Data sets number materials in their own ways, so all of theirs are one class.
    known = [one.material if one.attributes is not None else torch.full((len(one),), -1) for one in splits]
    materials = torch.cat([*map(spread, known)])[rows]
    touches = statistics(split.touch for split in splits)[rows]
    pictures = statistics(split.image for split in splits)
    distance = RelativeDistance(fit_gaussians(touches, materials), fit_gaussians(pictures, torch.zeros(len(pictures))))
    model.out_of_distribution["touch"] = distance
    model.config.ood_thresholds = {"touch": {"foreign": distance(touches).quantile(1.0 - ABSTAINED).item()}}


def pairs_of(splits: list[Contacts]) -> dict[str, Any]:
    """Second touches, attributes (N, 2, 13) and maps (N, 2, 4, 8, 8) around their mean in units of their deviation."""
    attributes = torch.cat([split.attributes for split in splits]).numpy()
    return {
        "second": [split.second for split in splits],
        "attributes": in_deviations(attributes, (0, 1)),
        "maps": in_deviations(np.concatenate([split.maps for split in splits]), (0, 1, 3, 4)).astype(np.float16),
    }


def main(stage: Stage, recipe: TouchRecipe) -> None:
    stage.check_drawn(*recipe.objective.pairs)
    share_of(recipe.sampler.sigma, stage.trainer.batch_size, len(stage.sources))  # refused before anything is decoded
    model = stage.joint_space("image")
    splits = stage.splits("image", "touch", "sensor")
    embeds = stage.image_embeddings(model, splits)
    tokens = recipe.sensors.tokens
    names = dict.fromkeys(name for split in splits for name in split.sensors)
    model.config.sensors = [] if tokens == 0 else [name for name in names if name is not None]
    model.config.sensor_tokens = tokens or model.config.sensor_tokens
    model.add("touch")
    if "init" in stage.folders:
        start_from(model, stage.folders["init"])
    elif model.touch_model.texture is not None:
        model.touch_model.texture.load_state_dict(model.vision_model.texture.state_dict())
    set_prototypes(model, splits, reaches=bool(recipe.objective.pairs))

    dataset = ArrayDataset(
        image_embeds=embeds,
        sensor=sensor_numbers(splits, model.config.sensors),
        touch=[split.touch for split in splits],
        **(pairs_of(splits) if recipe.objective.pairs else {}),
    )
    objective = TouchObjective(model, recipe.augment, recipe.objective)
    stage.fit(objective, dataset, stage.sampler(recipe.sampler, splits, embeds))
    fit_distance(model, splits)
    with stage.saving() as folder:
        model.save_pretrained(folder)
        stage.processor.save_pretrained(folder)
