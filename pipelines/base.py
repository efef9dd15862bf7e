"""Base class of the pipelines: the checks of a call, encoding, the denoising loops, decoding, reading and saving."""

import copy
import json
import math
import os
import sys
import tempfile
import threading
from collections.abc import Callable, Container, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from inspect import signature
from pathlib import Path
from types import NoneType
from typing import Any, Self

import torch
from diffusers import DiffusionPipeline
from diffusers.callbacks import MultiPipelineCallbacks, PipelineCallback
from diffusers.image_processor import VaeImageProcessor
from diffusers.loaders import StableDiffusionLoraLoaderMixin
from diffusers.pipelines.pipeline_utils import StableDiffusionMixin
from diffusers.utils.torch_utils import randn_tensor
from huggingface_hub import create_repo
from torch import Tensor

from unitouch_gen.arguments import MAX_SCALE, SamplingArguments
from unitouch_gen.conditioning import match_norm
from unitouch_gen.errors import (
    InvalidInputError,
    NonFiniteError,
    check_arguments,
    check_choice,
    check_count,
    check_dtype,
    check_equal,
    check_fields,
    check_integer,
    check_kind,
    check_multiple,
    check_number,
    check_tensor,
)
from unitouch_gen.files import LOADING_OPTIONS, as_path, check_filled, check_saved, local_folder, read_settings, reading
from unitouch_gen.models.autoencoders import decode, encode, scale_factor
from unitouch_gen.models.images import ImageInput, centre_rectangle, normalise_pixels
from unitouch_gen.models.joint import UNTOUCHED, warn_of_unknown
from unitouch_gen.models.sensor_bank import SensorMatch
from unitouch_gen.models.videos import is_untouched
from unitouch_gen.pipelines.hub import CARD, RECORD, Card, name_classes, resolve_classes
from unitouch_gen.sampling import (
    Denoiser,
    Guidance,
    ReturnCode,
    RunInterruptedError,
    RunReport,
    SampleStatus,
    solve,
)
from unitouch_gen.saving import SAVING_OPTIONS, filling
from unitouch_gen.schedule import alpha

Generators = torch.Generator | list[torch.Generator] | None
SensorNames = str | Sequence[str | None] | None
DIFFUSERS_CALLBACKS = (PipelineCallback, MultiPipelineCallbacks)
StepEndCallback = Callable[[Any, int, Tensor, dict[str, Tensor]], dict[str, Tensor] | None]
EndStep = Callable[[int, Tensor, Tensor], Tensor]  # (step, timestep, latents) -> latents to go on from

SMALL_WORK = 1e10
"""Work of an evaluation, in weights times positions, below which several threads of a CPU mostly wait for each other.

The built-in networks stay below it with four rows: two pictures with guidance.
"""


class SingleThread:
    """A context in which torch computes in the calling thread alone; contexts of several threads may overlap.

    `torch.set_num_threads` holds for the calling thread and for threads that start later. So the first of overlapping
    contexts stores the number, and each restores it.
    """

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.running = 0
        self.before = 1

    def __enter__(self) -> None:
        with self.lock:
            if self.running == 0:
                self.before = torch.get_num_threads()
            self.running += 1
            torch.set_num_threads(1)

    def __exit__(self, *_: object) -> None:
        with self.lock:
            self.running -= 1
            torch.set_num_threads(self.before)


SINGLE_THREAD = SingleThread()


def threads_for(work: float) -> AbstractContextManager[None]:
    """A context for evaluations: one thread where there is little work, otherwise all that torch has."""
    return SINGLE_THREAD if work < SMALL_WORK else nullcontext()


def stack_level() -> int:
    """The `stacklevel` of a warning, so that it names the line outside of this package that led to it."""
    frame: Any = sys._getframe(1)
    level = 1
    while frame.f_back is not None and frame.f_globals["__name__"].partition(".")[0] in ("unitouch_gen", "torch"):
        frame = frame.f_back
        level += 1
    return level


@dataclass(frozen=True)
class Touches:
    """Touches to encode: pixels in [0, 1] (B, 3, S, S), the sensor of each, and optional pictures of it untouched."""

    pixels: Tensor
    matches: list[SensorMatch]
    background: Tensor | None = None


