"""Texture: heads that add features of an ImageNet network to the embeddings of pictures and touches.

The encoders and the network are frozen, so their outputs on the training data are computed once. The two heads (see
`unitouch_gen.models.texture`) are trained by the losses of the earlier stages and by the names of the materials. On
drawn pictures, the distance to the embedding without texture is penalised, so that the space stays where it was.
"""

from functools import partial
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from pydantic import NonNegativeFloat, PositiveInt
from torch import Tensor, nn

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import UniTouchModel
from unitouch_gen.models.features import float_pixels, image_embeddings, in_batches, text_embeddings
from unitouch_gen.models.joint import stored_tensors
from unitouch_gen.models.texture import Texture, TextureHead, TextureTrunk
from unitouch_gen.models.vit import StemmedCLIPVisionModel
from unitouch_gen.training.batches import ArrayDataset, Batch, two_part_indices
from unitouch_gen.training.data import Contacts, DrawnContacts
from unitouch_gen.training.losses import symmetric_info_nce
from unitouch_gen.training.recipe import Settings, Share
from unitouch_gen.training.stages import Recipe, Stage, hash_weights
from unitouch_gen.training.touch import fit_distance
from unitouch_gen.weights import JOINT
from unitouch_gen.world import MATERIAL_NAMES

TRUNK = "vision_model.texture.trunk."  # prefix of its tensors in a joint space
TEMPLATES = ("{}", "this looks like {}", "this feels like {}")


class TextureSettings(Settings):
    """Width of the heads, and the trunk in front of them."""

    width: PositiveInt  # hidden units of each head
    trunk: str | None = None  # folder of a joint space to take the trunk from; the built-in one if left out

    @property
    def trunk_folder(self) -> Path:
        return JOINT if self.trunk is None else Path(self.trunk)


class TextureLosses(Settings):
    """Weights of the losses, and the noise on the statistics."""

    image: NonNegativeFloat  # InfoNCE of both touches of a contact and its picture (Eq. 2)
    touch: NonNegativeFloat  # InfoNCE of the two touches of a contact
    text: NonNegativeFloat  # InfoNCE of a picture and its caption
    image_name: NonNegativeFloat  # cross-entropy of a picture's material, against the embeddings of all names
    touch_name: NonNegativeFloat  # the same of both touches
    drawn: NonNegativeFloat  # 1 - cosine between the embeddings of a drawn picture with and without texture
    drawn_touch: NonNegativeFloat = 0.0  # the same of both touches of a drawn contact
    noise: NonNegativeFloat = 0.0  # standard deviation of the noise, in units of each statistic's own


class TextureRecipe(Recipe):
    model: TextureSettings
    objective: TextureLosses
    scanned: Share  # share of a batch that is of scanned surfaces, where there are any


class TextureObjective(nn.Module):
    """Losses of the two heads, on precomputed texture statistics and embeddings without texture.

    `names` are unit embeddings of the materials' names, (materials, D).
    """

    def __init__(self, model: UniTouchModel, losses: TextureLosses, names: Tensor):
        super().__init__()
        pictures, touches = textures_of(model)
        self.image = pictures.head
        self.touch = touches.head
        self.losses = losses
        self.temperature = model.config.temperature
        self.names = names

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        image = self.embedded(self.image, batch, "image")
        touch = self.embedded(self.touch, batch, "touch")
        second = self.embedded(self.touch, batch, "second")
        touch_to_image = symmetric_info_nce(touch, image, self.temperature)
        second_to_image = symmetric_info_nce(second, image, self.temperature)
        parts = {
            "image": touch_to_image + second_to_image,
            "touch": symmetric_info_nce(touch, second, self.temperature),
            "text": symmetric_info_nce(image, batch["text_embeds"], self.temperature),
            "image_name": self.name_loss(image, batch["material"]),
            "touch_name": self.name_loss(touch, batch["material"]) + self.name_loss(second, batch["material"]),
            "drawn": self.change(image, batch, "image"),
            "drawn_touch": self.change(touch, batch, "touch") + self.change(second, batch, "second"),
        }
        loss = torch.stack([getattr(self.losses, name) * part for name, part in parts.items()]).sum()
        return {"loss": loss, **{name: part.detach() for name, part in parts.items()}}

    def embedded(self, head: TextureHead, batch: Batch, name: str) -> Tensor:
        """Embeddings (B, D), with texture, of a batch's column "image", "touch" or "second"."""
        statistics = batch[f"{name}_statistics"]
        noise = self.losses.noise * head.deviation * torch.randn_like(statistics)
        return batch[f"{name}_embeds"] + head(statistics + noise)

    def change(self, embeds: Tensor, batch: Batch, name: str) -> Tensor:
        """Mean of 1 - cosine between embeddings (B, D) with and without texture, over the drawn contacts of a batch."""
        distance = 1.0 - F.cosine_similarity(embeds, batch[f"{name}_embeds"], dim=1)
        return (distance * batch["drawn"]).sum() / batch["drawn"].sum().clamp_min(1.0)

    def name_loss(self, embeds: Tensor, material: Tensor) -> Tensor:
        """Cross-entropy of the materials (B,) of embeddings (B, D) against the embeddings of all names."""
        logits = F.normalize(embeds, dim=1) @ self.names.to(embeds).T / self.temperature
        return F.cross_entropy(logits, material)


