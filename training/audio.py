"""Stage 2, audio bound to frozen images, as ImageBind (Girdhar et al., 2023).

python -m unitouch_gen.training.audio --joint runs/image_text/model --output runs/audio
"""

import torch
from torch import Tensor, nn

from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.training.data import ArrayDataset, Batch
from unitouch_gen.training.losses import symmetric_info_nce
from unitouch_gen.training.sampler import ShuffledSampler
from unitouch_gen.training.stages import (
    command,
    data_key,
    image_embeddings,
    parse,
    save_modalities,
    train,
    training_splits,
    write_record,
)


class AudioObjective(nn.Module):
    """Symmetric InfoNCE between sounds and the frozen embeddings of the pictures they belong to."""

    def __init__(self, model: UniTouchModel):
        super().__init__()
        self.trained = model.audio_model
        self.temperature = model.config.temperature

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        spectrum = roll_in_time(batch["audio"].float(), 2)
        spectrum = spectrum + 0.02 * torch.randn_like(spectrum)
        return {"loss": symmetric_info_nce(self.trained(spectrum), batch["image_embeds"], self.temperature)}


def roll_in_time(spectrum: Tensor, reach: int) -> Tensor:
    """Delays each log-mel picture (B, 1, mel, T) by up to `reach` frames."""
    delays = torch.randint(0, reach + 1, (len(spectrum),))
    frames = (torch.arange(spectrum.shape[-1])[None, :] - delays[:, None]).clamp_min(0)
    return spectrum.gather(3, frames[:, None, None, :].expand_as(spectrum).to(spectrum.device))


@command
def main() -> None:
    stage = parse("audio")
    torch.manual_seed(stage.trainer.seed)
    processor = UniTouchProcessor.from_pretrained(stage.folders["joint"])
    model = UniTouchModel.from_pretrained(stage.folders["joint"], modalities=("image",))
    splits = training_splits(stage, processor)
    embeds = image_embeddings(model, [split.image for split in splits], data_key(stage, splits), stage.cache)
    model.add("audio")

    dataset = ArrayDataset(audio=[split.audio for split in splits], image_embeds=embeds)
    sampler = ShuffledSampler(len(dataset), stage.trainer.batch_size, stage.trainer.seed)
    trainer = train(stage, AudioObjective(model), dataset, sampler)
    save_modalities(model, ("audio",), processor, stage.output / "model")
    write_record(stage, trainer.seconds)


if __name__ == "__main__":
    main()
