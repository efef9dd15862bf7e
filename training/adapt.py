"""A sensor of one's own: its tokens, its prototype and, if that helps, low-rank updates of the touch encoder.

The encoder stays as it is for all other sensors: what is learned goes into a file of its own, see `AddedSensor`.
"""

import copy
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveInt
from torch import Tensor, nn
from tqdm.auto import tqdm

from unitouch_gen import weights
from unitouch_gen.errors import InvalidInputError, needed
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
from unitouch_gen.training.watching import retrieval


class AdaptConfig(Settings):
    """How a sensor is learned."""

    steps: PositiveInt = 300
    batch_size: PositiveInt = 32  # as many as there are where there are fewer
    learning_rate: NonNegativeFloat = 1e-3  # peak of half a cosine
    rank: NonNegativeInt = 8  # of the low-rank updates; 0 learns tokens and prototype alone
    anchor: NonNegativeFloat = 0.5  # weight of staying near what the encoder said before
    seed: Seed = 0  # of the split, the batches and the noise


class Adapted(nn.Module):
    """A touch encoder behind the tokens of one sensor, (L, width)."""

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
    raw = batches.turn_and_flip(batches.shift_pixels(raw, raw.shape[-1] // 16), 0.5)
    return batches.add_noise(batches.jitter_colours(batches.blur_some(raw, 0.25), gain=0.1, offset=0.05), 0.02)


def adapt(
    model: UniTouchModel,
    name: str,
    touches: np.ndarray,
    images: np.ndarray | None = None,
    groups: Sequence[str] | None = None,
    config: AdaptConfig | None = None,
) -> AddedSensor:
    """Learns a sensor from its touches.

    Args:
        model: With the touch encoder, and the image encoder where pictures come.
        name: Of the new sensor.
        touches: uint8 (N, 3, S, S), at least 8, of the size that the model takes.
        images: Pictures of the same places, alike.
        groups: What each touch is of, such as its object: groups are kept together in the split. Each touch is one of
            its own where it is left out.
        config: How.

    Returns:
        The sensor, with `figures` of the touches that were held out, before and after.

    Raises:
        InvalidInputError: If there are too few touches or groups, or the name is taken.
    """
    config, count = config or AdaptConfig(), len(touches)
    groups = [str(row) for row in range(count)] if groups is None else groups
    if name in model.sensors:
        raise InvalidInputError(f"`sensor` is {name!r}, which this model knows already; take another name.")
    if count < 8 or len(set(groups)) < 2:
        given = f"{count} touches of {len(set(groups))} objects"
        raise InvalidInputError(f"Got {given}; take 8 of 2 objects at least, or nothing can be held out.")
    encoder, bank = model.load("touch")
    kept, held = split_groups(groups, config.seed)
    mean = torch.from_numpy(touches[kept].mean(axis=0, keepdims=True) / 255).float()
    prototype = F.interpolate(mean, (bank.prototype_size,) * 2, mode="bilinear", antialias=True)
    tokens = bank.tokens.new_zeros(bank.tokens.shape[1:])
    if len(bank):  # those of the sensor that looks most like it
        tokens = bank.tokens[int(bank.distances(prototype).argmin())].detach()
    torch.manual_seed(config.seed)
    network = copy.deepcopy(encoder).requires_grad_(False)
    if config.rank:  # low-rank updates of the linear layers of each block (Hu et al., 2022)
        peft, layers = needed("peft"), r"blocks\.\d+\.(attention\.qkv|attention\.out|mlp\.0|mlp\.2)"
        lora = peft.LoraConfig(r=config.rank, lora_alpha=config.rank, target_modules=layers)
        network = peft.inject_adapter_in_model(lora, network)
    trained = Adapted(network, tokens).eval()

    before, pictures = embedded(trained, touches), None
    columns: dict[str, Any] = {"touch": touches[kept], "before": before[kept]}
    if images is not None:
        embeds = embedded(lambda raw: model.get_image_features(normalise_pixels(raw)), images)
        columns["image_embeds"], pictures = embeds[kept], embeds[held]
    figures: dict[str, Any] = {"before": figures_of(trained, touches[held], pictures)}
    how = TrainerConfig(
        steps=config.steps, batch_size=min(config.batch_size, len(kept)), learning_rate=config.learning_rate,
        warmup=min(20, config.steps), weight_decay=0.0, save_every=config.steps, seed=config.seed,
    )  # fmt: skip
    objective = AdaptObjective(trained, config.anchor, model.config.temperature)
    sampler = ShuffledSampler(len(kept), how.batch_size, config.seed)
    with TemporaryDirectory() as folder:
        Trainer(objective, ArrayDataset(**columns), sampler, how, Path(folder) / name).fit()
    figures["after"] = figures_of(trained, touches[held], pictures)
    figures |= {"touches": count, "held_out": len(held), "seed": config.seed}
    updates = peft.get_peft_model_state_dict(network) if config.rank else {}
    reach = layout_distances(torch.from_numpy(touches[held]).float() / 255, prototype[0]).max().item()
    return AddedSensor(name, fingerprint(encoder), trained.tokens.detach(), prototype[0], updates, figures, reach)


def split_groups(groups: Sequence[str], seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows to learn from, and rows of a fifth of the groups, which figures are taken on."""
    names = sorted(set(groups))
    order = np.random.default_rng(seed).permutation(len(names))
    held = {names[place] for place in order[: max(round(0.2 * len(names)), 1)]}
    rows = np.array([group in held for group in groups])
    return np.flatnonzero(~rows), np.flatnonzero(rows)


@torch.no_grad()
def embedded(embed: Callable[[Tensor], Tensor], images: np.ndarray) -> Tensor:
    """(N, D) of uint8 images (N, 3, S, S)."""
    return torch.cat([embed(part.float() / 255) for part in torch.from_numpy(images).split(64)])


def figures_of(network: Adapted, touches: np.ndarray, pictures: Tensor | None) -> dict[str, float]:
    """How often another view ("view") or its own picture ("picture") is nearest to a touch, in percent, with chance."""
    embeds = embedded(network, touches)
    torch.manual_seed(0)
    others = {"view": embedded(lambda raw: network(augmented(raw)), touches), "picture": pictures}
    found = {name: 100 * retrieval(embeds, key)["retrieval_top1"] for name, key in others.items() if key is not None}
    return {**found, "chance": 100 / len(touches)}


def learn(
    folder: Path, name: str, model: Path | None, config: AdaptConfig, log_fn: Callable[[str], object], **layout: Any
) -> AddedSensor:
    """Learns a sensor from a folder of its touches, in a layout that `open_dataset` knows by its arguments `layout`.

    `model` is the folder of a joint space with its processor, the built-in one if it is `None`. `log_fn` gets a line on
    each thing that a user should know of the folder.
    """
    place = model or weights.JOINT
    joint, processor = UniTouchModel.from_pretrained(place), UniTouchProcessor.from_pretrained(place)
    data = open_dataset(folder, sensor=name, **layout)
    objects = [record.object or "" for record in data.records]
    pictured = sum(record.picture is not None for record in data.records)
    for note in data.notes:
        log_fn(note)
    if 0 < pictured < len(data):
        log_fn(f"{pictured} of {len(data)} touches have a picture, so no pictures are used; give one to each")

    def pixels(column: str) -> np.ndarray:
        rows = tqdm(data.records, desc=f"{data.name}: {column}", mininterval=5.0, disable=None)
        return np.stack([square(getattr(record, column), processor.image_size) for record in rows])

    images = pixels("picture") if pictured == len(data) else None
    return adapt(joint, name, pixels("touch"), images, None if "" in objects else objects, config)
