"""Configurations of the joint space. The defaults are the paper's size."""

import re
import sys
from collections.abc import Callable
from dataclasses import field
from functools import wraps
from typing import Any, TypeVar

from huggingface_hub.dataclasses import strict
from huggingface_hub.errors import StrictDataclassError
from transformers import CLIPTextConfig, CLIPVisionConfig, PreTrainedConfig
from transformers.activations import ACT2FN
from transformers.configuration_utils import SubConfigSpec

from unitouch_gen.errors import (
    InvalidInputError,
    InvalidTypeError,
    check_choice,
    check_integer,
    check_number,
    first_line,
    shortened,
)
from unitouch_gen.files import LARGEST_SIZE, MOST_LAYERS, saved_whole
from unitouch_gen.models.out_of_distribution import SCORES
from unitouch_gen.models.sensors import REACH

EXPONENTS = (0.0, 3.0)
"""Between which `UniTouchConfig.temperature_exponents` lie."""

Config = TypeVar("Config", bound=type)


def validated(cls: Config) -> Config:
    """huggingface's `strict`, but a bad value raises our errors: `StrictDataclassError` is no `ValueError`."""
    strict(cls)  # changes the class in place
    for name in ("__init__", "__setattr__", "validate"):
        setattr(cls, name, _with_our_errors(getattr(cls, name)))
    return cls


def _with_our_errors(method: Callable) -> Callable:
    @wraps(method)
    def call(*args: Any, **kwargs: Any) -> Any:
        try:
            return method(*args, **kwargs)
        except StrictDataclassError as error:
            # The cause is an error of our own validators, or one about a field's type: "Field 'x' expected int, ...".
            said = [" ".join(str(one).split()) for one in (error.__cause__ or error, error)]
            worded = [re.sub(r"(?:[Ff]ield|dict) '(\w+)'", r"`\1`", one) for one in said]
            unnamed = f"`{type(args[0]).__name__}`: {worded[0]}"
            raise InvalidInputError(shortened(next((one for one in worded if "`" in one), unnamed))) from error
        except ZeroDivisionError as error:  # transformers looks at it when it has divided by it
            raise InvalidInputError("`num_attention_heads` is 0; it has to be at least 1.") from error
        except InvalidTypeError:
            raise
        except (TypeError, NotImplementedError) as error:  # keys that are no words, tensors that cannot be printed
            named = ", ".join(f"`{key}`" for key in (*kwargs, *args[1:2]))  # those of `__init__`, or of `__setattr__`
            raise InvalidInputError(f"{named}: a value cannot be used: {first_line(error)}.") from error

    return call


