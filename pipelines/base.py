"""What the pipelines share: the checks of a call, the way from inputs to pictures, and reading and saving.

A call checks its arguments (`CallSettings`), encodes its inputs to embeddings of the joint space, makes of them what
the network is conditioned on, goes from noise to latents (`_denoise`), and from latents to pictures (`_images`).
"""

import copy
import math
import os
import tempfile
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import torch
from diffusers import DiffusionPipeline
from diffusers.callbacks import MultiPipelineCallbacks, PipelineCallback
from diffusers.image_processor import VaeImageProcessor
from diffusers.loaders import StableDiffusionLoraLoaderMixin
from diffusers.pipelines.pipeline_utils import StableDiffusionMixin
from diffusers.utils.torch_utils import randn_tensor
from huggingface_hub import create_repo
from safetensors import safe_open
from torch import Tensor

from unitouch_gen.conditioning import match_norm
from unitouch_gen.errors import (
    InvalidInputError,
    InvalidTypeError,
    NonFiniteError,
    check_choice,
    check_dtype,
    check_integer,
    check_kind,
    check_number,
    check_tensor,
    describe,
)
from unitouch_gen.files import as_path, local_folder, reading, writing_folder
from unitouch_gen.models.autoencoders import decode, encode, scale_factor
from unitouch_gen.models.images import ImageInput, centre_rectangle, denormalise_pixels, load_images
from unitouch_gen.models.out_of_distribution import UNTOUCHED, warn_of_unknown
from unitouch_gen.models.sensors import SensorMatch
from unitouch_gen.models.videos import is_untouched
from unitouch_gen.pipelines.hub import CARD, Card, copy_card, located, name_classes
from unitouch_gen.sampling import Guidance, ReturnCode, Run, RunReport, Steps, prepare_steps, sample

Generators = torch.Generator | list[torch.Generator] | None
SensorNames = str | Sequence[str | None] | None
StepEndCallback = Callable[[Any, int, Tensor, dict[str, Tensor]], dict[str, Tensor] | None]

MOST_IMAGES = 100_000  # of one input
LONGEST_SIDE = 16_384  # pixels
MAX_GAIN = 1e6  # of guidance and strength: beyond it float32 cannot hold a prediction and its parts at once


@dataclass(frozen=True)
class CallSettings:
    """What a call asks for beside its conditions, checked."""

    shape: tuple[int, int, int, int]  # of the latents, (B n, C, h, w)
    repeats: int  # n, samples of each input
    device: torch.device
    steps: Steps
    guidance: Guidance
    generator: Generators
    latents: Tensor | None
    callback: StepEndCallback | None
    callback_inputs: Sequence[str]  # names of the tensors that it gets
    cross_attention_kwargs: dict[str, Any] | None
    output_type: str
    throw: bool

    def __post_init__(self) -> None:
        check_choice("output_type", self.output_type, ("pil", "np", "pt", "latent"))
        check_kind("throw", self.throw, bool)
        kwargs = check_kind("cross_attention_kwargs", self.cross_attention_kwargs or {}, dict)
        check_number("cross_attention_kwargs['scale']", kwargs.get("scale", 1.0), -MAX_GAIN, MAX_GAIN)


@dataclass(frozen=True)
class Touches:
    """Touches ready to be encoded: pixel values (B, 3, S, S), the sensor of each, and the backgrounds that came."""

    pixels: Tensor
    matches: list[SensorMatch]
    background: Tensor | None = None