class UniTouchPipeline(DiffusionPipeline, StableDiffusionMixin, StableDiffusionLoraLoaderMixin):
    """Base class of pipelines whose network is conditioned on embeddings of the joint space.

    Subclasses have the components `unitouch` and `processor`; those that make images also have `unet`, `scheduler`,
    `vae` and `embedding_bank`.
    """

    _example_call = ""  # shown on the model card
    _example_end = 'output.images[0].save("output.png")'
    _task = "image-to-image"  # the card's tag
    text_encoder: Any = None  # x-to-touch has none, but diffusers' LoRA loader reads it
    embedding_bank: Any = None  # touch-to-text has none
    _card = Card()
    _record: Mapping[str, Any] = {}  # of the network's training; `distill` reads it in a saved folder

    def _finish_init(self, network_name: str, **defaults: Any) -> None:
        """The end of a constructor: defaults of a call go into the config, and the widths of embeddings are checked."""
        self.register_to_config(**defaults)
        self.vae_scale_factor = scale_factor(self.vae)
        self.image_processor = VaeImageProcessor(vae_scale_factor=self.vae_scale_factor)
        self._num_weights = self.unet.num_parameters()
        self._check_widths(network_name)

    def _check_widths(self, network_name: str) -> None:
        """Raises if the joint space or the bank has embeddings of another width than the network takes."""
        widths = {
            "unitouch": self.unitouch and self.unitouch.config.projection_dim,
            "embedding_bank": self.embedding_bank and self.embedding_bank.config.embedding_dim,
        }
        for name, width in widths.items():
            if width is not None:
                check_equal(name, "width", width, self.embedding_dim, f"as {network_name} takes")

    def _require(self, argument: str, *parts: str, instead: str = "pass embeddings") -> None:
        """Raises if a component that an argument needs is missing; `instead` is what a user can do without it."""
        missing = " and ".join(f"`{part}`" for part in parts if getattr(self, part) is None)
        if missing:
            raise InvalidInputError(
                f"`{argument}` needs {missing}, which this pipeline lacks; build it with them, or {instead}."
            )

    # Checks of a call, before any network runs ------------------------------------------------------------------------

    def _check_arguments(self, **given: Any) -> SamplingArguments:
        """The arguments of a call, checked; steps and `bridge` that are `None` become the checkpoint's defaults."""
        arguments = check_fields(SamplingArguments, given)
        config = self.config
        changes: dict[str, Any] = {}
        if arguments.tolerance is None and arguments.timesteps is None:
            steps = arguments.num_inference_steps
            is_default = steps in (None, config.default_num_inference_steps)
            is_whole_run = is_default and arguments.solver is None and arguments.init_strength == 1.0
            takes_timesteps = "timesteps" in signature(self.scheduler.set_timesteps).parameters
            if config.default_timesteps is not None and is_whole_run and takes_timesteps:
                changes |= {"timesteps": config.default_timesteps, "num_inference_steps": None}
            elif steps is None:
                changes["num_inference_steps"] = config.default_num_inference_steps
        if arguments.bridge is None:
            changes["bridge"] = self.embedding_bank is not None
        elif arguments.bridge:
            self._require("bridge", "embedding_bank", instead="pass False")
        return arguments.model_copy(update=changes)

    def _latents_shape(self, inputs: int, arguments: SamplingArguments) -> tuple[int, int, int, int]:
        """Shape (B n, C, h, w) of the latents. A call without a height or width takes those of the UNet's training."""
        trained = self.unet.config.sample_size  # one side, or (height, width)
        if not isinstance(trained, list | tuple):
            trained = (trained, trained)
        sides = []
        for name, side in zip(("height", "width"), trained, strict=True):
            pixels = getattr(arguments, name)
            if pixels is None:
                pixels = check_integer(name, side, 1) * self.vae_scale_factor  # raises for a UNet without a size
            check_multiple(name, pixels, self.vae_scale_factor)
            sides.append(pixels // self.vae_scale_factor)
        return (inputs * arguments.num_images_per_prompt, self.unet.config.out_channels, *sides)

    def check_inputs(
        self,
        shape: Sequence[int],
        arguments: SamplingArguments,
        *,
        generator: Any,
        latents: Any,
        cross_attention_kwargs: Any,
        callback_on_step_end: Any,
        callback_on_step_end_tensor_inputs: Any,
    ) -> None:
        """Raises on arguments of a call that do not fit the `shape` (B n, C, h, w) of its latents, or each other."""
        if latents is not None:
            check_tensor("latents", latents, *shape)
        generators = generator if isinstance(generator, list) else [generator]
        if len(generators) not in (1, shape[0]):
            raise InvalidInputError(
                f"`generator` holds {len(generators)} for {shape[0]} pictures; pass one, or one for each picture."
            )
        for one in generators:
            check_kind("generator", one, torch.Generator, NoneType)
        lora = check_kind("cross_attention_kwargs", cross_attention_kwargs, dict, NoneType) or {}
        check_number("cross_attention_kwargs['scale']", lora.get("scale", 1.0), -MAX_SCALE, MAX_SCALE)
        check_kind("callback_on_step_end", callback_on_step_end, Callable, NoneType)
        if isinstance(callback_on_step_end, DIFFUSERS_CALLBACKS) and arguments.tolerance is not None:
            raise InvalidInputError(
                "`callback_on_step_end` is one of `diffusers.callbacks`, which need a number of steps; leave out "
                "`tolerance`, or pass a function."
            )
        for name in check_kind("callback_on_step_end_tensor_inputs", callback_on_step_end_tensor_inputs, list, tuple):
            check_choice("callback_on_step_end_tensor_inputs", name, self._callback_tensor_inputs)

    # From inputs to embeddings ----------------------------------------------------------------------------------------

    def _read_touches(self, touch: ImageInput, sensor: SensorNames, background: ImageInput = None) -> Touches:
        """Touches with the sensor of each: named, or retrieved by the touch or, where one is passed, its background."""
        self._require("touch", "unitouch", "processor")
        _, sensor_bank = self.unitouch.load("touch")
        pixels = self.processor.raw_touch(touch)
        if background is None:
            return Touches(pixels, sensor_bank.match(pixels, sensor))
        backgrounds = self.processor.raw_images(background, name="background")
        check_count("background", len(backgrounds), len(pixels))
        backgrounds = backgrounds.expand_as(pixels)
        matches = sensor_bank.match(backgrounds, sensor, nearest=True)
        if matches[0].name is None:
            raise InvalidInputError("`background` cannot be used: this model has no sensor prototypes; leave it out.")
        return Touches(pixels, matches, backgrounds)

    def _touch_embeds(self, touches: Touches, report: RunReport, throw: bool = True) -> Tensor:
        """Embeddings (B, D) of touches; warns of those that are out of distribution or untouched."""
        model = self.unitouch
        pixels = touches.pixels
        if touches.background is not None:
            pixels = model.recentre(pixels, touches.background, touches.matches)
        features, reasons = model.encode_touches(normalise_pixels(pixels), model.sensor_ids(touches.matches))
        report.sensors = [match.name for match in touches.matches]
        report.sensor_distances = [match.distance for match in touches.matches]
        if touches.background is not None:
            untouched = is_untouched(touches.pixels, touches.background).tolist()
            reasons = [UNTOUCHED if empty else reason for empty, reason in zip(untouched, reasons, strict=True)]
        if any(reasons):
            report.unknown["touch"] = reasons
            warn_of_unknown(reasons, stacklevel=1 + stack_level())
        return self._match_norm(features, "touch", throw)

    def _match_norm(self, features: Tensor, modality: str, throw: bool = True) -> Tensor:
        """Features (B, D) rescaled to the norm of image embeddings, float32.

        Without `throw`, a non-finite embedding becomes NaN, and its sample ends as NON_FINITE.
        """
        features = features.float()
        failed = ~torch.isfinite(features.norm(dim=1))
        if throw and bool(failed.any()):
            raise NonFiniteError(
                f"The embedding of {modality} {int(failed.nonzero()[0])} is not finite; run `unitouch` in float32."
            )
        return match_norm(features, self.unitouch.config.embedding_norm).masked_fill(failed[:, None], float("nan"))

    def _encode_pictures(self, pictures: Sequence[Tensor], shape: Sequence[int]) -> Tensor:
        """Scaled latents (B, C, h, w) of pictures from `load_images`, which are cropped to the size of the `shape`."""
        height, width = (side * self.vae_scale_factor for side in shape[-2:])
        pixels = torch.stack([centre_rectangle(picture, height, width) for picture in pictures])
        return encode(self.vae, 2.0 * pixels - 1.0).float()

    # From noise to pictures -------------------------------------------------------------------------------------------

    def prepare_latents(
        self,
        shape: tuple[int, ...],
        steps: Any,
        generator: Generators,
        latents: Tensor | None,
        init: Tensor | None = None,
    ) -> Tensor:
        """The state to start from, float32 (B n, C, h, w): noise at the first noise level of the steps.

        Args:
            steps: A scheduler or noise levels, from `prepare_steps`. For a scheduler, the state is in its scale; for
                noise levels, it is variance-exploding.
            latents: Unit-variance noise, drawn if `None`.
            init: Scaled latents that the noise is added to (SDEdit; Meng et al., 2022).
        """
        device = self._execution_device
        if latents is None:
            # A seed draws the same noise for a UNet in float64 as in float32.
            dtype = torch.float32 if self.unet.dtype == torch.float64 else self.unet.dtype
            latents = randn_tensor(shape, generator=generator, device=device, dtype=dtype)
        noise = latents.to(device, torch.float32)
        if isinstance(steps, list):
            # x = z / alpha, with alpha = 1 / sqrt(1 + sigma^2)
            return noise * math.hypot(1.0, steps[0]) if init is None else init + steps[0] * noise
        if init is None:
            return noise * steps.init_noise_sigma
        return steps.add_noise(init, noise, steps.timesteps[:1].expand(len(init)))

    def _threads(self, shape: Sequence[int], guidance: Guidance) -> AbstractContextManager[None]:
        """`threads_for` evaluations on latents (B n, C, h, w)."""
        samples, _, height, width = shape
        return threads_for(self._num_weights * samples * (1 + guidance.active) * height * width)

    def _denoise(
        self,
        denoise: Denoiser,
        latents: Tensor,
        steps: Any,
        arguments: SamplingArguments,
        report: RunReport,
        *,
        generator: Generators,
        callback: StepEndCallback | None,
        callback_inputs: Sequence[str],
    ) -> Tensor:
        """The state of `prepare_latents` -> latents (B n, C, h, w), float32; counts and codes go into the report."""
        # A callback is passed a copy of the pipeline with the state of its own call: others may run on this one.
        pipe = self if callback is None else copy.copy(self)
        pipe._guidance_scale = denoise.guidance.scale
        pipe._interrupt = False
        end_step = None
        if callback is not None:
            if isinstance(callback, DIFFUSERS_CALLBACKS):
                callback_inputs = callback.tensor_inputs
            end_step = partial(pipe._end_step, callback, callback_inputs, denoise)
        with report.stage("denoising"):
            run = pipe._run_solver if isinstance(steps, list) else pipe._run_scheduler
            latents = run(denoise, latents, steps, arguments, report, generator=generator, end_step=end_step)
        self._guidance_scale = pipe._guidance_scale
        self._num_timesteps = pipe._num_timesteps
        self._interrupt = pipe._interrupt
        if not report.guided:
            report.left_out.append("unconditional branch")
        return latents

    def _run_scheduler(
        self,
        denoise: Denoiser,
        latents: Tensor,
        scheduler: Any,
        arguments: SamplingArguments,
        report: RunReport,
        *,
        generator: Generators,
        end_step: EndStep | None,
    ) -> Tensor:
        """diffusers' denoising loop, for any of its schedulers."""
        timesteps = scheduler.timesteps
        status = SampleStatus(len(latents), latents.device)
        ended = ReturnCode.SUCCESS
        self._num_timesteps = len(timesteps)
        report.solver = type(scheduler).__name__
        report.steps = len(arguments.timesteps) if arguments.timesteps else scheduler.num_inference_steps
        sigmas = [] if denoise.edit is None else denoise.schedule.sigma(timesteps.cpu()).tolist()
        options: dict[str, Any] = {}
        parameters = signature(scheduler.step).parameters
        if "generator" in parameters:
            options["generator"] = generator
        if "eta" in parameters:
            options["eta"] = arguments.eta
        with self.progress_bar(total=len(timesteps)) as bar:
            for step, timestep in enumerate(timesteps):
                z = scheduler.scale_model_input(latents, timestep)
                if step > 0:
                    status.update(step - 1, z)  # of z, since `latents` may be in another scale
                if end_step is not None and self._interrupt:
                    ended = ReturnCode.INTERRUPTED
                    break
                prediction = denoise.predict(z, timestep)
                if denoise.edit is not None:
                    prediction = denoise.edit_prediction(prediction, z, sigmas[step])
                latents = scheduler.step(prediction, timestep, latents, **options, return_dict=False)[0]
                if end_step is not None:
                    latents = end_step(step, timestep, latents)
                bar.update()
            else:  # not interrupted
                status.update(step, latents)
        status.conclude(report, denoise, ended, arguments.throw)
        return latents

    def _run_solver(
        self,
        denoise: Denoiser,
        x: Tensor,
        sigmas: list[float],
        arguments: SamplingArguments,
        report: RunReport,
        *,
        generator: Generators,
        end_step: EndStep | None,
    ) -> Tensor:
        """A named solver, or adaptive steps."""
        adaptive = arguments.tolerance is not None
        total = 100 if adaptive else len(sigmas) - 1  # 100 % of the way in log sigma
        status = SampleStatus(len(x), x.device)
        self._num_timesteps = total
        report.solver = arguments.solver or "adaptive"
        latents = x
        begin = sigmas[0]  # noise level at which a step begins

        def callback(step: int, x: Tensor, sigma: float) -> Tensor:
            nonlocal latents, begin
            latents = x * alpha(sigma)
            if end_step is not None:
                changed = end_step(step, denoise.timestep(begin, x.device), latents.clone())
                x = torch.where(changed == latents, x, changed / alpha(sigma))  # exact where nothing was changed
                latents = changed
            status.update(step, latents)
            report.steps = step + 1
            begin = sigma
            done = step + 1
            if adaptive:
                first, last = sigmas
                done = 100 if sigma <= last else round(100 * math.log(first / sigma) / math.log(first / last))
            bar.update(done - bar.n)
            if end_step is not None and self._interrupt and sigma > 0.0:
                raise RunInterruptedError
            return x

        with self.progress_bar(total=total) as bar:
            try:
                latents, ended = solve(denoise, x, sigmas, arguments, callback, generator)
            except RunInterruptedError:
                ended = ReturnCode.INTERRUPTED
        if not adaptive:
            report.steps = total
        if ended is ReturnCode.MAX_EVALUATIONS:
            status.update(report.steps, latents)
        status.conclude(report, denoise, ended, arguments.throw)
        return latents

    def _end_step(
        self,
        callback: StepEndCallback,
        names: Sequence[str],
        denoise: Denoiser,
        step: int,
        timestep: Tensor,
        latents: Tensor,
    ) -> Tensor:
        """Runs a user's callback after a step, which may change embeddings, guidance and the latents, returned here."""
        embeds_name = self._callback_tensor_inputs[-1]
        embeds = denoise.conditions["encoder_hidden_states"]
        tensors = {"latents": latents, embeds_name: embeds}
        changed = callback(self, step, timestep, {name: tensors[name] for name in names}) or {}
        check_kind("callback_on_step_end: what it returned", changed, dict)
        new_latents = changed.get("latents", latents)
        check_tensor("callback_on_step_end: latents", new_latents, *latents.shape, finite=False)
        new_embeds = changed.get(embeds_name, embeds)
        check_tensor(f"callback_on_step_end: {embeds_name}", new_embeds, "B", "T", embeds.shape[-1], finite=False)
        scale = check_number("callback_on_step_end: _guidance_scale", self._guidance_scale, -MAX_SCALE, MAX_SCALE)
        denoise.guidance = Guidance(scale)
        samples = len(latents)
        allowed = (2 * samples,) if denoise.guidance.active else (1, samples, 2 * samples)
        if len(new_embeds) not in allowed:
            raise InvalidInputError(
                f"`callback_on_step_end` left {len(new_embeds)} rows of `{embeds_name}` for {samples} samples; for "
                "guidance return both halves, and start with a `guidance_scale` above 1."
            )
        if len(new_embeds) == 1:
            new_embeds = new_embeds.expand(samples, -1, -1)
        denoise.conditions["encoder_hidden_states"] = new_embeds.to(embeds)
        return new_latents.to(latents)

    # What diffusers' callbacks read: in a callback, of the running call; otherwise, of the last call.
    _guidance_scale: float
    _num_timesteps: int
    _interrupt: bool
    guidance_scale = property(lambda self: self._guidance_scale)
    do_classifier_free_guidance = property(lambda self: Guidance(self._guidance_scale).active)
    num_timesteps = property(lambda self: self._num_timesteps)
    interrupt = property(lambda self: self._interrupt)

    def _decode(self, latents: Tensor, arguments: SamplingArguments, report: RunReport) -> Any:
        """Latents (B, C, h, w) -> pictures of the output type, of the samples that are finite."""
        rows = [row for row, code in enumerate(report.codes) if code.finite]
        if arguments.output_type == "latent":
            report.left_out.append("VAE decoder")
            return latents[rows]
        height, width = latents.shape[-2:]
        pixels = latents.new_zeros(0, 3, height * self.vae_scale_factor, width * self.vae_scale_factor)
        with report.stage("decoding"):
            if rows:
                pixels = decode(self.vae, latents[rows])
                finite = torch.isfinite(pixels.flatten(1)).all(dim=1)
                for row in torch.tensor(rows)[~finite.cpu()].tolist():
                    if arguments.throw:
                        raise NonFiniteError(f"Sample {row} is not finite after decoding; run the VAE in float32.")
                    report.codes[row] = ReturnCode.NON_FINITE
                    report.failed_at[row] = report.steps
                pixels = pixels[finite]
            return self.image_processor.postprocess(pixels, output_type=arguments.output_type)

    # Reading and saving -----------------------------------------------------------------------------------------------

    @classmethod
    def from_pretrained(cls, pretrained_model_name_or_path: str | os.PathLike, **kwargs: Any) -> Self:  # type: ignore[override]
        """Reads a pipeline from a folder or repository, as `DiffusionPipeline.from_pretrained` does.

        Only safetensors are read.

        Raises:
            InvalidInputError: If there is no such pipeline, or it cannot be read.
            InvalidTypeError: If there is no such argument; diffusers would ignore it.
        """
        components, defaults = cls._get_signature_keys(cls)
        check_arguments("`from_pretrained`", kwargs, {*LOADING_OPTIONS, *components, *defaults})
        check_safetensors("use_safetensors", kwargs.get("use_safetensors"))
        name = "pretrained_model_name_or_path"
        kwargs = {**kwargs, "use_safetensors": True}
        key = "torch_dtype" if "torch_dtype" in kwargs else "dtype"
        kwargs.setdefault(key, torch.float32)
        if not isinstance(kwargs[key], dict):  # dict: dtypes by component
            kwargs[key] = check_dtype(key, kwargs[key])
        # diffusers' download cannot resolve our components.
        folder = local_folder(name, pretrained_model_name_or_path, **kwargs)
        with reading(name, folder):
            check_components(cls, folder, kwargs)
            pipe = super().from_pretrained(folder, **kwargs)
            for part, network in pipe.components.items():
                if part not in kwargs and part != "unitouch" and isinstance(network, torch.nn.Module):
                    check_filled(folder / part, network)
            if (folder / RECORD).is_file():
                pipe._record = read_settings(name, folder / RECORD)
        pipe.register_to_config(_name_or_path=str(pretrained_model_name_or_path))
        return pipe

    @classmethod
    def load_config(cls, *args: Any, **kwargs: Any) -> Any:
        """model_index.json as diffusers reads it, with our classes in place of the folder's Python files."""
        loaded = super().load_config(*args, **kwargs)
        config = loaded[0] if isinstance(loaded, tuple) else loaded
        config.update(resolve_classes(config))
        return loaded

    def save_pretrained(
        self,
        save_directory: str | os.PathLike,
        safe_serialization: bool = True,
        *args: Any,
        card: Card | None = None,
        **kwargs: Any,
    ) -> None:
        """Writes the pipeline into a folder, as `DiffusionPipeline.save_pretrained` does; other files there stay.

        Also writes two-line Python files, by which `DiffusionPipeline.from_pretrained(folder, trust_remote_code=True)`
        finds our classes, and a model card, README.md. Without `card`, an existing card stays. The
        record of the network's training, if there is one, is written as record.json.

        Raises:
            InvalidInputError: If LoRA weights are loaded, or the folder cannot be written to; what it held stays.
        """
        check_kind("card", card, Card, NoneType)
        check_safetensors("safe_serialization", safe_serialization)
        check_arguments("`save_pretrained`", kwargs, SAVING_OPTIONS)
        folder = as_path("save_directory", save_directory)
        upload = kwargs.pop("push_to_hub", False)
        folder_name = os.path.basename(os.path.realpath(folder))  # Path.resolve raises on a loop of links
        name = kwargs.pop("repo_id", folder_name)
        networks = [part for part in self.components.values() if isinstance(part, torch.nn.Module)]
        if any(hasattr(one, "base_layer") for network in networks for one in network.modules()):
            raise InvalidInputError("LoRA weights are loaded; fuse them or not, then call `unload_lora_weights`.")
        with filling("save_directory", folder) as place:
            super().save_pretrained(place, True, *args, **kwargs)
            if type(self).__module__.startswith(__package__):
                name_classes(place)
            if card is not None or not (folder / CARD).exists():
                (card or self._card).write(place, name, self)
            if self._record:
                (place / RECORD).write_text(json.dumps(self._record, indent=2) + "\n", encoding="utf-8")
        if upload:
            self.push_to_hub(name, card=card, **kwargs)

    def push_to_hub(self, repo_id: str, *, card: Card | None = None, **kwargs: Any) -> Any:  # type: ignore[override]
        """Uploads what `save_pretrained` writes, with the model card; `kwargs` as of diffusers' `push_to_hub`."""
        options = {name: kwargs.pop(name, None) for name in ("token", "commit_message", "create_pr")}
        private = kwargs.pop("private", None)
        repo_id = create_repo(repo_id, private=private, token=options["token"], exist_ok=True).repo_id
        with tempfile.TemporaryDirectory() as place:
            self.save_pretrained(place, card=card, repo_id=repo_id, **kwargs)  # the card names it
            return self._upload_folder(place, repo_id, **options)

    def load_lora_weights(self, pretrained_model_name_or_path_or_dict: Any, *args: Any, **kwargs: Any) -> None:
        """Loads LoRA weights of UNet and text encoder, as diffusers does; needs peft.

        Raises:
            InvalidInputError: If no such weights can be read there, or they do not fit.
            InvalidTypeError: If there is no such argument; diffusers would ignore it.
        """
        own = ("adapter_name", "hotswap", "return_lora_metadata", "unet_config", "weight_name")
        check_arguments("`load_lora_weights`", kwargs, {*LOADING_OPTIONS, *own})
        name = "pretrained_model_name_or_path_or_dict"
        place = pretrained_model_name_or_path_or_dict
        with nullcontext() if isinstance(place, dict) else reading(name, place):
            super().load_lora_weights(place, *args, **{"use_safetensors": True, **kwargs})


def check_components(kind: type[DiffusionPipeline], folder: Path, passed: Container[str]) -> None:
    """Raises if a component that model_index.json names lacks files, unless it was passed."""
    kinds = {
        "tokenizer": "tokenizer",
        "processor": "processor",
        "scheduler": "scheduler",
        "image_noising_scheduler": "scheduler",
    }
    index = kind.load_config(folder)
    for name in kind._get_signature_keys(kind)[0]:
        saved = index.get(name)
        if isinstance(saved, list | tuple) and saved[1:] != [None] and name not in passed:
            check_saved(folder / name, kinds.get(name, "network"))


def check_safetensors(name: str, value: Any) -> None:
    """Raises if a user asks for pickles."""
    if value is False:
        raise InvalidInputError(f"`{name}` is False, but only safetensors are read and written; leave it out.")


def check_weights(name: str, weights: Sequence[Any]) -> list[float]:
    """Weights of a mix, >= 0, normalised to a sum of 1."""
    numbers = [check_number(name, weight, 0.0, MAX_SCALE) for weight in weights]
    if sum(numbers) == 0:
        raise InvalidInputError(f"`{name}` sums to 0; at least one weight has to be above 0.")
    return [number / sum(numbers) for number in numbers]
