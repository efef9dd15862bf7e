"""`UniTouchModel`: touch, image, text and audio in one space. Each encoder is read from disk when it is first used."""

import os
import threading
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import torch
import torch.nn.functional as F
from diffusers.utils.accelerate_utils import apply_forward_hook
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn
from transformers import CLIPTextModelWithProjection, CLIPVisionModelWithProjection, PreTrainedConfig, PreTrainedModel

from unitouch_gen.errors import (
    InvalidInputError,
    UnfamiliarInputWarning,
    check_arguments,
    check_choice,
    check_dtype,
    check_file,
    explain_errors,
)
from unitouch_gen.files import LOADING_OPTIONS, local_folder, read_settings, reading
from unitouch_gen.models.config import UniTouchConfig
from unitouch_gen.models.images import denormalise_pixels, local_mean
from unitouch_gen.models.sensor_bank import SensorBank, SensorMatch, Sensors
from unitouch_gen.models.vit import StemmedCLIPVisionModel, UniTouchViT, initialise
from unitouch_gen.saving import saved_whole

MODULES: dict[str, tuple[str, ...]] = {
    "image": ("vision_model",),
    "text": ("text_model",),
    "audio": ("audio_model",),
    "touch": ("touch_model", "sensor_bank"),
}
"""Sub-modules of each modality, and prefixes of their tensors on disk."""

MODALITIES = tuple(MODULES)

UNLIKE = "unlike anything known"
UNTOUCHED = "nothing is touched"
"""Reasons why the result for a touch is a guess, as in `RunReport.unknown`."""

_READING = threading.Lock()  # held while an encoder is read, so that threads that share a model read it once


def make_modules(config: PreTrainedConfig, modality: str) -> dict[str, nn.Module]:
    """The `MODULES` of a modality: CLIP for image and text, `UniTouchViT` for audio and touch."""
    if modality == "image":
        stemmed = getattr(config.vision_config, "stem", "patch") == "residual"
        kind: Any = StemmedCLIPVisionModel if stemmed else CLIPVisionModelWithProjection
        return {"vision_model": kind(config.vision_config)}
    if modality == "text":
        return {"text_model": CLIPTextModelWithProjection(config.text_config)}
    if modality == "audio":
        return {"audio_model": UniTouchViT(config.audio_config)}
    bank = SensorBank(
        config.sensors,
        tokens=config.sensor_tokens,
        width=config.touch_config.hidden_size,
        prototype_size=config.prototype_size,
        reaches=config.sensor_reaches,
    )
    return {"touch_model": UniTouchViT(config.touch_config), "sensor_bank": bank}


