"""What every pipeline on the joint space shares: its conditions, its denoising and its decoding."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from diffusers.callbacks import MultiPipelineCallbacks, PipelineCallback
from diffusers.image_processor import VaeImageProcessor
from diffusers.utils.torch_utils import randn_tensor
from torch import Tensor

from unitouch_gen.conditioning import match_norm
from unitouch_gen.eliminate import eliminated
from unitouch_gen.errors import InvalidInputError, NonFiniteError, describe
from unitouch_gen.memory import trim_memory
from unitouch_gen.models.autoencoders import decode, scale_factor
from unitouch_gen.models.images import ImageInput
from unitouch_gen.models.sensors import SensorMatch
from unitouch_gen.pipelines.call import MAX_EVALUATIONS, Call, StepEndCallback, solver_name
from unitouch_gen.pipelines.checks import (
    Generators,
    check_call,
    check_callback,
    check_generators,
    check_has_flow,
    check_interval,
    check_latents,
    check_sensor,
    check_tolerance,
    warn_of_unfamiliar,
)
from unitouch_gen.pipelines.planned import PlannedPipeline
from unitouch_gen.report import ReturnCode, RunReport
from unitouch_gen.sampling import Guidance, integrate, prepare_steps
from unitouch_gen.schedulers.estimate import UNCALIBRATED, Calibration
from unitouch_gen.schedulers.schedule import NoiseSchedule
from unitouch_gen.schedulers.solvers import make_scheduler
from unitouch_gen.schedulers.steps import follows_the_flow

SensorNames = str | Sequence[str | None] | None


class JointSpacePipeline(PlannedPipeline):
    """A latent diffusion model conditioned on embeddings of the joint space.

    A pipeline that is one has the components `unitouch`, `processor`, `unet`, `scheduler` and `vae`, and calls
    `_prepare_images` at the end of its constructor. `_hidden_name` is what it calls the hidden states that its UNet
    attends to, `_embeds_name` the embeddings that a call may pass in place of touches, if it may.
    """

    _hidden_name = "prompt_embeds"
    _embeds_name: str | None = None
    vae_scale_factor: int
    image_processor: VaeImageProcessor

    def _prepare_images(self) -> None:
        if self.vae is None:
            raise InvalidInputError("`vae` is None; build the pipeline with one, or load it with a `plan` of latents.")
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
            instead = f", or pass `{self._embeds_name}` instead" if self._embeds_name else ""
            raise InvalidInputError(
                f"`touch` came, but this pipeline has no `unitouch` and `processor`; build it with both{instead}."
            )
        check_sensor(sensor)
        pixels = self.processor.touch(touch)
        if background is None:
            matches = self.unitouch.match_sensors(pixels, sensor)
            warn_of_unfamiliar(self.unitouch.sensor_bank, matches)
            return pixels, matches
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
        """Features of any modality at the norm of the joint space's images, (B, D) float32.

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
        guidance_interval: Sequence[float] | None,
        solver: str | None,
        tolerance: float | None,
        max_evaluations: int | None,
        eta: float,
        generator: Generators,
        latents: Tensor | None,
        output_type: str,
        callback: StepEndCallback | None,
        callback_inputs: Sequence[str],
        throw: bool,
        from_noise: bool = True,
    ) -> Call:
        """The checkpoint's defaults filled in, and everything that cannot work refused; no network runs.

        Args:
            batch_size: B, number of inputs.
            repeats: n, samples for each input.
            from_noise: Whether it starts there, and not from given latents.

        Raises:
            InvalidInputError, InvalidTypeError: Naming the argument, what came, and what to do.
        """
        check_tolerance(
            tolerance, max_evaluations, solver=solver, num_inference_steps=num_inference_steps, eta=eta or None
        )
        height, width = self._default_size("height", height), self._default_size("width", width)
        guidance_scale = self._default("guidance_scale", guidance_scale)
        num_inference_steps = self._default("num_inference_steps", num_inference_steps)
        last = self.scheduler.config.num_train_timesteps - 1
        interval = check_interval("guidance_interval", guidance_interval, last)
        whole = from_noise and interval is None
        scheduler = make_scheduler(
            self.scheduler,
            solver,
            steps=None if tolerance is not None else num_inference_steps,
            guidance_scale=guidance_scale,
            whole=whole,
        )
        check_callback(callback, tolerance)
        if tolerance is not None:
            check_has_flow(self.scheduler)
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
        if tolerance is not None or follows_the_flow(scheduler, eta):
            NoiseSchedule.of(scheduler)  # refuses those that no error can be told of
        sides = (height // self.vae_scale_factor, width // self.vae_scale_factor)
        shape = (batch_size * repeats, self.unet.config.in_channels, *sides)
        check_generators(generator, shape[0])
        if latents is not None:
            check_latents(latents, shape)
        fixed = tolerance is None
        calibrations = (self.config.get("calibration") or {}) if whole else {}
        return Call(
            scheduler=scheduler,
            timesteps=prepare_steps(scheduler, num_inference_steps, self._execution_device)
            if fixed
            else torch.empty(0),
            num_inference_steps=int(num_inference_steps),
            guidance=Guidance(float(guidance_scale), interval),
            shape=shape,
            repeats=repeats,
            solver=solver,
            tolerance=tolerance,
            max_evaluations=MAX_EVALUATIONS if max_evaluations is None else max_evaluations,
            calibration=Calibration.find(calibrations, solver_name(solver, tolerance, scheduler), guidance_scale),
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
        """Noise -> latents (B n, C, h, w) in float32; see `diffusion.sampling.integrate`.

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
        steps = call.steps(noise.to(device), init, init_strength)
        hidden = hidden.to(device, dtype)
        if labels is not None:
            labels = labels.to(device, dtype if labels.is_floating_point() else None)
        self._guidance_scale = call.guidance.scale
        self._num_timesteps, self._interrupt = steps.planned, False

        def guidance() -> Guidance:
            now = replace(call.guidance, scale=self._guidance_scale)
            if now.active and len(hidden) != 2 * batch_size:
                raise InvalidInputError(
                    f"`callback_on_step_end` set `_guidance_scale` to {now.scale:g}, but there is no unconditional "
                    f"branch; start with a `guidance_scale` above 1, and keep both halves of `{self._hidden_name}`."
                )
            return now

        def denoise(state: Tensor, timestep: Tensor) -> Tensor:
            rows = len(state)  # as many as there are samples, or twice that
            states = hidden.expand(rows, -1, -1) if len(hidden) == 1 else hidden[-rows:]
            return lean(state.to(dtype), timestep, states, None if labels is None else labels[-rows:])

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

        request = eliminated(self.unet, hidden, labels, halves_share_latents=call.guidance.active)
        with request as lean, self.progress_bar(total=steps.planned) as bar:
            latents = integrate(
                denoise,
                steps,
                guidance,
                report,
                throw=call.throw,
                on_step=None if call.callback is None else on_step,
                progress=lambda: bar.update(steps.done - bar.n),
                interrupted=lambda: self._interrupt,
            )
        report.left_out += lean.left_out
        alone = report.evaluations - report.guided
        if call.guidance.active and alone:
            report.left_out.append(f"unconditional branch in {alone} of {report.evaluations} evaluations")
        calibration = call.calibration or UNCALIBRATED
        report.error_estimate = [calibration.error(value) for value in report.error_indicator]
        return latents

    def _decode(self, latents: Tensor, report: RunReport, throw: bool) -> Tensor:
        """Latents (B, C, h, w) -> pixels (b, 3, H, W), about [-1, 1], of the samples that ended well."""
        rows = [row for row, code in enumerate(report.codes) if code.finite]
        if not rows:
            return latents.new_zeros(0, 3, *(self.vae_scale_factor * side for side in latents.shape[-2:]))
        if self._low_memory:
            trim_memory()  # what denoising held lies in pieces, and decoding needs large ones
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
            return latents[[code.finite for code in report.codes]]
        pixels = self._decode(latents, report, call.throw)
        return self.image_processor.postprocess(pixels, output_type=call.output_type)
