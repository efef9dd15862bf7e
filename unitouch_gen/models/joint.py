"""`UniTouchModel`: touch, image, text and audio in one space, each modality read from disk when it is first used."""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten
from typing import Any, Self

import torch
from diffusers.utils.accelerate_utils import apply_forward_hook
from torch import Tensor, nn
from transformers import CLIPTextModelWithProjection, CLIPVisionModelWithProjection, PreTrainedConfig, PreTrainedModel
from transformers.utils import ModelOutput

from unitouch_gen.errors import (
    InvalidInputError,
    check_arguments,
    check_choice,
    check_choices,
    check_dtype,
    check_kind,
    check_tensor,
    describe,
)
from unitouch_gen.files import (
    LOADING,
    OF_AUTO_CLASSES,
    READ_OPTIONS,
    as_path,
    check_variant,
    local_folder,
    open_weights,
    reading,
    saved_whole,
    shards,
)
from unitouch_gen.models.added_sensors import AddedSensor
from unitouch_gen.models.config import UniTouchConfig
from unitouch_gen.models.images import denormalise_pixels, normalise_pixels
from unitouch_gen.models.out_of_distribution import OutOfDistribution, pixel_statistics, share_of_unseen
from unitouch_gen.models.sensors import SensorBank, SensorMatch
from unitouch_gen.models.vision import vision_model
from unitouch_gen.models.vit import UniTouchViT, initialise

MODALITIES: tuple[str, ...] = ("image", "text", "audio", "touch")

MODULES: dict[str, tuple[str, ...]] = {
    "image": ("vision_model",),
    "text": ("text_model",),
    "audio": ("audio_model",),
    "touch": ("touch_model", "sensor_bank"),
}
"""The sub-modules, and so the key prefixes on disk, of each modality."""

MADE_BY = "Use UniTouchProcessor."

LARGEST_INPUT = 1e4
"""Of pixel values and log-mels, ten at most when normalised; those far beyond become infinite on their way."""

LONGEST_REASON = 300
"""Characters of what torch says, which names every key."""


def modalities_of(keys: Iterable[str]) -> tuple[str, ...]:
    """Modalities whose encoders tensors of these names belong to."""
    modules = {key.partition(".")[0] for key in keys}
    return tuple(modality for modality in MODALITIES if MODULES[modality][0] in modules)


def make_encoder(config: PreTrainedConfig, modality: str) -> nn.Module:
    """The encoder of a modality in a `UniTouchConfig`, with projection: transformers' of image and text, else ours."""
    if modality == "image":
        return vision_model(config.vision_config)
    if modality == "text":
        return CLIPTextModelWithProjection(config.text_config)
    return UniTouchViT(config.audio_config if modality == "audio" else config.touch_config)


@dataclass
class UniTouchModelOutput(ModelOutput):
    """Embeddings of what came, (B, D) each, as `get_..._features` returns them."""

    image_embeds: Tensor | None = None
    text_embeds: Tensor | None = None
    audio_embeds: Tensor | None = None
    touch_embeds: Tensor | None = None