class UniTouchModel(PreTrainedModel):
    """The joint space (Section 3 of the paper).

    Image and text are transformers' CLIP encoders; touch and audio are `UniTouchViT`s, touch with a `SensorBank`. All
    features are (B, D) and un-normalised; audio's are means of normalised ones. Inputs come from `UniTouchProcessor`
    and are moved to the encoder's device and dtype.

    Args:
        config: Sizes of the four encoders.
        modalities: Encoders to build now, with fresh random weights.

    Example:
        >>> model = UniTouchModel.from_pretrained("path/to/model")  # doctest: +SKIP
        >>> model.get_touch_features(pixel_values)  # reads the touch encoder alone  # doctest: +SKIP
    """

    config_class = UniTouchConfig
    base_model_prefix = "unitouch"

    vision_model: CLIPVisionModelWithProjection
    text_model: CLIPTextModelWithProjection
    audio_model: UniTouchViT
    touch_model: UniTouchViT
    sensor_bank: SensorBank

    def __init__(self, config: UniTouchConfig, modalities: Iterable[str] = MODALITIES):
        super().__init__(config)
        self.source: Path | None = None  # folder it was read from
        self._stored: dict[str, Tensor] = {}  # the folder's tensors by name
        self._place = torch.empty(0)  # dtype and device of the weights, also of those not read yet
        self.out_of_distribution = nn.ModuleDict()  # the `RelativeDistance` of "touch", if one was fitted
        for modality in modalities:
            self.add(modality)

    # Features ---------------------------------------------------------------------------------------------------------

    @apply_forward_hook  # `enable_model_cpu_offload` moves the model by this hook
    def get_touch_features(self, pixel_values: Tensor, sensor_ids: Tensor | None = None) -> Tensor:
        """Touch embeddings f_T(t, s_t) of Eq. 3, (B, D), of pixel values (B, 3, S, S) from `UniTouchProcessor.touch`.

        `sensor_ids` are indices in the bank, integers (B,), -1 for a sensor without tokens; `None` retrieves them.
        """
        return self._encode_touches(pixel_values, sensor_ids)[0]

    @apply_forward_hook
    def encode_touches(self, pixel_values: Tensor, sensor_ids: Tensor | None = None) -> tuple[Tensor, list[str | None]]:
        """`get_touch_features`, and for each touch `UNLIKE` if it is out of distribution, else `None`.

        All are `None` if no distance was fitted.
        """
        features, patches = self._encode_touches(pixel_values, sensor_ids)
        if "touch" not in self.out_of_distribution:
            return features, [None] * len(pixel_values)
        distances = self.out_of_distribution["touch"](touch_statistics(patches, pixel_values))
        threshold = self.config.ood_thresholds["touch"]["foreign"]
        return features, [UNLIKE if distance > threshold else None for distance in distances.tolist()]

    def _encode_touches(self, pixel_values: Tensor, sensor_ids: Tensor | None) -> tuple[Tensor, Tensor]:
        """Embeddings (B, D), and the stem's output (B, width, h, w)."""
        touch_model, sensor_bank = self.load("touch")
        if sensor_ids is None:
            sensor_ids = self.sensor_ids(self.match_sensors(pixel_values))
        pixels = pixel_values.to(touch_model.projection.weight)
        patches = touch_model.stem(pixels)

        def encode(patches: Tensor, prefix: Tensor | None) -> Tensor:
            return touch_model.embed(touch_model.tokens(patches, prefix))

        features = sensor_bank.encode(encode, patches, sensor_ids)
        if touch_model.texture is not None:
            features = features + touch_model.texture(pixels)
        return features, patches

    def get_features(self, modality: str, **inputs: Tensor) -> Tensor:
        """Embeddings (B, D) of a modality, of its `UniTouchProcessor.inputs`."""
        return getattr(self, f"get_{modality}_features")(**inputs)

    @apply_forward_hook
    def get_image_features(self, pixel_values: Tensor) -> Tensor:
        """Image embeddings (B, D) of pixel values (B, 3, S, S) from `UniTouchProcessor.images`."""
        (vision_model,) = self.load("image")
        return vision_model(pixel_values=pixel_values.to(vision_model.visual_projection.weight)).image_embeds

    @apply_forward_hook
    def get_text_features(self, input_ids: Tensor, attention_mask: Tensor | None = None) -> Tensor:
        """Text embeddings (B, D) of token ids, integers (B, T), from `UniTouchProcessor.text`.

        `attention_mask` is ignored: causal attention cannot see padding after the end token.
        """
        (text_model,) = self.load("text")
        return text_model(input_ids=input_ids.long().to(text_model.device)).text_embeds

    @apply_forward_hook
    def get_audio_features(self, input_values: Tensor) -> Tensor:
        """Audio embeddings (B, D) of log-mel clips (B, clips, 1, mel_bins, frames) from `UniTouchProcessor.sounds`.

        Embeddings of the clips are normalised, then averaged, as in ImageBind.
        """
        (audio_model,) = self.load("audio")
        clips = input_values.flatten(0, 1).to(audio_model.projection.weight)
        embeds = F.normalize(audio_model(clips), dim=-1)
        return embeds.unflatten(0, input_values.shape[:2]).mean(dim=1)

    # Touches and sensors ----------------------------------------------------------------------------------------------

    def match_sensors(self, pixel_values: Tensor, sensor: Sensors = None, nearest: bool = False) -> list[SensorMatch]:
        """The sensor of each touch (B, 3, S, S), named or retrieved; see `SensorBank.match`."""
        _, sensor_bank = self.load("touch")
        return sensor_bank.match(denormalise_pixels(pixel_values.float()), sensor, nearest=nearest)

    def sensor_ids(self, matches: Sequence[SensorMatch]) -> Tensor:
        """Bank indices (B,) of matches, -1 for a match without a name."""
        _, sensor_bank = self.load("touch")
        indices = [-1 if match.name is None else sensor_bank.index(match.name) for match in matches]
        return torch.tensor(indices, device=self.device)

    def recentre(self, pixels: Tensor, background: Tensor, matches: Sequence[SensorMatch]) -> Tensor:
        """Touches (B, 3, S, S), in [0, 1], recoloured to the matched sensor: t - background + prototype.

        The background (1 or B, 3, S, S), in [0, 1], is the touches' own sensor untouched, or its mean image.
        """
        _, sensor_bank = self.load("touch")
        prototypes = torch.stack([sensor_bank.prototype(str(match.name)) for match in matches])
        prototypes = F.interpolate(prototypes.to(pixels), pixels.shape[-2:], mode="bilinear", antialias=True)
        return (pixels - background + prototypes).clamp(0.0, 1.0)

    # Encoders on demand -----------------------------------------------------------------------------------------------

    @property
    def known_modalities(self) -> tuple[str, ...]:
        """Modalities whose encoders are in memory or on disk."""
        modules = set(self._modules) | {key.partition(".")[0] for key in self._stored}
        return tuple(modality for modality in MODALITIES if MODULES[modality][0] in modules)

    @property
    def dtype(self) -> torch.dtype:
        """dtype of the weights, also of those not in memory yet."""
        return self._place.dtype

    @property
    def device(self) -> torch.device:
        """Device of the weights, also of those not in memory yet."""
        return self._place.device

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Hook behind `to`, `half`, `cuda`; encoders that are loaded later follow."""
        self._place = fn(self._place)
        return super()._apply(fn, recurse)

    def load(self, modality: str) -> tuple[Any, ...]:
        """The `MODULES` of a modality, read now if not in memory; raises `InvalidInputError` if that fails."""
        names = MODULES[check_choice("modality", modality, MODALITIES)]
        if names[0] not in self._modules:
            with _READING, torch.inference_mode(False):
                if names[0] not in self._modules:  # unless another thread was faster
                    self.load_tensors(modality, self._stored)
        return tuple(self._modules[name] for name in names)

    def add(self, modality: str) -> None:
        """Builds a modality's encoder with random weights, replacing any existing one."""
        modules = make_modules(self.config, modality)
        for module in modules.values():
            if isinstance(module, UniTouchViT):  # transformers' classes initialise themselves
                module.apply(initialise)
        self._adopt(modules)

    def load_tensors(self, modality: str, tensors: Mapping[str, Tensor]) -> None:
        """Builds an encoder from a state dict, without initialising weights."""
        if not any(key.startswith(MODULES[modality][0]) for key in tensors):
            modalities = ", ".join(self.known_modalities) or "none"
            raise InvalidInputError(f"This model has no {modality} encoder; it has {modalities}. Load one that has it.")
        with torch.device("meta"):
            modules = make_modules(self.config, modality)
        for name, module in modules.items():
            prefix = f"{name}."
            state = {key.removeprefix(prefix): tensors[key] for key in tensors if key.startswith(prefix)}
            try:
                module.load_state_dict(state, strict=True, assign=True)
            except RuntimeError as error:
                wrong = str(error).splitlines()[1].strip()[:300]  # torch names every key
                raise InvalidInputError(
                    f"`{self.source}` does not hold the {modality} encoder that its config describes: {wrong}"
                ) from error
            for part in module.modules():
                positions = getattr(part, "position_ids", None)  # transformers' embeddings do not store these
                if isinstance(positions, Tensor):
                    part.position_ids = torch.arange(positions.shape[-1])[None]
        self._adopt(modules)

    def _adopt(self, modules: Mapping[str, nn.Module]) -> None:
        """Moves new modules to this model's device and dtype, then attaches all of them at once."""
        for module in modules.values():
            module.train(self.training).to(self.device, self.dtype)
        self._modules = {**self._modules, **modules}  # a new dict: threads may be iterating over the old one

    # Reading and writing ----------------------------------------------------------------------------------------------

    @classmethod
    def from_pretrained(  # type: ignore[override]
        cls,
        pretrained_model_name_or_path: str | os.PathLike,
        *,
        modalities: Iterable[str] = (),
        dtype: torch.dtype | None = None,
        subfolder: str = "",
        variant: str | None = None,
        config: UniTouchConfig | None = None,
        **kwargs: Any,
    ) -> Self:
        """Reads a model from a folder of safetensors, or from a repository id.

        Args:
            pretrained_model_name_or_path: The folder, or a repository id.
            modalities: Encoders to read now; the others are read when first used.
            dtype: Precision of the weights in memory; float32 when left out.
            subfolder, variant, config: As in transformers.
            kwargs: `torch_dtype`, and download options such as `revision`. Other options of diffusers' loaders are
                ignored.

        Raises:
            InvalidInputError: If the folder holds no model, or not the one that its config describes.
            InvalidTypeError: If there is no such argument.
        """
        check_arguments("`from_pretrained`", kwargs, {*LOADING_OPTIONS, "modalities", "config"})
        name = "pretrained_model_name_or_path"
        dtype = check_dtype("dtype", dtype or kwargs.get("torch_dtype") or torch.float32)
        source = local_folder(name, pretrained_model_name_or_path, **kwargs) / subfolder
        with reading(name, source):
            check_file(name, source / "config.json", "the folder of a saved model")
            model = cls(config or UniTouchConfig.from_pretrained(source), modalities=())
            model.source = source
            model._stored = stored_tensors(source, variant)
            if "foreign" in model.config.ood_thresholds.get("touch", {}):
                model.out_of_distribution["touch"] = RelativeDistance.from_tensors(model._stored)
            model.to(dtype).eval()  # type: ignore[arg-type]
        for modality in modalities:
            model.load(modality)
        return model

    @saved_whole
    def save_pretrained(self, save_directory: str | os.PathLike, *, variant: str | None = None, **kwargs: Any) -> None:
        """Writes config and weights; encoders that are still on disk are read first and written, too."""
        for modality in self.known_modalities:
            self.load(modality)
        super().save_pretrained(save_directory, variant=variant, **kwargs)


