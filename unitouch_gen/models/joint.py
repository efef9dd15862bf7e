"""`UniTouchModel`: touch, image, text and audio in one space, each modality read from disk when it is first used."""

from collections.abc import Sequence

import torch
from diffusers.utils.accelerate_utils import apply_forward_hook
from torch import Tensor, nn
from transformers import PreTrainedModel

from unitouch_gen.errors import check_choice
from unitouch_gen.models.checks import check_input, check_sensor_ids
from unitouch_gen.models.images import denormalise_pixels, normalise_pixels
from unitouch_gen.models.modalities import MODALITIES
from unitouch_gen.models.on_demand import EncodersOnDemand
from unitouch_gen.models.sensors import SensorMatch


class UniTouchModel(EncodersOnDemand, PreTrainedModel):  # diffusers looks for the latter's name in this module
    """The joint space (Section 3 of the paper).

    Image and text are transformers' CLIP encoders; touch and audio are `UniTouchViT`s, touch with a `SensorBank`. All
    features are (B, D), un-normalised but for audio's, which are means of normalised ones. Inputs are moved to the
    device and dtype of the encoder. There is no `forward`: each `get_..._features` sets off the hooks by which
    `enable_model_cpu_offload` brings a model to its device.

    Args:
        config: Sizes of the four encoders.
        modalities: Which encoders to build now; the others are built when they are first used.

    Raises:
        InvalidInputError: If a modality is unknown.

    Example:
        >>> model = UniTouchModel.from_pretrained("path/to/model", modalities=("touch",))  # doctest: +SKIP
        >>> model.get_touch_features(pixel_values)  # doctest: +SKIP
    """

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
        check_input("pixel_values", pixel_values, (config.num_channels, config.image_height, config.image_width))
        if sensor_ids is None:
            sensor_ids = self.sensor_ids(self.match_sensors(pixel_values))
        else:
            check_sensor_ids(sensor_ids, len(pixel_values), self.sensor_bank.names)
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
        check_input("pixel_values", pixel_values, (self.config.vision_config.num_channels, side, side))
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
        """Audio embeddings (B, D) of log-mel clips (B, clips, 1, mel_bins, frames).

        Those of the clips are normalised and then averaged, as ImageBind does: what clips agree on counts, and not how
        long the embedding of each is.

        Raises:
            InvalidInputError: If the shape does not fit.
        """
        self.load("audio")
        config = self.config.audio_config
        check_input("input_values", input_values, (config.num_channels, config.image_height, config.image_width), 5)
        batch, clips = input_values.shape[:2]
        every_clip = input_values.flatten(0, 1).to(self.audio_model.projection.weight)
        embeds = nn.functional.normalize(self.audio_model(every_clip), dim=-1)
        return embeds.view(batch, clips, -1).mean(dim=1)

    def scaled(self, modality: str, features: Tensor) -> Tensor:
        """Features times the scale of a modality's logits, (B, D): what the published models return.

        They are normalised first but for those of audio, which are means of normalised ones.

        Args:
            modality: That the features are of. A scale of 1 is taken for one that has none.
            features: From `get_..._features`, (B, D).

        Raises:
            InvalidInputError: If the modality is unknown.
        """
        scale = self.config.logit_scales.get(check_choice("modality", modality, MODALITIES), 1.0)
        return scale * (features if modality == "audio" else nn.functional.normalize(features, dim=-1))

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
