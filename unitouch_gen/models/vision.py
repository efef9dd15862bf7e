"""transformers' CLIP vision tower behind a stem of convolutions, which learns textures from little data."""

from typing import Any

from torch import Tensor, nn
from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection
from transformers.models.clip.modeling_clip import CLIPVisionEmbeddings

from unitouch_gen.models.vit import PatchProjection, begun_at_the_mean, initialise, residual_stem


class Stem(nn.Sequential):
    """`residual_stem`, where transformers expects one convolution and asks for the dtype of its weight."""

    @property
    def weight(self) -> Tensor:
        return self[-2].weight  # type: ignore[return-value]


class StemmedEmbeddings(CLIPVisionEmbeddings):
    """Patch tokens made by a stem; the class token begins at their mean."""

    def __init__(self, config: CLIPVisionConfig):
        super().__init__(config)
        sizes: tuple[int, ...] = (config.hidden_size, config.num_channels, config.patch_size, config.image_size)  # type: ignore[assignment]
        self.patch_embedding = Stem(*residual_stem(*sizes)).apply(initialise)  # type: ignore[assignment, call-arg]

    def forward(self, pixel_values: Tensor, interpolate_pos_encoding: bool = False) -> Tensor:
        return begun_at_the_mean(super().forward(pixel_values, interpolate_pos_encoding=interpolate_pos_encoding))


class StemmedCLIPVisionModel(CLIPVisionModelWithProjection):
    """`CLIPVisionModelWithProjection` with patches made by residual convolutions (Xiao et al., 2021).

    Args:
        config: With a `patch_size` that is a power of two and divides `image_size`, and perhaps `patch_channels`, as
            `UniTouchViTConfig` has it.
    """

    def __init__(self, config: CLIPVisionConfig):
        super().__init__(config)
        self.vision_model.embeddings = StemmedEmbeddings(config)
        self.patch_projection: PatchProjection | None = None
        if channels := getattr(config, "patch_channels", 0):
            sizes = (config.hidden_size, (config.image_size // config.patch_size) ** 2, channels, config.projection_dim)
            self.patch_projection = PatchProjection(*sizes, config.layer_norm_eps).apply(initialise)

    def forward(self, pixel_values: Tensor, **options: Any) -> Any:
        made: Any = super().forward(pixel_values, **options)
        if self.patch_projection is not None:
            made.image_embeds = made.image_embeds + self.patch_projection(made.last_hidden_state[:, 1:])
        return made
