"""What the pipelines share: the plan of a request, the settings of a call, and the way from conditions to pictures."""

import copy
import inspect
import math
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from itertools import pairwise
from numbers import Real
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

import diffusers
import torch
from diffusers import DiffusionPipeline
from diffusers.callbacks import MultiPipelineCallbacks, PipelineCallback
from diffusers.image_processor import VaeImageProcessor
from diffusers.loaders import StableDiffusionLoraLoaderMixin
from diffusers.pipelines.pipeline_utils import StableDiffusionMixin
from diffusers.utils.torch_utils import randn_tensor
from huggingface_hub import create_repo
from torch import Tensor

from unitouch_gen.conditioning import EmbeddingBank, match_norm
from unitouch_gen.errors import (
    InvalidInputError,
    InvalidTypeError,
    NonFiniteError,
    check_arguments,
    check_choice,
    check_dense,
    check_dtype,
    check_flag,
    check_integer,
    check_kind,
    check_number,
    check_tensor,
    describe,
)
from unitouch_gen.files import (
    LOADING,
    READ_OPTIONS,
    check_variant,
    local_folder,
    open_weights,
    reading,
    saved_whole,
    written_for,
)
from unitouch_gen.models.autoencoders import decode, encode, scale_factor
from unitouch_gen.models.images import ImageInput, centre_rectangle, denormalise_pixels, load_images
from unitouch_gen.models.joint import MODALITIES
from unitouch_gen.models.out_of_distribution import UNTOUCHED, is_untouched
from unitouch_gen.models.sensors import SensorMatch
from unitouch_gen.pipelines.hub import CARD, Card, copy_card, located, name_classes
from unitouch_gen.sampling import (
    MAX_EVALUATIONS,
    MOST_STEPS,
    Guidance,
    ReturnCode,
    Run,
    RunReport,
    follows_the_flow,
    prepare_steps,
    sample,
    sample_to_tolerance,
    steps_made,
)
from unitouch_gen.schedulers.adaptive import ADAPTIVE
from unitouch_gen.schedulers.schedule import PREDICTION_TYPES, NoiseSchedule
from unitouch_gen.schedulers.solvers import make_scheduler, name_of

Generators = torch.Generator | list[torch.Generator] | None
SensorNames = str | Sequence[str | None] | None
StepEndCallback = Callable[[Any, int, Tensor, dict[str, Tensor]], dict[str, Tensor] | None]

MOST_IMAGES = 100_000
"""Pictures of one input, or candidates for it."""

LONGEST_SIDE = 16_384
"""Pixels; larger pictures are mistakes."""

OUTPUT_TYPES: tuple[str, ...] = ("pil", "np", "pt", "latent")

TIGHTEST = 1e-5
"""Tolerances below this are lost in the rounding of float32."""

MAX_GAIN = 1e6
"""The largest guidance and strength; beyond this, float32 cannot hold a guided prediction and its parts at once."""

# What a request needs -------------------------------------------------------------------------------------------------

COMPONENTS: dict[str, tuple[str, ...]] = {
    **{f"{modality} encoder": ("unitouch", "processor") for modality in MODALITIES},
    "prompt encoder": ("tokenizer", "text_encoder"),
    "bank of image embeddings": ("embedding_bank",),
    "VAE": ("vae",),
}
"""The components of a pipeline that hold a part, by the part's name in plans and run reports."""

UNCONDITIONAL = "unconditional branch"


@dataclass(frozen=True)
class Plan:
    """What a request needs of a pipeline, known from its arguments alone, before anything is loaded.

    Attributes:
        parts: Whether the request needs it, of each part that the pipeline has, by the names of run reports.
        pipeline: Class of the pipeline that made it.
    """

    parts: Mapping[str, bool]
    pipeline: str = ""

    @property
    def left_out(self) -> list[str]:
        """What the request does not need, in words."""
        return [part for part, needed in self.parts.items() if not needed]

    @property
    def modalities(self) -> tuple[str, ...]:
        """The modalities whose encoders of the joint space run."""
        return tuple(modality for modality in MODALITIES if self.parts.get(f"{modality} encoder"))

    @property
    def components(self) -> dict[str, bool]:
        """Whether the request needs it, of each component of the pipeline that a plan may leave out."""
        needed: dict[str, bool] = {}
        for part, names in COMPONENTS.items():
            if part in self.parts:
                needed |= {name: needed.get(name, False) or self.parts[part] for name in names}
        return needed

    def beyond(self, other: "Plan") -> list[str]:
        """The parts with weights that this plan needs and the other one left out."""
        return [part for part in other.left_out if part in COMPONENTS and self.parts.get(part)]


def guided(guidance_scale: Any) -> bool:
    """Whether a request has an unconditional branch: at a scale above 1, and as long as nothing says otherwise."""
    return not (isinstance(guidance_scale, Real) and guidance_scale <= 1.0)


# The settings of a call -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SamplingSettings:
    """What a call says about its samples, checked, with the checkpoint's defaults filled in.

    Attributes:
        scheduler: Fresh; with its timesteps set where they are fixed.
        solver: Its name, as reports call it.
        shape: Of the latents, (B n, C, h, w).
        repeats: n, samples for each input.
        device: Where the call runs.
        cross_attention_kwargs: For the UNet's attention processors, in every evaluation.
    """

    scheduler: Any  # a `SchedulerMixin`; its methods are those of each class
    solver: str
    shape: tuple[int, int, int, int]
    repeats: int
    device: torch.device
    guidance: Guidance
    tolerance: float | None
    max_evaluations: int
    eta: float
    generator: Generators
    latents: Tensor | None
    output_type: str
    callback: StepEndCallback | None
    callback_inputs: Sequence[str]
    cross_attention_kwargs: dict[str, Any] | None
    throw: bool


