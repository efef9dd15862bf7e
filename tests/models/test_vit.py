"""`UniTouchViT` against a transcription onto torch's own attention, and where its tokens enter."""

from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy.ndimage import uniform_filter
from torch import Tensor, nn
from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection

from unitouch_gen.models import StemmedCLIPVisionModel, UniTouchConfig, UniTouchModel, UniTouchViT, UniTouchViTConfig
from unitouch_gen.models.vit import LocalContrast

TINY = {
    "hidden_size": 32,
    "num_hidden_layers": 3,
    "num_attention_heads": 4,
    "image_height": 24,
    "image_width": 40,
    "patch_size": 8,
    "patch_stride": 8,
    "projection_dim": 12,
}


def reference(vit: UniTouchViT, config: UniTouchViTConfig, pixels: Tensor, prefix: Tensor | None) -> Tensor:
    """The same network written with `nn.MultiheadAttention(add_bias_kv=True)` and unfolded patches."""
    weights = vit.state_dict()
    width = config.hidden_size
    patches = F.unfold(pixels, config.patch_size, stride=config.patch_stride).transpose(1, 2)
    x = patches @ weights["stem.weight"].flatten(1).T
    if config.stem_norm:
        x = F.layer_norm(x, (width,), weights["stem_norm.weight"], weights["stem_norm.bias"], 1e-5)
    batch = len(pixels)
    x = torch.cat([weights["class_token"].expand(batch, -1, -1), x], dim=1) + weights["position"]
    if prefix is not None:
        x = torch.cat([x[:, :1], prefix, x[:, 1:]], dim=1)

    def norm(x: Tensor, key: str) -> Tensor:
        return F.layer_norm(x, (width,), weights[f"{key}.weight"], weights[f"{key}.bias"], config.layer_norm_eps)

    for i in range(config.num_hidden_layers):
        attention = nn.MultiheadAttention(
            width, config.num_attention_heads, add_bias_kv=config.add_bias_kv, batch_first=True, dtype=pixels.dtype
        ).eval()
        place = f"blocks.{i}.attention."
        attention.load_state_dict({key.removeprefix(place): weights[key] for key in weights if key.startswith(place)})
        normed = norm(x, f"blocks.{i}.norm_1")
        x = x + attention(normed, normed, normed, need_weights=False)[0]
        up, down = ([weights[f"blocks.{i}.mlp.{layer}.{part}"] for part in ("weight", "bias")] for layer in (0, 2))
        hidden = F.gelu(F.linear(norm(x, f"blocks.{i}.norm_2"), *up))
        x = x + F.linear(hidden, *down)
    embeds = norm(x, "norm")[:, 0] @ weights["projection.weight"].T
    if config.patch_channels:
        last = norm(x[:, -len(vit.position[0]) + 1 :], "patch_projection.norm")
        reduced = F.linear(last, weights["patch_projection.reduce.weight"], weights["patch_projection.reduce.bias"])
        embeds = embeds + F.gelu(reduced).flatten(1) @ weights["patch_projection.project.weight"].T
    return embeds


@torch.no_grad()
@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"add_bias_kv": False},
        {"stem_norm": True},
        {"patch_stride": 4},
        {"num_channels": 1, "mlp_ratio": 2.0},
        {"patch_channels": 6},
    ],
)
def test_features_equal_those_of_torchs_attention(changes: dict) -> None:
    torch.manual_seed(0)
    config = UniTouchViTConfig(**{**TINY, **changes})
    vit = UniTouchViT(config).eval()
    for parameter in vit.parameters():
        parameter.copy_(0.3 * torch.randn_like(parameter))
    pixels = torch.randn(2, config.num_channels, 24, 40)
    for prefix in (None, torch.randn(2, 5, 32)):
        torch.testing.assert_close(vit(pixels, prefix), reference(vit, config, pixels, prefix), rtol=1e-5, atol=1e-5)