def stored_tensors(folder: Path, variant: str | None = None) -> dict[str, Tensor]:
    """Tensors of a saved model by name, memory-mapped: they are read when used."""
    suffix = f".{variant}" if variant else ""
    index = folder / f"model.safetensors.index{suffix}.json"
    names = {f"model{suffix}.safetensors"}
    if index.is_file():
        weight_map = read_settings("source", index)["weight_map"]
        # Names alone, so that no file is outside of the folder.
        names = {Path(file).name for file in weight_map.values()}
    tensors = dict[str, Tensor]()
    for file in sorted(folder / name for name in names):
        check_file("source", file, "weights")  # opening a pipe would block
        with explain_errors(f"`{file}` is cut off or damaged", "fetch it again", SafetensorError, OSError):
            tensors |= load_file(file)
    return tensors


# Out of distribution --------------------------------------------------------------------------------------------------


class Gaussians(nn.Module):
    """The squared Mahalanobis distance to the nearest of C means (C, F) (Lee et al., 2018, Eq. 2), (B, F) -> (B,).

    With the `whitening` W (F, F), W W^T is the inverse of the shared covariance.
    """

    means: Tensor
    whitening: Tensor

    def __init__(self, means: Tensor, whitening: Tensor):
        super().__init__()
        self.register_buffer("means", means)
        self.register_buffer("whitening", whitening)

    def forward(self, features: Tensor) -> Tensor:
        means = self.means.float()
        whitening = self.whitening.float()
        centre = means.mean(dim=0)  # small numbers lose fewer digits
        whitened_features = (features.float() - centre) @ whitening
        whitened_means = (means - centre) @ whitening
        return torch.cdist(whitened_features, whitened_means).amin(dim=1).square()


