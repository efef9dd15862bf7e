"""diffusers' own tests of pipelines, as its repository has them, run on ours.

Its test mixins are not installed with it, so the environment variable `DIFFUSERS_REPOSITORY` has to name a checkout;
without one, all of this is skipped:

    git clone --depth 1 https://github.com/huggingface/diffusers elsewhere/diffusers
    pip install parameterized requests-mock torchsde
    DIFFUSERS_REPOSITORY=elsewhere/diffusers pytest tests/pipelines/test_diffusers_mixins.py -rs
"""

import importlib.util
import os
import sys
import unittest
from collections.abc import Callable
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


def without(reasons: dict[str, str]) -> Callable[[type], type]:
    """Skips tests of theirs, by name, each for a reason."""

    def skipped(tests: type) -> type:
        for name, reason in reasons.items():
            getattr(tests, name)  # one that is no longer theirs needs no reason
            setattr(tests, name, unittest.skip(reason)(lambda self: None))
        return tests

    return skipped


class Asked:
    """Does what their tests ask for and ours does otherwise.

    - Where they ask for pickles it saves safetensors, as transformers does, and it reads a pickle that they name, which
      ours does where `use_safetensors=False` says so.
    - It reads all of the joint space at once: their folders are gone when the first touch comes.
    """

    @classmethod
    def from_pretrained(cls, *args: Any, **options: Any) -> Any:
        pipe = super().from_pretrained(*args, **options)  # type: ignore[misc]
        if pipe.unitouch is not None:
            for modality in pipe.unitouch.known_modalities:
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


def x_to_touch_parts() -> dict[str, Any]:
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


PIPELINES = {
    "test_encode_prompt_works_in_isolation": "it builds pipelines without a UNet, which ours refuses",
    "test_save_load_optional_components": "it makes pictures of touches without the joint space, which ours refuses",
    "test_vae_slicing": "it repeats the prompt and not the touches; test_features.py has slices",
}
ONLY_TO_TOUCH = {
    "test_group_offloading_inference": "it offloads `text_encoder`, which is None here; test_features.py offloads all",
}
ON_A_CPU = {
    "test_cpu_offload_forward_pass_twice": "`enable_model_cpu_offload()` looks for an accelerator",
    "test_sequential_cpu_offload_forward_pass": "accelerate takes tensors from a CPU to other devices alone",
    "test_sequential_offload_forward_pass_twice": "accelerate takes tensors from a CPU to other devices alone",
}
ONLY_LORA_TO_IMAGE = {
    "test_simple_inference_save_pretrained_with_text_lora": "transformers saves an adapter and the name of its "
    "repository; a text encoder of random weights has none",
}
ONLY_LORA_TO_TOUCH = dict.fromkeys(
    (
        "test_simple_inference_with_text_denoiser_block_scale",
        "test_simple_inference_with_text_denoiser_block_scale_for_all_dict_options",
        "test_simple_inference_with_text_denoiser_lora_unloaded",
        "test_simple_inference_with_text_lora_unloaded",
    ),
    "it asks for a text encoder, which this pipeline has not",
)
LORA_ON_A_CPU = {
    "test_lora_loading_model_cpu_offload": "`enable_model_cpu_offload()` looks for an accelerator",
    "test_group_offloading_inference_denoiser_0_block_level": "a CPU has no streams",
    "test_group_offloading_inference_denoiser_2_leaf_level": "a CPU has no streams",
}
if ACCELERATOR:
    ON_A_CPU, LORA_ON_A_CPU = {}, {}


# Pipelines, their latents, features and schedulers --------------------------------------------------------------------


