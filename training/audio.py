"""Audio bound to frozen images, as ImageBind (Girdhar et al., 2023)."""

import torch
from torch import Tensor, nn

from unitouch_gen.models import UniTouchModel
from unitouch_gen.training.batches import ArrayDataset, Batch
from unitouch_gen.training.losses import symmetric_info_nce
from unitouch_gen.training.stages import Recipe, Stage


class AudioObjective(nn.Module):
    """Symmetric InfoNCE between sounds and the frozen embeddings of their pictures."""

    def __init__(self, model: UniTouchModel):
        super().__init__()
        self.trained = model.audio_model
        self.temperature = model.config.temperature

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        spectrum = roll_in_time(batch["audio"].float(), 2)
        spectrum = spectrum + 0.02 * torch.randn_like(spectrum)
        audio_embeds = self.trained(spectrum)
        return {"loss": symmetric_info_nce(audio_embeds, batch["image_embeds"], self.temperature)}


def roll_in_time(spectrum: Tensor, reach: int) -> Tensor:
    """Delays each log-mel spectrogram (B, 1, mel, T) by up to `reach` frames; the first frame is repeated."""
    delays = torch.randint(0, reach + 1, (len(spectrum),))
    frames = torch.arange(spectrum.shape[-1])
    sources = (frames[None, :] - delays[:, None]).clamp_min(0)  # (B, T)
    return spectrum.gather(3, sources[:, None, None, :].expand_as(spectrum).to(spectrum.device))


def main(stage: Stage, recipe: Recipe) -> None:
    model = stage.joint_space("image")
    splits = stage.splits("image", "audio")
    dataset = ArrayDataset(audio=[split.audio for split in splits], image_embeds=stage.image_embeddings(model, splits))
    model.add("audio")
    stage.fit(AudioObjective(model), dataset)
    with stage.saving() as folder:
        model.save_pretrained(folder)
        stage.processor.save_pretrained(folder)
