"""Configurations of the joint space; the defaults are the paper's sizes.

A value of a wrong type raises `InvalidTypeError`. A value out of range, or one that does not fit the others, raises
`InvalidInputError`.
"""

from collections.abc import Iterable
from dataclasses import field
from types import NoneType
from typing import Any

from huggingface_hub.errors import StrictDataclassError
from transformers import CLIPTextConfig, CLIPVisionConfig, PreTrainedConfig
from transformers.configuration_utils import SubConfigSpec

from unitouch_gen.errors import (
    InvalidInputError,
    check_choice,
    check_integer,
    check_kind,
    check_multiple,
    check_number,
    check_texts,
    did_you_mean,
)
from unitouch_gen.saving import saved_whole


def check_halved(patch_size: int, *lengths: int) -> None:
    """Raises if a stem of convolutions cannot halve images of these sides down to patches."""
    if patch_size & (patch_size - 1) or any(length % patch_size for length in lengths):
        raise InvalidInputError(
            f"`patch_size` is {patch_size}; with a stem of convolutions it has to be a power of two that divides "
            "height, width and stride."
        )


def check_spelling(kind: type, names: Iterable[str]) -> None:
    """Raises for a misspelt field. transformers would keep it as an attribute that nothing reads."""
    for name in names:
        hint = did_you_mean(name, kind.__dataclass_fields__)  # type: ignore[attr-defined]
        if hint and not hasattr(kind, name):
            raise InvalidInputError(f"`{name}` is no setting of {kind.__name__}. {hint}")


class UniTouchViTConfig(PreTrainedConfig):
    """The transformer that touch and audio share (Section 4.1 of the paper: 24 blocks, 16 heads, width 1024).

    Args:
        hidden_size, num_hidden_layers, num_attention_heads, mlp_ratio: Size of the transformer.
        image_height, image_width, num_channels: Shape of the input.
        patch_size, patch_stride: Side and distance of the patches, pixels; a stride below the size overlaps them.
        stem: "patch" for one projection (ViT); "residual" for stride-2 and residual convolutions down to `patch_size`
            on the image and its local contrast (Xiao et al., 2021), which learn faster on small data; "relief" for
            these on a touch and the relief behind it (`models.relief`), which sensors share.
        stem_norm: LayerNorm after the stem (eps 1e-5), as in ImageBind's audio trunk.
        add_bias_kv: One learned key and value appended to every sequence.
        layer_norm_eps: epsilon of all other norms.
        projection_dim: Width D of the joint space.
        patch_channels: Channels per patch of a position-wise head that is added to the class embedding; 0 for none
            (ViT).
        texture_width: Hidden units of the texture head (`models.texture`) that is added to the embedding; 0 for none
            (ViT).
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
    projection_dim: int = 1024
    patch_channels: int = 0
    texture_width: int = 0

    def __post_init__(self, **kwargs: Any) -> None:
        check_spelling(UniTouchViTConfig, kwargs)
        super().__post_init__(**kwargs)
        for name in ("hidden_size", "num_hidden_layers", "num_attention_heads", "projection_dim"):
            check_integer(name, getattr(self, name), 1)
        for name in ("num_channels", "patch_size", "patch_stride"):
            check_integer(name, getattr(self, name), 1)
        for name in ("image_height", "image_width"):
            check_integer(name, getattr(self, name), self.patch_size)
        for name in ("patch_channels", "texture_width"):
            check_integer(name, getattr(self, name), 0)
        check_number("mlp_ratio", self.mlp_ratio, 1e-3)
        check_number("layer_norm_eps", self.layer_norm_eps, 0.0)
        heads = self.num_attention_heads
        check_multiple("hidden_size", self.hidden_size, heads, of=f"`num_attention_heads`, which is {heads}")
        if check_choice("stem", self.stem, ("patch", "residual", "relief")) != "patch":
            check_halved(self.patch_size, self.image_height, self.image_width, self.patch_stride)

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of patch tokens."""
        rows = (self.image_height - self.patch_size) // self.patch_stride + 1
        columns = (self.image_width - self.patch_size) // self.patch_stride + 1
        return rows, columns


