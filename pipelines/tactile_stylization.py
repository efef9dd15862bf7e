"""`TactileStylizationPipeline`: a photo that looks as a touch feels (Section 4.4 of the paper)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from unitouch_gen.conditioning import apply_strength, mix_linear, mix_spherical, mix_to_norm
from unitouch_gen.errors import InvalidInputError, check_choice, check_flag, check_integer, check_number, describe
from unitouch_gen.models.images import ImageInput
from unitouch_gen.pipelines.base import (
    MAX_GAIN,
    MOST_IMAGES,
    OUTPUT_TYPES,
    CallSettings,
    Generators,
    SensorNames,
    StepEndCallback,
    Touches,
    check_attention,
    check_weights,
)
from unitouch_gen.pipelines.output import UniTouchPipelineOutput
from unitouch_gen.pipelines.touch_to_image import TouchToImagePipeline
from unitouch_gen.sampling import RunReport

MIXES = {"linear": mix_to_norm, "slerp": mix_spherical, "paper": mix_linear}
Weight = float | Sequence[float]


@dataclass(frozen=True)
class Blend:
    """What goes into the embeddings of B pictures.

    Attributes:
        photos: Pixel values (N, 3, S, S).
        touches: M of them.
        parts: (weight, "touch" or "image", row of that input for each of the B pictures); weights sum to 1.
    """

    photos: Tensor
    touches: Touches
    parts: list[tuple[float, str, list[int]]]

    @property
    def batch_size(self) -> int:
        return len(self.parts[0][2])


class TactileStylizationPipeline(TouchToImagePipeline):
    """Restyles photos by touches: the same unCLIP model, on a mix of both embeddings.

    See `TouchToImagePipeline` for the components. `default_strength` is for touches alone and is not used here.
    """

    _example_call = 'pipe(example("wood", "image"), example("gravel"))'

    @torch.no_grad()
    def __call__(  # type: ignore[override]
        self,
        image: ImageInput = None,
        touch: ImageInput = None,
        prompt: str | list[str] | None = None,
        touch_weight: Weight = 0.3,
        image_weight: Weight | None = None,
        mix: str = "linear",
        init_strength: float = 0.65,
        height: int | None = None,
        width: int | None = None,
        num_inference_steps: int | None = None,
        timesteps: Sequence[int] | None = None,
        sigmas: Sequence[float] | None = None,
        guidance_scale: float | None = None,
        guidance_interval: Sequence[float] | None = None,
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
            touch: One touch image or several, likewise. Several photos and touches go in pairs, one of either goes
                with all of the other.
            prompt: What else the picture should be; "high quality" when left out. One, or one for each picture.
            touch_weight, image_weight: Of the embeddings in the mix, brought to a sum of 1 (paper: 0.3 and 0.7). The
                photos' is what the touches leave of 1 when left out. A list weighs several touches, or photos, that are
                all mixed into one picture.
            mix: "linear", sum_i w_i e_i brought back to the norm of the joint space's images, as in X-to-touch;
                "slerp", along the sphere; or "paper", the sum as it is, which is shorter the more its parts differ.
            init_strength: How much of the photo's layout goes: the share of the steps that is made from its own
                latents, from near 0 (the photo) to 1, which starts from noise alone (the paper's). To a `tolerance` it
                is the share of the way in Karras spacing.
            strength: Gain on the mixed embedding, >= 0 (paper: 1).
            bridge: As there, of touches, before they are mixed.
            sensor: Which sensor took the touches: a name, one for each, or `None` to retrieve it.

        Examples:
            >>> import unitouch_gen

            >>> pipe = unitouch_gen.tiny("stylization")
            >>> pipe("photo.jpg", unitouch_gen.example("brick")).images[0].save("brick_photo.png")
            >>> pipe("photo.jpg", ["brick.png", "grass.png"], touch_weight=[0.2, 0.1])  # two touches into one picture
        """
        # 1. Check inputs, before any network runs
        strength = check_number("strength", strength, 0.0, MAX_GAIN)
        check_choice("mix", mix, MIXES)
        check_number("init_strength", init_strength, 0.0, 1.0)
        noise_level, bridge = self._check_noise_level(noise_level), self._check_bridge(bridge)
        blend = self._blend(image, touch, image_weight, touch_weight, sensor, background)
        batch_size = blend.batch_size
        if init_strength < 1.0 and len(blend.photos) not in (1, batch_size):
            raise InvalidInputError(
                f"`init_strength` is {init_strength:g}, but {len(blend.photos)} photos are mixed into one picture, and "
                "none of them is its layout; pass one photo, or 1 to start from noise."
            )
        repeats = check_integer("num_images_per_prompt", num_images_per_prompt, 1, MOST_IMAGES)
        settings = CallSettings(
            shape=self._check_shape(batch_size * repeats, height, width, generator, latents),
            repeats=repeats,
            device=self._execution_device,
            steps=self._check_steps(
                num_inference_steps, timesteps, sigmas, solver, tolerance, max_evaluations, eta, init_strength
            ),
            guidance=self._check_guidance(guidance_scale, guidance_interval),
            generator=generator,
            latents=latents,
            callback=self._check_callback(callback_on_step_end, callback_on_step_end_tensor_inputs, tolerance),
            cross_attention_kwargs=check_attention(cross_attention_kwargs),
            output_type=check_choice("output_type", output_type, OUTPUT_TYPES),
            throw=check_flag("throw", throw),
        )
        prompts = self._check_prompts(
            batch_size, settings.guidance, (prompt, prompt_embeds), (negative_prompt, negative_prompt_embeds)
        )

        # 2. Encode photos and touches, and mix their embeddings
        report = RunReport()
        with report.stage("mix"):
            embeds = self._mixed(blend, bridge, mix, strength, report, throw)

        # 3. Encode the photo's own latents
        init = None
        if init_strength < 1.0:
            with report.stage("photo latents"):
                init = self._encode_pictures("image", image, settings).expand(batch_size, -1, -1, -1)
                init = init.repeat_interleave(settings.repeats, dim=0)

        # 4. Generate from the mixed embedding
        images = self._generate(settings, embeds, noise_level, prompts, report, init)
        return UniTouchPipelineOutput(images=images, report=report, embeds=embeds) if return_dict else (images, report)

    # Conditions -------------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def encode_mix(
        self,
        image: ImageInput,
        touch: ImageInput,
        touch_weight: Weight = 0.3,
        image_weight: Weight | None = None,
        mix: str = "linear",
        strength: float = 1.0,
        sensor: SensorNames = None,
        background: ImageInput = None,
        bridge: bool | None = None,
    ) -> Tensor:
        """Mixed embeddings as the network will see them before noise, (B, D); see `__call__` for the arguments."""
        strength = check_number("strength", strength, 0.0, MAX_GAIN)
        check_choice("mix", mix, MIXES)
        bridge = self._check_bridge(bridge)
        blend = self._blend(image, touch, image_weight, touch_weight, sensor, background)
        return self._mixed(blend, bridge, mix, strength, RunReport())

    def _mixed(
        self, blend: Blend, bridge: bool, mix: str, strength: float, report: RunReport, throw: bool = True
    ) -> Tensor:
        """(B, D); an encoder whose inputs weigh nothing does not run."""
        used = [part for part in blend.parts if part[0] > 0]
        modalities = {modality for _, modality, _ in used}
        embeds = {}
        if "touch" in modalities:
            touches = self._matched(self._touch_features(blend.touches, report), "touch", throw)
            embeds["touch"] = self._bridged(touches, bridge)
        if "image" in modalities:
            embeds["image"] = self._matched(self.unitouch.get_image_features(blend.photos), "image", throw)
        report.left_out += [f"{name} encoder" for name in ("touch", "image") if name not in modalities]
        stacked = torch.stack([embeds[modality][rows] for _, modality, rows in used])
        weights = torch.tensor([weight for weight, _, _ in used], dtype=torch.float64, device=stacked.device)
        return apply_strength(stacked[0] if len(used) == 1 else MIXES[mix](stacked, weights), strength)

    # Checks -----------------------------------------------------------------------------------------------------------

    def _blend(
        self,
        image: ImageInput,
        touch: ImageInput,
        image_weight: Weight | None,
        touch_weight: Weight,
        sensor: SensorNames,
        background: ImageInput,
    ) -> Blend:
        """Reads photos and touches, and pairs them with their weights."""
        for name, value in (("image", image), ("touch", touch)):
            if value is None:
                raise InvalidInputError(f"`{name}` is missing; pass a photo as `image` and how it feels as `touch`.")
        touches = self._prepare_touch(touch, sensor, background)
        photos = self.processor.images(image)
        touch_weights = _weights("touch_weight", touch_weight, len(touches.pixels))
        if image_weight is None:
            image_weight = 1.0 - sum(touch_weights)
            if image_weight < 0:
                raise InvalidInputError(
                    f"`touch_weight` sums to {sum(touch_weights):g}; above 1, pass `image_weight`, too."
                )
        image_weights = _weights("image_weight", image_weight, len(photos))
        # One weight is for each of a batch; a list of weights mixes all of its inputs into every picture.
        inputs = (("touch", len(touches.pixels), touch_weights), ("image", len(photos), image_weights))
        sizes = [count if len(weights) == 1 else 1 for _, count, weights in inputs]
        batch_size = max(sizes)
        if min(sizes) not in (1, batch_size):
            raise InvalidInputError(
                f"`image` holds {len(photos)} photos and `touch` {len(touches.pixels)} touches; pass one, or one each, "
                "or a list of weights to mix them into one."
            )
        shares = iter(check_weights("touch_weight, image_weight", [*touch_weights, *image_weights]))
        parts = []
        for modality, count, weights in inputs:
            for number in range(len(weights)):
                paired = len(weights) == 1 and count == batch_size
                rows = list(range(batch_size)) if paired else [number] * batch_size
                parts.append((next(shares), modality, rows))
        return Blend(photos, touches, parts)


def _weights(name: str, weight: Any, count: int) -> list[float]:
    """One weight for a batch, or one for each of `count` inputs that are mixed into one picture."""
    if not isinstance(weight, list | tuple):
        return [check_number(name, weight, 0.0, MAX_GAIN)]
    if len(weight) != count:
        raise InvalidInputError(
            f"`{name}` is {describe(weight)} for {count} inputs; pass one number, or one for each input to mix."
        )
    return [check_number(f"{name}[{number}]", item, 0.0, MAX_GAIN) for number, item in enumerate(weight)]