@dataclass(frozen=True, eq=False)
class Touches:
    """Touches that are ready to be encoded.

    Attributes:
        pixels: Pixel values, (B, 3, S, S).
        matches: Sensor of each.
        at_rest: Whether each hardly differs from the background that came with it; empty where none came.
    """

    pixels: Tensor
    matches: list[SensorMatch]
    at_rest: list[bool]


class UniTouchPipeline(DiffusionPipeline, StableDiffusionMixin, StableDiffusionLoraLoaderMixin):
    """A latent diffusion model conditioned on embeddings of the joint space.

    A pipeline that is one has the components `unitouch`, `processor`, `unet`, `scheduler` and `vae`, and calls
    `_prepare_images` at the end of its constructor. `_hidden_name` is what it calls the hidden states that its UNet
    attends to, `_embeds_name` the embeddings that a call may pass in place of touches, if it may.
    """

    _hidden_name = "prompt_embeds"
    _embeds_name: str | None = None
    _made_for: Plan | None = None
    _bank_folder: Path | None = None  # of a bank that a plan may have left out
    _low_memory = False
    text_encoder: Any = None  # of pipelines without one, whose LoRA weights are of the UNet alone
    _card: Card | Path | None = None  # or the folder that has one
    _example_call = ""  # as its model card shows it
    _readers: Mapping[str, Callable[[], torch.nn.Module]] = MappingProxyType({})  # of components that may be freed
    vae_scale_factor: int
    image_processor: VaeImageProcessor

    def register_modules(self, **parts: Any) -> None:
        """Keeps parts under their names; refuses what is none, of which diffusers says nothing or breaks down.

        Raises:
            InvalidTypeError: If one is neither `None` nor anything that can be saved as a part.
        """
        for name, part in parts.items():
            if part is not None and not hasattr(part, "save_pretrained"):
                raise InvalidTypeError(f"`{name}` is {describe(part)}; it has to be a part that diffusers can save.")
        super().register_modules(**parts)

    def _keep_defaults(self, **defaults: Any) -> None:
        """Keeps the defaults that the constructor was told; calls check those that they take."""
        for name, value in defaults.items():
            check_number(name, value)
        self.register_to_config(**defaults)

    def _prepare_images(self) -> None:
        """Makes what turns latents into pictures, of parts that every call needs."""
        for name, argument in inspect.signature(type(self)).parameters.items():
            if argument.default is argument.empty and getattr(self, name) is None:
                raise InvalidInputError(f"`{name}` is None; build the pipeline with one.")
        self.vae_scale_factor = scale_factor(self.vae)
        self.image_processor = VaeImageProcessor(vae_scale_factor=self.vae_scale_factor)

    def _check_embeddings(self, wanted: str) -> None:
        """Refuses a joint space or a bank whose embeddings are none of the width that is `wanted`, in words."""
        for name, found in (
            ("unitouch", self.unitouch and self.unitouch.config.projection_dim),
            ("embedding_bank", self.embedding_bank and self.embedding_bank.config.embedding_dim),
        ):
            if found is not None and found != self.embedding_dim:
                raise InvalidInputError(
                    f"`{name}` has embeddings of width {found}, but {wanted}; use parts of one width."
                )

    # Loading what a request needs -------------------------------------------------------------------------------------

    @classmethod
    def plan(cls, *args: Any, **request: Any) -> Plan:
        """What a call with these arguments needs, before anything is loaded.

        Args:
            args, request: As of `__call__`. A `guidance_scale` that does not come counts as one above 1.

        Returns:
            A plan, to be looked at, and for `from_pretrained(..., plan=...)` or `unitouch_gen.tiny(..., plan=...)`.

        Raises:
            InvalidInputError: If there is no such argument, or nothing to start from came.

        Example:
            >>> from unitouch_gen import XToTouchPipeline
            >>> XToTouchPipeline.plan(text="rough brick", output_type="latent").left_out[-1]
            'VAE'
        """
        try:
            bound = inspect.signature(cls.__call__).bind(None, *args, **request)
        except TypeError as error:
            raise InvalidInputError(f"{error}; `plan` takes the arguments of a call of {cls.__name__}.") from error
        bound.apply_defaults()
        check_choice("output_type", bound.arguments["output_type"], OUTPUT_TYPES)
        return replace(cls._plan(bound.arguments), pipeline=cls._planner())

    @classmethod
    def _plan(cls, request: Mapping[str, Any]) -> Plan:
        """The plan of a call's arguments; those that cannot be used are for the call to refuse."""
        raise NotImplementedError

    @classmethod
    def _planner(cls) -> str:
        """The class whose plans are this one's."""
        return next(kind.__name__ for kind in cls.__mro__ if "_plan" in vars(kind))

    @classmethod
    def check_plan(cls, plan: Any) -> None:
        """Refuses what is neither a plan of this pipeline nor `None`.

        Raises:
            InvalidTypeError: If it is no plan.
            InvalidInputError: If it is another pipeline's, which says nothing of the parts of this one.
        """
        hint = f"Make it by `{cls.__name__}.plan(...)`, of the arguments of a call."
        if plan is not None and check_kind("plan", plan, Plan, hint=hint).pipeline != cls._planner():
            raise InvalidInputError(f"`plan` is one of {plan.pipeline}, and this is {cls.__name__}. {hint}")

    @classmethod
    def from_pretrained(  # type: ignore[override]
        cls, pretrained_model_name_or_path: str | os.PathLike, *, plan: Plan | None = None, **kwargs: Any
    ) -> Self:
        """Reads a pipeline, as `DiffusionPipeline.from_pretrained` does.

        Args:
            pretrained_model_name_or_path: A folder, or a repository id.
            plan: Read no more than it needs; calls that need more are refused.
            kwargs: As of `DiffusionPipeline.from_pretrained`; of weights, safetensors alone are read unless
                `use_safetensors` says otherwise.

        Raises:
            InvalidInputError, InvalidTypeError: If there is no such pipeline, or it cannot be read, the plan is another
                pipeline's, or there is no such argument.
        """
        required, optional = cls._get_signature_keys(cls)
        check_arguments("from_pretrained", kwargs, {*READ_OPTIONS, *required, *optional})
        for key in {"dtype", "torch_dtype"}.intersection(kwargs):  # of all parts, or by their names
            kwargs[key] = kwargs[key] if isinstance(kwargs[key], dict | None) else check_dtype(key, kwargs[key])
        kwargs = {"use_safetensors": True, **kwargs}  # without it, diffusers reads pickles where there is nothing else
        if "torch_dtype" not in kwargs:
            kwargs.setdefault("dtype", torch.float32)  # transformers would take the one of whichever save was the last
        cls.check_plan(plan)
        check_variant(kwargs.get("variant"))
        name, place, absent = "pretrained_model_name_or_path", pretrained_model_name_or_path, dict[str, Any]()
        place = local_folder(name, place, **kwargs)  # diffusers' own fetch knows no parts of ours
        if plan is not None:
            absent = dict.fromkeys(part for part, needed in plan.components.items() if not needed)
        with reading(name, place):
            if "vae" in absent:
                kind = getattr(diffusers, cls.load_config(place)["vae"][1])
                absent["vae"] = outline(kind, kind.load_config(place, subfolder="vae"))
            pipe = super().from_pretrained(place, **{**absent, **kwargs})
            for part in {"unet", "vae", "embedding_bank", "backgrounds"}.difference(absent, kwargs):
                check_filled(place / part, getattr(pipe, part, None))
        pipe.register_to_config(_name_or_path=str(pretrained_model_name_or_path))
        if (place / CARD).is_file():
            pipe._card = place
        if plan is not None:
            pipe._keep_to(plan, place / "embedding_bank")
        return pipe

    @classmethod
    def load_config(cls, *args: Any, **kwargs: Any) -> Any:
        """What model_index.json holds, as of diffusers, with classes of ours where they are: no file of code is run."""
        loaded = super().load_config(*args, **kwargs)
        config = loaded[0] if isinstance(loaded, tuple) else loaded
        config.update(located(config))
        return loaded

    @saved_whole
    def save_pretrained(
        self, save_directory: str | os.PathLike, *args: Any, card: Card | None = None, **kwargs: Any
    ) -> None:
        """Writes the pipeline, as `DiffusionPipeline.save_pretrained` does, whole or not at all.

        With it come Python files of two lines, by which `DiffusionPipeline.from_pretrained(folder,
        trust_remote_code=True)` finds the classes, and a model card, README.md: `card`, or what came with the pipeline,
        or one that says what is known. A README.md that is there stays unless a card is passed.

        Other files in the folder stay. Where the process is killed, the folder holds the old pipeline or the new one.
        In the moment that it takes to rename the new files, it holds one that diffusers' own classes refuse to load;
        the next pipeline of ours that is loaded from there, or saved to there, makes it the new one first.

        Args:
            save_directory: The folder.
            args, kwargs: As of `DiffusionPipeline.save_pretrained`.
            card: What the model card says.

        Raises:
            InvalidInputError, InvalidTypeError: If a plan has left out a part of this pipeline, or the folder cannot be
                written to; what it held stays as it was. Or if `card` is none.
        """
        folder, target = Path(save_directory), written_for(Path(save_directory))
        if card is not None:
            check_kind("card", card, Card)
        if self._made_for is not None and not all(self._made_for.components.values()):
            raise InvalidInputError(
                "`save_pretrained` would save no more than a part of this pipeline; load it without a `plan` for that."
            )
        for name in self._readers:
            self._component(name)
        super().save_pretrained(save_directory, *args, **kwargs)
        if type(self).__module__.startswith(__package__):
            name_classes(folder)
        if card is not None or not (target / CARD).exists():
            self._write_card(folder, target.name, card)

    def _write_card(self, folder: Path, name: str, card: Card | None = None) -> None:
        """Writes a model card, whose example loads the pipeline by a name: the one passed, its own, or a plain one."""
        known = card or self._card
        if isinstance(known, Path) and (known / CARD).is_file():
            copy_card(known, folder)
        else:
            (known if isinstance(known, Card) else Card()).write(folder, name, self)

    def push_to_hub(  # type: ignore[override]
        self,
        repo_id: str,
        commit_message: str | None = None,
        private: bool | None = None,
        token: str | None = None,
        create_pr: bool = False,
        safe_serialization: bool = True,
        variant: str | None = None,
        card: Card | None = None,
    ) -> Any:
        """Uploads what `save_pretrained` writes, the model card with it.

        Args:
            repo_id: Of the repository, which is made if there is none.
            commit_message, private, token, create_pr: As of diffusers' `push_to_hub`.
            safe_serialization, variant, card: As of `save_pretrained`.

        Returns:
            What huggingface_hub says of the commit.
        """
        repo_id = create_repo(repo_id, private=private, token=token, exist_ok=True).repo_id
        with tempfile.TemporaryDirectory() as place:
            self.save_pretrained(place, safe_serialization=safe_serialization, variant=variant)
            self._write_card(Path(place), repo_id, card)
            return self._upload_folder(place, repo_id, token, commit_message, create_pr)

    def load_lora_weights(  # type: ignore[override]
        self, pretrained_model_name_or_path_or_dict: str | os.PathLike | dict[str, Tensor], *args: Any, **kwargs: Any
    ) -> None:
        """Loads LoRA weights of the UNet and the text encoder, as diffusers' pipelines do; needs peft.

        `set_adapters`, `fuse_lora`, `unload_lora_weights` and the like are diffusers' own.

        Args:
            pretrained_model_name_or_path_or_dict: A folder, a file, a repository id, or the tensors.
            args, kwargs: As of diffusers; safetensors alone are read unless `use_safetensors` says otherwise.

        Raises:
            InvalidInputError: If no such weights can be read there, or they do not fit.
        """
        name, place = "pretrained_model_name_or_path_or_dict", pretrained_model_name_or_path_or_dict
        with nullcontext() if isinstance(place, dict) else reading(name, place):
            super().load_lora_weights(place, *args, **{"use_safetensors": True, **kwargs})

    @classmethod
    def load_lora_into_text_encoder(
        cls, state_dict: dict[str, Any], network_alphas: Any, text_encoder: Any, *args: Any, **kwargs: Any
    ) -> None:
        """As diffusers', where the pipeline has a text encoder.

        Raises:
            InvalidInputError: If it has none and the weights have layers of one.
        """
        if text_encoder is not None:
            super().load_lora_into_text_encoder(state_dict, network_alphas, text_encoder, *args, **kwargs)
        elif any(key.startswith(f"{cls.text_encoder_name}.") for key in state_dict):
            raise InvalidInputError("they are of a text encoder, too, and this pipeline has none.")

    def load_sensor(self, file: str | os.PathLike) -> str:
        """Adds a sensor to the joint space; see `UniTouchModel.load_sensor`.

        Raises:
            InvalidInputError: If the file holds no sensor of this model, or this pipeline has no `unitouch`.
        """
        if self.unitouch is None:
            raise InvalidInputError("`load_sensor` needs the touch encoder, and this pipeline has no `unitouch`.")
        return self.unitouch.load_sensor(file)

    def unload_sensor(self, name: str) -> None:
        """Removes a sensor that `load_sensor` added; see `UniTouchModel.unload_sensor`.

        Raises:
            InvalidInputError: If no sensor of that name was added, or this pipeline has no `unitouch`.
        """
        if self.unitouch is None:
            raise InvalidInputError("`unload_sensor` needs the touch encoder, and this pipeline has no `unitouch`.")
        self.unitouch.unload_sensor(name)

    def _keep_to(
        self,
        plan: Plan | None,
        bank: Path | None = None,
        low_memory: bool = False,
        readers: Mapping[str, Callable[[], torch.nn.Module]] = MappingProxyType({}),
    ) -> None:
        """Makes this a pipeline for requests that need no more than a plan, if there is one.

        Args:
            plan: The plan.
            bank: Folder of the bank of image embeddings, which need not be there.
            low_memory: Whether to free encoders that have done their work.
            readers: What reads them again, of components beside the joint space.
        """
        self._made_for, self._bank_folder, self._low_memory = plan, bank, low_memory
        self._readers = dict(readers) if low_memory else {}
        if plan is not None and not plan.parts["VAE"]:
            self.vae = None  # until here its outline said how many pixels a latent has

    def _begin(self, request: Mapping[str, Any]) -> Plan:
        """The plan of the call that starts here, which this pipeline has the parts for."""
        scale = request["guidance_scale"]
        check_choice("output_type", request["output_type"], OUTPUT_TYPES)
        bridge = self._banked if request["bridge"] is None else check_flag("bridge", request["bridge"])
        plan = self._plan({**request, "guidance_scale": self._default("guidance_scale", scale), "bridge": bridge})
        beyond = [] if self._made_for is None else plan.beyond(self._made_for)
        if beyond:
            raise InvalidInputError(
                f"This call needs the {' and the '.join(beyond)}, which the `plan` of this pipeline left out; load it "
                f"with `plan={type(self).__name__}.plan(...)` of the arguments of this call, or without a plan."
            )
        if plan.parts["VAE"] and self.vae is None:
            raise InvalidInputError('This call needs a `vae`, and this pipeline has none; pass `output_type="latent"`.')
        for name, needed in plan.components.items():
            if needed:
                self._component(name)
        return plan

    def _component(self, name: str) -> Any:
        """A component, read again if it was freed; a call holds on to it, as others may free it."""
        found = getattr(self, name)
        if found is not None or name not in self._readers:
            return found
        with LOADING:
            if getattr(self, name) is None:
                self.register_modules(**{name: self._readers[name]().to(self._execution_device)})
            return getattr(self, name)

    def _free(self, *parts: str) -> None:
        """Frees encoders that have done their work, where memory is low and they can be read again.

        Args:
            parts: Modalities of the joint space, or names of components.
        """
        if not (parts and self._low_memory):
            return
        for part in parts:
            if part in self._readers:
                with LOADING:
                    self.register_modules(**{part: None})

    # Checking a call, before any network runs -------------------------------------------------------------------------

    @property
    def _banked(self) -> bool:
        """Whether the checkpoint has a bank of image embeddings, be it one that the plan left out."""
        left_out = self._bank_folder if self._made_for is not None else None
        return self.embedding_bank is not None or (left_out is not None and left_out.is_dir())

    def read_bank(self) -> EmbeddingBank | None:
        """The checkpoint's bank of image embeddings, from its folder where the plan left it out."""
        if self.embedding_bank is None and self._banked:
            return EmbeddingBank.from_pretrained(self._bank_folder)
        return self.embedding_bank

    def _check_bridge(self, bridge: bool | None) -> bool:
        """Whether embeddings that are no pictures' are moved towards those of pictures; they are if there is a bank."""
        bridged = self._banked if bridge is None else check_flag("bridge", bridge)
        if bridged and self.embedding_bank is None:
            why = "which this pipeline has not" if self._made_for is None else "which its `plan` left out"
            raise InvalidInputError(f"`bridge` is {bridge} and needs the `embedding_bank`, {why}; pass False.")
        return bridged

    def _default(self, name: str, value: Any) -> Any:
        """What the call said, or else the checkpoint's default."""
        return self.config[f"default_{name}"] if value is None else value

    def _side(self, name: str, value: Any) -> int:
        """`height` or `width` as the call said, or else as the UNet was trained, pixels."""
        multiple = self.vae_scale_factor
        if value is None:
            size = self.unet.config.sample_size  # of latents: one side or (height, width)
            side = size[("height", "width").index(name)] if isinstance(size, list | tuple) else size
            if side is None:
                raise InvalidInputError(f"`{name}` has to be passed: this pipeline's UNet does not say its own size.")
            return check_integer("sample_size", side, 1, hint="It is the UNet's.") * multiple
        check_integer(name, value, multiple, LONGEST_SIDE, hint=f"It has to be a multiple of {multiple}.")
        if value % multiple:
            lower = value // multiple * multiple
            raise InvalidInputError(
                f"`{name}` is {value}; it has to be a multiple of {multiple}, such as {lower} or {lower + multiple}."
            )
        return value

    def _check_sampling(self, request: Mapping[str, Any], batch_size: int, repeats: int) -> SamplingSettings:
        """The settings of a call: defaults filled in, and everything that cannot work refused; no network runs.

        Args:
            request: The arguments of the call, by name.
            batch_size: B, number of inputs.
            repeats: n, samples for each input.
        """
        device = self._execution_device  # the pipeline looks it up in all of its modules, so once a call is enough
        solver, eta, callback = (request[name] for name in ("solver", "eta", "callback_on_step_end"))
        tolerance, max_evaluations = _check_tolerance(request)
        scale = self._default("guidance_scale", request["guidance_scale"])
        chosen = _check_chosen_steps(request, self.scheduler.config.num_train_timesteps - 1)
        steps = self._default("num_inference_steps", request["num_inference_steps"])
        steps = check_integer("num_inference_steps", steps, 1, self.scheduler.config.num_train_timesteps)
        scale = check_number("guidance_scale", scale, 0.0, MAX_GAIN, hint="Guidance is on above 1.")
        interval = check_interval(
            "guidance_interval", request["guidance_interval"], self.scheduler.config.num_train_timesteps - 1
        )
        scheduler = make_scheduler(self.scheduler, solver)
        if tolerance is not None and isinstance(callback, PipelineCallback | MultiPipelineCallbacks):
            raise InvalidInputError(
                f"`callback_on_step_end` is {type(callback).__name__}, which counts steps, but `tolerance` came, which "
                "chooses them as it goes; pass `num_inference_steps` in its place, or a function that looks at its "
                "`timestep`."
            )
        settings = self.scheduler.config
        if tolerance is not None and not (
            hasattr(self.scheduler, "alphas_cumprod") and settings.get("prediction_type") in PREDICTION_TYPES
        ):
            raise InvalidInputError(
                f"`tolerance` came, but {type(self.scheduler).__name__} has no noise levels to choose from; leave it "
                "out."
            )
        height, width = self._side("height", request["height"]), self._side("width", request["width"])
        eta = check_number("eta", eta, 0.0, 1.0)
        for name in ("throw", "return_dict"):
            check_flag(name, request[name])
        inputs = _check_callback(callback, request["callback_on_step_end_tensor_inputs"], self._callback_tensor_inputs)
        attention = _check_cross_attention_kwargs(request["cross_attention_kwargs"])
        if tolerance is not None or follows_the_flow(scheduler, eta):
            NoiseSchedule.of(scheduler)  # refuses noise levels that do not rise
        sides = (height // self.vae_scale_factor, width // self.vae_scale_factor)
        shape = (batch_size * repeats, self.unet.config.out_channels, *sides)
        guidance = Guidance(scale, interval)
        check_generators(request["generator"], shape[0])
        if request["latents"] is not None:
            check_tensor("latents", request["latents"], *shape)
        if tolerance is None:
            if chosen:  # a spacing would choose others
                spaced = {f"use_{name}_sigmas": False for name in ("karras", "exponential", "beta")}
                known = {name: value for name, value in spaced.items() if name in scheduler.config}
                scheduler = type(scheduler).from_config(scheduler.config, **known)
            prepare_steps(scheduler, steps, device, **chosen)
            name = solver or name_of(scheduler) or type(scheduler).__name__  # a pipeline's own, if none of ours
        else:
            name = ADAPTIVE
        return SamplingSettings(
            scheduler=scheduler,
            solver=name,
            shape=shape,
            repeats=repeats,
            device=device,
            guidance=guidance,
            tolerance=tolerance,
            max_evaluations=max_evaluations,
            eta=eta,
            generator=request["generator"],
            latents=request["latents"],
            output_type=request["output_type"],
            callback=callback,
            callback_inputs=inputs,
            cross_attention_kwargs=attention,
            throw=request["throw"],
        )

    def _prepare_touch(self, touch: ImageInput, sensor: SensorNames, background: ImageInput) -> Touches:
        """Touches with their sensors; no network runs."""
        if self.unitouch is None or self.processor is None:
            instead = f", or pass `{self._embeds_name}` instead" if self._embeds_name else ""
            raise InvalidInputError(
                f"`touch` came, but this pipeline has no `unitouch` and `processor`; build it with both{instead}."
            )
        pixels = self.processor.touch(touch)
        if background is None:
            matches = self.unitouch.match_sensors(pixels, sensor)
            return Touches(pixels, matches, [])
        behind = self.processor.images(background, name="background")
        if len(behind) not in (1, len(pixels)):
            raise InvalidInputError(
                f"`background` holds {len(behind)} images for {len(pixels)} touches; pass one, or one each."
            )
        behind = behind.expand_as(pixels)
        matches = self.unitouch.match_sensors(behind, sensor, nearest=True)
        if matches[0].name is None:
            raise InvalidInputError(
                "`background` came, but this model has no sensor prototypes to re-centre on; leave it out."
            )
        at_rest = is_untouched(denormalise_pixels(pixels), denormalise_pixels(behind)).tolist()
        return Touches(self.unitouch.recentre(pixels, behind, matches), matches, at_rest)

    def _encode_pictures(self, name: str, pictures: ImageInput, settings: SamplingSettings) -> Tensor:
        """Scaled latents (B, C, h, w) of pictures, cut to the shape of those that are made.

        Args:
            name: The argument that they came as.
            pictures: Paths, PIL images, arrays or tensors.
            settings: What was asked for.
        """
        height, width = (side * self.vae_scale_factor for side in settings.shape[-2:])
        pixels = torch.stack([centre_rectangle(picture, height, width) for picture in load_images(name, pictures)])
        return encode(self.vae, 2.0 * pixels.to(settings.device) - 1.0).float()

    # From conditions to pictures --------------------------------------------------------------------------------------

    def _features(self, modality: str, unknown: dict[str, list[str | None]], **inputs: Any) -> Tensor:
        """Features (B, D) as the encoder gives them; `unknown` is told why the model abstains from naming them."""
        features = getattr(self.unitouch, f"get_{modality}_features")(**inputs)
        if modality == "touch" and (reasons := self.unitouch.unknown_touches(inputs["pixel_values"])):
            unknown["touch"] = reasons
        return features

    def _touch_features(self, touches: Touches, unknown: dict[str, list[str | None]]) -> Tensor:
        """See `_features`; touches that hardly differ from their backgrounds are none."""
        ids = self.unitouch.sensor_ids(touches.matches)
        features = self._features("touch", unknown, pixel_values=touches.pixels, sensor_ids=ids)
        if any(touches.at_rest):
            reasons = unknown.get("touch", [None] * len(features))
            unknown["touch"] = [UNTOUCHED if rest else it for rest, it in zip(touches.at_rest, reasons, strict=True)]
        return features

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

    def _towards_pictures(self, embeds: Tensor, bridge: bool) -> Tensor:
        """Embeddings (B, D) moved towards those of pictures, as the bank does it, if at all."""
        if not bridge:
            return embeds
        broken = ~torch.isfinite(embeds).all(dim=1, keepdim=True)
        moved = self.embedding_bank.bridge(embeds.masked_fill(broken, 0.0))
        return moved.masked_fill(broken, float("nan"))

    @staticmethod
    def _report(settings: SamplingSettings, plan: Plan, matches: Sequence[SensorMatch] = ()) -> RunReport:
        """A fresh report of a call."""
        return RunReport(
            solver=settings.solver,
            tolerance=settings.tolerance,
            guidance_scale=settings.guidance.scale,
            left_out=plan.left_out,
            sensors=[match.name for match in matches],
            sensor_distances=[match.distance for match in matches],
        )

    # What diffusers' pipelines show of the call that ended last, and of the running one to its callback.

    @property
    def guidance_scale(self) -> float:
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
        settings: SamplingSettings,
        hidden: Tensor,
        labels: Tensor | None,
        report: RunReport,
        init: Tensor | None = None,
        init_strength: float = 1.0,
        beside: Tensor | None = None,
    ) -> Tensor:
        """Noise -> latents (B n, C, h, w) in float32.

        Args:
            settings: What was asked for; its noise is drawn here if none came.
            hidden, labels: Of the conditional branch, and before it of the unconditional one where guidance is on.
            report: Gets evaluations and return codes.
            init, init_strength: Latents to start from in place of noise alone, and how much of them to replace.
            beside: What the network is shown as further channels, (B n, C', h, w), the same in both branches.
        """
        device, dtype, batch_size = settings.device, self.unet.dtype, settings.shape[0]
        noise = settings.latents
        if noise is None:
            noise = randn_tensor(settings.shape, generator=settings.generator, device=device, dtype=dtype)
        hidden = hidden.to(device, dtype)
        if labels is not None:
            labels = labels.to(device, dtype if labels.is_floating_point() else None)

        passed = settings.cross_attention_kwargs
        given = {} if passed is None else {"cross_attention_kwargs": passed}

        def denoise(state: Tensor, timestep: Tensor) -> Tensor:
            guidance = replace(settings.guidance, scale=caller._guidance_scale)
            if guidance.active and len(hidden) != 2 * batch_size:
                raise InvalidInputError(
                    f"`callback_on_step_end` set `_guidance_scale` to {caller._guidance_scale:g}, but there is no "
                    "unconditional branch; start with a `guidance_scale` above 1, and keep both halves of "
                    f"`{self._hidden_name}`."
                )
            rows = len(state)  # as many as there are samples, or twice that
            conditions: dict[str, Any] = {
                "encoder_hidden_states": hidden.expand(rows, -1, -1) if len(hidden) == 1 else hidden[-rows:],
                "class_labels": None if labels is None else labels[-rows:],
            }
            conditions |= given
            if beside is not None:
                state = torch.cat([state, beside.repeat(rows // len(beside), 1, 1, 1).to(state)], dim=1)
            return self.unet(state.to(dtype), timestep, **conditions, return_dict=False)[0]

        def on_step(run: Run, evaluation: int, timestep: Tensor) -> None:
            nonlocal hidden
            assert settings.callback is not None
            tensors = {"latents": run.latents, self._hidden_name: hidden}
            given = {name: tensors[name] for name in settings.callback_inputs}
            changed = _check_changed(settings.callback(caller, evaluation, timestep, given), tensors)
            run.latents = changed.get("latents", run.latents)
            hidden = changed.get(self._hidden_name, hidden).to(hidden)
            if len(hidden) not in (1, batch_size, 2 * batch_size):
                raise InvalidInputError(
                    f"`callback_on_step_end` returned `{self._hidden_name}` that are {describe(hidden)}, for "
                    f"{batch_size} pictures; return one for each, one for all, or both halves."
                )
            scale = check_number("callback_on_step_end: _guidance_scale", caller._guidance_scale, -MAX_GAIN, MAX_GAIN)
            run.guidance = replace(run.guidance, scale=scale)
            run.interrupted = caller._interrupt

        planned, solver = 100, settings.scheduler  # percent of the way to a tolerance, or evaluations
        if settings.tolerance is None:
            steps = int(solver.num_inference_steps)
            skipped = 0 if init is None else steps - steps_made(steps, init_strength)
            planned = len(solver.timesteps) - skipped * solver.order
        # What a callback sets is the call's own: other calls may run on the same pipeline.
        caller = copy.copy(self)
        caller._guidance_scale, caller._num_timesteps, caller._interrupt = settings.guidance.scale, planned, False
        try:
            with self.progress_bar(total=planned) as bar:
                options: dict[str, Any] = {
                    "guidance": settings.guidance,
                    "throw": settings.throw,
                    "on_step": None if settings.callback is None else on_step,
                    "progress": lambda share: bar.update(int(share * planned + 1e-6) - bar.n),
                    "init": init,
                    "init_strength": init_strength,
                }
                if settings.tolerance is None:
                    drawn: dict[str, Any] = {"generator": settings.generator, "eta": settings.eta}
                    latents = sample(denoise, noise.to(device), solver, report, **drawn, **options)
                else:
                    latents = sample_to_tolerance(
                        denoise,
                        noise.to(device),
                        NoiseSchedule.of(solver),
                        solver.config.prediction_type,
                        settings.tolerance,
                        report,
                        max_evaluations=settings.max_evaluations,
                        discontinuities=(settings.guidance.interval or ()) if settings.guidance.active else (),
                        **options,
                    )
        finally:
            for name in ("_guidance_scale", "_num_timesteps", "_interrupt"):
                setattr(self, name, getattr(caller, name))
        alone = report.evaluations - report.guided
        if settings.guidance.active and alone:
            report.left_out.append(f"{UNCONDITIONAL} in {alone} of {report.evaluations} evaluations")
        return latents

    def _decode(self, latents: Tensor, report: RunReport, throw: bool) -> Tensor:
        """Latents (B, C, h, w) -> pixels (b, 3, H, W), about [-1, 1], of the samples that ended well."""
        rows = [row for row, code in enumerate(report.codes) if code.finite]
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

    def _images(self, settings: SamplingSettings, latents: Tensor, report: RunReport) -> Any:
        """Latents (B, C, h, w) -> pictures, of the output type, of the samples that ended well."""
        if settings.output_type == "latent":
            return latents[[code.finite for code in report.codes]]
        pixels = self._decode(latents, report, settings.throw)
        return self.image_processor.postprocess(pixels, output_type=settings.output_type)


def outline(kind: Any, config: Mapping[str, Any]) -> Any:
    """A network that takes no memory: all there is to it is its shape."""
    with torch.device("meta"):
        return kind.from_config(config)


def check_filled(folder: Path, network: Any) -> None:
    """Refuses a network that its files do not fill: what they lack, diffusers draws at random.

    Numbers are counted, as it knows other names of some tensors. Where no files are here, there is nothing to count.

    Raises:
        InvalidInputError: If there are fewer in the files.
    """
    if isinstance(network, torch.nn.Module) and folder.is_dir():
        wanted = sum(tensor.numel() for tensor in network.state_dict().values())
        counts: dict[str, int] = {}  # a variant holds the same ones
        for path in folder.glob("*.safetensors"):
            with open_weights(path) as file:
                names = file.keys()
                counts |= {name: math.prod(file.get_slice(name).get_shape()) for name in names}
        held = sum(counts.values())
        if held < wanted:
            raise InvalidInputError(
                f"`{folder}` holds {held} numbers of the {wanted} of its {type(network).__name__}; it is cut off or of "
                "another network."
            )


# Checks of arguments that several pipelines take ----------------------------------------------------------------------


def _check_tolerance(request: Mapping[str, Any]) -> tuple[float | None, int]:
    """A tolerance that can be reached, if one came, and the evaluations it may take; nothing else fixes the steps."""
    tolerance, max_evaluations = request["tolerance"], request["max_evaluations"]
    if tolerance is None:
        if max_evaluations is not None:
            raise InvalidInputError(
                f"`max_evaluations` is {describe(max_evaluations)}, but no `tolerance` came, without which it has no "
                "effect; leave it out."
            )
        return None, MAX_EVALUATIONS
    hint = "It is a relative error of the latents in float32."
    tolerance = check_number("tolerance", tolerance, TIGHTEST, 1.0, hint=hint)
    most = MAX_EVALUATIONS if max_evaluations is None else check_integer("max_evaluations", max_evaluations, 2)
    fixed = {name: request[name] for name in ("solver", "num_inference_steps")}
    for name, value in {**fixed, "eta": request["eta"] or None}.items():
        if value is not None:
            raise InvalidInputError(
                f"`{name}` is {describe(value)}, but `tolerance` came, which chooses solver and steps; leave one out."
            )
    return tolerance, most


def _check_chosen_steps(request: Mapping[str, Any], last: int) -> dict[str, list[float]]:
    """The timesteps, or noise levels, that came in place of a number of steps, by their name; nothing if none came."""
    given = {name: request[name] for name in ("timesteps", "sigmas") if request[name] is not None}
    for name, values in given.items():
        for other in ("timesteps", "num_inference_steps", "tolerance"):
            if other != name and request[other] is not None:
                raise InvalidInputError(
                    f"`{other}` is {describe(request[other])}, but `{name}` came, which says what steps are made; "
                    "leave one out."
                )
        if isinstance(values, Tensor):
            check_dense(name, values)
        if hasattr(values, "tolist") and len(values.shape) == 1 and len(values) <= MOST_STEPS + 1:
            values = values.tolist()
        if not isinstance(values, list | tuple) or not 0 < len(values) <= MOST_STEPS + 1:
            raise InvalidTypeError(
                f"`{name}` is {describe(request[name])}; it has to be a list of falling numbers, such as "
                f"{[999, 500, 1] if name == 'timesteps' else [14.6, 1.0, 0.0]}."
            )
        numbers = [
            check_integer(f"{name}[{place}]", value, 0, last)
            if name == "timesteps"
            else check_number(f"{name}[{place}]", value, 0.0)
            for place, value in enumerate(values)
        ]
        if any(after >= before for before, after in pairwise(numbers)):
            raise InvalidInputError(f"`{name}` is {describe(numbers)}; each has to be below the one before.")
        if name == "sigmas" and (numbers[-1] != 0.0 or len(numbers) < 2):
            raise InvalidInputError(f"`sigmas` is {describe(numbers)}; it has to end in 0, where the picture is.")
        given[name] = numbers
    return given


def _check_callback(callback: Any, inputs: Any, known: Sequence[str]) -> Sequence[str]:
    """The tensors that a callback gets."""
    if isinstance(callback, PipelineCallback | MultiPipelineCallbacks):
        inputs = callback.tensor_inputs
    if callback is not None and not callable(callback):
        raise InvalidTypeError(f"`callback_on_step_end` is {describe(callback)}; it has to be a function.")
    if not isinstance(inputs, list | tuple):
        raise InvalidTypeError(
            f"`callback_on_step_end_tensor_inputs` is {describe(inputs)}; it has to be a list of names."
        )
    for name in inputs:
        check_choice("callback_on_step_end_tensor_inputs", name, known)
    return inputs


TAKEN = ("attention_mask", "encoder_hidden_states", "hidden_states")
"""Arguments of attention layers that the UNet fills in."""


def _check_cross_attention_kwargs(given: Any) -> dict[str, Any] | None:
    """A copy of what came for the attention processors of the UNet, if it did."""
    if given is None:
        return None
    for key in check_kind("cross_attention_kwargs", given, dict, hint='Pass {"scale": 0.5}, for example.'):
        if not isinstance(key, str):
            raise InvalidTypeError(
                f"`cross_attention_kwargs` has the key {describe(key)}; keys have to be names, such as 'scale'."
            )
        if key in TAKEN:
            raise InvalidInputError(
                f"`cross_attention_kwargs` has the key {key!r}, which the pipeline fills in itself; leave it out."
            )
    checked, name = dict(given), "cross_attention_kwargs['scale']"
    if "scale" in checked:
        checked["scale"] = check_number(name, checked["scale"], -MAX_GAIN, MAX_GAIN, hint="It scales LoRA weights.")
    return checked


def _check_changed(changed: Any, known: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The tensors that a callback returned; whether they are finite is the loop's to see."""
    if not isinstance(changed, Mapping | None):
        raise InvalidTypeError(
            f"`callback_on_step_end` returned {describe(changed)}; return a dictionary of tensors, or None."
        )
    returned = {name: tensor for name, tensor in (changed or {}).items() if tensor is not None}
    for name, tensor in returned.items():
        check_choice("callback_on_step_end", name, known, hint="It is what the callback returned a tensor for.")
        sizes = known[name].shape[1:] if name == "latents" else ("T", known[name].shape[-1])
        check_tensor(f"callback_on_step_end: {name}", tensor, "B", *sizes, finite=False)
    return returned


def check_interval(name: str, interval: Any, last: int) -> tuple[float, float] | None:
    """Shares of the noise levels, as the timesteps from 0 to `last` that they stand for; `None` for all of them.

    Raises:
        InvalidInputError, InvalidTypeError: If it is no pair of rising numbers in [0, 1].
    """
    if interval is None:
        return None
    if not isinstance(interval, list | tuple) or len(interval) != 2:
        raise InvalidTypeError(f"`{name}` is {describe(interval)}; it has to be two numbers, such as (0.2, 0.8).")
    low, high = (check_number(name, end, 0.0, 1.0, hint="0 is no noise, 1 is noise alone.") for end in interval)
    if low >= high:
        raise InvalidInputError(f"`{name}` is ({low:g}, {high:g}); the lower end comes first.")
    return None if (low, high) == (0.0, 1.0) else (low * last, high * last)


def check_weights(name: str, weights: Sequence[Any]) -> list[float]:
    """Weights of a mix, >= 0 and finite, brought to a sum of 1.

    Raises:
        InvalidInputError, InvalidTypeError: If one is negative or no number, or all are 0.
    """
    numbers = [check_number(name, weight, 0.0, MAX_GAIN) for weight in weights]
    total = sum(numbers)
    if total == 0:
        raise InvalidInputError(f"`{name}` sums to 0; at least one weight has to be above 0.")
    return [number / total for number in numbers]


def check_generators(generator: Any, total: int) -> None:
    """One generator, one for each of `total` pictures, or none.

    Raises:
        InvalidInputError, InvalidTypeError: If it is something else.
    """
    if generator is None or isinstance(generator, torch.Generator):
        return
    if not isinstance(generator, list) or not all(isinstance(item, torch.Generator) for item in generator):
        raise InvalidTypeError(f"`generator` is {describe(generator)}; pass a torch.Generator or a list of them.")
    if len(generator) != total:
        raise InvalidInputError(
            f"`generator` is a list of {len(generator)} for {total} pictures; pass one, or one for each picture."
        )
