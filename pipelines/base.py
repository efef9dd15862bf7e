"""Base class of the pipelines: argument checks, the steps of a call, reading and saving.

A call checks its arguments (`CallSettings`), encodes its inputs to embeddings of the joint space, turns them into
conditioning, goes from noise to latents (`_denoise`), and from latents to pictures (`_images`).
"""

import copy
import os
import tempfile
from collections.abc import Callable, Container, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import wraps
from inspect import signature
from pathlib import Path
from typing import Any, Self, TypeVar

import torch
from diffusers import DiffusionPipeline
from diffusers.callbacks import MultiPipelineCallbacks, PipelineCallback
from diffusers.image_processor import VaeImageProcessor
from diffusers.loaders import StableDiffusionLoraLoaderMixin
from diffusers.pipelines.pipeline_utils import StableDiffusionMixin
from diffusers.utils.torch_utils import randn_tensor
from huggingface_hub import create_repo
from torch import Tensor

from unitouch_gen.conditioning import match_norm
from unitouch_gen.errors import (
    InvalidInputError,
    InvalidTypeError,
    NonFiniteError,
    check_arguments,
    check_choice,
    check_dtype,
    check_integer,
    check_kind,
    check_number,
    check_tensor,
    check_unused,
    describe,
)
from unitouch_gen.files import LOADING_OPTIONS, as_path, check_filled, check_saved, local_folder, reading
from unitouch_gen.models.autoencoders import decode, encode, scale_factor
from unitouch_gen.models.images import ImageInput, centre_rectangle, denormalise_pixels, load_images
from unitouch_gen.models.joint import UNTOUCHED, warn_of_unknown
from unitouch_gen.models.sensors import SensorMatch
from unitouch_gen.models.videos import is_untouched
from unitouch_gen.pipelines.hub import CARD, Card, located, name_classes
from unitouch_gen.sampling import Guidance, Network, ReturnCode, Run, RunReport, Steps, prepare_steps, sample
from unitouch_gen.saving import SAVING_OPTIONS, filling

Generators = torch.Generator | list[torch.Generator] | None
SensorNames = str | Sequence[str | None] | None
Method = TypeVar("Method", bound=Callable[..., Any])
StepEndCallback = Callable[[Any, int, Tensor, dict[str, Tensor]], dict[str, Tensor] | None]

MAX_SCALE = 1e6  # of guidance, strength and weights: beyond it float32 loses a prediction's smaller parts

_threads: list[int] = []  # one entry for each running call: the threads that torch had before any of them


def runs_networks(method: Method) -> Method:
    """A method of a pipeline that runs networks: without gradients, and in one thread if its main network is small."""

    @wraps(method)
    def run(self: Any, *args: Any, **kwargs: Any) -> Any:
        weights = list(getattr(self, self._main_network).parameters())
        if any(one.is_meta for one in weights):
            raise InvalidInputError("The pipeline is on the device 'meta', which keeps no numbers; read it again.")
        # On a CPU, threads of a network with fewer parameters mostly wait for each other.
        small = sum(one.numel() for one in weights) < 20_000_000
        _threads.append([*_threads, torch.get_num_threads()][0])
        torch.set_num_threads(1 if small else _threads[0])
        try:
            with torch.no_grad():
                return method(self, *args, **kwargs)
        finally:
            torch.set_num_threads(_threads[0])
            _threads.pop()

    return run  # type: ignore[return-value]


@dataclass(frozen=True)
class CallSettings:
    """Validated call arguments other than the conditioning."""

    shape: tuple[int, int, int, int]  # of the latents, (B n, C, h, w)
    repeats: int  # n, samples of each input
    device: torch.device
    steps: Steps
    guidance: Guidance
    generator: Generators
    latents: Tensor | None
    callback: StepEndCallback | None
    callback_inputs: Sequence[str]  # names of the tensors the callback gets
    cross_attention_kwargs: dict[str, Any] | None
    output_type: str
    throw: bool


@dataclass(frozen=True)
class Touches:
    """Touches to encode: pixel values (B, 3, S, S), the sensor of each, and optional backgrounds."""

    pixels: Tensor
    matches: list[SensorMatch]
    background: Tensor | None = None


