"""`TactileStylizationPipeline`: a photo restyled by a touch (Section 4.4 of the paper)."""

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from unitouch_gen.conditioning import mix_linear, mix_to_norm
from unitouch_gen.errors import InvalidInputError, check_choice, check_integer, check_kind, check_number
from unitouch_gen.models.images import ImageInput
from unitouch_gen.pipelines.base import (
    MAX_SCALE,
    Generators,
    SensorNames,
    StepEndCallback,
    Touches,
    check_count,
    check_weights,
    runs_networks,
)
from unitouch_gen.pipelines.output import UniTouchPipelineOutput
from unitouch_gen.pipelines.touch_to_image import TouchToImagePipeline
from unitouch_gen.sampling import Network, RunReport, trained_for
from unitouch_gen.schedule import NoiseSchedule, to_denoised

MIXES = {"linear": mix_to_norm, "paper": mix_linear}


def coarse(values: Tensor, cells: int, keep_colours: bool) -> Tensor:
    """The part of (B, C, h, w) on a grid of so many cells along the shorter side, with or without the mean."""
    size = values.shape[-2:]
    share = min(cells / min(size), 1.0)
    averages = F.interpolate(values, [max(round(share * side), 1) for side in size], mode="bilinear", antialias=True)
    smooth = F.interpolate(averages, size, mode="bicubic")
    return smooth if keep_colours else smooth - smooth.mean(dim=(2, 3), keepdim=True)


def hold_layout(
    network: Network, photo: Tensor, schedule: NoiseSchedule, prediction_type: str, cells: int, keep_colours: bool
) -> Network:
    """A network that holds the layout of photos, as ILVR does (Choi et al., 2021, Equation 8).

    The coarse part F of what it predicts of the clean latents becomes that of the photos' latents (B, C, h, w):
    D' = D + F(photo - D). Only the denoiser changes: every solver, adaptive steps and guidance run as they are.
    """

    def held(z: Tensor, timestep: Tensor) -> Tensor:
        prediction, sigma = network(z, timestep).float(), schedule.sigma(timestep.cpu()).item()
        denoised = to_denoised(prediction, z, sigma, prediction_type)
        one = torch.ones((), dtype=torch.float32)
        slope = to_denoised(one, 0.0 * one, sigma, prediction_type).item()  # dD / dprediction
        target = photo.float().repeat(len(z) // len(photo), 1, 1, 1)
        return prediction + coarse(target - denoised, cells, keep_colours) / slope

    return held


class TactileStylizationPipeline(TouchToImagePipeline):
    """Restyles photos by touches: the same unCLIP model, on a mix of both embeddings, holding the photo's layout.

    See `TouchToImagePipeline` for the components. `default_strength` is not used here.
    """

    _example_call = 'pipe(example("wood", "image"), example("gravel"))'

    @runs_networks
    def __call__(  # type: ignore[override]
        self,
        image: ImageInput = None, touch: ImageInput = None, prompt: str | list[str] | None = None,
        touch_weight: float | None = None, image_weight: float | None = None, mix: str = "linear",
        layout: int | None = 14, keep_colours: bool = False, init_strength: float = 1.0,
        height: int | None = None, width: int | None = None, num_inference_steps: int | None = None,
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
        strength = check_number("strength", strength, 0.0, MAX_SCALE)
        check_choice("mix", mix, MIXES)
        check_kind("keep_colours", keep_colours, bool)
        if layout is not None:
            cells, (schedule, prediction_type) = check_integer("layout", layout, 2), trained_for(self.scheduler)
        if touch_weight is None:
            touch_weight = 0.3 if layout is None else 0.7
        if image_weight is None:
            image_weight = 1.0 - check_number("touch_weight", touch_weight, 0.0, 1.0)
        weights = check_weights("touch_weight, image_weight", [touch_weight, image_weight])
        noise_level, bridge = self._check_noise_level(noise_level), self._check_bridge(bridge)
        for name, value in (("image", image), ("touch", touch)):
            if value is None:
                raise InvalidInputError(f"`{name}` is missing; pass a photo as `image` and a touch as `touch`.")
        touches, photos = self._prepare_touch(touch, sensor, background), self.processor.images(image)
        fewer, batch_size = sorted((len(photos), len(touches.pixels)))
        check_count("image, touch", fewer, batch_size)
        settings = self._check_call(
            batch_size, num_images_per_prompt, height, width, num_inference_steps, guidance_scale, solver, tolerance,
            max_evaluations, eta, generator, latents, output_type, cross_attention_kwargs, callback_on_step_end,
            callback_on_step_end_tensor_inputs, throw, init_strength,
        )  # fmt: skip
        positive, negative = (prompt, prompt_embeds), (negative_prompt, negative_prompt_embeds)
        prompts = self._check_prompts(batch_size, settings.guidance, positive, negative)

        # 2. Encode photos and touches, and mix their embeddings
        report = RunReport()
        with report.stage("mix"):
            embeds = self._mixed(photos, touches, weights, batch_size, mix, strength, bridge, report, throw)

        # 3. Encode the photo's own latents
        photo: Any = None
        if init_strength < 1.0 or layout is not None:
            with report.stage("photo latents"):
                photo = self._encode_pictures("image", image, settings).expand(batch_size, -1, -1, -1)
                photo = photo.repeat_interleave(settings.repeats, dim=0)

        # 4. Generate from the mixed embedding
        init = photo if init_strength < 1.0 else None
        held = None if layout is None else (photo, schedule, prediction_type, cells, keep_colours)
        wrap = None if held is None else lambda network: hold_layout(network, *held)
        images = self._generate(settings, embeds, noise_level, prompts, report, init, wrap)
        return UniTouchPipelineOutput(images=images, report=report, embeds=embeds) if return_dict else (images, report)

    def _mixed(
        self, photos: Tensor, touches: Touches, weights: list[float], batch_size: int, mix: str, strength: float,
        bridge: bool, report: RunReport, throw: bool,
    ) -> Tensor:  # fmt: skip
        """Mixed embeddings (B, D) by the weights of touches and photos; an encoder of zero weight does not run."""
        parts, shares = list[Tensor](), [weight for weight in weights if weight > 0]  # (1 or B, D) each
        if weights[0] > 0:
            embeds = self._touch_embeds(touches, report, throw)
            parts.append(self.embedding_bank.bridge(embeds) if bridge else embeds)
        else:
            report.left_out.append("touch encoder")
        if weights[1] > 0:
            parts.append(self._match_norm(self.unitouch.get_image_features(photos), "image", throw))
        else:
            report.left_out.append("image encoder")
        stacked = torch.stack([part.expand(batch_size, -1) for part in parts])
        return strength * MIXES[mix](stacked, torch.tensor(shares).to(stacked))
