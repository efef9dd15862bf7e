"""Stage 4, the autoencoder of pictures: diffusers' `AutoencoderKL` with an L1 + gradient loss.

    python -m unitouch_gen.training.image_vae --joint runs/image_text/model --output runs/image_vae
"""

import torch
import torch.nn.functional as F
from diffusers import AutoencoderKL
from torch import Tensor, nn

from unitouch_gen.encoders import UniTouchProcessor
from unitouch_gen.training.core import Batch, Trainer
from unitouch_gen.training.data import ArrayDataset
from unitouch_gen.training.sampler import ShuffledSampler
from unitouch_gen.training.stages import parse, training_splits, write_folder, write_record


class AutoencoderObjective(nn.Module):
    """Reconstruction (L1, and L1 of the image's differences, for crisp edges) with a light pull to a unit Gaussian."""

    def __init__(self, vae: AutoencoderKL, kl_weight: float, gradient_weight: float):
        super().__init__()
        self.trained = vae
        self.kl_weight, self.gradient_weight = kl_weight, gradient_weight

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        pixels = batch["image"].float() / 127.5 - 1.0
        posterior = self.trained.encode(pixels).latent_dist
        restored = self.trained.decode(posterior.sample()).sample.float()
        error = F.l1_loss(restored, pixels)
        edges = sum(F.l1_loss(restored.diff(dim=dim), pixels.diff(dim=dim)) for dim in (2, 3))
        kl = posterior.kl().mean() / posterior.mean[0].numel()
        mse = F.mse_loss(restored.detach(), pixels) / 4.0  # on [0, 1]
        loss = error + self.gradient_weight * edges + self.kl_weight * kl
        return {"loss": loss, "psnr": -10.0 * torch.log10(mse), "kl": kl.detach()}


@torch.no_grad()
def latent_scale(vae: AutoencoderKL, dataset: ArrayDataset, count: int = 2048) -> float:
    """1 / standard deviation of the latents (Rombach et al., 2022, appendix G)."""
    order = torch.randperm(len(dataset), generator=torch.Generator().manual_seed(0))[:count].tolist()
    latents = [
        vae.encode(dataset.__getitems__(order[i : i + 128])["image"].float() / 127.5 - 1.0).latent_dist.mean
        for i in range(0, len(order), 128)
    ]
    return 1.0 / torch.cat(latents).std().item()


def main() -> None:
    stage = parse("image_vae")
    torch.manual_seed(stage.trainer.seed)
    processor = UniTouchProcessor(image_size=stage.recipe["data"]["image_size"], audio=stage.recipe["data"]["audio"])
    dataset = ArrayDataset(image=[split.image for split in training_splits(stage, processor)])
    vae = AutoencoderKL(**stage.recipe["model"])
    sampler = ShuffledSampler(len(dataset), stage.trainer.batch_size, stage.trainer.seed)
    trainer = Trainer(AutoencoderObjective(vae, **stage.recipe["loss"]), dataset, sampler, stage.trainer, stage.output)
    if stage.resume:
        trainer.resume()
    trainer.fit()
    vae.register_to_config(scaling_factor=latent_scale(vae, dataset))
    write_folder(stage.output / "model", lambda folder: vae.save_pretrained(folder))
    write_record(stage, trainer.seconds)


if __name__ == "__main__":
    main()
