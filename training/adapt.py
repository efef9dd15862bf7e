"""A sensor of one's own: its tokens and its prototype, in a file of its own, see `AddedSensor`.

The encoder stays as it is, and with it all other sensors.
"""

import copy
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from pydantic import NonNegativeFloat, PositiveInt
from torch import Tensor, nn
from tqdm.auto import tqdm

from unitouch_gen import weights
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.models.sensors import AddedSensor, fingerprint, layout_distances
from unitouch_gen.training import batches
from unitouch_gen.training.batches import ArrayDataset, Batch, ShuffledSampler
from unitouch_gen.training.data import open_dataset
from unitouch_gen.training.data.columns import square
from unitouch_gen.training.losses import symmetric_info_nce
from unitouch_gen.training.recipe import Seed, Settings
from unitouch_gen.training.trainer import Trainer, TrainerConfig


class AdaptConfig(Settings):
    """How a sensor is learned."""

    steps: PositiveInt = 300
    batch_size: PositiveInt = 32  # as many as there are where there are fewer
    learning_rate: NonNegativeFloat = 1e-3  # peak of half a cosine
    anchor: NonNegativeFloat = 0.5  # weight of staying near what the encoder said before
    seed: Seed = 0  # of the batches and the noise


class Adapted(nn.Module):
    """A frozen touch encoder behind the tokens of one sensor, (L, width), which are learned."""

    def __init__(self, encoder: nn.Module, tokens: Tensor):
        super().__init__()
        self.encoder, self.tokens = encoder, nn.Parameter(tokens.clone())

    def forward(self, raw: Tensor) -> Tensor:
        """Embeddings (B, D) of raw touches (B, 3, S, S) in [0, 1]."""
        return self.encoder(normalise_pixels(raw), self.tokens.expand(len(raw), -1, -1))


class AdaptObjective(nn.Module):
    """Touches bound to their pictures where there are some (Eq. 2), otherwise two views of a touch to each other.

    Beside that, 1 - cosine to the embedding of before, at the weight `anchor`.
    """

    def __init__(self, trained: Adapted, anchor: float, temperature: float):
        super().__init__()
        self.trained, self.anchor, self.temperature = trained, anchor, temperature

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        raw = batch["touch"].float() / 255
        one = self.trained(augmented(raw))
        other = batch["image_embeds"] if "image_embeds" in batch else self.trained(augmented(raw))
        moved = 1.0 - F.cosine_similarity(one, batch["before"]).mean()
        bound = symmetric_info_nce(one, other, self.temperature)
        return {"loss": bound + self.anchor * moved, "bound": bound.detach(), "moved": moved.detach()}


def augmented(raw: Tensor) -> Tensor:
    """Another view of touches in [0, 1]: as another press of the same place might look."""
    raw = batches.blur_some(batches.shift_pixels(raw, raw.shape[-1] // 16), 0.25)
    return batches.add_noise(batches.jitter_colours(raw, gain=0.1, offset=0.05), 0.02)


def adapt(
    model: UniTouchModel, name: str, touches: np.ndarray, images: np.ndarray | None = None,
    config: AdaptConfig | None = None,
) -> AddedSensor:  # fmt: skip
    """Learns a sensor from its touches.

    Args:
        model: With the touch encoder, and the image encoder where pictures come.
        name: Of the new sensor.
        touches: uint8 (N, 3, S, S), at least 8, of the size that the model takes.
        images: Pictures of the same places, alike.
        config: How.

    Raises:
        InvalidInputError: If there are too few touches, or the name is taken.
    """
    config, count = config or AdaptConfig(), len(touches)
    if name in model.sensors:
        raise InvalidInputError(f"`sensor` is {name!r}, which this model knows already; take another name.")
    if count < 8:
        raise InvalidInputError(f"Got {count} touches; take 8 at least.")
    encoder, bank = model.load("touch")
    mean = torch.from_numpy(touches.mean(axis=0, keepdims=True) / 255).float()
    prototype = F.interpolate(mean, (bank.prototype_size,) * 2, mode="bilinear", antialias=True)
    tokens = bank.tokens.new_zeros(bank.tokens.shape[1:])
    if len(bank):  # those of the sensor that looks most like it
        tokens = bank.tokens[int(bank.distances(prototype).argmin())].detach()
    torch.manual_seed(config.seed)
    trained = Adapted(copy.deepcopy(encoder).requires_grad_(False), tokens).eval()
    columns: dict[str, Any] = {"touch": touches, "before": in_batches(trained, touches)}
    if images is not None:
        columns["image_embeds"] = in_batches(lambda raw: model.get_image_features(normalise_pixels(raw)), images)
    how = TrainerConfig(
        steps=config.steps, batch_size=min(config.batch_size, count), learning_rate=config.learning_rate,
        warmup=min(20, config.steps), weight_decay=0.0, save_every=config.steps, seed=config.seed,
    )  # fmt: skip
    objective = AdaptObjective(trained, config.anchor, model.config.temperature)
    sampler = ShuffledSampler(count, how.batch_size, config.seed)
    with TemporaryDirectory() as folder:
        Trainer(objective, ArrayDataset(**columns), sampler, how, Path(folder) / name).fit()
    reach = in_batches(lambda raw: layout_distances(raw, prototype[0]), touches).max().item()
    return AddedSensor(name, fingerprint(encoder), trained.tokens.detach(), prototype[0], reach)


@torch.no_grad()
def in_batches(call: Callable[[Tensor], Tensor], images: np.ndarray) -> Tensor:
    """Rows that a call makes of uint8 images (N, 3, S, S), which it gets in [0, 1]."""
    return torch.cat([call(part.float() / 255) for part in torch.from_numpy(images).split(64)])


def learn(
    folder: Path, name: str, model: Path | None, config: AdaptConfig, log_fn: Callable[[str], object], kind: str
) -> AddedSensor:
    """Learns a sensor from a folder of its touches, in a layout that `open_dataset` knows as `kind`.

    `model` is the folder of a joint space with its processor, the built-in one if it is `None`. `log_fn` gets a line on
    each thing that a user should know of the folder.
    """
    place = model or weights.JOINT
    joint, processor = UniTouchModel.from_pretrained(place), UniTouchProcessor.from_pretrained(place)
    data = open_dataset(folder, kind, sensor=name)
    pictured = sum(record.picture is not None for record in data.records)
    for note in data.notes:
        log_fn(note)
    if 0 < pictured < len(data):
        log_fn(f"{pictured} of {len(data)} touches have a picture, so no pictures are used; give one to each")

    def pixels(column: str) -> np.ndarray:
        rows = tqdm(data.records, desc=f"{data.name}: {column}", mininterval=5.0, disable=None)
        return np.stack([square(getattr(record, column), processor.image_size) for record in rows])

    return adapt(joint, name, pixels("touch"), pixels("picture") if pictured == len(data) else None, config)
