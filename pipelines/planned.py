"""What a request needs of a pipeline, known before anything is loaded, and pipelines that hold no more than that."""

import inspect
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import wraps
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self, TypeVar

import diffusers
import torch
from diffusers import DiffusionPipeline

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.files import local_folder
from unitouch_gen.memory import PeakMemory, trim_memory, values_in
from unitouch_gen.models.joint import MODALITIES, MODULES
from unitouch_gen.plan import Plan
from unitouch_gen.report import RunReport

HOOKS = {"_hf_hook", "_diffusers_hook"}
"""Where modules keep what accelerate and diffusers have done to them."""

PARTS = {"prompt encoder": "text_encoder", "bank of image embeddings": "embedding_bank", "VAE": "vae"}
"""Components of a pipeline, by the names that plans give them; the joint space's encoders are parts of one."""

Place = tuple[Path, str]
"""Where weights are: a folder, and what the names of those that are meant start with."""

NO_PICKLES = {"use_safetensors": True}
"""Without it, diffusers reads pickles where there is nothing else."""

Pictures = TypeVar("Pictures")


def one_call(call: Callable[..., Pictures]) -> Callable[..., Pictures]:
    """For a pipeline's `__call__`: its device is looked up once, and its peak of memory counts from its beginning."""

    @wraps(call)
    def run(self: "PlannedPipeline", *args: Any, **kwargs: Any) -> Pictures:
        self._device = self._execution_device
        self._memory = PeakMemory(self._device)
        try:
            return call(self, *args, **kwargs)
        finally:
            self._device = None

    return run