class UniTouchModel(PreTrainedModel):
    """The joint space (Section 3 of the paper).

    Image and text are transformers' CLIP encoders; touch and audio are `UniTouchViT`s, touch with a `SensorBank`. All
    features are (B, D), un-normalised but for audio's, which are means of normalised ones. Inputs are moved to the
    device and dtype of the encoder. Each `get_..._features` sets off the hooks by which `enable_model_cpu_offload`
    brings a model to its device.

    Args:
        config: Sizes of the four encoders.
        modalities: Encoders to build now; those of a model that was read from a folder come when they are first used.

    Raises:
        InvalidInputError: If a modality is unknown.

    Example:
        >>> model = UniTouchModel.from_pretrained("path/to/model", modalities=("touch",))  # doctest: +SKIP
        >>> model.get_touch_features(pixel_values)  # doctest: +SKIP
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
        super().__init__(check_kind("config", config, UniTouchConfig))
        self._source: Path | None = None
        self._variant: str | None = None
        self._lenders: dict[str, Callable[[], nn.Module]] = {}
        self._added: dict[str, AddedSensor] = {}
        self.out_of_distribution = nn.ModuleDict()  # by modality, of which the model stores scores
        self._place = torch.empty(0)  # dtype and device of the weights, those included that are not in memory yet
        for modality in check_choices("modalities", modalities, MODALITIES):
            self.add(modality)

    # Features ---------------------------------------------------------------------------------------------------------

    def forward(
        self,
        pixel_values: Tensor | None = None,
        input_ids: Tensor | None = None,
        attention_mask: Tensor | None = None,
        input_values: Tensor | None = None,
        touch_values: Tensor | None = None,
        sensor_ids: Tensor | None = None,
    ) -> UniTouchModelOutput:
        """Embeddings of all that came, of any modalities: `model(**processor(images=photo, touch=touch))`.

        Args:
            pixel_values, touch_values: Pictures and touch images, (B, 3, S, S).
            input_ids, attention_mask: Texts, (B, T).
            input_values: Sounds, (B, clips, 1, mel_bins, frames).
            sensor_ids: Of the touches; see `get_touch_features`.

        Raises:
            InvalidInputError, InvalidTypeError: If nothing came, or what does not fit.
        """
        made = UniTouchModelOutput(
            image_embeds=None if pixel_values is None else self.get_image_features(pixel_values),
            text_embeds=None if input_ids is None else self.get_text_features(input_ids, attention_mask),
            audio_embeds=None if input_values is None else self.get_audio_features(input_values),
            touch_embeds=None if touch_values is None else self.get_touch_features(touch_values, sensor_ids),
        )
        if not made:
            raise InvalidInputError(f"Nothing came; pass `pixel_values`, `touch_values` or the like. {MADE_BY}")
        return made

    @apply_forward_hook
    def get_touch_features(self, pixel_values: Tensor, sensor_ids: Tensor | None = None) -> Tensor:
        """Touch embeddings f_T(t, s_t) of Eq. 3, (B, D).

        Args:
            pixel_values: From `UniTouchProcessor.touch`, (B, 3, S, S).
            sensor_ids: Index of each image's sensor in the bank, integers (B,) from 0 to K - 1, -1 for one that it does
                not hold, which has no tokens; `None` retrieves them.

        Raises:
            InvalidInputError: If a shape does not fit, an index is out of range, or a sensor has to be retrieved and no
                prototype is stored.
            InvalidTypeError: If `sensor_ids` are no integers.
        """
        touch_model, sensor_bank = self.load("touch")
        config = self.config.touch_config
        shape = (config.num_channels, config.image_height, config.image_width)
        self._check_input("pixel_values", pixel_values, "B", *shape)
        if sensor_ids is None:
            sensor_ids = self.sensor_ids(self.match_sensors(pixel_values))
        else:
            sensor_bank.check_indices("sensor_ids", sensor_ids, len(pixel_values))
        weight = touch_model.projection.weight
        pixels = pixel_values.to(weight)
        if sensor_ids is None:
            return touch_model(pixels)
        ids = sensor_ids.to(weight.device, torch.long)
        features = sensor_bank.encode(touch_model, pixels, sensor_ids)
        for index, encoder in sensor_bank.encoders.items():
            (rows,) = torch.nonzero(ids == index, as_tuple=True)
            if len(rows):
                features = features.index_copy(0, rows, encoder(pixels[rows], sensor_bank(ids[rows])))
        return features

    @apply_forward_hook
    def get_image_features(self, pixel_values: Tensor) -> Tensor:
        """Image embeddings (B, D) of pixel values (B, 3, S, S) from `UniTouchProcessor.images`.

        Raises:
            InvalidInputError: If the shape does not fit.
        """
        (vision_model,) = self.load("image")
        side = self.config.vision_config.image_size
        shape = (self.config.vision_config.num_channels, side, side)
        self._check_input("pixel_values", pixel_values, "B", *shape)
        pixel_values = pixel_values.to(vision_model.visual_projection.weight)
        return vision_model(pixel_values=pixel_values).image_embeds

    @apply_forward_hook
    def get_text_features(self, input_ids: Tensor, attention_mask: Tensor | None = None) -> Tensor:
        """Text embeddings (B, D) of token ids, int64 (B, T), from `UniTouchProcessor.text`.

        The mask is accepted as tokenizers make one; causal attention never looks at what follows the end token.

        Raises:
            InvalidInputError, InvalidTypeError: If they are no ids of this model's vocabulary, or too many.
        """
        (text_model,) = self.load("text")
        config = self.config.text_config
        self._check_input("input_ids", input_ids, "B", "T", integers=True)
        ids = input_ids.long().to(text_model.device)
        low, high = (0, 0) if ids.is_meta else (int(ids.min()), int(ids.max()))
        if ids.shape[1] > config.max_position_embeddings or low < 0 or high >= config.vocab_size:
            raise InvalidInputError(
                f"`input_ids` is {describe(input_ids)} with ids from {low} to {high}; this model takes up to "
                f"{config.max_position_embeddings} from 0 to {config.vocab_size - 1}. {MADE_BY}"
            )
        return text_model(input_ids=ids).text_embeds

    @apply_forward_hook
    def get_audio_features(self, input_values: Tensor) -> Tensor:
        """Audio embeddings (B, D) of log-mel clips (B, clips, 1, mel_bins, frames).

        Those of the clips are normalised and then averaged, as ImageBind does: what clips agree on counts, and not how
        long the embedding of each is.

        Raises:
            InvalidInputError: If the shape does not fit.
        """
        (audio_model,) = self.load("audio")
        config = self.config.audio_config
        shape = (config.num_channels, config.image_height, config.image_width)
        self._check_input("input_values", input_values, "B", "clips", *shape)
        batch, clips = input_values.shape[:2]
        every_clip = input_values.flatten(0, 1).to(audio_model.projection.weight)
        embeds = nn.functional.normalize(audio_model(every_clip), dim=-1)
        return embeds.view(batch, clips, -1).mean(dim=1)

    def scaled(self, modality: str, features: Tensor) -> Tensor:
        """Features times the scale of a modality's logits, (B, D): what the published models return.

        They are normalised first but for those of audio, which are means of normalised ones.

        Args:
            modality: Modality of the features. A scale of 1 is taken for one that has none.
            features: Embeddings from `get_..._features`, (B, D).

        Raises:
            InvalidInputError: If the modality is unknown.
        """
        scale = self.config.logit_scales.get(check_choice("modality", modality, MODALITIES), 1.0)
        check_tensor("features", features, "B", self.config.projection_dim)
        return scale * (features if modality == "audio" else nn.functional.normalize(features, dim=-1))

    @apply_forward_hook
    def ood_features(self, modality: str, features: Tensor, pixel_values: Tensor | None = None) -> Tensor:
        """What out-of-distribution scores are of: unit embeddings, or patches and pixels of touches, (B, F).

        Of patches it is the mean before the first block: embeddings have little left of what they need not tell.

        Args:
            modality: Modality of the features.
            features: Embeddings from `get_..._features`, (B, D).
            pixel_values: Of touches, what they are embeddings of, (B, 3, S, S); see `pixel_statistics`.

        Raises:
            InvalidInputError, InvalidTypeError: If the modality is unknown, or they are no such tensors.
        """
        check_tensor("features", features, "B", self.config.projection_dim)
        if check_choice("modality", modality, MODALITIES) != "touch":
            return nn.functional.normalize(features.float(), dim=1)
        touch_model, _ = self.load("touch")
        config = self.config.touch_config
        shape = (config.num_channels, config.image_height, config.image_width)
        self._check_input("pixel_values", pixel_values, len(features), *shape)
        patches = touch_model.stem(pixel_values.to(touch_model.projection.weight)).float()  # type: ignore[union-attr]
        pixels = pixel_statistics(denormalise_pixels(pixel_values.float()))  # type: ignore[union-attr]
        return torch.cat([patches.mean(dim=(-2, -1)), pixels.to(patches)], dim=1)

    @torch.no_grad()
    def abstains(
        self, modality: str, features: Tensor, pixel_values: Tensor | None = None, input_ids: Tensor | None = None
    ) -> list[str | None]:
        """Why the model abstains from naming each input, such as "unlike anything known"; `None` where it does not.

        An empty list from a model that stores no out-of-distribution scores of this modality.

        Args:
            modality, features, pixel_values: See `ood_features`.
            input_ids: Of texts, what they are embeddings of, (B, T). Without, how many words are new is not counted.

        Raises:
            InvalidInputError, InvalidTypeError: See `ood_features`.
        """
        if check_choice("modality", modality, MODALITIES) not in self.out_of_distribution:
            return []
        scores: Any = self.out_of_distribution[modality]
        unseen = None
        if input_ids is not None and scores.vocabulary is not None:
            self._check_input("input_ids", input_ids, len(features), "T", integers=True)
            unseen = share_of_unseen(scores.vocabulary, input_ids.to(self.device), self.special_tokens)
        return scores.reasons(self.ood_features(modality, features, pixel_values).to(self.device), unseen)

    @property
    def special_tokens(self) -> tuple[int, ...]:
        """Tokens of the text encoder that stand for no word."""
        text = self.config.text_config
        ids = (text.bos_token_id, text.eos_token_id, text.pad_token_id)  # type: ignore[union-attr]
        return tuple(token for token in ids if token is not None)

    def match_sensors(
        self, pixel_values: Tensor, sensor: str | Sequence[str | None] | None = None, *, nearest: bool = False
    ) -> list[SensorMatch]:
        """The sensor of each image: the one named, or the one that is retrieved; see `SensorBank.match`.

        Args:
            pixel_values: From `UniTouchProcessor.touch`, (B, 3, S, S).
            sensor: A name for all, one for each image, or `None` to retrieve.
            nearest: Whether to take the nearest sensor also where an image is hardly of any.

        Raises:
            InvalidInputError: If a name is unknown, or has to be found and no prototype is stored.
        """
        _, sensor_bank = self.load("touch")
        size = self.config.prototype_size
        self._check_input("pixel_values", pixel_values, "B", 3, "S", "S")
        raw = denormalise_pixels(pixel_values.float())
        if len(sensor_bank) and raw.shape[-1] != size:
            raw = nn.functional.interpolate(raw, (size, size), mode="bilinear", antialias=True)
        return sensor_bank.match(raw, sensor, nearest=nearest)

    def recentre(self, pixel_values: Tensor, background: Tensor, matches: Sequence[SensorMatch]) -> Tensor:
        """Touches as the matched sensors would have coloured them: t - background + prototype, (B, 3, S, S).

        Off unless asked for; it helps where an unseen sensor's background differs from every known one.

        Args:
            pixel_values: Touches, (B, 3, S, S).
            background: What their sensor sees on average or untouched, (1 or B, 3, S, S).
            matches: Sensors whose look the touches should take on.

        Raises:
            InvalidInputError, InvalidTypeError: If they are no such tensors, or do not fit each other.
        """
        _, sensor_bank = self.load("touch")
        for name, values in (("pixel_values", pixel_values), ("background", background)):
            self._check_input(name, values, "B", 3, "S", "S")
        if pixel_values.shape[1:] != background.shape[1:] or len(background) not in (1, len(pixel_values)):
            raise InvalidInputError(
                f"`background` is {describe(background)}, `pixel_values` {describe(pixel_values)}; pass one background "
                "for all, or one for each, of their size."
            )
        raw = denormalise_pixels(pixel_values - background) - denormalise_pixels(torch.zeros_like(pixel_values[:1]))
        looks = torch.stack([sensor_bank.prototype(str(match.name)) for match in matches])
        looks = nn.functional.interpolate(looks.to(raw), raw.shape[-2:], mode="bilinear", antialias=True)
        return normalise_pixels((raw + looks).clamp(0.0, 1.0))

    def sensor_ids(self, matches: Sequence[SensorMatch]) -> Tensor | None:
        """Bank indices (B,) of matches, -1 for none of them; `None` for a bank of zero sensors."""
        _, sensor_bank = self.load("touch")
        if not len(sensor_bank):
            return None
        indices = [-1 if match.name is None else sensor_bank.index(match.name) for match in matches]
        return torch.tensor(indices, device=self.device)

    def _check_input(self, name: str, values: Any, *shape: int | str, integers: bool = False) -> None:
        """Refuses what `check_tensor` does; on the meta device nothing has values."""
        if self.device.type != "meta":
            check_tensor(name, values, *shape, integers=integers, hint=MADE_BY)
            if not integers and (largest := float(values.abs().max())) > LARGEST_INPUT:
                raise InvalidInputError(f"`{name}` holds {largest:.1g}; it may be up to {LARGEST_INPUT:g}. {MADE_BY}")

    # Encoders on demand -----------------------------------------------------------------------------------------------

    @property
    def loaded_modalities(self) -> tuple[str, ...]:
        """Modalities whose encoders are in memory."""
        return tuple(modality for modality in MODALITIES if hasattr(self, MODULES[modality][0]))

    @property
    def known_modalities(self) -> tuple[str, ...]:
        """Modalities whose encoders are in memory or can be read."""
        stored = modalities_of(key for keys in self.stored().values() for key in keys)
        known = {*self.loaded_modalities, *self._lenders, *stored}
        return tuple(modality for modality in MODALITIES if modality in known)

    @property
    def source(self) -> Path | None:
        """The folder that modalities are read from, if there is one."""
        return self._source

    def stored(self, prefix: str = "") -> dict[Path, list[str]]:
        """The files of weights in its folder, if it has one, with the keys in each that start with `prefix`."""
        return {} if self._source is None else shards(self._source, prefix, self._variant)

    @property
    def dtype(self) -> torch.dtype:
        """dtype of the weights, also of those that are not in memory yet."""
        return self._place.dtype

    @property
    def device(self) -> torch.device:
        """Device of the weights, also of those that are not in memory yet."""
        return self._place.device

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """What `to`, `half`, `cuda` and the like are made of: modalities read later follow."""
        self._place = fn(self._place)
        return super()._apply(fn, recurse)

    # Added sensors ----------------------------------------------------------------------------------------------------

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors that it knows: those it was trained with, and those that were added."""
        return (*self.config.sensors, *self._added)

    def load_sensor(self, file: str | os.PathLike) -> str:
        """Adds a sensor that `unitouch-gen adapt` has made of touches, and returns its name.

        It replaces one of its name that was added before. Touches of the other sensors are embedded as before. What
        `save_pretrained` writes leaves added sensors out: load them again.

        Args:
            file: That `adapt` wrote.

        Raises:
            InvalidInputError, InvalidTypeError: If it is no such file, is for another touch encoder, or the name is
                that of a sensor that the model was trained with.
        """
        sensor = AddedSensor.read(as_path("file", file))
        with LOADING:
            touch_model, sensor_bank = self.load("touch")
            others = {name: added for name, added in self._added.items() if name != sensor.name}
            bank = sensor.extend(
                sensor_bank.without(sensor.name) if sensor.name in self._added else sensor_bank, touch_model
            )
            self._modules, self._added = {**self._modules, "sensor_bank": bank}, {**others, sensor.name: sensor}
        return sensor.name

    def unload_sensor(self, name: str) -> None:
        """Removes a sensor that `load_sensor` added. Calls that run meanwhile may take others for it.

        Raises:
            InvalidInputError: If no sensor of that name was added.
        """
        if not self._added:
            raise InvalidInputError(f"`name` is {describe(name)}, but no sensor was added; see `load_sensor`.")
        check_choice("name", name, self._added)
        with LOADING:
            _, sensor_bank = self.load("touch")
            self._modules = {**self._modules, "sensor_bank": sensor_bank.without(name)}
            self._added = {key: added for key, added in self._added.items() if key != name}

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

    def load(self, modality: str) -> tuple[Any, ...]:
        """Makes sure a modality's encoder is in memory, and returns its `MODULES`: calls in other threads may free it.

        Raises:
            InvalidInputError: If the modality is unknown, or the encoder was not built and there is no folder to read.
        """
        names = MODULES[check_choice("modality", modality, MODALITIES)]
        found = self._modules  # whoever loads or frees puts another dictionary in its place
        if all(name in found for name in names):
            return tuple(found[name] for name in names)
        with LOADING, torch.inference_mode(False):  # weights that are made inside of it could never be trained
            if modality not in self.loaded_modalities:  # no other thread was faster
                self._read(modality)
            return tuple(self._modules[name] for name in names)

    def add(self, modality: str) -> None:
        """Builds a modality's encoder with fresh random weights, in place of any that is there: the start of training.

        Raises:
            InvalidInputError: If the modality is unknown.
        """
        modules = self._construct(check_choice("modality", modality, MODALITIES))
        if modality in ("audio", "touch"):
            modules[MODULES[modality][0]].apply(initialise)
        self._adopt(modules)

    def release(self, modality: str) -> None:
        """Frees a modality's encoder; it is read again when next used.

        Raises:
            InvalidInputError: If it could not be read again, because the model does not come from a folder.
        """
        if not self.can_read(check_choice("modality", modality, MODALITIES)):
            raise InvalidInputError(
                f"`release({modality!r})` would lose the encoder: this model was not read from a folder."
            )
        with LOADING:
            kept = {name: module for name, module in self._modules.items() if name not in MODULES[modality]}
            self._modules = kept

    def _construct(self, modality: str) -> dict[str, nn.Module]:
        """A modality's `MODULES`, with the weights that their classes begin with."""
        config = self.config
        modules: dict[str, nn.Module] = {MODULES[modality][0]: make_encoder(config, modality)}
        if modality == "touch":
            width = config.touch_config.hidden_size
            modules["sensor_bank"] = SensorBank(
                config.sensors,
                config.sensor_tokens,
                width,
                config.prototype_size,
                config.sensor_reach,
                config.sensor_reaches,
            )
        return modules

    def _adopt(self, modules: Mapping[str, nn.Module]) -> None:
        """Brings new modules to where the others are, and makes them this model's, all at once."""
        for module in modules.values():
            module.train(self.training).to(self.device, self.dtype)
        self._modules = {**self._modules, **modules}
        if "sensor_bank" in modules:
            bank: Any = modules["sensor_bank"]
            for sensor in self._added.values():
                bank = sensor.extend(bank, modules["touch_model"])
            self._modules = {**self._modules, "sensor_bank": bank}

    # Reading and writing ----------------------------------------------------------------------------------------------

    def _read(self, modality: str) -> None:
        """Takes a modality's encoder from where it is."""
        if modality in self._lenders:
            name, encoder = MODULES[modality][0], self._lenders[modality]()
            setattr(self.config, f"{name.removesuffix('_model')}_config", encoder.config)
            return self._adopt({name: encoder})
        if self._source is None:
            raise InvalidInputError(
                f"`modalities` left out {modality!r} when this model was built, and it has no folder to read it from; "
                "build it with that modality or use `from_pretrained`."
            )
        tensors = self._tensors(modality)
        if modality not in modalities_of(tensors):
            raise InvalidInputError(
                f"`{self._source}` holds no {modality} encoder; it has {', '.join(self.known_modalities) or 'none'}. "
                "Save it with that one, or convert the checkpoint that has it into the same folder."
            )
        return self._fill(modality, tensors)

    def _tensors(self, modality: str) -> dict[str, Tensor]:
        """One modality's tensors, and no others, from a folder; of the dtype wanted they stay mapped from it."""
        found = (item for name in MODULES[modality] for item in self._stored_tensors(f"{name}."))
        return {key: tensor.to(self.dtype) if tensor.is_floating_point() else tensor for key, tensor in found}

    def _stored_tensors(self, prefix: str) -> Iterator[tuple[str, Tensor]]:
        """Tensors of its folder whose names start with `prefix`, one at a time."""
        for path, keys in self.stored(prefix).items():
            with open_weights(path) as file:
                for key in keys:
                    yield key, file.get_tensor(key)

    def _read_scores(self) -> None:
        """Reads the out-of-distribution scores of its folder, which are small, of all modalities that have some."""
        for modality, thresholds in self.config.ood_thresholds.items():
            prefix = f"out_of_distribution.{modality}."
            tensors = {key.removeprefix(prefix): tensor for key, tensor in self._stored_tensors(prefix)}
            self.out_of_distribution[modality] = OutOfDistribution.from_tensors(tensors, thresholds)

    def _fill(self, modality: str, tensors: Mapping[str, Tensor]) -> None:
        """Makes a modality's encoder of tensors with their full names; no others are ever in memory."""
        with torch.device("meta"):
            modules = self._construct(modality)
        for name, module in modules.items():
            state = {key.removeprefix(f"{name}."): tensors[key] for key in tensors if key.startswith(f"{name}.")}
            try:
                module.load_state_dict(state, strict=True, assign=True)
            except RuntimeError as error:
                raise InvalidInputError(
                    f"`{self._source}` does not hold the {modality} encoder that its config.json describes: "
                    f"{shorten(str(error).splitlines()[1], LONGEST_REASON, placeholder=' ...')}"
                ) from error
            for part in module.modules():
                positions = getattr(part, "position_ids", None)  # of transformers' embeddings; no file holds them
                if isinstance(positions, Tensor):
                    part.position_ids = torch.arange(positions.shape[-1])[None]
        self._adopt(modules)

    @classmethod
    def from_pretrained(  # type: ignore[override]
        cls,
        pretrained_model_name_or_path: str | os.PathLike,
        *args: Any,
        modalities: Iterable[str] = (),
        dtype: torch.dtype | None = None,
        subfolder: str = "",
        variant: str | None = None,
        config: UniTouchConfig | None = None,
        **kwargs: Any,
    ) -> Self:
        """Reads a model from a folder of safetensors, or from a repository id.

        Args:
            pretrained_model_name_or_path: The folder, or the id of a repository to fetch it from.
            modalities: Read now; all others are read when they are first used.
            dtype: Precision of the weights in memory; float32 when left out.
            subfolder: Place within the folder or repository.
            variant: That of the weights' files, such as "fp16" of `model.fp16.safetensors`.
            config: Sizes, in place of the folder's own.
            kwargs: Those that diffusers' loaders pass; what places or splits weights (`device_map`,
                `low_cpu_mem_usage`, ...) has nothing to do here and is ignored.

        Raises:
            InvalidInputError: If the folder holds no model, or not the one that its config describes.
        """
        check_arguments("from_pretrained", kwargs, {*READ_OPTIONS, *OF_AUTO_CLASSES})
        name, value = ("dtype", dtype) if dtype is not None else ("torch_dtype", kwargs.get("torch_dtype"))
        dtype = torch.float32 if value is None else check_dtype(name, value)
        check_variant(variant)
        wanted = check_choices("modalities", modalities, MODALITIES)
        source = local_folder("pretrained_model_name_or_path", pretrained_model_name_or_path, **kwargs)
        source = source / as_path("subfolder", subfolder)
        with reading("pretrained_model_name_or_path", source):
            if not (source / "config.json").is_file():
                raise InvalidInputError("it holds no config.json; pass the folder that `save_pretrained` wrote.")
            model = cls(config or UniTouchConfig.from_pretrained(source), modalities=())
            model._source, model._variant = source, variant
            model._read_scores()
        model.to(dtype).eval()  # type: ignore[arg-type]
        for modality in wanted:
            model.load(modality)
        return model

    @saved_whole
    def save_pretrained(self, save_directory: str | os.PathLike, *, variant: str | None = None, **kwargs: Any) -> None:
        """Writes config and weights, all or none; modalities that are still on disk are read first, so none is lost.

        Raises:
            InvalidInputError: If the model's folder is no longer there, or holds part of an encoder; or if
                `save_directory` cannot be written to.
        """
        for modality in self.known_modalities:
            self.load(modality)
        state = kwargs.pop("state_dict", None) or self.state_dict()
        if self._added:
            own = len(self.config.sensors)
            state |= {key: value[:own] for key, value in state.items() if key.startswith("sensor_bank.")}
        super().save_pretrained(save_directory, variant=variant, state_dict=state, **kwargs)

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
        """Reads the checkpoints that UniTouch's and ImageBind's authors published; see `convert.unitouch`.

        Args:
            touch: UniTouch's file (`last_new.ckpt`), of which the touch encoder is read. It has no sensor tokens.
            imagebind: ImageBind's (`imagebind_huge.pth`), of which image, text and audio are.
            config: Sizes of encoders other than the published ones, without sensors.
            dtype: Precision of the weights; the files' own when left out.
            told: Gets lines on what was used, ignored and missed.

        Raises:
            InvalidInputError: If neither came, or a file is none of these, lacks tensors, or holds some that are not
                finite.
        """
        from unitouch_gen.convert.unitouch import missed, open_published

        config, tensors, lines = open_published(config, touch, imagebind, dtype)
        model = cls(config, modalities=())
        model.to(next(tensor.dtype for found in tensors.values() for tensor in found.values())).eval()  # type: ignore[arg-type]
        while tensors:  # what a modality is made of is let go when it is read
            modality = next(iter(tensors))
            model._fill(modality, {key: tensor.make() for key, tensor in tensors.pop(modality).items()})
        for line in [*lines, *missed(model.loaded_modalities)]:
            told(line)
        return model
