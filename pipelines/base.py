"""What every pipeline on the joint space shares: its conditions, its denoising and its decoding."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from diffusers import DiffusionPipeline
from diffusers.callbacks import MultiPipelineCallbacks, PipelineCallback
from diffusers.image_processor import VaeImageProcessor
from diffusers.schedulers.scheduling_utils import SchedulerMixin
from diffusers.utils.torch_utils import randn_tensor
from torch import Tensor

from unitouch_gen.diffusion.conditioning import match_norm
from unitouch_gen.diffusion.latents import decode, scale_factor
from unitouch_gen.diffusion.report import ReturnCode, RunReport
from unitouch_gen.diffusion.sampling import Guidance, prepare_steps, sample, start_from
from unitouch_gen.diffusion.solvers import make_scheduler
from unitouch_gen.encoders.pixels import ImageInput
from unitouch_gen.encoders.sensors import SensorMatch
from unitouch_gen.errors import InvalidInputError, NonFiniteError, describe
from unitouch_gen.pipelines.checks import Generators, check_call, check_generators, check_latents, check_sensor

SensorNames = str | Sequence[str | None] | None
StepEndCallback = Callable[[Any, int, Tensor, dict[str, Tensor]], dict[str, Tensor] | None]


@dataclass
class Call:
    """The settings of one call, checked; the names are those of the pipelines' arguments.

    Attributes:
        scheduler: Fresh, with its timesteps set.
        shape: Of the latents, (B n, C, h, w).
        repeats: n, of samples for each input.
    """

    scheduler: SchedulerMixin
    timesteps: Tensor
    num_inference_steps: int
    guidance: Guidance
    shape: tuple[int, int, int, int]
    repeats: int
    solver: str | None
    eta: float
    generator: Generators
    latents: Tensor | None
    output_type: str
    callback: StepEndCallback | None
    callback_inputs: Sequence[str]
    throw: bool

    def report(self, matches: Sequence[SensorMatch] = ()) -> RunReport:
        """A fresh report of this call."""
        return RunReport(
            solver=self.solver or type(self.scheduler).__name__,
            guidance_scale=self.guidance.scale,
            sensors=[match.name for match in matches],
            sensor_distances=[match.distance for match in matches],
        )


class JointSpacePipeline(DiffusionPipeline):
    """A latent diffusion model conditioned on embeddings of the joint space.

    A pipeline that is one has the components `unitouch`, `processor`, `unet`, `scheduler` and `vae`, names the hidden
    states that its UNet attends to in `_hidden_name`, and calls `_prepare_images` at the end of its constructor.
    """

    _hidden_name = "prompt_embeds"

    def _prepare_images(self) -> None:
        self.vae_scale_factor = scale_factor(self.vae)
        self.image_processor = VaeImageProcessor(vae_scale_factor=self.vae_scale_factor)

    # Conditions -------------------------------------------------------------------------------------------------------

    def _default(self, name: str, value: Any) -> Any:
        """What the call said, or else the checkpoint's default."""
        return self.config[f"default_{name}"] if value is None else value

    def _default_size(self, name: str, value: Any) -> Any:
        """`height` or `width` as the call said, or else as the UNet was trained, pixels."""
        if value is not None:
            return value
        size = self.unet.config.sample_size  # of latents: one side or (height, width)
        side = size[("height", "width").index(name)] if isinstance(size, list | tuple) else size
        if side is None:
            raise InvalidInputError(f"`{name}` has to be passed: this pipeline's UNet does not say its own size.")
        return side * self.vae_scale_factor

    def _prepare_touch(
        self, touch: ImageInput, sensor: SensorNames, background: ImageInput
    ) -> tuple[Tensor, list[SensorMatch]]:
        """Pixel values (B, 3, S, S) and the sensor of each touch; no network runs."""
        if self.unitouch is None or self.processor is None:
            raise InvalidInputError(
                "`touch` came, but this pipeline has no `unitouch` and `processor`; pass `touch_embeds` instead."
            )
        check_sensor(sensor)
        pixels = self.processor.touch(touch)
        if background is None:
            return pixels, self.unitouch.match_sensors(pixels, sensor)
        behind = self.processor.images(background, name="background")
        if len(behind) not in (1, len(pixels)):
            raise InvalidInputError(
                f"`background` holds {len(behind)} images for {len(pixels)} touches; pass one, or one each."
            )
        behind = behind.expand_as(pixels)
        matches = self.unitouch.match_sensors(behind, sensor)
        if matches[0].name is None:
            raise InvalidInputError(
                "`background` came, but this model has no sensor prototypes to re-centre on; leave it out."
            )
        return self.unitouch.recentre(pixels, behind, matches), matches

    def _touch_features(self, pixels: Tensor, matches: list[SensorMatch]) -> Tensor:
        """(B, D), as the encoder gives them."""
        return self.unitouch.get_touch_features(pixels, self.unitouch.sensor_ids(matches))

    def _matched(self, features: Tensor, what: str, throw: bool = True) -> Tensor:
        """Features of any sense at the norm of the joint space's images, (B, D) float32.

        Without `throw`, an embedding that is not finite stays so, and its sample breaks.
        """
        features = features.float()
        broken = ~torch.isfinite(features.norm(dim=1))
        if throw and bool(broken.any()):
            raise NonFiniteError(
                f"The embedding of {what} {int(broken.nonzero()[0])} is not finite; run `unitouch` in float32."
            )
        return match_norm(features, self.unitouch.config.embedding_norm).masked_fill(broken[:, None], float("nan"))

    # What a call asks for ---------------------------------------------------------------------------------------------

    def _check_call(
        self,
        batch_size: int,
        repeats: int,
        *,
        height: int | None,
        width: int | None,
        num_inference_steps: int | None,
        guidance_scale: float | None,
        solver: str | None,
        eta: float,
        generator: Generators,
        latents: Tensor | None,
        output_type: str,
        callback: StepEndCallback | None,
        callback_inputs: Sequence[str],
        throw: bool,
    ) -> Call:
        """The checkpoint's defaults filled in, and everything that cannot work refused; no network runs.

        Args:
            batch_size: B, number of inputs.
            repeats: n, samples for each input.

        Raises:
            InvalidInputError, InvalidTypeError: Naming the argument, what came, and what to do.
        """
        height, width = self._default_size("height", height), self._default_size("width", width)
        guidance_scale = self._default("guidance_scale", guidance_scale)
        num_inference_steps = self._default("num_inference_steps", num_inference_steps)
        scheduler = make_scheduler(self.scheduler, solver)
        if isinstance(callback, PipelineCallback | MultiPipelineCallbacks):
            callback_inputs = callback.tensor_inputs
        check_call(
            height=height,
            width=width,
            multiple=self.vae_scale_factor,
            num_inference_steps=num_inference_steps,
            max_steps=scheduler.config.num_train_timesteps,
            guidance_scale=guidance_scale,
            eta=eta,
            output_type=output_type,
            callback=callback,
            callback_inputs=callback_inputs,
            known_callback_inputs=self._callback_tensor_inputs,
        )
        sides = (height // self.vae_scale_factor, width // self.vae_scale_factor)
        shape = (batch_size * repeats, self.unet.config.in_channels, *sides)
        check_generators(generator, shape[0])
        if latents is not None:
            check_latents(latents, shape)
        return Call(
            scheduler=scheduler,
            timesteps=prepare_steps(scheduler, num_inference_steps, self._execution_device),
            num_inference_steps=int(num_inference_steps),
            guidance=Guidance(float(guidance_scale)),
            shape=shape,
            repeats=repeats,
            solver=solver,
            eta=eta,
            generator=generator,
            latents=latents,
            output_type=output_type,
            callback=callback,
            callback_inputs=callback_inputs,
            throw=throw,
        )

    # Denoising and decoding -------------------------------------------------------------------------------------------

    @property
    def guidance_scale(self) -> float:
        """Of the call that runs; `callback_on_step_end` may set `_guidance_scale`, as with diffusers' pipelines."""
        return self._guidance_scale

    @property
    def do_classifier_free_guidance(self) -> bool:
        return Guidance(self._guidance_scale).active

    @property
    def num_timesteps(self) -> int:
        return self._num_timesteps

    @property
    def interrupt(self) -> bool:
        return self._interrupt

    def _denoise(
        self,
        call: Call,
        hidden: Tensor,
        labels: Tensor | None,
        report: RunReport,
        init: Tensor | None = None,
        init_strength: float = 1.0,
    ) -> Tensor:
        """Noise -> latents (B n, C, h, w) in float32; see `diffusion.sampling.sample`.

        Args:
            call: What was asked for; its noise is drawn here if none came.
            hidden, labels: Of the conditional branch, and before it of the unconditional one where guidance is on.
            report: Gets evaluations and return codes.
            init, init_strength: Latents to start from in place of noise alone, and how much of them to replace.
        """
        device, dtype, batch_size = self._execution_device, self.unet.dtype, call.shape[0]
        noise = call.latents
        if noise is None:
            noise = randn_tensor(call.shape, generator=call.generator, device=device, dtype=dtype)
        noise, timesteps, steps = noise.to(device), call.timesteps, call.num_inference_steps
        state = None
        if init is not None:
            state, timesteps, steps = start_from(call.scheduler, timesteps, steps, init, noise, init_strength)
        hidden = hidden.to(device, dtype)
        if labels is not None:
            labels = labels.to(device, dtype if labels.is_floating_point() else None)
        self._guidance_scale = call.guidance.scale
        self._num_timesteps, self._interrupt = len(timesteps), False

        def guidance() -> Guidance:
            now = Guidance(self._guidance_scale)
            if now.active and len(hidden) != 2 * batch_size:
                raise InvalidInputError(
                    f"`callback_on_step_end` set `_guidance_scale` to {now.scale:g}, but there is no unconditional "
                    "branch; start with a `guidance_scale` above 1, and keep both halves of `{self._hidden_name}`."
                )
            return now

        def denoise(state: Tensor, timestep: Tensor) -> Tensor:
            rows = len(state)  # as many as there are samples, or twice that
            states = hidden.expand(rows, -1, -1) if len(hidden) == 1 else hidden[-rows:]
            conditions = {"encoder_hidden_states": states, "class_labels": None if labels is None else labels[-rows:]}
            return self.unet(state.to(dtype), timestep, **conditions, return_dict=False)[0]

        def on_step(step: int, timestep: Tensor, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
            nonlocal hidden
            assert call.callback is not None
            tensors = {**tensors, self._hidden_name: hidden}
            changed = call.callback(self, step, timestep, {key: tensors[key] for key in call.callback_inputs}) or {}
            if self._hidden_name in changed:
                hidden = changed[self._hidden_name].to(hidden)
            if len(hidden) not in (1, batch_size, 2 * batch_size):
                raise InvalidInputError(
                    f"`callback_on_step_end` returned `{self._hidden_name}` that are {describe(hidden)}, for "
                    f"{batch_size} pictures; return one for each, one for all, or both halves."
                )
            return changed

        with self.progress_bar(total=len(timesteps)) as bar:
            return sample(
                denoise,
                call.scheduler,
                noise,
                guidance,
                report,
                timesteps=timesteps,
                num_inference_steps=steps,
                start=state,
                generator=call.generator,
                eta=call.eta,
                throw=call.throw,
                on_step=None if call.callback is None else on_step,
                progress=bar.update,
                interrupted=lambda: self._interrupt,
            )

    def _decode(self, latents: Tensor, report: RunReport, throw: bool) -> Tensor:
        """Latents (B, C, h, w) -> pixels (b, 3, H, W), about [-1, 1], of the samples that ended well."""
        rows = [row for row, code in enumerate(report.codes) if code is ReturnCode.SUCCESS]
        if not rows:
            return latents.new_zeros(0, 3, *(self.vae_scale_factor * side for side in latents.shape[-2:]))
        pixels = decode(self.vae, latents[rows])
        finite = torch.isfinite(pixels.flatten(1)).all(dim=1)
        broken = [row for row, fine in zip(rows, finite.tolist(), strict=True) if not fine]
        if broken and throw:
            raise NonFiniteError(f"Sample {broken[0]} is not finite after decoding; run the VAE in float32.")
        for row in broken:
            report.codes[row], report.failed_at[row] = ReturnCode.NON_FINITE, report.steps
        return pixels[finite]

    def _images(self, call: Call, latents: Tensor, report: RunReport) -> Any:
        """Latents (B, C, h, w) -> pictures, of the output type, of the samples that ended well."""
        if call.output_type == "latent":
            report.left_out.append("VAE")
            return latents[[code is ReturnCode.SUCCESS for code in report.codes]]
        pixels = self._decode(latents, report, call.throw)
        return self.image_processor.postprocess(pixels, output_type=call.output_type)