def name_embeddings(model: UniTouchModel, processor: Any) -> Tensor:
    """Unit embeddings of the materials' names, (materials, D), averaged over `TEMPLATES`."""
    per_template = [
        text_embeddings(model, processor, [template.format(name) for name in MATERIAL_NAMES]) for template in TEMPLATES
    ]
    return F.normalize(torch.stack(per_template).mean(dim=0), dim=1)


def textures_of(model: UniTouchModel) -> tuple[Any, Any]:
    """The `Texture`s of the encoders of image and touch; `None` for an encoder without one."""
    vision: Any = model.vision_model
    touch: Any = model.touch_model
    return getattr(vision, "texture", None), touch.texture


def check_takes_texture(model: UniTouchModel) -> None:
    """Raises if the encoders of a joint space cannot be given texture."""
    if not isinstance(model.vision_model, StemmedCLIPVisionModel):
        raise InvalidInputError(
            "`joint` has a plain CLIP encoder of pictures, which has no place for texture; name one whose "
            "`vision_config.stem` is 'residual'."
        )
    if any(texture is not None for texture in textures_of(model)):
        raise InvalidInputError("`joint` has texture already; name the joint space that the stage `touch` left.")


def read_trunk(folder: Path) -> TextureTrunk | None:
    """The trunk of a joint space in a folder, in float32; `None` if it has none."""
    tensors = stored_tensors(folder)
    if not any(name.startswith(TRUNK) for name in tensors):
        return None
    trunk = TextureTrunk()
    trunk.load_state_dict({name: tensors[TRUNK + name].float() for name in trunk.state_dict()})
    return trunk


def add_texture(model: UniTouchModel, settings: TextureSettings) -> None:
    """Gives the encoders of image and touch the trunk of another joint space, and heads that add nothing yet."""
    trunk = read_trunk(settings.trunk_folder)
    if trunk is None:
        raise InvalidInputError(f"`model.trunk` is {str(settings.trunk_folder)!r}, which holds no trunk of texture.")
    encoders: list[Any] = [model.vision_model, model.touch_model]
    configs: list[Any] = [model.config.vision_config, model.config.touch_config]
    for encoder, config in zip(encoders, configs, strict=True):
        encoder.texture = Texture(settings.width, model.config.projection_dim)
        encoder.texture.trunk.load_state_dict(trunk.state_dict())
        config.texture_width = settings.width


def touch_embeddings(stage: Stage, model: UniTouchModel, name: str, splits: list[Contacts]) -> Tensor:
    """Embeddings (N, D) of the column "touch", with tokens of its named sensors, or "second", without tokens."""

    def compute() -> Tensor:
        parts = [
            image_embeddings(model, "touch", getattr(split, name), split.sensors if name == "touch" else ())
            for split in splits
        ]
        return torch.cat(parts)

    return stage.computed_once(f"{name}-embeddings", "joint", splits, compute)


def texture_statistics(trunk: TextureTrunk, images: Any) -> Tensor:
    """Texture statistics (N, 528) of images (N, 3, S, S), of bytes or in [0, 1]."""
    return in_batches(len(images), lambda rows: trunk(float_pixels(images[rows])), size=32)


def cached_statistics(stage: Stage, trunk: TextureTrunk, trunk_hash: str, name: str, splits: list[Contacts]) -> Tensor:
    """`texture_statistics` of a column of all splits, cached by the hash of the trunk's weights."""

    def compute() -> Tensor:
        return torch.cat([texture_statistics(trunk, getattr(split, name)) for split in splits])

    return stage.computed_once(f"{name}-texture-{trunk_hash[:16]}", "joint", splits, compute)


def main(stage: Stage, recipe: TextureRecipe) -> None:
    if not all(isinstance(source, DrawnContacts) for source in stage.sources):
        raise InvalidInputError("`data.sets` cannot be used here: texture needs drawn contacts; leave it out.")
    model = stage.joint_space("image", "text", "touch")
    check_takes_texture(model)
    splits = stage.splits("image", "touch", "text")
    sources: Any = stage.sources
    columns: dict[str, Any] = {
        "material": torch.cat([split.material for split in splits]),
        "drawn": torch.tensor([float(surface is None) for source in sources for surface in source.surfaces("train")]),
        "text_embeds": text_embeddings(model, stage.processor, [text for split in splits for text in split.text]),
        "image_embeds": stage.image_embeddings(model, splits),
        "touch_embeds": touch_embeddings(stage, model, "touch", splits),
        "second_embeds": touch_embeddings(stage, model, "second", splits),
    }
    add_texture(model, recipe.model)
    pictures, touches = textures_of(model)
    trunk_hash = hash_weights(recipe.model.trunk_folder)
    for name in ("image", "touch", "second"):
        columns[f"{name}_statistics"] = cached_statistics(stage, pictures.trunk, trunk_hash, name, splits)
    pictures.head.fit(columns["image_statistics"])
    touches.head.fit(torch.cat([columns["touch_statistics"], columns["second_statistics"]]))

    objective = TextureObjective(model, recipe.objective, name_embeddings(model, stage.processor))
    is_scanned = (columns["drawn"] == 0.0).numpy()
    indices_of = partial(two_part_indices, in_first=is_scanned, share=recipe.scanned, **stage.batch_options)
    stage.fit(objective, ArrayDataset(**columns), indices_of)
    with torch.no_grad():
        embeds = columns["image_embeds"] + pictures.head(columns["image_statistics"])
    model.config.embedding_norm = embeds.norm(dim=1).mean().item()
    fit_distance(model, splits)
    with stage.saving(embedding_norm=model.config.embedding_norm) as folder:
        model.save_pretrained(folder)
        stage.processor.save_pretrained(folder)
