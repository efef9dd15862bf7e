"""`UniTouchModel`: touch, image, text and audio in one space, each sense read from disk when it is first used."""

import json
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import torch
from diffusers.utils.accelerate_utils import apply_forward_hook
from safetensors import safe_open
from torch import Tensor, nn
from transformers import CLIPTextModelWithProjection, CLIPVisionModelWithProjection, PreTrainedModel
from transformers.utils import SAFE_WEIGHTS_INDEX_NAME, SAFE_WEIGHTS_NAME

from unitouch_gen.encoders.config import UniTouchConfig
from unitouch_gen.encoders.pixels import denormalise_pixels, normalise_pixels
from unitouch_gen.encoders.sensors import SensorBank, SensorMatch
from unitouch_gen.encoders.vit import UniTouchViT
from unitouch_gen.errors import InvalidInputError, InvalidTypeError, check_choice, describe

SENSES: tuple[str, ...] = ("image", "text", "audio", "touch")

MODULES: dict[str, tuple[str, ...]] = {
    "image": ("vision_model",),
    "text": ("text_model",),
    "audio": ("audio_model",),
    "touch": ("touch_model", "sensor_bank"),
}
"""The sub-modules, and so the key prefixes on disk, of each sense."""


class UniTouchModel(PreTrainedModel):
    """The joint space (Section 3 of the paper).

    Image and text are transformers' CLIP encoders; touch and audio are `UniTouchViT`s, touch with a `SensorBank`. All
    features are un-normalised (B, D). Inputs are moved to the device and dtype of the encoder. There is no `forward`:
    each `get_..._features` sets off the hooks by which `enable_model_cpu_offload` brings a model to its device.

    Args:
        config: Sizes of the four encoders.
        senses: Which encoders to build now; the others are built when they are first used.

    Raises:
        InvalidInputError: If a sense is unknown.

    Example:
        >>> model = UniTouchModel.from_pretrained("path/to/model", senses=("touch",))  # doctest: +SKIP
        >>> model.get_touch_features(pixel_values)  # doctest: +SKIP
    """

    config_class = UniTouchConfig
    base_model_prefix = "unitouch"
    main_input_name = "pixel_values"

    def __init__(self, config: UniTouchConfig, senses: Iterable[str] = SENSES):
        super().__init__(config)
        self._source: Path | None = None
        self._place = torch.empty(0)  # dtype and device of the weights, those included that are not in memory yet
        for sense in senses:
            self._build(check_choice("senses", sense, SENSES))

    # Features ---------------------------------------------------------------------------------------------------------

    @apply_forward_hook
    def get_touch_features(self, pixel_values: Tensor, sensor_ids: Tensor | None = None) -> Tensor:
        """Touch embeddings f_T(t, s_t) of Eq. 3, (B, D).

        Args:
            pixel_values: From `UniTouchProcessor.touch`, (B, 3, S, S).
            sensor_ids: Index of each image's sensor in the bank, integers (B,) from 0 to K - 1; `None` retrieves the
                nearest prototype.

        Raises:
            InvalidInputError: If a shape does not fit, an index is out of range, or a sensor has to be retrieved and no
                prototype is stored.
            InvalidTypeError: If `sensor_ids` are no integers.
        """
        self.load("touch")
        config = self.config.touch_config
        _check_input("pixel_values", pixel_values, (config.num_channels, config.image_height, config.image_width))
        if sensor_ids is None:
            sensor_ids = self.sensor_ids(self.match_sensors(pixel_values))
        else:
            _check_sensor_ids(sensor_ids, len(pixel_values), self.sensor_bank.names)
        weight = self.touch_model.projection.weight
        prefix = None if sensor_ids is None else self.sensor_bank(sensor_ids.to(weight.device, torch.long))
        return self.touch_model(pixel_values.to(weight), prefix)

    @apply_forward_hook
    def get_image_features(self, pixel_values: Tensor) -> Tensor:
        """Image embeddings (B, D) of pixel values (B, 3, S, S) from `UniTouchProcessor.images`.

        Raises:
            InvalidInputError: If the shape does not fit.
        """
        self.load("image")
        side = self.config.vision_config.image_size
        _check_input("pixel_values", pixel_values, (self.config.vision_config.num_channels, side, side))
        pixel_values = pixel_values.to(self.vision_model.visual_projection.weight)
        return self.vision_model(pixel_values=pixel_values).image_embeds

    @apply_forward_hook
    def get_text_features(self, input_ids: Tensor, attention_mask: Tensor | None = None) -> Tensor:
        """Text embeddings (B, D) of token ids, int64 (B, T), from `UniTouchProcessor.text`.

        The mask is accepted as tokenizers make one; causal attention never looks at what follows the end token.
        """
        self.load("text")
        return self.text_model(input_ids=input_ids.to(self.text_model.device)).text_embeds

    @apply_forward_hook
    def get_audio_features(self, input_values: Tensor) -> Tensor:
        """Audio embeddings (B, D) of log-mel clips (B, clips, 1, mel_bins, frames), averaged over the clips.

        Raises:
            InvalidInputError: If the shape does not fit.
        """
        self.load("audio")
        config = self.config.audio_config
        _check_input("input_values", input_values, (config.num_channels, config.image_height, config.image_width), 5)
        batch, clips = input_values.shape[:2]
        every_clip = input_values.flatten(0, 1).to(self.audio_model.projection.weight)
        return self.audio_model(every_clip).view(batch, clips, -1).mean(dim=1)

    def match_sensors(
        self, pixel_values: Tensor, sensor: str | Sequence[str | None] | None = None
    ) -> list[SensorMatch]:
        """The sensor of each image: the one named, or the nearest prototype.

        Args:
            pixel_values: From `UniTouchProcessor.touch`, (B, 3, S, S).
            sensor: A name for all, one for each image, or `None` to retrieve.

        Raises:
            InvalidInputError: If a name is unknown, or has to be found and no prototype is stored.
        """
        self.load("touch")
        size = self.config.prototype_size
        raw = denormalise_pixels(pixel_values.float())
        if len(self.sensor_bank) and raw.shape[-1] != size:
            raw = nn.functional.interpolate(raw, (size, size), mode="bilinear", antialias=True)
        return self.sensor_bank.match(raw, sensor)

    def recentre(self, pixel_values: Tensor, background: Tensor, matches: Sequence[SensorMatch]) -> Tensor:
        """Touches as the matched sensors would have coloured them: t - background + prototype, (B, 3, S, S).

        Off unless asked for; it helps where an unseen sensor's background differs from every known one.

        Args:
            pixel_values: Touches, (B, 3, S, S).
            background: What their sensor sees on average or untouched, (1 or B, 3, S, S).
            matches: Sensors whose look the touches should take on.
        """
        self.load("touch")
        raw = denormalise_pixels(pixel_values - background) - denormalise_pixels(torch.zeros_like(pixel_values[:1]))
        looks = torch.stack([self.sensor_bank.prototype(str(match.name)) for match in matches])
        looks = nn.functional.interpolate(looks.to(raw), raw.shape[-2:], mode="bilinear", antialias=True)
        return normalise_pixels((raw + looks).clamp(0.0, 1.0))

    def sensor_ids(self, matches: Sequence[SensorMatch]) -> Tensor | None:
        """Bank indices (B,) of matches; `None` for a bank of zero sensors."""
        if not len(self.sensor_bank):
            return None
        return torch.tensor([self.sensor_bank.index(str(match.name)) for match in matches], device=self.device)

    # Senses on demand -------------------------------------------------------------------------------------------------

    @property
    def loaded_senses(self) -> tuple[str, ...]:
        """Senses whose encoders are in memory."""
        return tuple(sense for sense in SENSES if hasattr(self, MODULES[sense][0]))

    def load(self, sense: str) -> None:
        """Makes sure a sense's encoder is in memory; does nothing if it is.

        Raises:
            InvalidInputError: If the sense is unknown, or the encoder was not built and there is no folder to read.
        """
        check_choice("sense", sense, SENSES)
        if sense in self.loaded_senses:
            return
        if self._source is None:
            raise InvalidInputError(
                f"`senses` left out {sense!r} when this model was built, and it has no folder to read it from; build "
                "it with that sense or use `from_pretrained`."
            )
        self._build(sense)
        try:
            self._read(sense)
        except Exception:  # or the next call would take random weights for loaded ones
            self.release(sense)
            raise

    def add(self, sense: str) -> None:
        """Builds a sense's encoder with fresh random weights, in place of any that is there: the start of training.

        Raises:
            InvalidInputError: If the sense is unknown.
        """
        self._build(check_choice("sense", sense, SENSES))

    def release(self, sense: str) -> None:
        """Frees a sense's encoder; it is read again when next used.

        Raises:
            InvalidInputError: If it could not be read again, because the model does not come from a folder.
        """
        check_choice("sense", sense, SENSES)
        if self._source is None:
            raise InvalidInputError(
                f"`release({sense!r})` would lose the encoder: this model was not read from a folder."
            )
        for name in MODULES[sense]:
            if hasattr(self, name):
                delattr(self, name)

    def _build(self, sense: str) -> None:
        config = self.config
        if sense == "image":
            self.vision_model = CLIPVisionModelWithProjection(config.vision_config)
        elif sense == "text":
            self.text_model = CLIPTextModelWithProjection(config.text_config)
        elif sense == "audio":
            self.audio_model = UniTouchViT(config.audio_config)
            self.audio_model.apply(_initialise)
        else:
            self.touch_model = UniTouchViT(config.touch_config)
            self.touch_model.apply(_initialise)
            width = config.touch_config.hidden_size
            self.sensor_bank = SensorBank(
                config.sensors, config.sensor_tokens, width, config.prototype_size, config.sensor_reach
            )
        for name in MODULES[sense]:
            getattr(self, name).train(self.training).to(self.device, self.dtype)

    def _read(self, sense: str) -> None:
        """Copies one sense's tensors, and no others, from the folder."""
        assert self._source is not None
        for name in MODULES[sense]:
            module = getattr(self, name)
            state = {}
            for path, keys in _shards(self._source, f"{name}.").items():
                with safe_open(path, framework="pt") as file:
                    state.update({key.removeprefix(f"{name}."): file.get_tensor(key) for key in keys})
            try:
                module.load_state_dict(state, strict=True)
            except RuntimeError as error:
                raise InvalidInputError(
                    f"`{self._source}` does not hold the {sense} encoder that its config.json describes: "
                    f"{str(error).splitlines()[1].strip()}"
                ) from error

    @classmethod
    def from_pretrained(  # type: ignore[override]
        cls,
        pretrained_model_name_or_path: str | os.PathLike,
        *args: Any,
        senses: Iterable[str] = (),
        dtype: torch.dtype | None = None,
        subfolder: str = "",
        config: UniTouchConfig | None = None,
        **kwargs: Any,
    ) -> "UniTouchModel":
        """Reads a model from a folder of safetensors, or from a repository id.

        Args:
            pretrained_model_name_or_path: The folder, or the id of a repository to fetch it from.
            senses: Read now; all others are read when they are first used.
            dtype: Of the weights in memory; float32 when left out.
            subfolder: Within the folder or repository.
            config: In place of the folder's own.
            kwargs: Taken for the sake of transformers' and diffusers' loaders; what places or splits weights
                (`device_map`, `low_cpu_mem_usage`, ...) has nothing to do here and is ignored.

        Raises:
            InvalidInputError: If the folder holds no model, or not the one that its config describes.
        """
        dtype = dtype or kwargs.get("torch_dtype") or torch.float32
        source = Path(pretrained_model_name_or_path)
        if not source.is_dir():
            from huggingface_hub import snapshot_download
            from huggingface_hub.utils import validate_repo_id

            try:
                validate_repo_id(str(pretrained_model_name_or_path))
            except ValueError as error:
                raise InvalidInputError(
                    f"`pretrained_model_name_or_path` is {str(source)!r}, which is no folder and no repository id; "
                    "pass the folder that `save_pretrained` wrote."
                ) from error
            hub = {key: kwargs[key] for key in ("cache_dir", "revision", "token", "local_files_only") if key in kwargs}
            try:
                source = Path(snapshot_download(str(pretrained_model_name_or_path), **hub))
            except OSError as error:
                raise InvalidInputError(
                    f"`pretrained_model_name_or_path` is {str(source)!r}, which is no folder and could not be fetched: "
                    f"{str(error).partition(chr(10))[0]}"
                ) from error
        source = source / subfolder
        if not (source / "config.json").is_file():
            raise InvalidInputError(f"`{source}` holds no config.json; pass the folder that `save_pretrained` wrote.")
        model = cls(config or UniTouchConfig.from_pretrained(source), senses=())
        model._source = source
        model.to(dtype).eval()  # type: ignore[arg-type]
        for sense in senses:
            model.load(sense)
        return model

    def save_pretrained(self, save_directory: str | os.PathLike, *args: Any, **kwargs: Any) -> Any:
        """Writes config and weights; senses that are still on disk are read first, so none is lost.

        Raises:
            InvalidInputError: If the model's folder is no longer there, or holds part of an encoder.
        """
        if self._source is not None:
            for sense in SENSES:
                if sense not in self.loaded_senses and _shards(self._source, f"{MODULES[sense][0]}."):
                    self.load(sense)
        return super().save_pretrained(save_directory, *args, **kwargs)

    @property
    def dtype(self) -> torch.dtype:
        """Of the weights, also of those that are not in memory yet."""
        return self._place.dtype

    @property
    def device(self) -> torch.device:
        """Of the weights, also of those that are not in memory yet."""
        return self._place.device

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "UniTouchModel":
        """What `to`, `half`, `cuda` and the like are made of: senses read later follow."""
        self._place = fn(self._place)
        return super()._apply(fn, recurse)


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


