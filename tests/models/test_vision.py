"""CLIP's vision tower behind convolutions: transformers' own but for its patches, saved and read by anybody."""

from pathlib import Path

import torch
from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection

from unitouch_gen.models import StemmedCLIPVisionModel, UniTouchConfig, UniTouchModel

SIZES = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 2, "image_size": 32,
         "patch_size": 8, "projection_dim": 16}  # fmt: skip


def trained(model: torch.nn.Module) -> torch.nn.Module:
    """With statistics that batch norms would have of some pictures."""
    torch.manual_seed(0)
    model.train()(torch.randn(8, 3, 32, 32))
    return model.eval()


@torch.no_grad()
def test_only_the_patches_and_their_mean_differ_from_transformers_own() -> None:
    model, pixels = trained(StemmedCLIPVisionModel(CLIPVisionConfig(**SIZES))), torch.randn(3, 3, 32, 32)
    reference = CLIPVisionModelWithProjection(CLIPVisionConfig(**SIZES)).eval()
    own = {name: value for name, value in model.state_dict().items() if ".patch_embedding." not in name}
    missing = reference.load_state_dict(own, strict=False).missing_keys
    assert missing == ["vision_model.embeddings.patch_embedding.weight"]
    stem = model.vision_model.embeddings.patch_embedding
    reference.vision_model.embeddings.patch_embedding = stem

    def begun(_module: torch.nn.Module, _input: object, tokens: torch.Tensor) -> torch.Tensor:
        return torch.cat([tokens[:, :1] + tokens[:, 1:].mean(dim=1, keepdim=True), tokens[:, 1:]], dim=1)

    reference.vision_model.embeddings.register_forward_hook(begun)
    assert stem(pixels).shape == (3, 32, 4, 4)
    torch.testing.assert_close(model(pixels).image_embeds, reference(pixels).image_embeds, rtol=0, atol=1e-6)


@torch.no_grad()
def test_it_is_saved_and_read_alone_and_in_a_joint_space(config: UniTouchConfig, tmp_path: Path) -> None:
    parts = {f"{name}_config": getattr(config, f"{name}_config") for name in ("text", "touch", "audio")}
    model = UniTouchModel(UniTouchConfig(vision_config={**SIZES, "stem": "residual"}, projection_dim=16, **parts))
    pixels, encoder = torch.randn(2, 3, 32, 32), trained(model.vision_model)
    expected = encoder(pixels).image_embeds
    encoder.save_pretrained(tmp_path / "alone")
    model.save_pretrained(tmp_path / "joint")
    alone = StemmedCLIPVisionModel.from_pretrained(tmp_path / "alone").eval()
    torch.testing.assert_close(alone(pixels).image_embeds, expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(UniTouchModel.from_pretrained(tmp_path / "joint").get_image_features(pixels), expected)