@validated
class UniTouchViTConfig(PreTrainedConfig):
    """The transformer that touch and audio share (Section 4.1 of the paper: 24 blocks, 16 heads, width 1024).

    Args:
        hidden_size, num_hidden_layers, num_attention_heads, mlp_ratio: Size of the transformer.
        image_height, image_width, num_channels: Shape of the input.
        patch_size, patch_stride: Side and distance of the patches, pixels; a stride below the size overlaps them.
        stem: "patch" for one projection (ViT), or "residual" for stride-2 and residual convolutions down to
            `patch_size` on the image and its local contrast (Xiao et al., 2021), which learn faster on small data;
            "relief" is the last on a touch and the relief behind it (`models.relief`), which sensors share.
        stem_norm: LayerNorm after the stem (eps 1e-5), as the audio trunk of ImageBind has.
        add_bias_kv: One learned key and value appended to every sequence.
        layer_norm_eps: Epsilon of all other norms.
        drop_path: Probability of skipping a block's branch in training, for the last block; earlier ones less.
        projection_dim: Width D of the joint space.

    Raises:
        InvalidInputError: If a value is of a wrong type or out of range, or no network can be built from them together.
    """

    model_type = "unitouch_vit"

    hidden_size: int = 1024
    num_hidden_layers: int = 24
    num_attention_heads: int = 16
    mlp_ratio: float | int = 4.0
    image_height: int = 224
    image_width: int = 224
    num_channels: int = 3
    patch_size: int = 14
    patch_stride: int = 14
    stem: str = "patch"
    stem_norm: bool = False
    add_bias_kv: bool = True
    layer_norm_eps: float = 1e-6
    drop_path: float | int = 0.0
    projection_dim: int = 1024

    def validate_architecture(self):
        """Part of `@strict`-powered validation."""
        for name in ("hidden_size", "num_hidden_layers", "num_attention_heads", "image_height", "image_width",
                     "num_channels", "patch_size", "patch_stride", "projection_dim"):  # fmt: skip
            check_integer(name, getattr(self, name), 1, MOST_LAYERS if "layers" in name else LARGEST_SIZE)
        check_number("mlp_ratio", self.mlp_ratio, 1 / self.hidden_size, LARGEST_SIZE)
        check_number("layer_norm_eps", self.layer_norm_eps, 0.0)
        check_number("drop_path", self.drop_path, 0.0, 0.999)
        check_choice("stem", self.stem, ("patch", "residual", "relief"))
        if min(self.image_height, self.image_width) < self.patch_size:
            raise InvalidInputError(
                f"`image_height` is {self.image_height} and `image_width` {self.image_width}; neither may be below "
                f"`patch_size` ({self.patch_size})."
            )
        if self.hidden_size % self.num_attention_heads:
            raise InvalidInputError(
                f"`hidden_size` is {self.hidden_size}; it has to be a multiple of `num_attention_heads` "
                f"({self.num_attention_heads})."
            )
        if self.stem != "patch" and (self.patch_size & (self.patch_size - 1) or self.patch_size != self.patch_stride):
            raise InvalidInputError(
                f"`patch_size` is {self.patch_size} and `patch_stride` {self.patch_stride}; the {self.stem!r} stem "
                "halves the image a whole number of times, so they have to be the same power of two."
            )
        if self.stem != "patch" and (self.image_height % self.patch_size or self.image_width % self.patch_size):
            raise InvalidInputError(
                f"`image_height` is {self.image_height} and `image_width` {self.image_width}; the {self.stem!r} stem "
                f"needs multiples of `patch_size` ({self.patch_size})."
            )

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of patch tokens."""
        rows = (self.image_height - self.patch_size) // self.patch_stride + 1
        return rows, (self.image_width - self.patch_size) // self.patch_stride + 1


# ImageBind's, which the paper builds on.
VISION = {"hidden_size": 1280, "intermediate_size": 5120, "num_hidden_layers": 32, "num_attention_heads": 16,
          "patch_size": 14, "projection_dim": 1024, "hidden_act": "gelu", "layer_norm_eps": 1e-6}  # fmt: skip
TEXT = {"hidden_size": 1024, "intermediate_size": 4096, "num_hidden_layers": 24, "num_attention_heads": 16,
        "projection_dim": 1024, "hidden_act": "gelu", "layer_norm_eps": 1e-6}  # fmt: skip
AUDIO = {"hidden_size": 768, "num_hidden_layers": 12, "num_attention_heads": 12, "image_height": 128,
         "image_width": 204, "num_channels": 1, "patch_size": 16, "patch_stride": 10, "stem_norm": True}  # fmt: skip

CLIP_SIZES = ("hidden_size", "intermediate_size", "num_hidden_layers", "num_attention_heads", "image_size",
              "patch_size", "num_channels", "vocab_size", "max_position_embeddings", "projection_dim")  # fmt: skip
"""Settings of transformers' CLIP, which it leaves to those who build the networks to look at."""


@validated
class VisionConfig(CLIPVisionConfig):
    """transformers' configuration of CLIP's vision tower, and a stem.

    Args:
        stem: "patch" for CLIP's own projection, or "residual" as in `UniTouchViTConfig`, which learns textures sooner.
        **kwargs: Those of `CLIPVisionConfig`.

    Raises:
        InvalidInputError: If the stem is unknown, or cannot be built for these patches.
    """

    stem: str = "patch"

    def validate_architecture(self):
        """Part of `@strict`-powered validation."""
        check_choice("vision_config.stem", self.stem, ("patch", "residual"))
        size: Any = self
        if self.stem == "residual" and (size.patch_size & (size.patch_size - 1) or size.image_size % size.patch_size):
            raise InvalidInputError(
                f"`vision_config.patch_size` is {size.patch_size}, of pictures of {size.image_size}; the 'residual' "
                "stem halves them a whole number of times, so it has to be a power of two that divides their side."
            )
        super().validate_architecture()