@without({**PIPELINES, **ON_A_CPU})
class TestTouchToImage(
    common.PipelineLatentTesterMixin,
    common.PipelineKarrasSchedulerTesterMixin,
    common.SDFunctionTesterMixin,
    common.PipelineTesterMixin,
    unittest.TestCase,
):
    pipeline_class = ToImage
    params = frozenset({"touch", "prompt", "height", "width", "guidance_scale", "negative_prompt", "prompt_embeds",
                        "negative_prompt_embeds"})  # fmt: skip
    batch_params = frozenset({"touch", "prompt", "negative_prompt"})
    image_params = frozenset({"touch"})
    image_latents_params = frozenset[str]()
    callback_cfg_params = frozenset({"prompt_embeds"})
    test_layerwise_casting = test_group_offloading = True

    def get_dummy_components(self) -> dict[str, Any]:
        return make_components()

    def get_dummy_inputs(self, device: str, seed: int = 0) -> dict[str, Any]:
        return {
            "touch": picture(seed),
            "prompt": "high quality rough brick",
            "generator": torch.Generator(device).manual_seed(seed),
            "num_inference_steps": 2,
            "guidance_scale": 3.0,
            "output_type": "np",
        }


@without({**PIPELINES, **ONLY_TO_TOUCH, **ON_A_CPU})
class TestXToTouch(
    common.PipelineLatentTesterMixin,
    common.PipelineKarrasSchedulerTesterMixin,
    common.SDFunctionTesterMixin,
    common.PipelineTesterMixin,
    unittest.TestCase,
):
    pipeline_class = ToTouch
    params = frozenset({"image", "text", "audio", "touch", "height", "width", "guidance_scale", "condition_embeds"})
    batch_params = frozenset({"image"})
    image_params = frozenset({"image"})
    image_latents_params = frozenset[str]()
    callback_cfg_params = frozenset({"condition_embeds"})
    test_layerwise_casting = test_group_offloading = True

    def get_dummy_components(self) -> dict[str, Any]:
        return x_to_touch_parts()

    def get_dummy_inputs(self, device: str, seed: int = 0) -> dict[str, Any]:
        return {
            "image": picture(seed),
            "generator": torch.Generator(device).manual_seed(seed),
            "num_inference_steps": 2,
            "guidance_scale": 3.0,
            "output_type": "np",
        }


# LoRA -----------------------------------------------------------------------------------------------------------------


class LoraParts(lora.PeftLoraLoaderMixinTests):
    """What their LoRA tests ask for, of parts of ours."""

    scheduler_cls = DDIMScheduler
    unet_kwargs = {"made": "below"}
    output_shape = (1, 16, 16, 3)
    inputs: dict[str, Any]

    def parts(self) -> dict[str, Any]:
        raise NotImplementedError

    def get_dummy_components(self, scheduler_cls: Any = None, use_dora: bool = False, lora_alpha: int | None = None):
        def adapter(modules: list[str]) -> Any:
            return lora.LoraConfig(
                r=4, lora_alpha=lora_alpha or 4, target_modules=modules, init_lora_weights=False, use_dora=use_dora
            )

        return self.parts(), adapter(self.text_encoder_target_modules), adapter(self.denoiser_target_modules)

    def get_dummy_inputs(self, with_generator: bool = True):
        shared = {"num_inference_steps": 5, "guidance_scale": 6.0, "output_type": "np", **self.inputs}
        if with_generator:
            shared["generator"] = torch.manual_seed(0)
        return torch.zeros(1), torch.zeros(1, 10, dtype=torch.long), shared


@without({**ONLY_LORA_TO_IMAGE, **LORA_ON_A_CPU})
class TestLoraOfTouchToImage(LoraParts, unittest.TestCase):
    pipeline_class = ToImage
    inputs = {"touch": picture(), "prompt": "high quality rough brick"}

    def parts(self) -> dict[str, Any]:
        return make_components()


@without({**ONLY_LORA_TO_TOUCH, **LORA_ON_A_CPU})
class TestLoraOfXToTouch(LoraParts, unittest.TestCase):
    pipeline_class = ToTouch
    supports_text_encoder_loras = False
    inputs = {"image": picture()}

    def parts(self) -> dict[str, Any]:
        return x_to_touch_parts()
