"""`TactileStylizationPipeline`: a photo restyled by a touch (Section 4.4 of the paper)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from unitouch_gen.conditioning import apply_strength, mix_linear, mix_spherical, mix_to_norm
from unitouch_gen.errors import InvalidInputError, check_choice, check_integer, check_number
from unitouch_gen.models.images import ImageInput
from unitouch_gen.pipelines.base import (
    MAX_IMAGES,
    MAX_SCALE,
    CallSettings,
    Generators,
    SensorNames,
    StepEndCallback,
    Touches,
    check_weights,
)
from unitouch_gen.pipelines.output import UniTouchPipelineOutput
from unitouch_gen.pipelines.touch_to_image import TouchToImagePipeline
from unitouch_gen.sampling import RunReport

MIXES = {"linear": mix_to_norm, "slerp": mix_spherical, "paper": mix_linear}


@dataclass(frozen=True)
class Mixture:
    """Photos, touches and their weights for B pictures."""

    photos: Tensor  # pixel values (1 or B, 3, S, S)
    touches: Touches  # 1 or B; with several touch weights, all are mixed into every picture
    touch_weights: list[float]  # sum to 1 with `image_weight`
    image_weight: float
    batch_size: int  # B


class TactileStylizationPipeline(TouchToImagePipeline):
    """Restyles photos by touches: the same unCLIP model, on a mix of both embeddings.

    See `TouchToImagePipeline` for the components. `default_strength` is not used here.
    """

    _example_call = 'pipe(example("wood", "image"), example("gravel"))'

    @torch.no_grad()
    def __call__(  # type: ignore[override]
        self,
        image: ImageInput = None, touch: ImageInput = None, prompt: str | list[str] | None = None,
        touch_weight: float | Sequence[float] = 0.3, image_weight: float | None = None, mix: str = "linear",
        init_strength: float = 0.65,
        height: int | None = None, width: int | None = None, num_inference_steps: int | None = None,
        timesteps: Sequence[int] | None = None, sigmas: Sequence[float] | None = None,
        guidance_scale: float | None = None,
        strength: float = 1.0, negative_prompt: str | list[str] | None = None,
        num_images_per_prompt: int = 1, noise_level: int | None = None,
        sensor: SensorNames = None, background: ImageInput = None, bridge: bool | None = None,
        solver: str | None = None, tolerance: float | None = None, max_evaluations: int | None = None, eta: float = 0.0,
        generator: Generators = None, latents: Tensor | None = None,
        prompt_embeds: Tensor | None = None, negative_prompt_embeds: Tensor | None = None,
        output_type: str = "pil", return_dict: bool = True,
        cross_attention_kwargs: dict[str, Any] | None = None, callback_on_step_end: StepEndCallback | None = None,
        callback_on_step_end_tensor_inputs: Sequence[str] = ("latents",), throw: bool = True,
    ) -> UniTouchPipelineOutput | tuple:  # fmt: skip
        """Restyles photos by touches.

        The other arguments, the output, errors and warnings are those of `TouchToImagePipeline.__call__`.

        Args:
            image: One photo or several: paths, PIL images, arrays (H, W, 3), tensors (3, H, W), or a list.
            touch: One touch image or several, likewise. Several photos and touches are paired; one of either goes with
                all of the other.
            prompt: One prompt, or one for each picture; default "high quality".
            touch_weight, image_weight: Weights of the embeddings, normalised to a sum of 1 (paper: 0.3 and 0.7).
                `image_weight` defaults to the rest. A list of touch weights mixes all touches into each picture.
            mix: "linear", sum_i w_i e_i rescaled to the norm of image embeddings, as in X-to-touch; "slerp", along the
                sphere; or "paper", the plain sum, which is shorter the more its parts differ.
            init_strength: Share of the steps to run from the photo's latents (img2img strength), from near 0 (photo) to
                1 (from noise alone, as in the paper). With a `tolerance`: the share of the Karras spacing.
            strength: Factor on the mixed embedding, >= 0 (paper: 1).
            bridge: See there; touch embeddings are bridged before the mix.
            sensor: Sensor that took the touches: a name, one for each, or `None` to retrieve it.

        Examples:
            >>> import unitouch_gen

            >>> pipe = unitouch_gen.tiny("stylization")
            >>> pipe("photo.jpg", unitouch_gen.example("brick")).images[0].save("brick_photo.png")
            >>> pipe("photo.jpg", ["brick.png", "grass.png"], touch_weight=[0.2, 0.1])  # two touches into one picture
        """
        # 1. Check inputs, before any network runs
        strength = check_number("strength", strength, 0.0, MAX_SCALE)
        check_choice("mix", mix, MIXES)
        check_number("init_strength", init_strength, 0.0, 1.0)
        noise_level, bridge = self._check_noise_level(noise_level), self._check_bridge(bridge)
        mixture = self._check_mixture(image, touch, image_weight, touch_weight, sensor, background)
        batch_size = mixture.batch_size
        repeats = check_integer("num_images_per_prompt", num_images_per_prompt, 1, MAX_IMAGES)
        settings = CallSettings(
            shape=self._check_shape(batch_size * repeats, height, width, generator, latents),
            steps=self._check_steps(
                num_inference_steps, timesteps, sigmas, solver, tolerance, max_evaluations, eta, init_strength
            ),
            guidance=self._check_guidance(guidance_scale),
            callback_inputs=self._check_callback(callback_on_step_end, callback_on_step_end_tensor_inputs, tolerance),
            callback=callback_on_step_end, cross_attention_kwargs=cross_attention_kwargs, repeats=repeats,
            device=self._execution_device, generator=generator, latents=latents, output_type=output_type, throw=throw,
        )  # fmt: skip
        prompts = self._check_prompts(
            batch_size, settings.guidance, (prompt, prompt_embeds), (negative_prompt, negative_prompt_embeds)
        )

        # 2. Encode photos and touches, and mix their embeddings
        report = RunReport()
        with report.stage("mix"):
            embeds = self._mixed(mixture, mix, strength, bridge, report, throw)

        # 3. Encode the photo's own latents
        init = None
        if init_strength < 1.0:
            with report.stage("photo latents"):
                init = self._encode_pictures("image", image, settings).expand(batch_size, -1, -1, -1)
                init = init.repeat_interleave(settings.repeats, dim=0)

        # 4. Generate from the mixed embedding
        images = self._generate(settings, embeds, noise_level, prompts, report, init)
        return UniTouchPipelineOutput(images=images, report=report, embeds=embeds) if return_dict else (images, report)

    def _mixed(
        self, mixture: Mixture, mix: str, strength: float, bridge: bool, report: RunReport, throw: bool
    ) -> Tensor:
        """Mixed embeddings (B, D); an encoder of zero weight does not run."""
        parts, weights = list[Tensor](), list[float]()  # (1 or B, D) each
        if sum(mixture.touch_weights) > 0:
            touches = self._touch_embeds(mixture.touches, report, throw)
            touches = self.embedding_bank.bridge(touches) if bridge else touches
            parts += touches.split(1) if len(mixture.touch_weights) > 1 else [touches]
            weights += mixture.touch_weights
        else:
            report.left_out.append("touch encoder")
        if mixture.image_weight > 0:
            parts.append(self._match_norm(self.unitouch.get_image_features(mixture.photos), "image", throw))
            weights.append(mixture.image_weight)
        else:
            report.left_out.append("image encoder")
        stacked = torch.stack([part.expand(mixture.batch_size, -1) for part in parts])
        return apply_strength(MIXES[mix](stacked, torch.tensor(weights).to(stacked)), strength)

    def _check_mixture(
        self,
        image: ImageInput,
        touch: ImageInput,
        image_weight: float | None,
        touch_weight: float | Sequence[float],
        sensor: SensorNames,
        background: ImageInput,
    ) -> Mixture:
        """Reads photos and touches, and checks their weights."""
        for name, value in (("image", image), ("touch", touch)):
            if value is None:
                raise InvalidInputError(f"`{name}` is missing; pass a photo as `image` and a touch as `touch`.")
        touches = self._prepare_touch(touch, sensor, background)
        photos, count = self.processor.images(image), len(touches.pixels)
        several = isinstance(touch_weight, list | tuple)
        weights: Any = touch_weight if several else [touch_weight]
        given = [check_number("touch_weight", weight, 0.0, MAX_SCALE) for weight in weights]
        if several and len(given) != count:
            raise InvalidInputError(f"`touch_weight` holds {len(given)} numbers for {count} touches; pass one each.")
        remaining = 1.0 - sum(given)
        if image_weight is None and remaining < 0:
            raise InvalidInputError(f"`touch_weight` sums to {sum(given):g}; above 1, pass `image_weight`, too.")
        image_weight = check_number("image_weight", remaining if image_weight is None else image_weight, 0.0, MAX_SCALE)
        sizes = (len(photos), 1 if several else count)
        if min(sizes) not in (1, max(sizes)):
            raise InvalidInputError(
                f"`image` holds {len(photos)} photos and `touch` {count} touches; pass one, or one each, or a list of "
                "touch weights to mix all touches into each picture."
            )
        *touch_weights, image_weight = check_weights("touch_weight, image_weight", [*given, image_weight])
        return Mixture(photos, touches, touch_weights, image_weight, max(sizes))