class UniTouchPipeline(DiffusionPipeline, StableDiffusionMixin, StableDiffusionLoraLoaderMixin):
    """A latent diffusion model conditioned on embeddings of the joint space.

    Subclasses have the components `unitouch`, `processor`, `unet`, `scheduler`, `vae` and `embedding_bank`.
    """

    _hidden_name = "prompt_embeds"  # what the UNet attends to, as callbacks call it
    _example_call = ""  # of the model card
    text_encoder: Any = None  # x-to-touch has none; diffusers' LoRA loader asks for it
    _card: Card | Path | None = None  # or the folder that has one

    def _finish_init(self, wanted_width: str, **defaults: float) -> None:
        """Stores defaults in the config, and checks that the parts fit."""
        self.register_to_config(**defaults)
        self.vae_scale_factor = scale_factor(self.vae)
        self.image_processor = VaeImageProcessor(vae_scale_factor=self.vae_scale_factor)
        widths = {
            "unitouch": self.unitouch and self.unitouch.config.projection_dim,
            "embedding_bank": self.embedding_bank and self.embedding_bank.config.embedding_dim,
        }
        for name, width in widths.items():
            if width not in (None, self.embedding_dim):
                raise InvalidInputError(f"`{name}` has embeddings of width {width}, but {wanted_width}.")

    def _joint(self, what: str) -> Any:
        """The joint space, which `what` needs."""
        if self.unitouch is None or self.processor is None:
            raise InvalidInputError(
                f"`{what}` needs the joint space, but this pipeline has no `unitouch` and `processor`; build it with "
                "both, or pass embeddings."
            )
        return self.unitouch

    # Checks of a call, before any network runs ------------------------------------------------------------------------

    def _default(self, name: str, value: Any) -> Any:
        """What the call said, or else the checkpoint's default."""
        return self.config[f"default_{name}"] if value is None else value

    def _check_steps(
        self, count: Any, timesteps: Any, sigmas: Any, solver: Any, tolerance: Any, most: Any, eta: Any, part: Any = 1.0
    ) -> Steps:
        """The way from noise to latents, see `prepare_steps`; in the checkpoint's number of steps by default."""
        if timesteps is None and sigmas is None and tolerance is None:
            count = self._default("num_inference_steps", count)
        chosen = {"num_inference_steps": count, "timesteps": timesteps, "sigmas": sigmas, "tolerance": tolerance}
        options = {"solver": solver, "max_evaluations": most, "eta": eta, "init_strength": part}
        return prepare_steps(self.scheduler, device=self._execution_device, **chosen, **options)

    def _check_guidance(self, scale: float | None) -> Guidance:
        return Guidance(check_number("guidance_scale", self._default("guidance_scale", scale), 0.0, MAX_GAIN))

    def _check_shape(
        self, batch_size: int, height: int | None, width: int | None, generator: Generators, latents: Tensor | None
    ) -> tuple[int, int, int, int]:
        """(B n, C, h, w) of the latents; those that came, and a list of generators, have to fit it."""
        factor, trained = self.vae_scale_factor, self.unet.config.sample_size  # one side, or (height, width)
        trained = trained if isinstance(trained, list | tuple) else (trained, trained)
        sides = []
        for name, given, side in zip(("height", "width"), (height, width), trained, strict=True):
            pixels = check_integer(name, side * factor if given is None and side else given, factor, LONGEST_SIDE)
            if pixels % factor:
                raise InvalidInputError(f"`{name}` is {pixels}; it has to be a multiple of {factor}.")
            sides.append(pixels // factor)
        shape = (batch_size, self.unet.config.out_channels, *sides)
        if latents is not None:
            check_tensor("latents", latents, *shape)
        if isinstance(generator, list) and len(generator) != batch_size:
            raise InvalidInputError(
                f"`generator` is a list of {len(generator)} for {batch_size} pictures; pass one, or one for each."
            )
        for one in generator if isinstance(generator, list) else [generator] * (generator is not None):
            check_kind("generator", one, torch.Generator)
        return shape

    def _check_callback(self, callback: Any, inputs: Sequence[str], tolerance: float | None) -> Sequence[str]:
        """Names of the tensors that a callback gets; those of diffusers name theirs themselves."""
        if isinstance(callback, PipelineCallback | MultiPipelineCallbacks):
            if tolerance is not None:
                raise InvalidInputError("`callback_on_step_end` counts steps, but `tolerance` does not; leave one out.")
            inputs = callback.tensor_inputs
        if callback is not None and not callable(callback):
            raise InvalidTypeError(f"`callback_on_step_end` is {describe(callback)}; pass a function.")
        for name in check_kind("callback_on_step_end_tensor_inputs", inputs, list, tuple):
            check_choice("callback_on_step_end_tensor_inputs", name, self._callback_tensor_inputs)
        return inputs

    def _check_bridge(self, bridge: bool | None) -> bool:
        """Whether embeddings that are no images' are moved towards images'; by default where there is a bank."""
        if bridge is None:
            return self.embedding_bank is not None
        if check_kind("bridge", bridge, bool) and self.embedding_bank is None:
            raise InvalidInputError("`bridge` is True, but this pipeline has no `embedding_bank`; pass False.")
        return bridge

    # From inputs to conditions ----------------------------------------------------------------------------------------

    def _prepare_touch(self, touch: ImageInput, sensor: SensorNames, background: ImageInput) -> Touches:
        """Touches with their sensors, and what these see untouched where it came."""
        model = self._joint("touch")
        pixels = self.processor.touch(touch)
        if background is None:
            return Touches(pixels, model.match_sensors(pixels, sensor))
        behind = self.processor.images(background, name="background")
        if len(behind) not in (1, len(pixels)):
            raise InvalidInputError(
                f"`background` holds {len(behind)} images for {len(pixels)} touches; pass one, or one each."
            )
        behind = behind.expand_as(pixels)
        matches = model.match_sensors(behind, sensor, nearest=True)
        if matches[0].name is None:
            raise InvalidInputError("`background` came, but this model has no sensor prototypes; leave it out.")
        return Touches(pixels, matches, behind)

    def _touch_embeds(self, touches: Touches, report: RunReport, throw: bool = True) -> Tensor:
        """Embeddings (B, D) of touches; warns of those that are unlike any the model knows."""
        model, pixels, background = self.unitouch, touches.pixels, touches.background
        if background is not None:
            pixels = model.recentre(pixels, background, touches.matches)
        features = model.get_touch_features(pixels, model.sensor_ids(touches.matches))
        report.sensors = [match.name for match in touches.matches]
        report.sensor_distances = [match.distance for match in touches.matches]
        reasons = model.unknown_touches(pixels) or [None] * len(pixels)
        if background is not None:
            at_rest = is_untouched(denormalise_pixels(touches.pixels), denormalise_pixels(background)).tolist()
            reasons = [UNTOUCHED if rest else reason for rest, reason in zip(at_rest, reasons, strict=True)]
        if any(reasons):
            report.unknown["touch"] = reasons
            warn_of_unknown(reasons, stacklevel=6)  # two methods and `torch.no_grad` above this one
        return self._matched(features, "touch", throw)

    def _matched(self, features: Tensor, modality: str, throw: bool = True) -> Tensor:
        """Features (B, D) at the norm of the joint space's image embeddings, float32.

        Without `throw`, an embedding that is not finite becomes NaN, and its sample ends as NON_FINITE.
        """
        features = features.float()
        broken = ~torch.isfinite(features.norm(dim=1))
        if throw and bool(broken.any()):
            raise NonFiniteError(
                f"The embedding of {modality} {int(broken.nonzero()[0])} is not finite; run `unitouch` in float32."
            )
        return match_norm(features, self.unitouch.config.embedding_norm).masked_fill(broken[:, None], float("nan"))

    def _encode_pictures(self, name: str, pictures: ImageInput, settings: CallSettings) -> Tensor:
        """Scaled latents (B, C, h, w) of pictures, cut to the shape of those that are made."""
        height, width = (side * self.vae_scale_factor for side in settings.shape[-2:])
        pixels = torch.stack([centre_rectangle(picture, height, width) for picture in load_images(name, pictures)])
        return encode(self.vae, 2.0 * pixels - 1.0).float()

    # From conditions to pictures --------------------------------------------------------------------------------------

    def _denoise(
        self,
        settings: CallSettings,
        hidden: Tensor,
        labels: Tensor | None,
        report: RunReport,
        init: Tensor | None = None,
        shown: Tensor | None = None,
    ) -> Tensor:
        """Noise -> latents (B n, C, h, w) in float32.

        Args:
            hidden, labels: Hidden states and class labels; with guidance the unconditional half first.
            init: Scaled latents to start from (B n, C, h, w), in place of noise alone.
            shown: Further input channels of the network, (B n, C', h, w), the same in both halves.
        """
        device, dtype, batch_size = settings.device, self.unet.dtype, settings.shape[0]
        noise = settings.latents
        if noise is None:
            noise = randn_tensor(settings.shape, generator=settings.generator, device=device, dtype=dtype)
        hidden = hidden.to(device, dtype)
        if labels is not None:
            labels = labels.to(device, dtype if labels.is_floating_point() else None)

        def network(state: Tensor, timestep: Tensor) -> Tensor:
            rows = len(state)  # B n, or both halves
            if len(hidden) != 2 * batch_size and (rows > batch_size or len(hidden) not in (1, rows)):
                raise InvalidInputError(
                    f"`callback_on_step_end` left {len(hidden)} rows of `{self._hidden_name}` for {rows} states; for "
                    "guidance return both halves, and start with a `guidance_scale` above 1."
                )
            if shown is not None:
                state = torch.cat([state, shown.repeat(rows // batch_size, 1, 1, 1).to(state)], dim=1)
            return self.unet(
                state.to(dtype),
                timestep,
                encoder_hidden_states=hidden.expand(rows, -1, -1) if len(hidden) == 1 else hidden[-rows:],
                class_labels=None if labels is None else labels[-rows:],
                cross_attention_kwargs=settings.cross_attention_kwargs,
                return_dict=False,
            )[0]

        # A callback sees a copy of the pipeline, as other calls may run on this one.
        caller, total = copy.copy(self), settings.steps.count or 100
        caller._guidance_scale, caller._num_timesteps, caller._interrupt = settings.guidance.scale, total, False

        def on_step(step: int, timestep: Tensor, latents: Tensor, run: Run) -> Tensor:
            nonlocal hidden
            tensors = {"latents": latents, self._hidden_name: hidden}
            shared = {name: tensors[name] for name in settings.callback_inputs}
            changed = settings.callback(caller, step, timestep, shared) or {}  # type: ignore[misc]
            check_kind("callback_on_step_end: what it returned", changed, dict)
            name, width = f"callback_on_step_end: {self._hidden_name}", hidden.shape[-1]
            states = changed.get(self._hidden_name, hidden)
            hidden = check_tensor(name, states, "B", "T", width, finite=False).to(hidden)
            scale = check_number("callback_on_step_end: _guidance_scale", caller._guidance_scale, -MAX_GAIN, MAX_GAIN)
            run.guidance, run.interrupted = Guidance(scale), caller._interrupt
            return changed.get("latents", latents)

        with self.progress_bar(total=total) as bar:
            result = sample(
                network,
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
        self._guidance_scale, self._num_timesteps = caller._guidance_scale, total  # as diffusers leaves them
        if alone := report.evaluations - report.guided:
            where = f" in {alone} of {report.evaluations} evaluations" if report.guided else ""
            report.left_out.append(f"unconditional branch{where}")
        return result

    # Of a running call, in its callback, or of the last one.
    _guidance_scale: float
    _num_timesteps: int
    guidance_scale = property(lambda self: self._guidance_scale)
    do_classifier_free_guidance = property(lambda self: Guidance(self._guidance_scale).active)
    num_timesteps = property(lambda self: self._num_timesteps)
    interrupt = property(lambda self: self._interrupt)

    def _decode(self, latents: Tensor, report: RunReport, throw: bool) -> Tensor:
        """Latents (B, C, h, w) -> pixels (b, 3, H, W), about [-1, 1], of the samples that ended well."""
        rows = [row for row, code in enumerate(report.codes) if code.finite]
        if not rows:
            return latents.new_zeros(0, 3, *(self.vae_scale_factor * side for side in latents.shape[-2:]))
        pixels = decode(self.vae, latents[rows])
        finite = torch.isfinite(pixels.flatten(1)).all(dim=1)
        for row in torch.tensor(rows)[~finite.cpu()].tolist():
            if throw:
                raise NonFiniteError(f"Sample {row} is not finite after decoding; run the VAE in float32.")
            report.codes[row], report.failed_at[row] = ReturnCode.NON_FINITE, report.steps
        return pixels[finite]

    def _images(self, settings: CallSettings, latents: Tensor, report: RunReport) -> Any:
        """Latents (B, C, h, w) -> pictures of the output type, of the samples that ended well."""
        if settings.output_type == "latent":
            report.left_out.append("VAE decoder")
            return latents[[code.finite for code in report.codes]]
        pixels = self._decode(latents, report, settings.throw)
        return self.image_processor.postprocess(pixels, output_type=settings.output_type)

    # Reading and saving -----------------------------------------------------------------------------------------------

    @classmethod
    def from_pretrained(cls, pretrained_model_name_or_path: str | os.PathLike, **kwargs: Any) -> Self:  # type: ignore[override]
        """Reads a pipeline from a folder or repository, as `DiffusionPipeline.from_pretrained` does.

        Only safetensors are read unless `use_safetensors` says otherwise.

        Raises:
            InvalidInputError: If there is no such pipeline, or it cannot be read.
        """
        name, kwargs = "pretrained_model_name_or_path", {"use_safetensors": True, **kwargs}
        key = "torch_dtype" if "torch_dtype" in kwargs else "dtype"
        kwargs.setdefault(key, torch.float32)
        if not isinstance(kwargs[key], dict):  # of dtypes by component
            kwargs[key] = check_dtype(key, kwargs[key])
        folder = local_folder(name, pretrained_model_name_or_path, **kwargs)  # diffusers' fetch knows no parts of ours
        with reading(name, folder):
            pipe = super().from_pretrained(folder, **kwargs)
            for part in ("unet", "vae", "embedding_bank", "backgrounds"):
                if part not in kwargs:
                    check_filled(folder / part, getattr(pipe, part, None))
        pipe.register_to_config(_name_or_path=str(pretrained_model_name_or_path))
        pipe._card = folder if (folder / CARD).is_file() else None
        return pipe

    @classmethod
    def load_config(cls, *args: Any, **kwargs: Any) -> Any:
        """model_index.json as diffusers reads it, with our classes where it names the Python files beside it."""
        loaded = super().load_config(*args, **kwargs)
        config = loaded[0] if isinstance(loaded, tuple) else loaded
        config.update(located(config))
        return loaded

    def save_pretrained(
        self, save_directory: str | os.PathLike, *args: Any, card: Card | None = None, **kwargs: Any
    ) -> None:
        """Writes the pipeline, as `DiffusionPipeline.save_pretrained` does, whole or not at all; other files stay.

        Beside it come Python files of two lines, by which `DiffusionPipeline.from_pretrained(folder,
        trust_remote_code=True)` finds our classes, and a model card, README.md. Without a `card`, one that is there
        stays, or the one that the pipeline was loaded with is written.

        Raises:
            InvalidInputError: If the folder cannot be written to; what it held stays as it was.
        """
        if card is not None:
            check_kind("card", card, Card)
        folder = as_path("save_directory", save_directory)
        upload = kwargs.pop("push_to_hub", False)
        with writing_folder("save_directory", folder) as place:
            super().save_pretrained(place, *args, **kwargs)
            if type(self).__module__.startswith(__package__):
                name_classes(place)
            if card is not None or not (folder / CARD).exists():
                self._write_card(place, folder.resolve().name, card)
        if upload:
            self.push_to_hub(kwargs.pop("repo_id", folder.resolve().name), card=card, **kwargs)

    def _write_card(self, folder: Path, name: str, card: Card | None) -> None:
        """Writes a model card: the one passed, the pipeline's own, or a plain one that loads it by a name."""
        known = card or self._card or Card()
        if isinstance(known, Path):
            copy_card(known, folder)
        else:
            known.write(folder, name, self)

    def push_to_hub(self, repo_id: str, *, card: Card | None = None, **kwargs: Any) -> Any:  # type: ignore[override]
        """Uploads what `save_pretrained` writes, with the model card; `kwargs` as of diffusers' `push_to_hub`."""
        options = {name: kwargs.pop(name, None) for name in ("token", "commit_message", "create_pr")}
        private = kwargs.pop("private", None)
        repo_id = create_repo(repo_id, private=private, token=options["token"], exist_ok=True).repo_id
        with tempfile.TemporaryDirectory() as place:
            self.save_pretrained(place, **kwargs)
            self._write_card(Path(place), repo_id, card)
            return self._upload_folder(place, repo_id, **options)

    def load_lora_weights(self, pretrained_model_name_or_path_or_dict: Any, *args: Any, **kwargs: Any) -> None:
        """Loads LoRA weights of UNet and text encoder, as diffusers does; needs peft.

        Raises:
            InvalidInputError: If no such weights can be read there, or they do not fit.
        """
        name, place = "pretrained_model_name_or_path_or_dict", pretrained_model_name_or_path_or_dict
        with nullcontext() if isinstance(place, dict) else reading(name, place):
            super().load_lora_weights(place, *args, **{"use_safetensors": True, **kwargs})

    def load_sensor(self, file: str | os.PathLike) -> str:
        """Adds a sensor of one's own to the joint space; see `UniTouchModel.load_sensor`."""
        return self._joint("load_sensor").load_sensor(file)

    def unload_sensor(self, name: str) -> None:
        """Removes a sensor that `load_sensor` added."""
        self._joint("unload_sensor").unload_sensor(name)


def check_filled(folder: Path, network: Any) -> None:
    """Raises where a folder's files hold fewer numbers than the network: diffusers draws what is missing at random."""
    if not isinstance(network, torch.nn.Module) or not folder.is_dir():
        return
    sizes: dict[str, int] = {}
    for path in folder.glob("*.safetensors"):
        with safe_open(path, framework="pt") as file:
            for name in file.keys():  # noqa: SIM118 - not a dict
                sizes[name] = math.prod(file.get_slice(name).get_shape())
    held, wanted = sum(sizes.values()), sum([tensor.numel() for tensor in network.state_dict().values()])
    if held < wanted:
        raise InvalidInputError(
            f"`{folder}` holds {held} of the {wanted} numbers of {type(network).__name__}; it is cut off or of another "
            "network."
        )


def check_unused(instead: str, **given: Any) -> None:
    """Raises where arguments came that have no effect beside another one, such as `touch_embeds`."""
    for name, value in given.items():
        if value is not None:
            raise InvalidInputError(f"`{name}` has no effect beside `{instead}`; leave one of them out.")


def check_weights(name: str, weights: Sequence[Any]) -> list[float]:
    """Weights of a mix, >= 0, brought to a sum of 1."""
    numbers = [check_number(name, weight, 0.0, MAX_GAIN) for weight in weights]
    if sum(numbers) == 0:
        raise InvalidInputError(f"`{name}` sums to 0; at least one weight has to be above 0.")
    return [number / sum(numbers) for number in numbers]
