"""Calls of the pipelines of `components`, the networks that ran in them, and diffusers' pipeline beside ours."""

from dataclasses import dataclass
from typing import Any

import torch
from diffusers import StableUnCLIPImg2ImgPipeline, UNet2DConditionModel
from torch import Tensor, nn
from transformers import CLIPImageProcessor, CLIPVisionConfig, CLIPVisionModelWithProjection

from tests.helpers.components import D
from unitouch_gen.conditioning import SensorBackgrounds
from unitouch_gen.models.joint import MODULES
from unitouch_gen.pipelines import XToTouchPipeline


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def quiet(pipe: Any) -> Any:
    pipe.set_progress_bar_config(disable=True)
    return pipe


@dataclass
class Call:
    """A pipeline with its inputs, of which it draws from one seed."""

    pipe: Any
    inputs: dict[str, Any]

    def __call__(self, **options: Any) -> Any:
        return self.pipe(**{"generator": seeded(), "output_type": "pt", **self.inputs, **options})

    def latents(self, **options: Any) -> Tensor:
        """Before the VAE: a codebook jumps where sums are rounded otherwise."""
        return self(output_type="latent", **options).images

    def one(self, row: int) -> "Call":
        """The same with one of the inputs."""
        rows = {name: value[row : row + 1] for name, value in self.inputs.items() if isinstance(value, Tensor)}
        return Call(self.pipe, {**self.inputs, **rows})


def networks_of(pipe: Any) -> dict[str, nn.Module]:
    """By their names in `report.left_out`."""
    found = {"UNet": pipe.unet, "VAE encoder": pipe.vae.encoder, "VAE decoder": pipe.vae.decoder}
    if pipe.unitouch is not None:
        modules = {name: first for name, (first, *_) in MODULES.items()} | {"touch": "touch_model.stem"}
        found |= {f"{modality} encoder": pipe.unitouch.get_submodule(name) for modality, name in modules.items()}
    return found | ({} if pipe.text_encoder is None else {"prompt encoder": pipe.text_encoder})


def watched(pipe: Any) -> list[tuple[str, int]]:
    """The networks that run from here on, with the batch sizes that they see."""
    ran: list[tuple[str, int]] = []

    def note(name: str) -> Any:
        return lambda module, args, kwargs: ran.append((name, len([*args, *kwargs.values()][0])))

    for name, network in networks_of(pipe).items():
        network.register_forward_pre_hook(note(name), with_kwargs=True)
    return ran


def diffusers_pipeline(components: dict[str, Any]) -> StableUnCLIPImg2ImgPipeline:
    """diffusers' own unCLIP pipeline of the same components."""
    config = CLIPVisionConfig(
        hidden_size=16,
        intermediate_size=32,
        num_hidden_layers=1,
        num_attention_heads=2,
        image_size=32,
        patch_size=8,
        projection_dim=D,
    )
    shared = {key: value for key, value in components.items() if key not in ("unitouch", "processor")}
    encoder = CLIPVisionModelWithProjection(config).eval()
    processor = CLIPImageProcessor(size=32, crop_size=32)
    return quiet(StableUnCLIPImg2ImgPipeline(feature_extractor=processor, image_encoder=encoder, **shared))


def shown_gels(
    pipe: XToTouchPipeline, sensors: tuple[str, ...] = ("gelsight", "digit"), **parts: Any
) -> XToTouchPipeline:
    """A pipeline of the same parts whose network is shown untouched gels."""
    torch.manual_seed(2)
    labels = len(sensors) + 1 if sensors else None
    unet = UNet2DConditionModel.from_config(pipe.unet.config, in_channels=6, num_class_embeds=labels).eval()
    stored = SensorBackgrounds.of(torch.randn(len(sensors), 3, 8, 8)) if sensors else None
    own = {**pipe.components, "unet": unet, "backgrounds": stored, **parts}
    return quiet(XToTouchPipeline(**own, sensors=sensors, default_num_inference_steps=2))