def _shards(source: Path, prefix: str) -> dict[Path, list[str]]:
    """The safetensors files of a folder with the keys in each that start with `prefix`, if it has any."""
    index = source / SAFE_WEIGHTS_INDEX_NAME
    if index.is_file():
        weight_map = json.loads(index.read_text())["weight_map"]
        files: dict[Path, list[str]] = {}
        for key, file in weight_map.items():
            if key.startswith(prefix):
                files.setdefault(source / file, []).append(key)
        return files
    path = source / SAFE_WEIGHTS_NAME
    if not path.is_file():
        raise InvalidInputError(
            f"`{source}` holds no {SAFE_WEIGHTS_NAME}; pass the folder that `save_pretrained` wrote."
        )
    with safe_open(path, framework="pt") as file:
        keys = [key for key in file.keys() if key.startswith(prefix)]  # noqa: SIM118 - not a dict
    return {path: keys} if keys else {}


def _check_input(name: str, values: Tensor, shape: tuple[int, ...], ndim: int = 4) -> None:
    if values.ndim != ndim or tuple(values.shape[-3:]) != shape:
        leading = ("B", "clips")[: ndim - 3]
        expected = ", ".join([*leading, *map(str, shape)])
        raise InvalidInputError(
            f"`{name}` is {describe(values)}; this model takes ({expected}). Use UniTouchProcessor."
        )


def _check_sensor_ids(sensor_ids: Any, count: int, names: Sequence[str]) -> None:
    """Integers (count,) that are indices into the names."""
    hint = f"pass the index of each image's sensor, integers ({count},) from 0 to {len(names) - 1}, or None."
    if not names:
        raise InvalidInputError(f"`sensor_ids` is {describe(sensor_ids)}; this model has no sensor tokens; pass None.")
    if not isinstance(sensor_ids, Tensor) or sensor_ids.dtype == torch.bool or sensor_ids.is_floating_point():
        raise InvalidTypeError(f"`sensor_ids` is {describe(sensor_ids)}; {hint}")
    if tuple(sensor_ids.shape) != (count,):
        raise InvalidInputError(f"`sensor_ids` is {describe(sensor_ids)}; {hint}")
    if count and not 0 <= int(sensor_ids.min()) <= int(sensor_ids.max()) < len(names):
        raise InvalidInputError(f"`sensor_ids` is {sensor_ids.tolist()}; {hint}")
