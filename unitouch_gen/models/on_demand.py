"""A model whose encoders are read from disk when they are first used, each alone."""

import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from textwrap import shorten
from typing import Any, Self

import torch
from accelerate import init_empty_weights
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn
from transformers import CLIPTextModelWithProjection, CLIPVisionModelWithProjection, PreTrainedModel
from transformers.utils import SAFE_WEIGHTS_INDEX_NAME

from unitouch_gen.convert.published import missed, of_modality, open_published, taken_from
from unitouch_gen.errors import InvalidInputError, check_choice
from unitouch_gen.files import adding_to_folder, local_folder, shards, weight_map_of
from unitouch_gen.models.config import UniTouchConfig
from unitouch_gen.models.modalities import MODALITIES, MODULES, make_encoder, modalities_of
from unitouch_gen.models.sensors import SensorBank
from unitouch_gen.models.vit import UniTouchViT

LONGEST_REASON = 300
"""Characters of what torch says, which names every key."""


class EncodersOnDemand(PreTrainedModel):
    """The encoders of a joint space.

    Args:
        config: Sizes of the four.
        modalities: Which to build now; the others are built when they are first used.

    Raises:
        InvalidInputError: If a modality is unknown.
    """

    config_class = UniTouchConfig
    base_model_prefix = "unitouch"
    main_input_name = "pixel_values"

    vision_model: CLIPVisionModelWithProjection
    text_model: CLIPTextModelWithProjection
    audio_model: UniTouchViT
    touch_model: UniTouchViT
    sensor_bank: SensorBank

    def __init__(self, config: UniTouchConfig, modalities: Iterable[str] = MODALITIES):
        super().__init__(config)
        self._source: Path | None = None
        self._lenders: dict[str, Callable[[], nn.Module]] = {}
        self._place = torch.empty(0)  # dtype and device of the weights, those included that are not in memory yet
        for modality in modalities:
            self._build(check_choice("modalities", modality, MODALITIES))

    # What is there -------------------------------------------------------------------------------------------------

    @property
    def loaded_modalities(self) -> tuple[str, ...]:
        """Modalities whose encoders are in memory."""
        return tuple(modality for modality in MODALITIES if hasattr(self, MODULES[modality][0]))

    @property
    def known_modalities(self) -> tuple[str, ...]:
        """Modalities whose encoders are in memory or can be read."""
        files = {} if self._source is None else shards(self._source)
        stored = modalities_of(key for keys in files.values() for key in keys)
        known = {*self.loaded_modalities, *self._lenders, *stored}
        return tuple(modality for modality in MODALITIES if modality in known)

    @property
    def source(self) -> Path | None:
        """The folder that modalities are read from, if there is one."""
        return self._source

    def can_read(self, modality: str) -> bool:
        """Whether a modality's encoder would come back after a `release`."""
        return self._source is not None or modality in self._lenders

    def borrow(self, modality: str, lender: Callable[[], nn.Module]) -> None:
        """Takes a modality's encoder from elsewhere, when it is first used, as where another model brings an equal one.

        Args:
            modality: "image" or "text".
            lender: Reads transformers' CLIP encoder with projection of that modality.

        Raises:
            InvalidInputError: If the modality is none of them.
        """
        self._lenders[check_choice("modality", modality, ("image", "text"))] = lender

    def load(self, modality: str) -> None:
        """Makes sure a modality's encoder is in memory; does nothing if it is.

        Raises:
            InvalidInputError: If the modality is unknown, or the encoder was not built and there is no folder to read.
        """
        check_choice("modality", modality, MODALITIES)
        if modality in self.loaded_modalities:
            return
        if modality in self._lenders:
            encoder = self._lenders[modality]()
            setattr(self, MODULES[modality][0], encoder)
            setattr(self.config, f"{MODULES[modality][0].removesuffix('_model')}_config", encoder.config)
            self._settle(modality)
            return
        if self._source is None:
            raise InvalidInputError(
                f"`modalities` left out {modality!r} when this model was built, and it has no folder to read it from; "
                "build it with that modality or use `from_pretrained`."
            )
        tensors = self._read(modality)
        if modality not in modalities_of(tensors):
            raise InvalidInputError(
                f"`{self._source}` holds no {modality} encoder; it has {', '.join(self.known_modalities) or 'none'}. "
                "Save it with that one, or convert the checkpoint that has it into the same folder."
            )
        try:
            self._fill(modality, tensors)
        except Exception:  # or the next call would take half an encoder for a loaded one
            self.release(modality)
            raise

    def add(self, modality: str) -> None:
        """Builds a modality's encoder with fresh random weights, in place of any that is there: the start of training.

        Raises:
            InvalidInputError: If the modality is unknown.
        """
        self._build(check_choice("modality", modality, MODALITIES))

    def release(self, modality: str) -> None:
        """Frees a modality's encoder; it is read again when next used.

        Raises:
            InvalidInputError: If it could not be read again, because the model does not come from a folder.
        """
        if not self.can_read(check_choice("modality", modality, MODALITIES)):
            raise InvalidInputError(
                f"`release({modality!r})` would lose the encoder: this model was not read from a folder."
            )
        for name in MODULES[modality]:
            if hasattr(self, name):
                delattr(self, name)

    def _build(self, modality: str) -> None:
        """With random weights."""
        self._construct(modality)
        for name in MODULES[modality]:
            if isinstance(getattr(self, name), UniTouchViT):
                getattr(self, name).apply(_initialise)
        self._settle(modality)

    def _construct(self, modality: str) -> None:
        config = self.config
        setattr(self, MODULES[modality][0], make_encoder(config, modality))
        if modality == "touch":
            width = config.touch_config.hidden_size
            self.sensor_bank = SensorBank(
                config.sensors, config.sensor_tokens, width, config.prototype_size, config.sensor_reach
            )

    def _settle(self, modality: str) -> None:
        """Brings a new encoder to where the others are."""
        for name in MODULES[modality]:
            getattr(self, name).train(self.training).to(self.device, self.dtype)

    def _read(self, modality: str) -> dict[str, Tensor]:
        """One modality's tensors, and no others, from the folder; of the dtype wanted they stay mapped from it."""
        assert self._source is not None
        tensors = {}
        for name in MODULES[modality]:
            for path, keys in shards(self._source, f"{name}.").items():
                try:
                    with safe_open(path, framework="pt") as file:
                        for key in keys:
                            tensor = file.get_tensor(key)
                            tensors[key] = tensor.to(self.dtype) if tensor.is_floating_point() else tensor
                except SafetensorError as error:
                    raise InvalidInputError(
                        f"`{path}` does not hold what it says: {error}. It is cut off or damaged; write it again."
                    ) from error
        return tensors

    def _fill(self, modality: str, tensors: Mapping[str, Tensor]) -> None:
        """Makes a modality's encoder of tensors with their full names; no others are ever in memory."""
        with init_empty_weights(), torch.random.fork_rng(devices=()):  # transformers draws tokens in any case
            self._construct(modality)
        for name in MODULES[modality]:
            own = {key.removeprefix(f"{name}."): tensors[key] for key in tensors if key.startswith(f"{name}.")}
            try:
                getattr(self, name).load_state_dict(own, strict=True, assign=True)
            except RuntimeError as error:
                raise InvalidInputError(
                    f"`{self._source}` does not hold the {modality} encoder that its config.json describes: "
                    f"{shorten(str(error).splitlines()[1], LONGEST_REASON, placeholder=' ...')}"
                ) from error
        self._settle(modality)

    @classmethod
    def from_pretrained(  # type: ignore[override]
        cls,
        pretrained_model_name_or_path: str | os.PathLike,
        *args: Any,
        modalities: Iterable[str] = (),
        dtype: torch.dtype | None = None,
        subfolder: str = "",
        config: UniTouchConfig | None = None,
        **kwargs: Any,
    ) -> Self:
        """Reads a model from a folder of safetensors, or from a repository id.

        Args:
            pretrained_model_name_or_path: The folder, or the id of a repository to fetch it from.
            modalities: Read now; all others are read when they are first used.
            dtype: Of the weights in memory; float32 when left out.
            subfolder: Within the folder or repository.
            config: In place of the folder's own.
            kwargs: Taken for the sake of transformers' and diffusers' loaders; what places or splits weights
                (`device_map`, `low_cpu_mem_usage`, ...) has nothing to do here and is ignored.

        Raises:
            InvalidInputError: If the folder holds no model, or not the one that its config describes.
        """
        dtype = dtype or kwargs.get("torch_dtype") or torch.float32
        source = local_folder("pretrained_model_name_or_path", pretrained_model_name_or_path, **kwargs)
        source = source / subfolder
        if not (source / "config.json").is_file():
            raise InvalidInputError(f"`{source}` holds no config.json; pass the folder that `save_pretrained` wrote.")
        model = cls(config or UniTouchConfig.from_pretrained(source), modalities=())
        model._source = source
        model.to(dtype).eval()  # type: ignore[arg-type]
        for modality in modalities:
            model.load(modality)
        return model

    def save_pretrained(self, save_directory: str | os.PathLike, *args: Any, **kwargs: Any) -> None:
        """Writes config and weights; modalities that are still on disk are read first, so none is lost.

        Raises:
            InvalidInputError: If the model's folder is no longer there, or holds part of an encoder; or if
                `save_directory` cannot be written to.
        """
        for modality in self.known_modalities:
            self.load(modality)
        folder = Path(save_directory)
        before = weight_map_of(folder)
        with adding_to_folder("save_directory", folder) as place:
            if kwargs.get("push_to_hub"):
                kwargs.setdefault("repo_id", folder.name)  # transformers would take that of the folder it writes to
            super().save_pretrained(place, *args, **kwargs)
            written = {file.name for file in place.iterdir()}
        for file in ({SAFE_WEIGHTS_INDEX_NAME, *before.values()} if before else set()) - written:
            (folder / file).unlink(missing_ok=True)  # or the next reader would follow the index of before

    @property
    def dtype(self) -> torch.dtype:
        """Of the weights, also of those that are not in memory yet."""
        return self._place.dtype

    @property
    def device(self) -> torch.device:
        """Of the weights, also of those that are not in memory yet."""
        return self._place.device

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """What `to`, `half`, `cuda` and the like are made of: modalities read later follow."""
        self._place = fn(self._place)
        return super()._apply(fn, recurse)

    @classmethod
    def from_published(
        cls,
        touch: str | os.PathLike | None = None,
        imagebind: str | os.PathLike | None = None,
        *,
        config: UniTouchConfig | None = None,
        dtype: torch.dtype | None = None,
        told: Callable[[str], object] = print,
    ) -> Self:
        """Reads the checkpoints that UniTouch's and ImageBind's authors published; see `encoders.published`.

        Args:
            touch: UniTouch's file (`last_new.ckpt`), of which the touch encoder is read. It has no sensor tokens.
            imagebind: ImageBind's (`imagebind_huge.pth`), of which image, text and audio are.
            config: Of encoders of another size, without sensors.
            dtype: Of the weights; the files' own when left out.
            told: Gets lines on what was used, ignored and missed.

        Raises:
            InvalidInputError: If neither came, or a file is none of these, lacks tensors, or holds some that are not
                finite.
        """
        config, parts = open_published(config, touch, imagebind, dtype)
        model = cls(config, modalities=())
        model.to(next(iter(parts[0].promises.values())).dtype).eval()  # type: ignore[arg-type]
        lines = [line for part in parts for line in taken_from(part)]
        while parts:  # each is let go when it is read
            part = parts.pop(0)
            for modality in part.modalities:
                model._fill(modality, {key: promise.make() for key, promise in of_modality(modality, part).items()})
        for line in [*lines, *missed(model.loaded_modalities)]:
            told(line)
        return model


def _initialise(module: nn.Module) -> None:
    """Truncated normals of 0.02 for weights and tokens, zeros for biases (as in ViT and CLIP)."""
    if isinstance(module, nn.Linear | nn.Conv2d):
        nn.init.trunc_normal_(
            module.weight, std=0.02 if isinstance(module, nn.Linear) else module.weight[0].numel() ** -0.5
        )
        if module.bias is not None:
            nn.init.zeros_(module.bias)
    elif isinstance(module, UniTouchViT):
        nn.init.trunc_normal_(module.class_token, std=0.02)
        nn.init.trunc_normal_(module.position, std=0.02)
    for name in ("bias_k", "bias_v"):
        if getattr(module, name, None) is not None:
            nn.init.trunc_normal_(getattr(module, name), std=0.02)
