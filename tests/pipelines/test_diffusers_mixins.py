"""diffusers' own tests of pipelines, as its repository has them, run on two of ours.

Its test mixins are not installed with it, so `DIFFUSERS_REPOSITORY` names a checkout; without one all is skipped:

    git clone --depth 1 https://github.com/huggingface/diffusers elsewhere/diffusers
    pip install parameterized requests-mock torchsde
    DIFFUSERS_REPOSITORY=elsewhere/diffusers pytest tests/pipelines/test_diffusers_mixins.py -rs
"""

import importlib.util
import os
import sys
import unittest
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel
from PIL import Image

from tests.helpers.components import make_components, make_x_to_touch
from unitouch_gen.pipelines import TouchToImagePipeline, XToTouchPipeline

if "DIFFUSERS_REPOSITORY" not in os.environ:
    pytest.skip("DIFFUSERS_REPOSITORY names no checkout of diffusers", allow_module_level=True)
for needed in ("parameterized", "peft", "requests_mock", "torchsde"):
    pytest.importorskip(needed, reason=f"diffusers' tests need {needed}")


def theirs(module: str) -> Any:
    """A module of their tests, which import each other as parts of one package; `tests` is the name of ours."""
    name = "diffusers_tests"
    if name not in sys.modules:
        folder = Path(os.environ["DIFFUSERS_REPOSITORY"]) / "tests"
        spec = importlib.util.spec_from_file_location(
            name, folder / "__init__.py", submodule_search_locations=[str(folder)]
        )
        assert spec is not None and spec.loader is not None
        sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[name])
    return importlib.import_module(f"{name}.{module}")


ACCELERATOR = torch.cuda.is_available()
if not ACCELERATOR:  # the CPU in its place, where their marks would skip a test: to them this is another device
    os.environ["DIFFUSERS_TEST_DEVICE"] = "cpu:0"
common, lora = theirs("pipelines.test_pipelines_common"), theirs("lora.utils")
if not ACCELERATOR:
    common.torch_device = lora.torch_device = "cpu"
common.KarrasDiffusionSchedulers = [  # EDM's call the network with log(sigma) / 4, which ours refuses
    one for one in common.KarrasDiffusionSchedulers if "EDM" not in one.name
]

SKIPPED = {  # why, and by what words in the names of their tests
    "it builds pipelines without a UNet, which ours refuses": ["encode_prompt_works_in_isolation"],
    "it makes pictures of touches without the joint space": ["save_load_optional_components"],
    "it repeats the prompt and not the touches; test_against_diffusers.py has slices": ["test_vae_slicing"],
    "transformers saves an adapter and the name of its repository; random weights have none": [
        "inference_save_pretrained_with_text_lora"
    ],
}
SKIPPED_ON_A_CPU = {
    "`enable_model_cpu_offload()` looks for an accelerator": ["cpu_offload_forward_pass_twice", "model_cpu_offload"],
    "accelerate takes tensors from a CPU to other devices alone": ["sequential_cpu_offload", "sequential_offload"],
    "a CPU has no streams": ["offloading_inference_denoiser_0_block", "offloading_inference_denoiser_2_leaf"],
}
SKIPPED_WITHOUT_A_TEXT_ENCODER = {
    "it asks for a text encoder, which x-to-touch has not": [
        "inference_with_text_denoiser", "inference_with_text_lora_unloaded", "test_group_offloading_inference",
    ]
}  # fmt: skip


def without(*reasons: dict[str, list[str]]) -> Any:
    """Skips tests of theirs, each for a reason."""

    def skipped(tests: type) -> type:
        for reason, words in [pair for each in reasons for pair in each.items()]:
            for name in [name for name in dir(tests) if name.startswith("test_") and any(one in name for one in words)]:
                setattr(tests, name, unittest.skip(reason)(lambda self: None))
        return tests

    return skipped


class Asked:
    """Saves safetensors where their tests ask for pickles, reads a pickle that they name, and reads all encoders at
    once, as their folders are gone when the first touch comes."""

    @classmethod
    def from_pretrained(cls, *args: Any, **options: Any) -> Any:
        pipe = super().from_pretrained(*args, **options)  # type: ignore[misc]
        for modality in pipe.unitouch.known_modalities if pipe.unitouch is not None else ():
            pipe.unitouch.load(modality)
        return pipe

    def save_pretrained(self, folder: Any, safe_serialization: bool = True, **options: Any) -> None:
        super().save_pretrained(folder, **options)  # type: ignore[misc]

    def load_lora_weights(self, place: Any, **options: Any) -> None:
        super().load_lora_weights(place, use_safetensors=not str(place).endswith(".bin"), **options)  # type: ignore[misc]


