"""Cases on what pipelines are made of: networks in half precision and broken ones, and schedulers of their own."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from typing import Any

import torch
from diffusers import (
    DDIMScheduler,
    DEISMultistepScheduler,
    DPMSolverMultistepScheduler,
    EulerDiscreteScheduler,
    PNDMScheduler,
    UniPCMultistepScheduler,
)
from torch import Tensor

from unitouch_gen.numerics.problems import STABLE_DIFFUSION
from unitouch_gen.numerics.stability import Case, Ended, ends, raises, refused
from unitouch_gen.numerics.stability_pipelines import (
    DIVERGED,
    INF,
    NAN,
    NON_FINITE,
    QUICK,
    SUCCESS,
    Make,
    Noise,
    Trial,
    input_suite,
)

HALF = {torch.float16: 2e-2, torch.bfloat16: 0.15}
"""Largest relative error of the latents that networks in half precision may make."""


def precision_cases(trial: Trial) -> Iterator[Case]:
    """Networks in half precision, against the same in float32 from the same noise."""
    usual: dict[str, Any] = {"latents": Noise(), "output_type": "latent", "num_inference_steps": 8}
    for kind in ("touch-to-image", "stylization", "x-to-touch"):

        @cache
        def truth(kind: str = kind) -> Tensor:
            return trial.call(kind, **usual).images

        for dtype, bound in HALF.items():
            name = f"{str(dtype).removeprefix('torch.')}, {kind}"
            yield trial.ends(name, kind, bound=bound, truth=truth, dtype=dtype, **usual)
            for scale, code in ((0.0, SUCCESS), (1000.0, DIVERGED)):
                yield trial.ends(f"{name}, guidance {scale:g}", kind, code, dtype=dtype, guidance_scale=scale)
            bold: dict[str, Any] = {"guidance_scale": 30.0, "num_inference_steps": 10}
            yield trial.ends(f"{name}, guidance 30 in 10 steps", kind, dtype=dtype, **bold)
    huge: dict[str, Any] = {"touch_embeds": Noise(lambda noise: 1e6 * noise)}
    yield trial.ends("float16, embeddings beyond it", "touch-to-image", NON_FINITE, dtype=torch.float16, **huge)
    large: dict[str, Any] = {"condition_embeds": Noise(lambda noise: 1e6 * noise)}
    yield trial.ends("float16, conditions beyond it", "x-to-touch", NON_FINITE, dtype=torch.float16, **large)


@contextmanager
def spoiled(module: torch.nn.Module, value: float, row: int | None = None, call: int = 0) -> Iterator[None]:
    """A network that says a value in place of what it would at one of its calls, for one sample or for all."""
    calls: list[int] = []

    def spoil(module: Any, arguments: Any, output: Any) -> Any:
        calls.append(1)
        if len(calls) - 1 != call:
            return output
        parts = output if isinstance(output, tuple) else (output,)
        changed = parts[0].clone()
        changed[slice(None) if row is None else row] = value
        return (changed, *parts[1:]) if isinstance(output, tuple) else changed

    handle = module.register_forward_hook(spoil)
    try:
        yield
    finally:
        handle.remove()


def broken_cases(trial: Trial) -> Iterator[Case]:
    """Each network of a pipeline broken in turn, for all samples and for one of three."""
    kind = "touch-to-image"
    three: dict[str, Any] = {"num_images_per_prompt": 3, "guidance_scale": 1.0}
    one_of_three = [SUCCESS, NON_FINITE, SUCCESS]

    @cache
    def others() -> Tensor:
        return trial.call(kind, **three).images[[0, 2]]

    def run(part: Callable[[Any], torch.nn.Module], value: float, row: int | None = None, call: int = 0) -> Ended:
        module = part(trial.make(kind, torch.float32))
        with spoiled(module, value, row, call):
            return trial.run(kind, others if row is not None else None, **three)

    def raising(part: Callable[[Any], torch.nn.Module]) -> Any:
        with spoiled(part(trial.make(kind, torch.float32)), NAN):
            return trial.call(kind, throw=True)

    parts: dict[str, Callable[[Any], torch.nn.Module]] = {
        "UNet": lambda pipe: pipe.unet,
        "VAE": lambda pipe: pipe.vae.decoder,
        "touch encoder": lambda pipe: pipe.unitouch.touch_model,
        "text encoder": lambda pipe: pipe.text_encoder.final_layer_norm,
    }
    for name, part in parts.items():
        for value in (NAN, INF):
            yield ends(f"{name} says {value}", partial(run, part, value), NON_FINITE)
        yield raises(f"{name} says NaN, raising", partial(raising, part), NON_FINITE)
    yield ends("UNet says NaN at its last call", partial(run, parts["UNet"], NAN, None, 1), NON_FINITE)
    yield ends("UNet says NaN of one of three", partial(run, parts["UNet"], NAN, 1), one_of_three, 1e-4)
    yield ends("VAE says NaN of one of three", partial(run, parts["VAE"], NAN, 1), one_of_three, 1e-4)
    for value, code in ((0.0, SUCCESS), (1e4, DIVERGED)):
        yield ends(f"UNet says {value:g}", partial(run, parts["UNet"], value), code)


LEADING = {"timestep_spacing": "leading", "steps_offset": 1}
LINSPACE = {"timestep_spacing": "linspace"}
TRAILING = {"timestep_spacing": "trailing"}
KARRAS = {"use_karras_sigmas": True}
VELOCITY = {"prediction_type": "v_prediction"}
ZERO_SNR = {"rescale_betas_zero_snr": True}

DEFECTIVE: list[tuple[str, Any, dict[str, Any], int]] = [
    ("UniPC bh1 to no noise", UniPCMultistepScheduler, {"solver_type": "bh1"}, 20),
    ("DPM++ linspace, as many steps as levels", DPMSolverMultistepScheduler, LINSPACE, 1000),
    ("DPM++ leading, 50 steps", DPMSolverMultistepScheduler, LEADING, 50),
    ("DPM++ leading, 200 steps", DPMSolverMultistepScheduler, LEADING, 200),
    ("UniPC leading, 50 steps", UniPCMultistepScheduler, LEADING, 50),
    ("DEIS leading, 200 steps", DEISMultistepScheduler, LEADING, 200),
    ("DDIM leading, as many steps as levels", DDIMScheduler, LEADING, 1000),
    ("PNDM leading, as many steps as levels", PNDMScheduler, {**LEADING, "skip_prk_steps": True}, 1000),
    ("DDIM linspace", DDIMScheduler, LINSPACE, 50),
    ("DDIM leading, 1 step", DDIMScheduler, LEADING, 1),
    ("Euler linspace, 1 step", EulerDiscreteScheduler, LINSPACE, 1),
    ("DEIS of order 3, 160 steps", DEISMultistepScheduler, {**KARRAS, "solver_order": 3}, 160),
    ("DDIM from pure noise, of noise", DDIMScheduler, {**TRAILING, **ZERO_SNR, "prediction_type": "epsilon"}, 20),
    ("DPM++ Karras from pure noise, 10 steps", DPMSolverMultistepScheduler, {**KARRAS, **ZERO_SNR}, 10),
    ("DPM++ Karras from pure noise, 50 steps", DPMSolverMultistepScheduler, {**KARRAS, **ZERO_SNR}, 50),
]
"""Name, scheduler, settings and steps of each defect of diffusers' schedulers that `schedulers.defects` knows."""