class RelativeDistance(nn.Module):
    """The relative Mahalanobis distance of `touch_statistics`, (B, F) -> (B,), higher for images that are no touches.

    It is the distance to the nearest class of training touches, minus that to pictures (Ren et al., 2021, "A simple fix
    to Mahalanobis distance for improving near-OOD detection"). Touches of unknown sensors lie as far from the training
    touches as photos do, but further from pictures.
    """

    def __init__(self, known: Gaussians, foreign: Gaussians):
        super().__init__()
        self.groups = nn.ModuleDict({"known": known, "foreign": foreign})

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor]) -> "RelativeDistance":
        """Builds the distance from the state dict of a joint space."""

        def gaussians(group: str) -> Gaussians:
            prefix = f"out_of_distribution.touch.groups.{group}"
            return Gaussians(tensors[f"{prefix}.means"], tensors[f"{prefix}.whitening"])

        return cls(gaussians("known"), gaussians("foreign"))

    def forward(self, statistics: Tensor) -> Tensor:
        return self.groups["known"](statistics) - self.groups["foreign"](statistics)


@torch.no_grad()
def touch_statistics(patches: Tensor, pixel_values: Tensor) -> Tensor:
    """Features of `RelativeDistance`, (B, width + 12).

    An encoder that ignores differences between sensors ignores what distinguishes a photo from a touch. So these are
    features of its input: the mean output of the stem, mean and spread of each channel, and correlations of the
    channels' detail. Lamps of several colours show each slope in a channel of its own, whereas shades of a picture
    darken all channels alike.

    Args:
        patches: Output of the touch encoder's stem, (B, width, h, w).
        pixel_values: Normalised touches, (B, 3, H, W).
    """
    pixels = denormalise_pixels(pixel_values.float())
    reach = max(1, max(pixels.shape[-2:]) // 28)  # a window of 7 % of the longer side
    detail = (pixels - local_mean(pixels, reach)).flatten(2)
    covariance = (detail @ detail.mT / detail.shape[-1]).nan_to_num() + 1e-9 * torch.eye(3).to(pixels)
    deviation = covariance.diagonal(dim1=1, dim2=2).sqrt()
    red, green, _ = (covariance / (deviation[:, :, None] * deviation[:, None])).unbind(dim=1)
    correlations = torch.stack([red[:, 1], red[:, 2], green[:, 2]], dim=1)
    eigenvalues = torch.linalg.eigvalsh(covariance).clamp_min(1e-9).log()
    mean = pixels.mean(dim=(-2, -1))
    spread = F.adaptive_avg_pool2d(pixels, 8).flatten(2).std(dim=2)
    pixel_statistics = torch.cat([mean, spread, correlations, eigenvalues], dim=1)
    return torch.cat([patches.float().mean(dim=(-2, -1)), pixel_statistics.to(patches.device)], dim=1)


def warn_of_unknown(reasons: Sequence[str | None], stacklevel: int) -> None:
    """Warns once of all touches with a reason, `UNLIKE` or `UNTOUCHED`; `stacklevel` as of `warnings.warn`."""
    rows = [row for row, reason in enumerate(reasons) if reason]
    names = {row: f"`touch[{row}]`" if len(reasons) > 1 else "`touch`" for row in rows}
    listed = "; ".join(f"{names[row]}: {reasons[row]}" for row in rows[:3])
    more = f" and {len(rows) - 3} more" if len(rows) > 3 else ""
    warnings.warn(f"{listed}{more}. The result is a guess.", UnfamiliarInputWarning, stacklevel=stacklevel)
