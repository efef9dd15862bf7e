"""`TactileStylizationPipeline`: a photo restyled by a touch (Section 4.4 of the paper)."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from unitouch_gen.arguments import SamplingArguments
from unitouch_gen.conditioning import mix_linear, mix_to_norm
from unitouch_gen.errors import InvalidInputError, check_number
from unitouch_gen.models.images import ImageInput, load_images
from unitouch_gen.pipelines.base import (
    Generators,
    SensorNames,
    StepEndCallback,
    Touches,
    check_weights,
)
from unitouch_gen.pipelines.output import UniTouchPipelineOutput
from unitouch_gen.pipelines.touch_to_image import TouchToImagePipeline
from unitouch_gen.sampling import Denoiser, Guidance, RunReport, prepare_steps
from unitouch_gen.schedule import NoiseSchedule

MIXES = {"linear": mix_to_norm, "paper": mix_linear}


def coarse(values: Tensor, cells: int, keep_colours: bool) -> Tensor:
    """The part of (B, C, h, w) on a grid of so many cells along the shorter side, with or without the mean."""
    size = values.shape[-2:]
    share = min(cells / min(size), 1.0)
    averages = F.interpolate(values, [max(round(share * side), 1) for side in size], mode="bilinear", antialias=True)
    smooth = F.interpolate(averages, size, mode="bicubic")
    return smooth if keep_colours else smooth - smooth.mean(dim=(2, 3), keepdim=True)


def hold_layout(denoised: Tensor, photo: Tensor, cells: int, keep_colours: bool) -> Tensor:
    """Predicted latents (B, C, h, w) with the layout of photos' latents, as in ILVR (Choi et al., 2021, Equation 8).

    The coarse part F of the prediction becomes that of the photo: D' = D + F(photo - D). Only the denoiser changes:
    every solver, adaptive steps and guidance run as they are.
    """
    return denoised + coarse(photo - denoised, cells, keep_colours)


class TactileStylizationPipeline(TouchToImagePipeline):
    """Restyles photos by touches: the same unCLIP model, on a mix of both embeddings, holding the photo's layout.

    See `TouchToImagePipeline` for the components. `default_strength` is not used here.
    """

    _example_call = 'pipe(example("wood", "image"), example("gravel"))'

    @torch.no_grad()
    def __call__(  # type: ignore[override]
        self,
        image: ImageInput = None,
        touch: ImageInput = None,
        prompt: str | list[str] | None = None,
        touch_weight: float | None = None,
        image_weight: float | None = None,
        mix: str = "linear",
        layout: int | None = 14,
        keep_colours: bool = False,
        init_strength: float = 1.0,
        height: int | None = None,
        width: int | None = None,
        num_inference_steps: int | None = None,
        guidance_scale: float | None = None,
        strength: float = 1.0,
        negative_prompt: str | list[str] | None = None,
        num_images_per_prompt: int = 1,
        noise_level: int | None = None,
        sensor: SensorNames = None,
        background: ImageInput = None,
        bridge: bool | None = None,
        solver: str | None = None,
        tolerance: float | None = None,
        max_evaluations: int | None = None,
        eta: float = 0.0,
        generator: Generators = None,
        latents: Tensor | None = None,
        prompt_embeds: Tensor | None = None,
        negative_prompt_embeds: Tensor | None = None,
        output_type: str = "pil",
        return_dict: bool = True,
        cross_attention_kwargs: dict[str, Any] | None = None,
        callback_on_step_end: StepEndCallback | None = None,
        callback_on_step_end_tensor_inputs: Sequence[str] = ("latents",),
        throw: bool = True,
    ) -> UniTouchPipelineOutput | tuple:
        """Restyles photos by touches.

        The other arguments, the output, errors and warnings are those of `TouchToImagePipeline.__call__`.

        Args:
            image: One photo or several: paths, PIL images, arrays (H, W, 3), tensors (3, H, W), or a list.
            touch: One touch image or several, likewise. Several photos and touches are paired; one of either goes with
                all of the other.
            prompt: One prompt, or one for each picture; default "high quality".
            touch_weight, image_weight: Weights of the embeddings, normalised to a sum of 1. `touch_weight` defaults to
                0.7, and without a `layout` to the paper's 0.3; `image_weight` to the rest.
            mix: "linear", sum_i w_i e_i rescaled to the norm of image embeddings, as in X-to-touch; or "paper", the
                plain sum, which is shorter the more its parts differ.
            layout: The photo's layout is held on a grid of so many cells along the picture's shorter side, from 2:
                more keep more of the photo, fewer show more of the touch. `None` holds nothing, as in the paper.
            keep_colours: Whether the mean colour stays that of the photo, too, where a layout is held.
            init_strength: Share of the steps to run from the photo's latents (img2img strength), from near 0 (photo) to
                1 (from noise alone). With a `tolerance`: the share of the Karras spacing.
            strength: Factor on the mixed embedding, >= 0 (paper: 1).
            bridge: See there; touch embeddings are bridged before the mix.
            sensor: Sensor that took the touches: a name, one for each, or `None` to retrieve it.

        Examples:
            >>> import unitouch_gen

            >>> pipe = unitouch_gen.tiny("stylization")
            >>> pipe("photo.jpg", unitouch_gen.example("brick")).images[0].save("brick_photo.png")
            >>> pipe("photo.jpg", "brick.png", layout=None)  # as in the paper
        """
        # 1. Check inputs, before any network runs
        for name, value in (("image", image), ("touch", touch)):
            if value is None:
                raise InvalidInputError(f"`{name}` is missing; pass a photo as `image` and a touch as `touch`.")
        if touch_weight is None:
            touch_weight = 0.3 if layout is None else 0.7
        if image_weight is None:
            image_weight = 1.0 - check_number("touch_weight", touch_weight, 0.0, 1.0)
        arguments = self._check_arguments(
            touch_weight=touch_weight,
            image_weight=image_weight,
            mix=mix,
            layout=layout,
            keep_colours=keep_colours,
            init_strength=init_strength,
            height=height,
            width=width,
            num_inference_steps=num_inference_steps,
            guidance_scale=self.config.default_guidance_scale if guidance_scale is None else guidance_scale,
            strength=strength,
            num_images_per_prompt=num_images_per_prompt,
            noise_level=self.config.default_noise_level if noise_level is None else noise_level,
            bridge=bridge,
            solver=solver,
            tolerance=tolerance,
            max_evaluations=max_evaluations,
            eta=eta,
            output_type=output_type,
            throw=throw,
        )
        weights = check_weights("touch_weight, image_weight", [arguments.touch_weight, arguments.image_weight])
        touches = self._read_touches(touch, sensor, background)
        photos = load_images("image", image)
        batch_size = max(len(photos), len(touches.pixels))
        if min(len(photos), len(touches.pixels)) not in (1, batch_size):
            counts = f"{len(photos)} for {len(touches.pixels)} of `touch`"
            raise InvalidInputError(f"`image` holds {counts}; pass one of either, or as many of both.")
        shape = self._latents_shape(batch_size, arguments)
        guidance = Guidance(arguments.guidance_scale)
        self.check_inputs(
            shape,
            arguments,
            generator=generator,
            latents=latents,
            cross_attention_kwargs=cross_attention_kwargs,
            callback_on_step_end=callback_on_step_end,
            callback_on_step_end_tensor_inputs=callback_on_step_end_tensor_inputs,
        )
        prompts = self._check_prompts(
            batch_size,
            guidance,
            prompt=prompt,
            prompt_embeds=prompt_embeds,
            negative_prompt=negative_prompt,
            negative_prompt_embeds=negative_prompt_embeds,
        )
        steps, schedule = prepare_steps(self.scheduler, arguments, self._execution_device)
        if arguments.layout is not None:
            schedule = NoiseSchedule.of(self.scheduler)
        report = RunReport()

        with self._threads(shape, guidance):
            # 2. Encode photos and touches and mix their embeddings, and encode the prompts
            with report.stage("mix"):
                parts = self._embeds(photos, touches, weights, arguments, report)
                stacked = torch.stack([part.expand(batch_size, -1) for part in parts])
                shares = torch.tensor([weight for weight in weights if weight > 0])
                embeds = arguments.strength * MIXES[arguments.mix](stacked, shares.to(stacked))
            conditions = {
                "encoder_hidden_states": self._encode_prompts(prompts, shape[0], cross_attention_kwargs, report),
                "class_labels": self._class_labels(embeds, arguments, guidance, generator),
                "cross_attention_kwargs": cross_attention_kwargs,
            }

            # 3. Encode the photo's own latents
            photo: Any = None
            if arguments.init_strength < 1.0 or arguments.layout is not None:
                with report.stage("photo latents"):
                    photo = self._encode_pictures(photos, shape)
                    photo = photo.repeat_interleave(shape[0] // len(photo), dim=0)

            # 4. Denoise, from the photo's latents where there is an `init_strength`, and hold their layout
            init = photo if arguments.init_strength < 1.0 else None
            noise = self.prepare_latents(shape, steps, generator, latents, init)
            edit = None
            if arguments.layout is not None:
                edit = partial(hold_layout, photo=photo, cells=arguments.layout, keep_colours=arguments.keep_colours)
            latents = self._denoise(
                Denoiser(self.unet, schedule, conditions, guidance, edit=edit),
                noise,
                steps,
                arguments,
                report,
                generator=generator,
                callback=callback_on_step_end,
                callback_inputs=callback_on_step_end_tensor_inputs,
            )

            # 5. Decode the finite samples
            images = self._decode(latents, arguments, report)
        self.maybe_free_model_hooks()
        if not return_dict:
            return images, report
        return UniTouchPipelineOutput(images=images, report=report, embeds=embeds)

    def _embeds(
        self,
        photos: list[Tensor],
        touches: Touches,
        weights: Sequence[float],
        arguments: SamplingArguments,
        report: RunReport,
    ) -> list[Tensor]:
        """Embeddings (1 or B, D) of touches and photos, in this order; an encoder of zero weight does not run."""
        touch_weight, image_weight = weights
        parts = []
        if touch_weight > 0:
            embeds = self._touch_embeds(touches, report, arguments.throw)
            parts.append(self.embedding_bank.bridge(embeds) if arguments.bridge else embeds)
        else:
            report.left_out.append("touch encoder")
        if image_weight > 0:
            features = self.unitouch.get_image_features(self.processor.images(photos))
            parts.append(self._match_norm(features, "image", arguments.throw))
        else:
            report.left_out.append("image encoder")
        return parts
