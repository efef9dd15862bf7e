"""Audio, or another modality, bound to frozen images, as ImageBind (Girdhar et al., 2023).

The stage's name is the modality that is bound.
"""

import torch
from torch import Tensor, nn

from unitouch_gen.models import UniTouchModel
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.training.batches import ArrayDataset, Batch
from unitouch_gen.training.losses import symmetric_info_nce
from unitouch_gen.training.stages import Recipe, Stage


class BindingObjective(nn.Module):
    """Symmetric InfoNCE between a modality, such as "audio", and the frozen embeddings of pictures."""

    def __init__(self, model: UniTouchModel, modality: str):
        super().__init__()
        self.trained, *_ = model.load(modality)
        self.temperature = model.config.temperature
        self.augment = AUGMENTATIONS.get(modality, normalised)

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        embeds = self.trained(self.augment(batch["values"]))
        return {"loss": symmetric_info_nce(embeds, batch["image_embeds"], self.temperature)}


def normalised(images: Tensor) -> Tensor:
    """Pixel values of uint8 images (B, 3, S, S)."""
    return normalise_pixels(images.float() / 255)


def augment_sounds(spectrum: Tensor) -> Tensor:
    """Log-mel spectrograms (B, 1, mel, T), delayed and with noise."""
    spectrum = roll_in_time(spectrum.float(), 2)
    return spectrum + 0.02 * torch.randn_like(spectrum)


def roll_in_time(spectrum: Tensor, reach: int) -> Tensor:
    """Delays each log-mel spectrogram (B, 1, mel, T) by up to `reach` frames; the first frame is repeated."""
    delays = torch.randint(0, reach + 1, (len(spectrum),))
    frames = torch.arange(spectrum.shape[-1])
    sources = (frames[None, :] - delays[:, None]).clamp_min(0)  # (B, T)
    return spectrum.gather(3, sources[:, None, None, :].expand_as(spectrum).to(spectrum.device))


AUGMENTATIONS = {"audio": augment_sounds}
"""What prepares the columns of a modality for its encoder; those of others are uint8 images."""


def main(stage: Stage, recipe: Recipe) -> None:
    modality = stage.name
    model = stage.joint_space("image")
    splits = stage.splits("image", modality)
    values = [getattr(split, modality) for split in splits]
    dataset = ArrayDataset(values=values, image_embeds=stage.image_embeddings(model, splits))
    model.add(modality)
    stage.fit(BindingObjective(model, modality), dataset)
    with stage.saving() as folder:
        model.save_pretrained(folder)
        stage.processor.save_pretrained(folder)