class UniTouchPipeline(DiffusionPipeline, StableDiffusionMixin, StableDiffusionLoraLoaderMixin):
    """A network conditioned on embeddings of the joint space.

    Subclasses have the components `unitouch` and `processor`; those that make images also have `unet`, `scheduler`,
    `vae` and `embedding_bank`.
    """

    _hidden_states_name = "prompt_embeds"  # callback name of encoder_hidden_states
    _main_network = "unet"
    _example_call, _example_end = "", 'output.images[0].save("output.png")'  # shown on the model card
    _task = "image-to-image"  # and its tag
    text_encoder: Any = None  # x-to-touch has none, but diffusers' LoRA loader reads it
    embedding_bank: Any = None  # touch-to-text has none
    _card = Card()

    def _finish_init(self, network: str, **defaults: Any) -> None:
        """The end of a constructor: defaults of a call go into the config, and the widths of embeddings are checked."""
        self.register_to_config(**defaults)
        self.vae_scale_factor = scale_factor(self.vae)
        self.image_processor = VaeImageProcessor(vae_scale_factor=self.vae_scale_factor)
        self._check_widths(network)

    def _check_widths(self, network: str) -> None:
        """Raises if the joint space or the bank has embeddings of another width than the network takes."""
        widths = {
            "unitouch": self.unitouch and self.unitouch.config.projection_dim,
            "embedding_bank": self.embedding_bank and self.embedding_bank.config.embedding_dim,
        }
        for name, width in widths.items():
            if width not in (None, self.embedding_dim):
                raise InvalidInputError(f"`{name}` has width {width}, but {network} takes {self.embedding_dim}.")

    def _joint(self, argument: str) -> Any:
        """The joint space; if there is none, raises an error that names the argument which needs it."""
        if self.unitouch is None or self.processor is None:
            raise InvalidInputError(
                f"`{argument}` needs the joint space, but this pipeline lacks `unitouch` or `processor`; build it with "
                "both, or pass embeddings."
            )
        return self.unitouch

    # Checks of a call, before any network runs ------------------------------------------------------------------------

    def _default(self, name: str, value: Any) -> Any:
        """The argument, or the checkpoint's default if `None`."""
        return self.config[f"default_{name}"] if value is None else value

    def _check_call(
        self, inputs: int, num_images_per_prompt: Any, height: Any, width: Any, num_inference_steps: Any,
        guidance_scale: Any, solver: Any, tolerance: Any, max_evaluations: Any, eta: Any, generator: Any, latents: Any,
        output_type: Any, cross_attention_kwargs: Any, callback: Any, callback_inputs: Any, throw: Any,
        init_strength: Any = 1.0, timesteps: Any = None,
    ) -> CallSettings:  # fmt: skip
        """The validated arguments of a call with `inputs` inputs; `None` is the checkpoint's default."""
        repeats = check_integer("num_images_per_prompt", num_images_per_prompt, 1, 100_000)
        check_choice("output_type", output_type, ("pil", "np", "pt", "latent"))
        check_kind("throw", throw, bool)
        lora = check_kind("cross_attention_kwargs", cross_attention_kwargs, dict, type(None)) or {}
        check_number("cross_attention_kwargs['scale']", lora.get("scale", 1.0), -MAX_SCALE, MAX_SCALE)
        scale = check_number("guidance_scale", self._default("guidance_scale", guidance_scale), 0.0, MAX_SCALE)
        # The scheduler's own steps are kept unless an argument, which may be of any kind yet, asks for others.
        whole = isinstance(init_strength, float | int) and init_strength == 1.0
        own = timesteps is None and solver is None and tolerance is None and whole
        usual = num_inference_steps is None or (
            isinstance(num_inference_steps, int) and num_inference_steps == self.config.default_num_inference_steps
        )
        if own and usual and "timesteps" in signature(self.scheduler.set_timesteps).parameters:
            timesteps, num_inference_steps = self.config.default_timesteps, None
        if timesteps is None and tolerance is None:
            num_inference_steps = self._default("num_inference_steps", num_inference_steps)
        steps = prepare_steps(
            self.scheduler, num_inference_steps=num_inference_steps, timesteps=timesteps, solver=solver,
            tolerance=tolerance, max_evaluations=max_evaluations, eta=eta, init_strength=init_strength,
            device=self._execution_device,
        )  # fmt: skip
        return CallSettings(
            shape=self._check_shape(inputs * repeats, height, width, generator, latents), repeats=repeats,
            device=self._execution_device, steps=steps, guidance=Guidance(scale), generator=generator, latents=latents,
            callback=callback, callback_inputs=self._check_callback(callback, callback_inputs, tolerance),
            cross_attention_kwargs=cross_attention_kwargs, output_type=output_type, throw=throw,
        )  # fmt: skip

    def _check_shape(
        self, batch_size: int, height: int | None, width: int | None, generator: Generators, latents: Tensor | None
    ) -> tuple[int, int, int, int]:
        """Shape of the latents, (B n, C, h, w); given latents and a list of generators have to fit it."""
        factor, trained = self.vae_scale_factor, self.unet.config.sample_size  # one side, or (height, width)
        trained = trained if isinstance(trained, list | tuple) else (trained, trained)
        sides = []
        for name, given, side in zip(("height", "width"), (height, width), trained, strict=True):
            pixels = check_integer(name, side * factor if given is None and side else given, factor, 16_384)
            if pixels % factor:
                raise InvalidInputError(f"`{name}` is {pixels}; it has to be a multiple of {factor}.")
            sides.append(pixels // factor)
        shape = (batch_size, self.unet.config.out_channels, *sides)
        if latents is not None:
            check_tensor("latents", latents, *shape)
        if isinstance(generator, list) and len(generator) != batch_size:
            raise InvalidInputError(f"`generator` has {len(generator)} for {batch_size} images; pass one, or one each.")
        for one in generator if isinstance(generator, list) else [generator] * (generator is not None):
            check_kind("generator", one, torch.Generator)
        return shape

    def _check_callback(self, callback: Any, inputs: Sequence[str], tolerance: float | None) -> Sequence[str]:
        """Names of the tensors a callback gets; diffusers' own callbacks list theirs."""
        if isinstance(callback, PipelineCallback | MultiPipelineCallbacks):
            check_unused("callback_on_step_end", tolerance=tolerance)  # it counts steps
            inputs = callback.tensor_inputs
        if callback is not None and not callable(callback):
            raise InvalidTypeError(f"`callback_on_step_end` is {describe(callback)}; pass a function.")
        for name in check_kind("callback_on_step_end_tensor_inputs", inputs, list, tuple):
            check_choice("callback_on_step_end_tensor_inputs", name, self._callback_tensor_inputs)
        return inputs

    def _check_bridge(self, bridge: bool | None) -> bool:
        """Whether to bridge non-image embeddings; default True if there is a bank."""
        if bridge is None:
            return self.embedding_bank is not None
        if check_kind("bridge", bridge, bool) and self.embedding_bank is None:
            raise InvalidInputError("`bridge` is True, but this pipeline has no `embedding_bank`; pass False.")
        return bridge

    # From inputs to conditioning --------------------------------------------------------------------------------------

    def _prepare_touch(self, touch: ImageInput, sensor: SensorNames, background: ImageInput) -> Touches:
        """Touches with their sensors and, if given, backgrounds."""
        model = self._joint("touch")
        pixels = self.processor.touch(touch)
        if background is None:
            return Touches(pixels, model.match_sensors(pixels, sensor))
        backgrounds = self.processor.images(background, name="background")
        check_count("background", len(backgrounds), len(pixels))
        backgrounds = backgrounds.expand_as(pixels)
        matches = model.match_sensors(backgrounds, sensor, nearest=True)
        if matches[0].name is None:
            raise InvalidInputError("`background` was given, but this model has no sensor prototypes; leave it out.")
        return Touches(pixels, matches, backgrounds)

    def _touch_embeds(self, touches: Touches, report: RunReport, throw: bool = True) -> Tensor:
        """Embeddings (B, D) of touches; warns of those that are out of distribution or untouched."""
        model, pixels, background = self.unitouch, touches.pixels, touches.background
        if background is not None:
            pixels = model.recentre(pixels, background, touches.matches)
        features, reasons = model.encode_touches(pixels, model.sensor_ids(touches.matches))
        report.sensors = [match.name for match in touches.matches]
        report.sensor_distances = [match.distance for match in touches.matches]
        if background is not None:
            untouched = is_untouched(denormalise_pixels(touches.pixels), denormalise_pixels(background)).tolist()
            reasons = [UNTOUCHED if empty else reason for empty, reason in zip(untouched, reasons, strict=True)]
        if any(reasons):
            report.unknown["touch"] = reasons
            warn_of_unknown(reasons, stacklevel=6)  # the line that called the pipeline
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

    def _encode_pictures(self, name: str, pictures: ImageInput, settings: CallSettings) -> Tensor:
        """Scaled latents (B, C, h, w) of pictures, cropped to the output size."""
        height, width = (side * self.vae_scale_factor for side in settings.shape[-2:])
        pixels = torch.stack([centre_rectangle(picture, height, width) for picture in load_images(name, pictures)])
        return encode(self.vae, 2.0 * pixels - 1.0).float()

    # From conditioning to pictures ------------------------------------------------------------------------------------

    def _denoise(
        self, settings: CallSettings, hidden_states: Tensor, class_labels: Tensor | None, report: RunReport,
        init: Tensor | None = None, extra_channels: Tensor | None = None,
        wrap: Callable[[Network], Network] | None = None,
    ) -> Tensor:  # fmt: skip
        """Noise -> latents (B n, C, h, w) in float32.

        Args:
            hidden_states, class_labels: The UNet's conditioning; with guidance the unconditional half first.
            init: Scaled latents to start from (B n, C, h, w), in place of noise alone.
            extra_channels: Additional input channels (B n, C', h, w), the same in both halves.
            wrap: Changes what the network predicts.
        """
        device, dtype, batch_size = settings.device, self.unet.dtype, settings.shape[0]
        noise = settings.latents
        if noise is None:
            single = torch.float32 if dtype == torch.float64 else dtype  # a seed is the same noise in both
            noise = randn_tensor(settings.shape, generator=settings.generator, device=device, dtype=single)
        hidden_states = hidden_states.to(device, dtype)
        if class_labels is not None:
            class_labels = class_labels.to(device, dtype if class_labels.is_floating_point() else None)

        def network(state: Tensor, timestep: Tensor) -> Tensor:
            rows, held = len(state), len(hidden_states)  # rows: B n, or 2 B n with guidance
            allowed = (1, batch_size, 2 * batch_size) if rows == batch_size else (rows,)
            if held not in allowed:
                raise InvalidInputError(
                    f"`callback_on_step_end` left {held} rows of `{self._hidden_states_name}` for {rows} states; for "
                    "guidance return both halves, and start with a `guidance_scale` above 1."
                )
            if extra_channels is not None:
                state = torch.cat([state, extra_channels.repeat(rows // batch_size, 1, 1, 1).to(state)], dim=1)
            return self.unet(
                state.to(dtype),
                timestep,
                encoder_hidden_states=hidden_states.expand(rows, -1, -1) if held == 1 else hidden_states[-rows:],
                class_labels=None if class_labels is None else class_labels[-rows:],
                cross_attention_kwargs=settings.cross_attention_kwargs,
                return_dict=False,
            )[0]

        # A callback gets a copy of the pipeline: other calls may run on this one.
        caller, total = copy.copy(self), settings.steps.count or 100
        caller._guidance_scale, caller._num_timesteps, caller._interrupt = settings.guidance.scale, total, False

        def on_step(step: int, timestep: Tensor, latents: Tensor, run: Run) -> Tensor:
            nonlocal hidden_states
            tensors = {"latents": latents, self._hidden_states_name: hidden_states}
            inputs = {name: tensors[name] for name in settings.callback_inputs}
            changed = settings.callback(caller, step, timestep, inputs) or {}  # type: ignore[misc]
            check_kind("callback_on_step_end: what it returned", changed, dict)
            name, width = f"callback_on_step_end: {self._hidden_states_name}", hidden_states.shape[-1]
            states = changed.get(self._hidden_states_name, hidden_states)
            hidden_states = check_tensor(name, states, "B", "T", width, finite=False).to(hidden_states)
            scale = check_number("callback_on_step_end: _guidance_scale", caller._guidance_scale, -MAX_SCALE, MAX_SCALE)
            run.guidance, run.interrupted = Guidance(scale), caller._interrupt
            return changed.get("latents", latents)

        with report.stage("denoising"), self.progress_bar(total=total) as bar:
            result = sample(
                network if wrap is None else wrap(network),
                noise.to(device),
                settings.steps,
                report,
                guidance=settings.guidance,
                init=init,
                generator=settings.generator,
                throw=settings.throw,
                on_step=on_step if settings.callback else None,
                progress=lambda share: bar.update(round(share * total) - bar.n),
            )
        self._guidance_scale, self._num_timesteps, self._interrupt = caller._guidance_scale, total, caller._interrupt
        if not report.guided:
            report.left_out.append("unconditional branch")
        return result

    # What diffusers' callbacks read: in a callback, of the running call; otherwise, of the last call.
    _guidance_scale: float
    _num_timesteps: int
    _interrupt: bool
    guidance_scale = property(lambda self: self._guidance_scale)
    do_classifier_free_guidance = property(lambda self: Guidance(self._guidance_scale).active)
    num_timesteps = property(lambda self: self._num_timesteps)
    interrupt = property(lambda self: self._interrupt)

    def _images(self, settings: CallSettings, latents: Tensor, report: RunReport) -> Any:
        """Latents (B, C, h, w) -> pictures of the output type, of the samples that are finite."""
        rows = [row for row, code in enumerate(report.codes) if code.finite]
        if settings.output_type == "latent":
            report.left_out.append("VAE decoder")
            return latents[rows]
        pixels = latents.new_zeros(0, 3, *(self.vae_scale_factor * side for side in latents.shape[-2:]))
        with report.stage("decoding"):
            if rows:
                pixels = decode(self.vae, latents[rows])
                finite = torch.isfinite(pixels.flatten(1)).all(dim=1)
                for row in torch.tensor(rows)[~finite.cpu()].tolist():
                    if settings.throw:
                        raise NonFiniteError(f"Sample {row} is not finite after decoding; run the VAE in float32.")
                    report.codes[row], report.failed_at[row] = ReturnCode.NON_FINITE, report.steps
                pixels = pixels[finite]
            return self.image_processor.postprocess(pixels, output_type=settings.output_type)

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
        if kwargs.get("use_safetensors") is False:
            raise InvalidInputError("`use_safetensors` is False, but only safetensors are read; leave it out.")
        name, kwargs = "pretrained_model_name_or_path", {**kwargs, "use_safetensors": True}
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
        pipe.register_to_config(_name_or_path=str(pretrained_model_name_or_path))
        return pipe

    @classmethod
    def load_config(cls, *args: Any, **kwargs: Any) -> Any:
        """model_index.json as diffusers reads it, with our classes in place of the folder's Python files."""
        loaded = super().load_config(*args, **kwargs)
        config = loaded[0] if isinstance(loaded, tuple) else loaded
        config.update(located(config))
        return loaded

    def save_pretrained(
        self, save_directory: str | os.PathLike, safe_serialization: bool = True, *args: Any,
        card: Card | None = None, **kwargs: Any,
    ) -> None:  # fmt: skip
        """Writes the pipeline into a folder, as `DiffusionPipeline.save_pretrained` does; other files there stay.

        Also writes two-line Python files, by which `DiffusionPipeline.from_pretrained(folder, trust_remote_code=True)`
        finds our classes, and a model card, README.md. Without `card`, an existing card stays.

        Raises:
            InvalidInputError: If LoRA weights are loaded, or the folder cannot be written to; what it held stays.
        """
        check_kind("card", card, Card, type(None))
        if not safe_serialization:
            raise InvalidInputError("`safe_serialization` is False, but only safetensors are written; leave it out.")
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
        name, place = "pretrained_model_name_or_path_or_dict", pretrained_model_name_or_path_or_dict
        with nullcontext() if isinstance(place, dict) else reading(name, place):
            super().load_lora_weights(place, *args, **{"use_safetensors": True, **kwargs})


def check_components(kind: type[DiffusionPipeline], folder: Path, given: Container[str]) -> None:
    """Raises if a component that model_index.json names, and that is not `given`, lacks files."""
    kinds = {
        "tokenizer": "tokenizer",
        "processor": "processor",
        "scheduler": "scheduler",
        "image_noising_scheduler": "scheduler",
    }
    index = kind.load_config(folder)
    for name in kind._get_signature_keys(kind)[0]:
        saved = index.get(name)
        if isinstance(saved, list | tuple) and saved[1:] != [None] and name not in given:
            check_saved(folder / name, kinds.get(name, "network"))


def check_count(name: str, count: int, inputs: int) -> None:
    """Raises unless there is one for all of the inputs, or one for each."""
    if count not in (1, inputs):
        raise InvalidInputError(f"`{name}` holds {count} for {inputs} inputs; pass one, or one each.")


def check_weights(name: str, weights: Sequence[Any]) -> list[float]:
    """Weights of a mix, >= 0, normalised to a sum of 1."""
    numbers = [check_number(name, weight, 0.0, MAX_SCALE) for weight in weights]
    if sum(numbers) == 0:
        raise InvalidInputError(f"`{name}` sums to 0; at least one weight has to be above 0.")
    return [number / sum(numbers) for number in numbers]
