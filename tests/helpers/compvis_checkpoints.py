"""Checkpoints in CompVis' layout with random weights, and their settings."""

import copy
import functools
import math
from pathlib import Path

import numpy as np
import torch
import yaml
from torch import Tensor

from tests.helpers.compvis_networks import Autoencoder, UNet, random_weights

WIDTH = 8  # of the condition
START, END, STEPS = 0.0015, 0.0195, 1000

UNETS = {
    "vq": {"image_size": 8, "in_channels": 3, "out_channels": 3, "model_channels": 32, "attention_resolutions": [2],
           "num_res_blocks": 1, "channel_mult": [1, 2], "num_heads": 2, "use_spatial_transformer": True,
           "transformer_depth": 1, "context_dim": WIDTH},
    "kl": {"image_size": 8, "in_channels": 4, "out_channels": 4, "model_channels": 32, "attention_resolutions": [1, 2],
           "num_res_blocks": 2, "channel_mult": [1, 2], "num_head_channels": 16, "use_spatial_transformer": True,
           "transformer_depth": 2, "context_dim": WIDTH, "use_linear_in_transformer": True,
           "use_scale_shift_norm": True, "use_checkpoint": True, "legacy": False},
}  # fmt: skip
FIRST_STAGES = {
    "vq": {"embed_dim": 3, "n_embed": 32,
           "ddconfig": {"double_z": False, "z_channels": 3, "resolution": 32, "in_channels": 3, "out_ch": 3, "ch": 32,
                        "ch_mult": [1, 1, 2], "num_res_blocks": 2, "attn_resolutions": [], "dropout": 0.0}},
    "kl": {"embed_dim": 4, "lossconfig": {"target": "torch.nn.Identity"},
           "ddconfig": {"double_z": True, "z_channels": 4, "resolution": 32, "in_channels": 3, "out_ch": 3, "ch": 32,
                        "ch_mult": [1, 2], "num_res_blocks": 1, "attn_resolutions": [], "dropout": 0.0}},
}  # fmt: skip
CLASSES = {"vq": "VQModelInterface", "kl": "AutoencoderKL"}
SCALES = {"vq": 1.0, "kl": 0.25}


def settings_of(kind: str) -> dict:
    """What the YAML file holds."""
    first_stage = {"target": f"ldm.models.autoencoder.{CLASSES[kind]}", "params": FIRST_STAGES[kind]}
    unet = {"target": "ldm.modules.diffusionmodules.openaimodel.UNetModel", "params": UNETS[kind]}
    params = {"linear_start": START, "linear_end": END, "timesteps": STEPS, "conditioning_key": "crossattn",
              "image_size": 8, "channels": 3, "scale_factor": SCALES[kind], "first_stage_config": first_stage,
              "unet_config": unet}  # fmt: skip
    return copy.deepcopy({"model": {"target": "ldm.models.diffusion.ddpm.LatentDiffusion", "params": params}})


@functools.cache
def networks_of(kind: str) -> tuple:
    """UNet, autoencoder, and the UNet that is its moving average."""
    return (
        random_weights(UNet(UNETS[kind]), 0),
        random_weights(Autoencoder(FIRST_STAGES[kind]), 1),
        random_weights(UNet(UNETS[kind]), 2),
    )


def betas() -> np.ndarray:
    """The schedule of latent diffusion: linear in the root."""
    return np.linspace(math.sqrt(START), math.sqrt(END), STEPS) ** 2


@functools.cache
def state_of(kind: str) -> dict[str, Tensor]:
    unet, vae, average = networks_of(kind)
    return {
        "betas": torch.tensor(betas(), dtype=torch.float32),
        "alphas_cumprod": torch.tensor(np.cumprod(1 - betas()), dtype=torch.float32),
        **{f"model.diffusion_model.{key}": tensor for key, tensor in unet.state_dict().items()},
        "model_ema.decay": torch.tensor(0.9999),
        "model_ema.num_updates": torch.tensor(10),
        **{f"model_ema.diffusion_model{key.replace('.', '')}": t for key, t in average.state_dict().items()},
        **{f"first_stage_model.{key}": tensor for key, tensor in vae.state_dict().items()},
        "cond_stage_model.embedding.weight": torch.ones(4, WIDTH),
    }


def write(folder: Path, state: dict, settings: dict) -> dict[str, Path]:
    """The two files of a checkpoint, as arguments."""
    folder.mkdir(parents=True, exist_ok=True)
    torch.save({"state_dict": state, "global_step": 7}, folder / "last.ckpt")
    (folder / "config.yaml").write_text(yaml.safe_dump(settings), encoding="utf-8")
    return {"ldm": folder / "last.ckpt", "config": folder / "config.yaml"}
