"""Stage 3, texture: what a network that was trained on photos adds to the embeddings of pictures and touches.

All encoders and the network stay as they are: what they say of the training data is computed once, and two small heads
are trained on that (see `unitouch_gen.models.texture`). Scanned surfaces teach them, by the same losses as the stages
before, and the names of materials; drawn contacts hold the space where it was.
"""

from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from pydantic import NonNegativeFloat, PositiveInt
from torch import Tensor, nn

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.evaluation.contacts import float_pixels, image_embeddings, in_batches
from unitouch_gen.evaluation.zero_shot import text_embeddings
from unitouch_gen.models import UniTouchModel
from unitouch_gen.models.joint import stored_tensors
from unitouch_gen.models.texture import Texture, TextureHead, TextureTrunk
from unitouch_gen.models.vit import StemmedCLIPVisionModel
from unitouch_gen.training.batches import ArrayDataset, Batch
from unitouch_gen.training.data import Contacts
from unitouch_gen.training.losses import symmetric_info_nce
from unitouch_gen.training.recipe import Settings
from unitouch_gen.training.stages import Recipe, Stage
from unitouch_gen.training.touch import fit_distance
from unitouch_gen.weights import JOINT
from unitouch_gen.world import MATERIAL_NAMES

TRUNK = "vision_model.texture.trunk."  # prefix of its tensors in a joint space
TEMPLATES = ("{}", "this looks like {}", "this feels like {}")


class TextureSettings(Settings):
    """Sizes of the heads, and whose trunk they stand on."""

    width: PositiveInt
    trunk: str | None = None  # folder of a joint space that has one; the built-in one if left out


class TextureLosses(Settings):
    """Weights of losses, and the noise on what they are of."""

    image: NonNegativeFloat  # InfoNCE of both touches of a contact and its picture (Eq. 2)
    touch: NonNegativeFloat  # InfoNCE of its touches
    text: NonNegativeFloat  # InfoNCE of its picture and its caption
    image_name: NonNegativeFloat  # cross-entropy of the material's name among all, of pictures
    touch_name: NonNegativeFloat  # and of touches
    drawn: NonNegativeFloat  # 1 - cosine of the embedding of a drawn picture before and after
    noise: NonNegativeFloat = 0.0  # deviation of what is added to statistics, in units of theirs


class TextureRecipe(Recipe):
    model: TextureSettings
    objective: TextureLosses


class TextureObjective(nn.Module):
    """What the heads are trained by, on statistics and on what the encoders say without them.

    `names` are unit embeddings of the materials' names (materials, D), in their order.
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
        kept = F.cosine_similarity(image, batch["image_embeds"].float(), dim=1)
        bound = symmetric_info_nce(touch, image, self.temperature) + symmetric_info_nce(second, image, self.temperature)
        parts = {
            "image": bound,
            "touch": symmetric_info_nce(touch, second, self.temperature),
            "text": symmetric_info_nce(image, batch["text_embeds"], self.temperature),
            "image_name": self.named(image, batch["material"]),
            "touch_name": self.named(touch, batch["material"]) + self.named(second, batch["material"]),
            "drawn": ((1.0 - kept) * batch["drawn"]).sum() / batch["drawn"].sum().clamp_min(1.0),
        }
        loss = torch.stack([getattr(self.losses, name) * part for name, part in parts.items()]).sum()
        return {"loss": loss, **{name: part.detach() for name, part in parts.items()}}

    def embedded(self, head: TextureHead, batch: Batch, name: str) -> Tensor:
        """Embeddings (B, D) with texture of a batch's image, touch or second touch."""
        statistics = batch[f"{name}_statistics"]
        noise = self.losses.noise * head.deviation * torch.randn_like(statistics)
        return batch[f"{name}_embeds"] + head(statistics + noise)

    def named(self, embeds: Tensor, material: Tensor) -> Tensor:
        logits = F.normalize(embeds, dim=1) @ self.names.to(embeds).T / self.temperature
        return F.cross_entropy(logits, material)


def name_embeddings(model: UniTouchModel, processor: Any) -> Tensor:
    """Unit embeddings of the materials' names, (materials, D): means over `TEMPLATES`."""
    per_template = [
        text_embeddings(model, processor, [template.format(name) for name in MATERIAL_NAMES]) for template in TEMPLATES
    ]
    return F.normalize(torch.stack(per_template).mean(dim=0), dim=1)


def textures_of(model: UniTouchModel) -> tuple[Texture, Texture]:
    """Those of the encoders of image and touch."""
    vision: Any = model.vision_model
    touch: Any = model.touch_model
    return vision.texture, touch.texture


def add_texture(model: UniTouchModel, settings: TextureSettings) -> None:
    """Gives the encoders of image and touch the trunk of another joint space, and heads that add nothing yet."""
    if not isinstance(model.vision_model, StemmedCLIPVisionModel):
        raise InvalidInputError(
            "`joint` has a plain CLIP encoder of pictures, which has no place for texture; name one whose "
            "`vision_config.stem` is 'residual'."
        )
    tensors = stored_tensors(Path(settings.trunk) if settings.trunk else JOINT)
    encoders: list[Any] = [model.vision_model, model.touch_model]
    configs: list[Any] = [model.config.vision_config, model.config.touch_config]
    for encoder, config in zip(encoders, configs, strict=True):
        encoder.texture = Texture(settings.width, model.config.projection_dim)
        trunk = encoder.texture.trunk
        trunk.load_state_dict({name: tensors[TRUNK + name].float() for name in trunk.state_dict()})
        config.texture_width = settings.width


def touch_embeddings(stage: Stage, model: UniTouchModel, name: str, splits: list[Contacts]) -> Tensor:
    """Embeddings (N, D) of a column of touches: those of named sensors with their tokens, "second" ones without."""

    def compute() -> Tensor:
        parts = [
            image_embeddings(model, "touch", getattr(split, name), split.sensors if name == "touch" else ())
            for split in splits
        ]
        return torch.cat(parts)

    return stage.computed_once(f"{name}-embeddings", "joint", splits, compute)


def statistics_of(stage: Stage, trunk: TextureTrunk, name: str, splits: list[Contacts]) -> Tensor:
    """Texture statistics (N, 528) of a column of images."""

    def of_images(images: Any) -> Tensor:
        return in_batches(len(images), lambda rows: trunk(float_pixels(images[rows])), size=32)

    def compute() -> Tensor:
        return torch.cat([of_images(getattr(split, name)) for split in splits])

    return stage.computed_once(f"{name}-texture", "joint", splits, compute)


def main(stage: Stage, recipe: TextureRecipe) -> None:
    stage.check_drawn(*recipe.objective.model_dump(exclude={"noise"}))
    model = stage.joint_space("image", "text", "touch")
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
    for name in ("image", "touch", "second"):
        columns[f"{name}_statistics"] = statistics_of(stage, pictures.trunk, name, splits)
    pictures.head.fit(columns["image_statistics"])
    touches.head.fit(torch.cat([columns["touch_statistics"], columns["second_statistics"]]))

    objective = TextureObjective(model, recipe.objective, name_embeddings(model, stage.processor))
    stage.fit(objective, ArrayDataset(**columns))
    with torch.no_grad():
        embeds = columns["image_embeds"] + pictures.head(columns["image_statistics"])
    model.config.embedding_norm = embeds.norm(dim=1).mean().item()
    fit_distance(model, splits)
    with stage.saving(embedding_norm=model.config.embedding_norm) as folder:
        model.save_pretrained(folder)
        stage.processor.save_pretrained(folder)
