"""A sensor of one's own: its tokens, its prototype and, if that helps, low-rank updates of the touch encoder.

The encoder stays as it is for all other sensors: what is learned goes into a file of its own, see `AddedSensor`.
"""

import copy
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import torch
import torch.nn.functional as F
from pydantic import Field, NonNegativeFloat, PositiveInt
from torch import Tensor, nn
from tqdm.auto import tqdm

from unitouch_gen import weights
from unitouch_gen.errors import InvalidInputError, describe, first_of, needed
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.models.added_sensors import AddedSensor, print_of
from unitouch_gen.models.images import centre_rectangle, normalise_pixels
from unitouch_gen.models.sensors import layout_distances
from unitouch_gen.training.batches import (
    ArrayDataset,
    Batch,
    ShuffledSampler,
    add_noise,
    blur_some,
    jitter_colours,
    shift_pixels,
    turn_and_flip,
)
from unitouch_gen.training.data import open_dataset
from unitouch_gen.training.losses import symmetric_info_nce
from unitouch_gen.training.recipe import Settings
from unitouch_gen.training.trainer import Trainer, TrainerConfig

FEWEST = 8
"""Touches that a sensor is made of, at least."""

HELD_OUT = 0.2
"""Share of the groups of touches that figures are taken on."""

LAYERS = ("attention.qkv", "attention.out", "mlp.0", "mlp.2")
"""Linear layers of each block that get low-rank updates."""

MOST = {"steps": 10**6, "rank": 1000, "seed": 2**63 - 1}
"""What they may be; seeds are torch's to bound."""


class AdaptConfig(Settings):
    """How a sensor is learned.

    Attributes:
        steps: Optimiser steps.
        batch_size: Touches a step, of which as many as there are are taken.
        learning_rate: Peak of half a cosine.
        rank: Of the low-rank updates (Hu et al., 2022); 0 learns tokens and prototype alone.
        anchor: Weight of staying near what the encoder said before.
        seed: Of the split, the batches and the noise.
    """

    steps: Annotated[int, Field(ge=1, le=MOST["steps"])] = 300
    batch_size: PositiveInt = 32
    learning_rate: NonNegativeFloat = 1e-3
    rank: Annotated[int, Field(ge=0, le=MOST["rank"])] = 8
    anchor: NonNegativeFloat = 0.5
    seed: Annotated[int, Field(ge=0, le=MOST["seed"])] = 0


class Adapted(nn.Module):
    """A touch encoder behind the tokens of one sensor."""

    def __init__(self, encoder: nn.Module, tokens: Tensor):
        super().__init__()
        self.encoder, self.tokens = encoder, nn.Parameter(tokens.clone())

    def forward(self, pixel_values: Tensor) -> Tensor:
        return self.encoder(pixel_values, self.tokens.expand(len(pixel_values), -1, -1))


class AdaptObjective(nn.Module):
    """Touches bound to their pictures where there are some (Eq. 2), otherwise two views of a touch to each other.

    Args:
        encoder: The touch encoder, frozen, with updates that are trained if it has any.
        tokens: To start from, (L, width).
        anchor: Weight of one minus the cosine to the embedding of before.
        temperature: tau.
    """

    def __init__(self, encoder: nn.Module, tokens: Tensor, anchor: float, temperature: float):
        super().__init__()
        self.trained = Adapted(encoder, tokens)
        self.anchor, self.temperature = anchor, temperature

    def embed(self, raw: Tensor) -> Tensor:
        """(B, D) of raw touches (B, 3, S, S) in [0, 1]."""
        return self.trained(normalise_pixels(raw))

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        raw = batch["touch"].float() / 255
        one = self.embed(augmented(raw))
        other = batch["image_embeds"] if "image_embeds" in batch else self.embed(augmented(raw))
        moved = 1.0 - F.cosine_similarity(one, batch["before"]).mean()
        bound = symmetric_info_nce(one, other, self.temperature)
        return {"loss": bound + self.anchor * moved, "bound": bound.detach(), "moved": moved.detach()}