class ToImage(Asked, TouchToImagePipeline):
    pass


class ToTouch(Asked, XToTouchPipeline):
    pass


def to_image_parts() -> dict[str, Any]:
    return {**make_components(), "embedding_bank": None}


def to_touch_parts() -> dict[str, Any]:
    shared = {name: part for name, part in make_components().items() if name in ("unitouch", "processor", "scheduler")}
    torch.manual_seed(2)
    vae = AutoencoderKL(
        block_out_channels=(8, 8), norm_num_groups=4, latent_channels=4,
        down_block_types=("DownEncoderBlock2D",) * 2, up_block_types=("UpDecoderBlock2D",) * 2,
    )  # fmt: skip
    own = make_x_to_touch()
    latents = {"in_channels": 4, "out_channels": 4, "num_class_embeds": None}  # `sensors` are no part
    unet = UNet2DConditionModel.from_config({**own["unet"].config, **latents})
    return {**shared, **own, "unet": unet.eval(), "vae": vae.eval(), "backgrounds": None}


def picture(seed: int = 0) -> Image.Image:
    return Image.fromarray(np.random.default_rng(seed).integers(0, 100, (32, 32, 3), dtype=np.uint8))


class Parts(
    common.PipelineLatentTesterMixin,
    common.PipelineKarrasSchedulerTesterMixin,
    common.SDFunctionTesterMixin,
    common.PipelineTesterMixin,
):
    image_latents_params = frozenset[str]()
    test_layerwise_casting = test_group_offloading = True

    def get_dummy_components(self) -> dict[str, Any]:
        return to_image_parts() if self.pipeline_class is ToImage else to_touch_parts()

    def get_dummy_inputs(self, device: str, seed: int = 0) -> dict[str, Any]:
        own = {"touch": picture(seed), "prompt": "high quality rough brick"}
        return {
            **(own if self.pipeline_class is ToImage else {"image": picture(seed)}),
            "generator": torch.Generator(device).manual_seed(seed),
            "num_inference_steps": 2,
            "guidance_scale": 3.0,
            "output_type": "np",
        }


ON_A_CPU = {} if ACCELERATOR else SKIPPED_ON_A_CPU


@without(SKIPPED, ON_A_CPU)
class TestTouchToImage(Parts, unittest.TestCase):
    pipeline_class = ToImage
    params = frozenset({"touch", "prompt", "height", "width", "guidance_scale", "negative_prompt", "prompt_embeds",
                        "negative_prompt_embeds"})  # fmt: skip
    batch_params = frozenset({"touch", "prompt", "negative_prompt"})
    image_params = frozenset({"touch"})
    callback_cfg_params = frozenset({"prompt_embeds"})


@without(SKIPPED, ON_A_CPU, SKIPPED_WITHOUT_A_TEXT_ENCODER)
class TestXToTouch(Parts, unittest.TestCase):
    pipeline_class = ToTouch
    params = frozenset({"image", "text", "audio", "touch", "height", "width", "guidance_scale", "condition_embeds"})
    batch_params = image_params = frozenset({"image"})
    callback_cfg_params = frozenset({"condition_embeds"})


class LoraParts(lora.PeftLoraLoaderMixinTests):
    scheduler_cls = DDIMScheduler
    unet_kwargs = {"made": "below"}
    output_shape = (1, 16, 16, 3)

    def get_dummy_components(self, scheduler_cls: Any = None, use_dora: bool = False, lora_alpha: int | None = None):
        parts = to_image_parts() if self.pipeline_class is ToImage else to_touch_parts()
        options = {"r": 4, "lora_alpha": lora_alpha or 4, "init_lora_weights": False, "use_dora": use_dora}
        targets = (self.text_encoder_target_modules, self.denoiser_target_modules)
        return parts, *(lora.LoraConfig(target_modules=modules, **options) for modules in targets)

    def get_dummy_inputs(self, with_generator: bool = True):
        shared = {"num_inference_steps": 5, "guidance_scale": 6.0, "output_type": "np"}
        own = {"touch": picture(), "prompt": "high quality rough brick"}
        shared |= own if self.pipeline_class is ToImage else {"image": picture()}
        shared |= {"generator": torch.manual_seed(0)} if with_generator else {}
        return torch.zeros(1), torch.zeros(1, 10, dtype=torch.long), shared


@without(SKIPPED, ON_A_CPU)
class TestLoraOfTouchToImage(LoraParts, unittest.TestCase):
    pipeline_class = ToImage


@without(SKIPPED, ON_A_CPU, SKIPPED_WITHOUT_A_TEXT_ENCODER)
class TestLoraOfXToTouch(LoraParts, unittest.TestCase):
    pipeline_class = ToTouch
    supports_text_encoder_loras = False
