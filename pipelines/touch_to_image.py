"""`TouchToImagePipeline`: a picture of what a touch feels like (Section 4.4 of the paper)."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from diffusers.utils import replace_example_docstring
from torch import Tensor

from unitouch_gen.errors import check_integer, check_number
from unitouch_gen.models.images import ImageInput
from unitouch_gen.models.sensors import SensorMatch
from unitouch_gen.pipelines.base import SensorNames
from unitouch_gen.pipelines.call import StepEndCallback
from unitouch_gen.pipelines.checks import MAX_GAIN, Generators, check_embeds, check_one_source
from unitouch_gen.pipelines.pipeline_output import UniTouchPipelineOutput
from unitouch_gen.pipelines.planned import one_call
from unitouch_gen.pipelines.unclip import UnclipPipeline
from unitouch_gen.plan import Plan

EXAMPLE_DOC_STRING = """
    Examples:
        ```py
        >>> import unitouch_gen

        >>> pipe = unitouch_gen.tiny("touch-to-image")
        >>> output = pipe("samples/inputs/gelsight_brick.png")
        >>> output.images[0].save("brick.png")
        >>> print(output.report)
        ```
"""


class TouchToImagePipeline(UnclipPipeline):
    """Touch to image: an unCLIP model that gets a touch embedding in place of an image embedding.

    See `UnclipPipeline` for the components.
    """

    _embeds_name = "touch_embeds"

    @classmethod
    def _plan(cls, request: Mapping[str, Any]) -> Plan:
        check_one_source(request["touch"], request["touch_embeds"])
        return Plan(
            modalities=() if request["touch"] is None else ("touch",),
            known_modalities=("touch",),
            vae=request["output_type"] != "latent",
            **cls._prompt_plan(request),
        )

    @torch.no_grad()
    @replace_example_docstring(EXAMPLE_DOC_STRING)
    @one_call
    def __call__(
        self,
        touch: ImageInput = None,
        prompt: str | list[str] | None = None,
        height: int | None = None,
        width: int | None = None,
        num_inference_steps: int | None = None,
        guidance_scale: float | None = None,
        guidance_interval: Sequence[float] | None = None,
        strength: float | None = None,
        negative_prompt: str | list[str] | None = None,
        num_images_per_prompt: int = 1,
        noise_level: int | None = None,
        sensor: SensorNames = None,
        background: ImageInput = None,
        solver: str | None = None,
        tolerance: float | None = None,
        max_evaluations: int | None = None,
        eta: float = 0.0,
        generator: Generators = None,
        latents: Tensor | None = None,
        touch_embeds: Tensor | None = None,
        prompt_embeds: Tensor | None = None,
        negative_prompt_embeds: Tensor | None = None,
        output_type: str = "pil",
        return_dict: bool = True,
        callback_on_step_end: StepEndCallback | None = None,
        callback_on_step_end_tensor_inputs: Sequence[str] = ("latents",),
        throw: bool = True,
    ) -> UniTouchPipelineOutput | tuple:
        """Generates pictures from touches.

        Args:
            touch: One touch image or several: paths, PIL images, arrays (H, W, 3), tensors (3, H, W), or a list.
            prompt: What else the picture should be; "high quality" when left out. One, or one for each touch.
            height, width: Of the pictures, pixels; multiples of the VAE's scale factor.
            num_inference_steps: Solver steps.
            guidance_scale: s of classifier-free guidance, >= 0; on above 1.
            guidance_interval: Where guidance is on, (low, high) shares of the training timesteps, from 0 (the least
                noise) to 1 (noise alone); everywhere when left out. Outside, the unconditional branch is left out,
                which saves half of an evaluation and is no longer the same picture.
            strength: Gain on the touch embedding, >= 0 (paper: 0.75).
            negative_prompt: What guidance leads away from; empty when left out.
            num_images_per_prompt: Pictures for each touch.
            noise_level: Of the noise on the embedding, from 0 to 999; more noise, more variety.
            sensor: Which sensor took the touch: a name, one for each touch, or `None` to retrieve it.
            background: What the sensor sees untouched, to re-centre touches of a sensor the model does not know.
            solver: A name in `unitouch_gen.schedulers.SOLVERS`, or "fitted"; `None` uses the pipeline's own scheduler.
            tolerance: Relative RMS error of the latents, from 1e-5 to 1: chooses the steps as it goes, in place of
                `num_inference_steps` and `solver`.
            max_evaluations: Of the network, at most, to a tolerance; 1,000 when left out.
            eta: Of DDIM, from 0 to 1; other solvers ignore it.
            generator: One, or one for each picture.
            latents: Unit-variance noise (B, C, h, w); the scheduler's `init_noise_sigma` is applied to it here.
            touch_embeds: Embeddings (B, D) in place of `touch`, taken as they come: see `encode_touch`. `strength`,
                `sensor` and `background` are about touches and go there, too.
            prompt_embeds, negative_prompt_embeds: Hidden states (B or 1, T, C) in place of the prompts.
            output_type: "pil", "np", "pt" or "latent".
            return_dict: Whether to return an output object rather than the tuple (images, report).
            callback_on_step_end: Called as `callback(pipe, step, timestep, tensors)` after every evaluation, or to a
                `tolerance` every accepted step; may return new tensors, and set `pipe._guidance_scale` for the
                evaluations that follow. Or, without a `tolerance`, one of `diffusers.callbacks`.
            callback_on_step_end_tensor_inputs: Which tensors it gets: "latents" (B n, C, h, w) in float32,
                "prompt_embeds" with the hidden states of both branches, the unconditional one first.
            throw: Raise where a sample breaks. Otherwise the others are returned, and its code is in the report, as
                are, in either case, those of samples that are there, but diverged or interrupted.

        Examples:

        Returns:
            [`UniTouchPipelineOutput`] or `tuple`.

        Raises:
            InvalidInputError, InvalidTypeError: On input that cannot be used, before any network runs.
            NonFiniteError: If an embedding or a sample leaves the range of floating-point numbers and `throw` is set.
            NotConvergedError: If a tolerance is not reached or latents grow to a hundred times a picture's, and `throw`
                is set.

        Warns:
            UnfamiliarTouchWarning: Of touches that are unlike those the model knows of their sensor.
        """
        # 1. Refuse what cannot work, before any network runs
        plan = self._begin(
            touch=touch,
            touch_embeds=touch_embeds,
            prompt_embeds=prompt_embeds,
            negative_prompt_embeds=negative_prompt_embeds,
            guidance_scale=self._default("guidance_scale", guidance_scale),
            guidance_interval=guidance_interval,
            output_type=output_type,
        )
        check_one_source(touch, touch_embeds, strength=strength, sensor=sensor, background=background)
        strength = check_number("strength", self._default("strength", strength), 0.0, MAX_GAIN)
        noise_level = self._check_noise_level(noise_level)
        matches: list[SensorMatch] = []
        if touch is not None:
            pixels, matches = self._prepare_touch(touch, sensor, background)
            batch_size = len(pixels)
        else:
            batch_size = len(check_embeds("touch_embeds", touch_embeds, self.embedding_dim))
        call = self._check_call(
            batch_size,
            check_integer("num_images_per_prompt", num_images_per_prompt, 1),
            height=height,
            width=width,
            num_inference_steps=num_inference_steps,
            guidance_scale=guidance_scale,
            guidance_interval=guidance_interval,
            solver=solver,
            tolerance=tolerance,
            max_evaluations=max_evaluations,
            eta=eta,
            generator=generator,
            latents=latents,
            output_type=output_type,
            callback=callback_on_step_end,
            callback_inputs=callback_on_step_end_tensor_inputs,
            throw=throw,
        )
        prompts = self._check_prompts(call, batch_size, prompt, prompt_embeds, negative_prompt, negative_prompt_embeds)
        report = call.report(plan, matches)

        # 2. Touch embedding
        if touch_embeds is None:
            with report.stage("touch"):
                touch_embeds = self._touch_embeds(pixels, matches, strength, throw)
            self._release("touch")

        # 3. Prompts, noise, denoising, decoding
        return self._generate(call, touch_embeds, noise_level, prompts, report, return_dict)