SOUND: list[tuple[str, Any, dict[str, Any], int]] = [
    ("DPM++ of beta spacing, 60 steps", DPMSolverMultistepScheduler, {"use_beta_sigmas": True}, 60),
    ("DDIM from pure noise, of velocity", DDIMScheduler, {**TRAILING, **ZERO_SNR}, 4),
    ("Euler from pure noise, of velocity", EulerDiscreteScheduler, {**TRAILING, **ZERO_SNR}, 4),
    ("DDIM leading, 20 steps", DDIMScheduler, LEADING, 20),
    ("PNDM leading, 10 steps", PNDMScheduler, {**LEADING, "skip_prk_steps": True}, 10),
]
"""Name, scheduler, settings and steps of what is near a defect, or mended."""


def scheduler_cases(trial: Trial) -> Iterator[Case]:
    """Pipelines with schedulers of their own."""
    kind = "touch-to-image"

    def own(scheduler: Any, settings: dict[str, Any], steps: int) -> Ended:
        pipe = trial.make(kind, torch.float32)
        kept = pipe.scheduler
        usual = {**STABLE_DIFFUSION, **VELOCITY, **({"clip_sample": False} if scheduler is DDIMScheduler else {})}
        pipe.scheduler = scheduler(**{**usual, **settings})
        try:
            return trial.run(kind, num_inference_steps=steps, **QUICK)
        finally:
            pipe.scheduler = kept

    for name, scheduler, settings, steps in DEFECTIVE:
        yield refused(name, partial(own, scheduler, settings, steps), "num_inference_steps")
    for name, scheduler, settings, steps in SOUND:
        yield ends(name, partial(own, scheduler, settings, steps))


def pipeline_suite(make: Make) -> dict[str, list[Case]]:
    """All cases on pipelines, by group."""
    trial = Trial(make)
    return {
        **input_suite(trial),
        "precision": list(precision_cases(trial)),
        "broken": list(broken_cases(trial)),
        "schedulers": list(scheduler_cases(trial)),
    }