@torch.no_grad()
@pytest.mark.parametrize("stem", ["residual", "relief"])
def test_convolutional_stems_make_the_same_grid_as_patches_and_serve_half_precision(stem: str) -> None:
    for patch in (2, 4, 8):
        torch.manual_seed(0)
        changes = {"patch_size": patch, "patch_stride": patch, "stem": stem}
        vit = UniTouchViT(UniTouchViTConfig(**TINY | changes)).eval()
        pixels = torch.randn(2, 3, 24, 40)
        assert vit.tokens(vit.stem(pixels)).shape == (2, 1 + 24 * 40 // patch**2, 32)
        exact = vit(pixels)
        rounded = vit.bfloat16()(pixels.bfloat16()).float()
        assert exact.shape == (2, 12)
        assert F.cosine_similarity(exact, rounded).min() > 0.97


def test_local_contrast_is_detail_over_its_deviation() -> None:
    pixels = torch.from_numpy(np.random.default_rng(0).normal(size=(1, 2, 100, 100)).astype(np.float32))
    mean = uniform_filter(uniform_filter(pixels[0].numpy(), (0, 7, 7), mode="nearest"), (0, 7, 7), mode="nearest")
    detail = pixels[0].numpy() - mean
    expected = np.clip(detail / (np.sqrt((detail**2).mean()) + 0.03), -4.0, 4.0)
    torch.testing.assert_close(LocalContrast(100)(pixels)[0, 2:], torch.from_numpy(expected), rtol=0, atol=1e-4)


@torch.no_grad()
def test_half_precision_errs_by_less_than_with_a_rounded_sum() -> None:
    config = UniTouchViTConfig(**{**TINY, "hidden_size": 64, "num_hidden_layers": 24})
    torch.manual_seed(0)
    joint = UniTouchConfig(touch_config=config.to_dict(), projection_dim=12)
    vit = UniTouchModel(joint, modalities=("touch",)).eval().touch_model
    pixels = torch.randn(16, 3, 24, 40)
    expected = reference(vit, config, pixels, None)
    vit.bfloat16()
    rounded = (reference(vit, config, pixels.bfloat16(), None), vit(pixels.bfloat16()))
    errors = [float((found.float() - expected).norm() / expected.norm()) for found in rounded]
    assert errors[1] < 0.7 * errors[0] < 0.02


def test_the_default_encoders_have_the_published_sizes_and_shapes() -> None:
    with torch.device("meta"):
        paper = UniTouchModel(UniTouchConfig(sensors=["gelsight", "digit", "taxim"])).eval()
        audio = paper.get_audio_features(torch.empty(2, 3, 1, 128, 204))
        touch = paper.touch_model(torch.empty(2, 3, 224, 224), torch.empty(2, 5, 1024))
    assert audio.shape == touch.shape == (2, 1024)

    def millions(module: nn.Module) -> float:
        return sum(parameter.numel() for parameter in module.parameters()) / 1e6

    # The published stems are 3-D over two frames, twice the 2-D kernel; its text count leaves the projection out.
    assert millions(paper.touch_model) + 1024 * 3 * 14 * 14 / 1e6 == pytest.approx(304.9, abs=0.05)
    assert millions(paper.vision_model) + 1280 * 3 * 14 * 14 / 1e6 == pytest.approx(632.8, abs=0.05)
    assert millions(paper.text_model) - 1024 * 1024 / 1e6 == pytest.approx(353.0, abs=0.05)
    assert millions(paper.audio_model) == pytest.approx(86.2, abs=0.05)
    assert paper.sensor_bank.tokens.shape == (3, 5, 1024)


SIZES = {
    "hidden_size": 32,
    "intermediate_size": 64,
    "num_hidden_layers": 2,
    "num_attention_heads": 2,
    "image_size": 32,
    "patch_size": 8,
    "projection_dim": 16,
}


def trained(model: torch.nn.Module) -> torch.nn.Module:
    """With statistics that batch norms would have of some pictures."""
    torch.manual_seed(0)
    model.train()(torch.randn(8, 3, 32, 32))
    return model.eval()


@torch.no_grad()
def test_only_the_patches_and_their_mean_differ_from_transformers_own() -> None:
    model = trained(StemmedCLIPVisionModel(CLIPVisionConfig(**SIZES)))
    pixels = torch.randn(3, 3, 32, 32)
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
def test_a_stemmed_vision_model_is_saved_alone_and_in_a_joint_space(config: UniTouchConfig, tmp_path: Path) -> None:
    parts = {f"{name}_config": getattr(config, f"{name}_config") for name in ("text", "touch", "audio")}
    model = UniTouchModel(UniTouchConfig(vision_config={**SIZES, "stem": "residual"}, projection_dim=16, **parts))
    pixels = torch.randn(2, 3, 32, 32)
    encoder = trained(model.vision_model)
    expected = encoder(pixels).image_embeds
    encoder.save_pretrained(tmp_path / "alone")
    model.save_pretrained(tmp_path / "joint")
    alone = StemmedCLIPVisionModel.from_pretrained(tmp_path / "alone").eval()
    torch.testing.assert_close(alone(pixels).image_embeds, expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(UniTouchModel.from_pretrained(tmp_path / "joint").get_image_features(pixels), expected)