# Sizes of ImageBind's encoders, which the paper builds on.
VISION = {
    "hidden_size": 1280,
    "intermediate_size": 5120,
    "num_hidden_layers": 32,
    "num_attention_heads": 16,
    "patch_size": 14,
    "projection_dim": 1024,
    "hidden_act": "gelu",
    "layer_norm_eps": 1e-6,
}
TEXT = {
    "hidden_size": 1024,
    "intermediate_size": 4096,
    "num_hidden_layers": 24,
    "num_attention_heads": 16,
    "projection_dim": 1024,
    "hidden_act": "gelu",
    "layer_norm_eps": 1e-6,
}
AUDIO = {
    "hidden_size": 768,
    "num_hidden_layers": 12,
    "num_attention_heads": 12,
    "image_height": 128,
    "image_width": 204,
    "num_channels": 1,
    "patch_size": 16,
    "patch_stride": 10,
    "stem_norm": True,
}


class UniTouchConfig(PreTrainedConfig):
    """The joint space of touch, image, text and audio.

    Args:
        vision_config, text_config: transformers' CLIP configurations. The first may have a `stem`, "patch" or
            "residual". With the latter it may have `patch_channels` and `texture_width`, as in `UniTouchViTConfig`.
        touch_config, audio_config: Each a `UniTouchViTConfig`. Encoders without a configuration have the paper's sizes.
        projection_dim: Width D of the joint space (paper: 1024); all four encoders project to it.
        sensors: Names of the K sensors that have tokens (paper: 3); may be empty.
        sensor_tokens: L, tokens for each sensor (paper: 5).
        prototype_size: Side of the raw touch images whose mean is a sensor's prototype, pixels.
        sensor_reaches: Distance from each sensor's prototype within which its own touches lie, by name; see
            `SensorBank`.
        temperature: tau of Eq. 1 (paper: 0.07).
        ood_thresholds: `{"touch": {"foreign": ...}}`, the `RelativeDistance` above which a touch is unknown.
        embedding_norm: Mean L2 norm of the space's image embeddings; conditioning scales every modality to it.
    """

    model_type = "unitouch"
    save_pretrained = saved_whole(PreTrainedConfig.save_pretrained)
    sub_configs_defaults = {
        "vision_config": SubConfigSpec(CLIPVisionConfig, init_kwargs=VISION),
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
    sensor_reaches: dict[str, float] = field(default_factory=dict)
    temperature: float | int = 0.07
    ood_thresholds: dict[str, dict[str, float]] = field(default_factory=dict)
    embedding_norm: float | int = 1.0

    def __post_init__(self, **kwargs: Any) -> None:
        kwargs.pop("auto_map", None)  # belongs to the folder
        check_spelling(UniTouchConfig, kwargs)
        for name in self.sub_configs_defaults:
            check_kind(name, getattr(self, name), dict, PreTrainedConfig, NoneType)
        check_integer("projection_dim", self.projection_dim, 1)
        for name, spec in self.sub_configs_defaults.items():
            if getattr(self, name) is None:  # such as of a modality that was added after the space was saved
                setattr(self, name, {**spec.init_kwargs, "projection_dim": self.projection_dim})
        try:
            super().__post_init__(**kwargs)
        except StrictDataclassError as error:  # from CLIP's configurations; it is no `ValueError`
            raise InvalidInputError(f"`vision_config` or `text_config`: {error.__cause__}") from error
        for name in ("sensor_tokens", "prototype_size"):
            check_integer(name, getattr(self, name), 1)
        for name in ("temperature", "embedding_norm"):
            check_number(name, getattr(self, name), 1e-30)
        for name in self.sub_configs_defaults:
            width = getattr(self, name).projection_dim
            check_integer(f"{name}.projection_dim", width, self.projection_dim, self.projection_dim)
        vision: Any = self.vision_config
        stem = check_choice("vision_config.stem", getattr(vision, "stem", "patch"), ("patch", "residual"))
        if stem == "residual":
            check_halved(vision.patch_size, vision.image_size)
        self.sensors = check_texts("sensors", self.sensors, repeated=False) if self.sensors else []
        for name, reach in check_kind("sensor_reaches", self.sensor_reaches, dict).items():
            check_number(f"sensor_reaches[{name!r}]", reach, 0.0)