def augmented(raw: Tensor) -> Tensor:
    """Another view of touches in [0, 1]: as another press of the same place might look."""
    raw = turn_and_flip(shift_pixels(raw, raw.shape[-1] // 16), 0.5)
    return add_noise(jitter_colours(blur_some(raw, 0.25), gain=0.1, offset=0.05), 0.02)


def adapt(
    model: UniTouchModel,
    name: str,
    touches: np.ndarray,
    images: np.ndarray | None = None,
    groups: Sequence[str] | None = None,
    config: AdaptConfig | None = None,
    *,
    quiet: bool = False,
) -> AddedSensor:
    """Learns a sensor from its touches.

    Args:
        model: With the touch encoder, and the image encoder where pictures come.
        name: Of the new sensor.
        touches: uint8 (N, 3, S, S), at least `FEWEST`, of the size that the model takes.
        images: Pictures of the same places, alike.
        groups: What each touch is of, such as its object: groups are kept together in the split. Each touch is one of
            its own where it is left out.
        config: How.
        quiet: Whether to show no progress.

    Returns:
        The sensor, with `figures` of the touches that were held out, before and after.

    Raises:
        InvalidInputError: If there are too few touches or groups, or the name is taken.
    """
    config = config or AdaptConfig()
    groups = groups_of(model, name, len(touches), groups)
    size = model.config.touch_config.image_height
    for what, images_of in {"touches": touches, "images": images}.items():
        if images_of is not None and (images_of.dtype != np.uint8 or images_of.shape != (len(touches), 3, size, size)):
            raise InvalidInputError(
                f"`{what}` is {describe(images_of)}; it has to be uint8 ({len(touches)}, 3, {size}, {size})."
            )
    encoder, bank = model.load("touch")
    kept, held = split_groups(groups, config.seed)
    mean = torch.from_numpy(touches[kept].mean(axis=0, keepdims=True) / 255).float()
    prototype = F.interpolate(mean, (bank.prototype_size,) * 2, mode="bilinear", antialias=True)
    tokens = bank.tokens.new_zeros(bank.tokens.shape[1:])
    if len(bank):  # those of the sensor that looks most like it
        tokens = bank.tokens[int(bank.distances(prototype).argmin())].detach()
    torch.manual_seed(config.seed)
    network = copy.deepcopy(encoder).requires_grad_(False)
    if config.rank:
        layers = rf"blocks\.\d+\.({'|'.join(re.escape(layer) for layer in LAYERS)})"
        peft = needed("peft")
        lora_config = peft.LoraConfig(r=config.rank, lora_alpha=config.rank, target_modules=layers)
        network = peft.inject_adapter_in_model(lora_config, network)
    objective = AdaptObjective(network, tokens, config.anchor, model.config.temperature).eval()

    before = embedded(objective.embed, touches)
    columns: dict[str, Any] = {"touch": touches[kept], "before": before[kept]}
    pictures = None
    if images is not None:
        pictures = embedded(lambda raw: model.get_image_features(normalise_pixels(raw)), images)
        columns["image_embeds"] = pictures[kept]
    figures = {"before": figures_of(objective, touches, pictures, groups, held)}
    count = min(config.batch_size, len(kept))
    how = TrainerConfig(
        steps=config.steps, batch_size=count, learning_rate=config.learning_rate, warmup=min(20, config.steps),
        weight_decay=0.0, save_every=config.steps, trackers=[], seed=config.seed,
    )  # fmt: skip
    with TemporaryDirectory() as folder:
        sampler = ShuffledSampler(len(kept), count, config.seed)
        trainer = Trainer(objective, ArrayDataset(**columns), sampler, how, Path(folder) / name, quiet=quiet)
        if not trainer.fit():
            raise KeyboardInterrupt
    figures["after"] = figures_of(objective, touches, pictures, groups, held)
    lora = peft.get_peft_model_state_dict(network) if config.rank else {}
    counts = {"touches": len(touches), "held_out": len(held), "seed": config.seed}
    tokens = objective.trained.tokens.detach()
    reach = layout_distances(torch.from_numpy(touches[held]).float() / 255, prototype[0]).max().item()
    return AddedSensor(name, print_of(encoder), tokens, prototype[0], lora, {**counts, **figures}, reach)


def groups_of(model: UniTouchModel, name: str, count: int, groups: Sequence[str] | None) -> Sequence[str]:
    """What each of `count` touches is of; see `adapt`, whose errors it raises."""
    if name in model.sensors:
        raise InvalidInputError(f"`sensor` is {name!r}, which this model knows already; take another name.")
    if count < FEWEST:
        raise InvalidInputError(f"`touches` are {count}; {FEWEST} is the least that a sensor is made of.")
    if groups is None:
        return [str(row) for row in range(count)]
    if len(groups) != count:
        raise InvalidInputError(f"`groups` are {len(groups)} for {count} touches; name that of each.")
    if len(set(groups)) < 2:
        raise InvalidInputError("`groups` are one, so nothing can be held out; pass touches of two objects at least.")
    return groups


def split_groups(groups: Sequence[str], seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows to learn from and rows that are held out, no group in both."""
    names = sorted(set(groups))
    order = np.random.default_rng(seed).permutation(len(names))
    held = {names[place] for place in order[: max(round(HELD_OUT * len(names)), 1)]}
    rows = np.array([group in held for group in groups])
    return np.flatnonzero(~rows), np.flatnonzero(rows)


@torch.no_grad()
def embedded(embed: Callable[[Tensor], Tensor], images: np.ndarray, size: int = 64) -> Tensor:
    """(N, D) of uint8 images (N, 3, S, S)."""
    parts = (torch.from_numpy(np.array(images[start : start + size])) for start in range(0, len(images), size))
    return torch.cat([embed(part.float() / 255) for part in parts])


def figures_of(
    objective: AdaptObjective,
    touches: np.ndarray,
    pictures: Tensor | None,
    groups: Sequence[str],
    rows: np.ndarray,
) -> dict[str, float]:
    """What the embeddings of some touches are good for, in percent, with what chance gives.

    - "view": that another view of a touch is nearest to it among those of all the touches.
    - "picture": that its own picture is, where there are some.
    - "group": that the nearest other touch is of the same group, where groups have several.
    """
    was_training = objective.training
    objective.eval()
    embeds = F.normalize(embedded(objective.embed, touches[rows]), dim=1)
    torch.manual_seed(0)
    views = F.normalize(embedded(lambda raw: objective.embed(augmented(raw)), touches[rows]), dim=1)
    objective.train(was_training)
    own = torch.arange(len(rows))

    def found(others: Tensor) -> float:
        return 100 * float(((embeds @ others.T).argmax(dim=1) == own).float().mean())

    figures = {"view": found(views), "chance": 100 / len(rows)}
    if pictures is not None:
        figures["picture"] = found(F.normalize(pictures[rows], dim=1))
    names = np.array([groups[row] for row in rows])
    same = torch.from_numpy(names[:, None] == names[None, :]).float().fill_diagonal_(0.0)
    several = same.any(dim=1)
    if bool(several.any()):
        nearest = (embeds @ embeds.T).fill_diagonal_(-2.0).argmax(dim=1)
        figures["group"] = 100 * float(same[own, nearest][several].mean())
        figures["group_chance"] = 100 * float((same[several].sum(dim=1) / (len(rows) - 1)).mean())
    return figures


def learn(
    folder: Path,
    name: str,
    model: Path | None = None,
    config: AdaptConfig | None = None,
    *,
    told: Callable[[str], object] = print,
    quiet: bool = False,
    **layout: Any,
) -> AddedSensor:
    """Learns a sensor from a folder; see `adapt`.

    Args:
        folder: Of its touches, in any layout that `open_dataset` knows.
        name: Of the new sensor.
        model: Folder of a joint space with its processor; the built-in one if left out.
        config: How.
        told: Gets a line on each thing that a user should know of the folder.
        quiet: Whether to show no progress.
        layout: Of the folder: `kind`, `patterns` and `bgr` of `open_dataset`.

    Raises:
        InvalidInputError: If the folder or the model cannot be read, or there are too few touches.
    """
    if (config or AdaptConfig()).rank:
        needed("peft")
    place = weights.JOINT if model is None else model
    joint, processor = UniTouchModel.from_pretrained(place), UniTouchProcessor.from_pretrained(place)
    data = open_dataset(folder, sensor=name, **layout)
    records, size = data.records, processor.image_size
    objects = [record.object or "" for record in records]
    groups = groups_of(joint, name, len(data), None if "" in objects else objects)
    pictured = sum(record.picture is not None for record in records)
    for note in data.notes:
        told(note)
    if 0 < pictured < len(data):
        told(f"{pictured} of {len(data)} touches have a picture, so no pictures are used; give one to each")

    def pixels(column: str) -> np.ndarray:
        rows = tqdm(range(len(data)), desc=f"{data.name}: {column}", mininterval=5.0, disable=quiet)
        return np.stack(
            [(centre_rectangle(getattr(data[row], column).read(), size, size) * 255).round().byte() for row in rows]
        )

    images = pixels("picture") if pictured == len(data) else None
    touches = pixels("touch")
    _, bank = joint.load("touch")

    def distances(raw: Tensor) -> Tensor:
        raw = F.interpolate(raw, (bank.prototype_size,) * 2, mode="bilinear", antialias=True)
        return bank.distances(raw).min(dim=1).values

    if far := bank.unfamiliar(embedded(distances, touches).tolist()) if bool(bank.known.any()) else []:
        unlike = "touches look like those of no sensor that the model knows, as photos would; see that they are touches"
        told(f"{len(far)} of {len(data)} {unlike}: {first_of([records[row].id for row in far])}")
    return adapt(joint, name, touches, images, groups, config, quiet=quiet)