@validated
class UniTouchConfig(PreTrainedConfig):
    """The joint space of touch, image, text and audio.

    Args:
        vision_config: transformers' CLIP configuration, or a `VisionConfig`.
        text_config: transformers' CLIP configuration.
        touch_config, audio_config: Each a `UniTouchViTConfig`.
        projection_dim: Width D of the joint space (paper: 1024); all four encoders project to it.
        sensors: Names of the K sensors that have tokens (paper: 3); may be empty.
        sensor_tokens: L, tokens for each sensor (paper: 5).
        prototype_size: Side of the raw touch images whose mean is a sensor's prototype, pixels.
        sensor_reach: Mean absolute difference to a sensor's prototype, in units of full scale, beyond which a touch is
            called unfamiliar; see `sensors.REACH`.
        sensor_reaches: How far each sensor's own touches lie from its prototype, by name; see `SensorBank`.
        temperature: tau of Eq. 1 (paper: 0.07).
        temperatures: Of zero-shot classification, by modality, as fitted to validation samples (Guo et al., 2017);
            `temperature` where there is none, whose probabilities are not calibrated. "touch by pictures" is that of
            touches that are named by a bank of image embeddings.
        temperature_exponents: By the names of `temperatures`, how much they fall where scores of classes lie apart, see
            `evaluation.zero_shot.calibrated_probabilities`; 0 where there is none.
        ood_thresholds: By modality and score, above which the model abstains; see `OutOfDistribution`.
        embedding_norm: Mean L2 norm of the space's image embeddings; conditioning brings every modality to it.
        logit_scales: By modality, what normalised features are multiplied by; see `UniTouchModel.scaled`.

    Raises:
        InvalidInputError: If a value is of a wrong type or out of range, or the modalities differ in their width.
    """

    model_type = "unitouch"
    save_pretrained = saved_whole(PreTrainedConfig.save_pretrained)
    sub_configs_defaults = {
        "vision_config": SubConfigSpec(VisionConfig, init_kwargs=VISION),
        "text_config": SubConfigSpec(CLIPTextConfig, init_kwargs=TEXT),
        "touch_config": SubConfigSpec(UniTouchViTConfig),
        "audio_config": SubConfigSpec(UniTouchViTConfig, init_kwargs=AUDIO),
    }

    vision_config: dict | PreTrainedConfig | None = None
    text_config: dict | PreTrainedConfig | None = None
    touch_config: dict | PreTrainedConfig | None = None
    audio_config: dict | PreTrainedConfig | None = None
    projection_dim: int = 1024
    sensors: list[str] | tuple[str, ...] = ()
    sensor_tokens: int = 5
    prototype_size: int = 224
    sensor_reach: float | int = REACH
    sensor_reaches: dict[str, float] = field(default_factory=dict)
    temperature: float | int = 0.07
    temperatures: dict[str, float] = field(default_factory=dict)
    temperature_exponents: dict[str, float] = field(default_factory=dict)
    ood_thresholds: dict[str, dict[str, float]] = field(default_factory=dict)
    embedding_norm: float | int = 1.0
    logit_scales: dict[str, float] = field(default_factory=dict)

    def __post_init__(self, **kwargs):
        kwargs.pop("auto_map", None)  # is the folder's
        super().__post_init__(**kwargs)
        self.sensors = list(self.sensors)

    def validate_architecture(self):
        """Part of `@strict`-powered validation."""
        for name in ("projection_dim", "sensor_tokens", "prototype_size"):
            check_integer(name, getattr(self, name), 1, LARGEST_SIZE)
        check_number("sensor_reach", self.sensor_reach, 0.0)
        for name in ("temperature", "embedding_norm"):
            check_number(name, getattr(self, name), sys.float_info.min, hint="It has to be above 0.")
        for name in ("temperatures", "sensor_reaches"):
            for key, value in getattr(self, name).items():
                check_number(f"{name}.{key}", value, sys.float_info.min, hint="It has to be above 0.")
        for key, value in self.temperature_exponents.items():
            check_number(f"temperature_exponents.{key}", value, *EXPONENTS)
        for modality, thresholds in self.ood_thresholds.items():
            check_choice("ood_thresholds", modality, ("image", "text", "audio", "touch"))
            for score, value in thresholds.items():
                check_choice(f"ood_thresholds.{modality}", score, SCORES)
                check_number(f"ood_thresholds.{modality}.{score}", value)
        for name in ("vision", "text", "touch", "audio"):
            config = getattr(self, f"{name}_config")
            for key in CLIP_SIZES if name in ("vision", "text") else ():
                size = getattr(config, key, 1)
                check_integer(f"{name}_config.{key}", size, 1, MOST_LAYERS if "layers" in key else LARGEST_SIZE)
            if name == "text":
                check_integer("text_config.eos_token_id", config.eos_token_id, 0, LARGEST_SIZE)
            if name in ("vision", "text"):
                check_choice(f"{name}_config.hidden_act", config.hidden_act, ACT2FN)
            width = config.projection_dim
            if width != self.projection_dim:
                raise InvalidInputError(
                    f"`{name}_config.projection_dim` is {width}; the joint space's `projection_dim` is "
                    f"{self.projection_dim}, and all modalities have to share it."
                )
        side: Any = self.vision_config
        check_integer("vision_config.patch_size", side.patch_size, 1, side.image_size)
        for modality, scale in self.logit_scales.items():
            check_number(f"logit_scales.{modality}", scale)
        if len(set(self.sensors)) != len(self.sensors):
            raise InvalidInputError(f"`sensors` is {self.sensors}; the names have to differ.")
