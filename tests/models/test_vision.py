"""CLIP's vision tower behind convolutions: transformers' own but for its patches, saved and read by anybody."""

from pathlib import Path

import pytest
import torch
from torch import nn
from transformers import CLIPTextConfig, CLIPVisionConfig, CLIPVisionModelWithProjection

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import StemmedCLIPVisionModel, UniTouchConfig, UniTouchModel, UniTouchViTConfig

SIZES = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 2, "image_size": 32,
         "patch_size": 8, "projection_dim": 16}  # fmt: skip
TEXT = {"hidden_size": 16, "intermediate_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2, "vocab_size": 40,
        "max_position_embeddings": 8, "projection_dim": 16}  # fmt: skip
OURS = {"hidden_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2, "image_height": 32, "image_width": 32,
        "patch_size": 8, "patch_stride": 8, "projection_dim": 16}  # fmt: skip


def joint_config(**vision) -> UniTouchConfig:
    return UniTouchConfig(
        vision_config={**SIZES, **vision}, text_config=CLIPTextConfig(**TEXT), projection_dim=16,
        touch_config=UniTouchViTConfig(**OURS), audio_config=UniTouchViTConfig(**{**OURS, "num_channels": 1}),
    )  # fmt: skip


def trained(model: nn.Module) -> nn.Module:
    """With statistics that batch norms would have of some pictures."""
    torch.manual_seed(0)
    model.train()(torch.randn(8, 3, 32, 32))
    return model.eval()


def test_only_the_patches_and_their_mean_differ_from_transformers_own() -> None:
    torch.manual_seed(0)
    model, pixels = trained(StemmedCLIPVisionModel(CLIPVisionConfig(**SIZES))), torch.randn(3, 3, 32, 32)
    reference = CLIPVisionModelWithProjection(CLIPVisionConfig(**SIZES)).eval()
    own = {name: value for name, value in model.state_dict().items() if ".patch_embedding." not in name}
    missing = reference.load_state_dict(own, strict=False).missing_keys
    assert missing == ["vision_model.embeddings.patch_embedding.weight"]
    stem = model.vision_model.embeddings.patch_embedding
    reference.vision_model.embeddings.patch_embedding = stem

    def begun(_module: nn.Module, _input: object, tokens: torch.Tensor) -> torch.Tensor:
        return torch.cat([tokens[:, :1] + tokens[:, 1:].mean(dim=1, keepdim=True), tokens[:, 1:]], dim=1)

    reference.vision_model.embeddings.register_forward_hook(begun)
    assert stem(pixels).shape == (3, 32, 4, 4)
    with torch.no_grad():
        torch.testing.assert_close(model(pixels).image_embeds, reference(pixels).image_embeds, rtol=0, atol=1e-6)


def test_it_is_saved_and_read_as_transformers_models_are(tmp_path: Path) -> None:
    model, pixels = trained(StemmedCLIPVisionModel(CLIPVisionConfig(**SIZES))), torch.randn(2, 3, 32, 32)
    model.save_pretrained(tmp_path)
    found = StemmedCLIPVisionModel.from_pretrained(tmp_path).eval()
    with torch.no_grad():
        torch.testing.assert_close(found(pixels).image_embeds, model(pixels).image_embeds, rtol=0, atol=1e-6)


def test_a_joint_space_is_read_with_its_stem(tmp_path: Path) -> None:
    torch.manual_seed(0)
    model = UniTouchModel(joint_config(stem="residual"))
    assert isinstance(model.vision_model, StemmedCLIPVisionModel)
    trained(model.vision_model)
    model.save_pretrained(tmp_path)
    found, pixels = UniTouchModel.from_pretrained(tmp_path, modalities=("image",)), torch.randn(2, 3, 32, 32)
    with torch.no_grad():
        torch.testing.assert_close(found.get_image_features(pixels), model.eval().get_image_features(pixels))
    assert type(UniTouchModel(joint_config()).vision_model) is CLIPVisionModelWithProjection


@pytest.mark.parametrize(
    ("vision", "message"),
    [
        ({"stem": "relief"}, "`vision_config.stem` is 'relief'"),
        ({"stem": "residual", "patch_size": 12}, "is 12, of pictures"),
        ({"stem": "residual", "image_size": 36}, "pictures of 36"),
    ],
)
def test_a_stem_that_cannot_be_built_is_refused(vision, message) -> None:
    with pytest.raises(InvalidInputError, match=message):
        joint_config(**vision)
