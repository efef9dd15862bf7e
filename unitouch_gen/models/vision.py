"""transformers' CLIP vision tower behind a stem of convolutions, which learns textures from little data."""

from torch import Tensor, nn
from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection
from transformers.models.clip.modeling_clip import CLIPVisionEmbeddings

from unitouch_gen.models.vit import begun_at_the_mean, initialise, residual_stem


class Stem(nn.Sequential):
    """`residual_stem`, where transformers expects one convolution."""

    @property
    def weight(self) -> Tensor:
        """Of the last convolution: embeddings ask for its dtype."""
        last = self[-2]
        assert isinstance(last, nn.Conv2d)
        return last.weight


class StemmedEmbeddings(CLIPVisionEmbeddings):
    """Tokens of patches that a stem makes, the class token of which begins at their mean."""

    def __init__(self, config: CLIPVisionConfig):
        super().__init__(config)
        assert isinstance(config.patch_size, int) and isinstance(config.image_size, int)
        stem = Stem(*residual_stem(config.hidden_size, config.num_channels, config.patch_size, config.image_size))
        stem.apply(initialise)
        self.patch_embedding = stem  # type: ignore[assignment]

    def forward(self, pixel_values: Tensor, interpolate_pos_encoding: bool = False) -> Tensor:
        return begun_at_the_mean(super().forward(pixel_values, interpolate_pos_encoding=interpolate_pos_encoding))


class StemmedCLIPVisionModel(CLIPVisionModelWithProjection):
    """`CLIPVisionModelWithProjection` with patches made by residual convolutions (Xiao et al., 2021).

    Args:
        config: With a `patch_size` that is a power of two and divides `image_size`.
    """

    def __init__(self, config: CLIPVisionConfig):
        super().__init__(config)
        self.vision_model.embeddings = StemmedEmbeddings(config)


def vision_model(config: CLIPVisionConfig) -> CLIPVisionModelWithProjection:
    """The image encoder of a config: its `stem` is "residual", or "patch" where it says none."""
    kind = StemmedCLIPVisionModel if getattr(config, "stem", "patch") == "residual" else CLIPVisionModelWithProjection
    return kind(config)