class PlannedPipeline(DiffusionPipeline):
    """A pipeline whose calls follow a plan, and which may have been loaded for one."""

    _made_for: Plan | None = None
    _places: Mapping[str, Place] = MappingProxyType({})
    _low_memory = False
    _readers: Mapping[str, Callable[[], torch.nn.Module]] = MappingProxyType({})
    _device: torch.device | None = None
    _memory: PeakMemory

    @property
    def _execution_device(self) -> torch.device:
        """As `DiffusionPipeline`'s, which looks slowly through all modules for hooks that know it: once in a call."""
        if self._device is not None:
            return self._device
        networks = [part for part in self.components.values() if isinstance(part, torch.nn.Module)]
        hooked = any(not HOOKS.isdisjoint(module.__dict__) for network in networks for module in network.modules())
        weight = next((weight for network in networks for weight in network.parameters()), None)
        return super()._execution_device if hooked or weight is None else weight.device

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
            >>> XToTouchPipeline.plan(text="rough brick", output_type="latent").modalities
            ('text',)
        """
        signature = inspect.signature(cls.__call__)
        try:
            bound = signature.bind(None, *args, **request)
        except TypeError as error:
            raise InvalidInputError(f"{error}; `plan` takes the arguments of a call of {cls.__name__}.") from error
        bound.apply_defaults()
        return cls._plan(bound.arguments)

    @classmethod
    def _plan(cls, request: Mapping[str, Any]) -> Plan:
        """The plan of a call's arguments; those that cannot be used are for the call to refuse."""
        raise NotImplementedError

    @classmethod
    def from_pretrained(  # type: ignore[override]
        cls, pretrained_model_name_or_path: str | os.PathLike, *, plan: Plan | None = None, **kwargs: Any
    ) -> Self:
        """As `DiffusionPipeline.from_pretrained`.

        Args:
            pretrained_model_name_or_path: A folder, or a repository id.
            plan: Read no more than it needs; calls that need more are refused.
            kwargs: As of `DiffusionPipeline.from_pretrained`; of weights, safetensors alone are read unless
                `use_safetensors` says otherwise.

        Raises:
            InvalidInputError: If a plan came, and this is neither a folder nor a repository that can be fetched.
        """
        if plan is None:
            return super().from_pretrained(pretrained_model_name_or_path, **{**NO_PICKLES, **kwargs})
        folder = local_folder("pretrained_model_name_or_path", pretrained_model_name_or_path, **kwargs)
        absent: dict[str, Any] = dict.fromkeys(name for name, needed in plan.components.items() if not needed)
        if not plan.vae:
            kind = getattr(diffusers, cls.load_config(folder)["vae"][1])
            absent["vae"] = outline(kind, kind.load_config(folder, subfolder="vae"))
        pipe = super().from_pretrained(folder, **{**NO_PICKLES, **absent, **kwargs})
        pipe._keep_to(
            plan, {name: (folder / name, "") for name in ("unitouch", "text_encoder", "embedding_bank", "vae")}
        )
        return pipe

    def save_pretrained(self, save_directory: str | os.PathLike, *args: Any, **kwargs: Any) -> None:
        """As `DiffusionPipeline.save_pretrained`.

        Raises:
            InvalidInputError: If a plan has left out a part of this pipeline.
        """
        if self._made_for is not None and not all(self._made_for.components.values()):
            raise InvalidInputError(
                "`save_pretrained` would save no more than a part of this pipeline; load it without a `plan` for that."
            )
        self._read_again(self._readers)
        super().save_pretrained(save_directory, *args, **kwargs)

    def _keep_to(
        self,
        plan: Plan | None,
        places: Mapping[str, Place],
        low_memory: bool = False,
        readers: Mapping[str, Callable[[], torch.nn.Module]] = MappingProxyType({}),
    ) -> None:
        """Makes this a pipeline for requests that need no more than a plan, if there is one.

        Args:
            plan: The plan.
            places: Where the weights of each component are.
            low_memory: Whether to free encoders that have done their work.
            readers: What reads them again, of components beside the joint space.
        """
        self._made_for, self._places, self._low_memory = plan, dict(places), low_memory
        self._readers = dict(readers) if low_memory else {}
        if plan is not None and not plan.vae:
            self.vae = None  # until here its outline said how many pixels a latent has

    def _begin(self, **request: Any) -> Plan:
        """The plan of the call that starts here, which this pipeline has the parts for."""
        plan = self._plan(request)
        beyond = [] if self._made_for is None else plan.beyond(self._made_for)
        if beyond:
            raise InvalidInputError(
                f"This call needs the {' and the '.join(beyond)}, which the `plan` of this pipeline left out; load it "
                f"with `plan={type(self).__name__}.plan(...)` of the arguments of this call, or without a plan."
            )
        if plan.vae and self.vae is None:
            raise InvalidInputError('This call needs a `vae`, and this pipeline has none; pass `output_type="latent"`.')
        self._read_again(name for name, needed in plan.components.items() if needed)
        return plan

    def _read_again(self, names: Iterable[str]) -> None:
        """Components that were freed, of those named."""
        for name in names:
            if name in self._readers and getattr(self, name) is None:
                self.register_modules(**{name: self._readers[name]().to(self._execution_device)})

    def _free(self, name: str) -> None:
        """Frees a component that has done its work, where memory is low and it can be read again."""
        if name in self._readers:
            self.register_modules(**{name: None})
            trim_memory()

    def _end(self, report: RunReport) -> None:
        """What is to be done when the pictures are there."""
        report.saved = self._saved(report.left_out)
        report.peak_memory = self._memory.extra
        self.maybe_free_model_hooks()

    def _saved(self, left_out: Sequence[str]) -> dict[str, int]:
        """Bytes of weights, as they would lie in memory, of each part left out that does not."""
        joint = getattr(self, "unitouch", None)
        in_memory = {f"{modality} encoder" for modality in (joint.loaded_modalities if joint is not None else ())}
        in_memory |= {part for part, name in PARTS.items() if getattr(self, name, None) is not None}
        places = {part: self._places[name] for part, name in PARTS.items() if name in self._places}
        source = self._places["unitouch"][0] if "unitouch" in self._places else joint and joint.source
        places |= {
            f"{modality} encoder": (source, f"{MODULES[modality][0]}.") for modality in MODALITIES if source is not None
        }
        stored = next(self.unet.parameters(), None)  # an exact denoiser in its place has none
        bytes_each = (self.unet.dtype if stored is None else stored.dtype).itemsize
        sizes = {part: values_in(*places[part]) for part in left_out if part in places and part not in in_memory}
        return {part: bytes_each * size for part, size in sizes.items() if size}

    def _release(self, *modalities: str) -> None:
        """Frees encoders that have done their work, where memory is low; they are read again for the next call."""
        if not (modalities and self._low_memory):
            return
        for modality in modalities:
            if self.unitouch.can_read(modality):
                self.unitouch.release(modality)
        trim_memory()


def outline(kind: Any, config: Mapping[str, Any]) -> Any:
    """A network that takes no memory: all there is to it is its shape."""
    with torch.device("meta"):
        return kind.from_config(config)
