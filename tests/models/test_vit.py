"""`UniTouchViT` against a transcription onto torch's own attention, and where its tokens enter."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy.ndimage import uniform_filter
from torch import Tensor, nn

from unitouch_gen.models import UniTouchConfig, UniTouchModel, UniTouchViT, UniTouchViTConfig
from unitouch_gen.models.vit import LocalContrast

TINY = {"hidden_size": 32, "num_hidden_layers": 3, "num_attention_heads": 4, "image_height": 24, "image_width": 40,
        "patch_size": 8, "patch_stride": 8, "projection_dim": 12}  # fmt: skip


def random_vit(**changes) -> UniTouchViT:
    torch.manual_seed(0)
    vit = UniTouchViT(UniTouchViTConfig(**{**TINY, **changes})).eval()
    with torch.no_grad():
        for parameter in vit.parameters():
            parameter.copy_(0.3 * torch.randn_like(parameter))
    return vit


def reference(vit: UniTouchViT, config: UniTouchViTConfig, pixels: Tensor, prefix: Tensor | None) -> Tensor:
    """The same network written with `nn.MultiheadAttention(add_bias_kv=True)` and unfolded patches."""
    weights, width = vit.state_dict(), config.hidden_size
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
        attention = (
            nn.MultiheadAttention(width, config.num_attention_heads, add_bias_kv=config.add_bias_kv, batch_first=True)
            .eval()
            .to(pixels.dtype)
        )
        state = {
            "in_proj_weight": weights[f"blocks.{i}.attention.qkv.weight"],
            "in_proj_bias": weights[f"blocks.{i}.attention.qkv.bias"],
            "out_proj.weight": weights[f"blocks.{i}.attention.out.weight"],
            "out_proj.bias": weights[f"blocks.{i}.attention.out.bias"],
        }
        if config.add_bias_kv:
            state |= {key: weights[f"blocks.{i}.attention.{key}"] for key in ("bias_k", "bias_v")}
        attention.load_state_dict(state)
        normed = norm(x, f"blocks.{i}.norm_1")
        x = x + attention(normed, normed, normed, need_weights=False)[0]
        hidden = F.linear(
            norm(x, f"blocks.{i}.norm_2"), weights[f"blocks.{i}.mlp.0.weight"], weights[f"blocks.{i}.mlp.0.bias"]
        )
        x = x + F.linear(F.gelu(hidden), weights[f"blocks.{i}.mlp.2.weight"], weights[f"blocks.{i}.mlp.2.bias"])
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
    ids=["paper", "no bias_kv", "stem norm", "overlapping patches", "one channel", "patches read by place"],
)
@pytest.mark.parametrize("with_prefix", [False, True])
def test_features_equal_those_of_torchs_attention(changes: dict, with_prefix: bool) -> None:
    config, vit = UniTouchViTConfig(**{**TINY, **changes}), random_vit(**changes)
    pixels = torch.randn(2, config.num_channels, 24, 40)
    prefix = torch.randn(2, 5, 32) if with_prefix else None
    torch.testing.assert_close(vit(pixels, prefix), reference(vit, config, pixels, prefix), rtol=1e-5, atol=1e-5)


@torch.no_grad()
def test_prefix_tokens_carry_no_position_and_are_their_own_images() -> None:
    vit, pixels, prefix = random_vit(), torch.randn(2, 3, 24, 40), torch.randn(2, 5, 32)
    before = vit(pixels, prefix)
    shuffled = prefix[:, torch.tensor([3, 1, 4, 0, 2])]
    torch.testing.assert_close(vit(pixels, shuffled), before, rtol=1e-5, atol=1e-5)
    after = vit(pixels, torch.stack([prefix[0], torch.randn(5, 32)]))
    torch.testing.assert_close(after[0], before[0])
    assert not torch.allclose(after[1], before[1], atol=1e-3)


@torch.no_grad()
@pytest.mark.parametrize("stem", ["residual", "relief"])
@pytest.mark.parametrize("patch", [2, 4, 8])
def test_convolutional_stems_make_the_same_grid_as_patches_and_serve_half_precision(patch: int, stem: str) -> None:
    torch.manual_seed(0)
    vit = UniTouchViT(UniTouchViTConfig(**{**TINY, "patch_size": patch, "patch_stride": patch, "stem": stem})).eval()
    pixels = torch.randn(2, 3, 24, 40)
    assert vit.tokens(pixels).shape == (2, 1 + 24 * 40 // patch**2, 32)
    exact, rounded = vit(pixels), vit.bfloat16()(pixels.bfloat16()).float()
    assert exact.shape == (2, 12) and F.cosine_similarity(exact, rounded).min() > 0.97


def test_local_contrast_is_the_same_under_lamps_of_any_strength() -> None:
    torch.manual_seed(0)
    axis = torch.linspace(-1.0, 1.0, 64)
    lamp = 0.3 + 0.2 * axis[None, :] + 0.1 * axis[:, None]
    relief = torch.randn(1, 3, 64, 64)
    once, twice = (LocalContrast(64)(lamp + strength * relief)[:, 3:] for strength in (20.0, 40.0))
    torch.testing.assert_close(once, twice, rtol=0, atol=0.02)
    assert LocalContrast(64)(lamp.expand(1, 3, 64, 64))[0, 3:, 4:-4, 4:-4].abs().max() < 1e-4  # a plane has no detail


def test_local_contrast_is_detail_over_its_deviation() -> None:
    pixels = torch.from_numpy(np.random.default_rng(0).normal(size=(1, 2, 100, 100)).astype(np.float32))
    mean = uniform_filter(uniform_filter(pixels[0].numpy(), (0, 7, 7), mode="nearest"), (0, 7, 7), mode="nearest")
    detail = pixels[0].numpy() - mean
    expected = np.clip(detail / (np.sqrt((detail**2).mean()) + 0.03), -4.0, 4.0)
    torch.testing.assert_close(LocalContrast(100)(pixels)[0, 2:], torch.from_numpy(expected), rtol=0, atol=1e-4)


def test_dropped_branches_keep_their_expectation_and_are_of_training_alone() -> None:
    block = UniTouchViT(UniTouchViTConfig(**{**TINY, "drop_path": 0.5})).blocks[-1].train()
    torch.manual_seed(0)
    branch = block._drop(torch.ones(20_000, 1, 1))
    assert set(branch.unique().tolist()) == {0.0, 2.0}
    assert branch.mean().item() == pytest.approx(1.0, abs=0.03)
    assert torch.equal(block.eval()._drop(torch.ones(9, 1, 1)), torch.ones(9, 1, 1))


def test_every_weight_gets_the_same_gradient_with_checkpointing() -> None:
    vit, pixels, prefix = random_vit().train(), torch.randn(2, 3, 24, 40), torch.randn(2, 3, 32)
    gradients = []
    for vit.gradient_checkpointing in (False, True):
        vit.zero_grad()
        vit(pixels, prefix).square().sum().backward()
        gradients.append([parameter.grad.clone() for parameter in vit.parameters()])
    assert all(one.abs().sum() > 0 for one in gradients[0])
    torch.testing.assert_close(gradients[0], gradients[1])


@torch.no_grad()
def test_half_precision_errs_by_less_than_with_a_rounded_sum() -> None:
    config = UniTouchViTConfig(**{**TINY, "hidden_size": 64, "num_hidden_layers": 24})
    torch.manual_seed(0)
    others = {f"{modality}_config": {"projection_dim": 12} for modality in ("vision", "text", "audio")}
    joint = UniTouchConfig(touch_config=config.to_dict(), projection_dim=12, **others)
    vit = UniTouchModel(joint, modalities=("touch",)).eval().touch_model
    pixels = torch.randn(16, 3, 24, 40)
    expected = reference(vit, config, pixels, None)
    vit.bfloat16()
    rounded = (reference(vit, config, pixels.bfloat16(), None), vit(pixels.bfloat16()))
    errors = [float((found.float() - expected).norm() / expected.norm()) for found in rounded]
    assert errors[1] < 0.7 * errors[0] < 0.02


# The paper's size, by configuration alone -----------------------------------------------------------------------------


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
    found = {name: tuple(tensor.shape) for name, tensor in paper.state_dict().items()}
    for name, shape in {
        "touch_model.position": (1, 257, 1024),
        "touch_model.stem.weight": (1024, 3, 14, 14),
        "touch_model.blocks.23.attention.bias_k": (1, 1, 1024),
        "audio_model.position": (1, 229, 768),
        "audio_model.stem.weight": (768, 1, 16, 16),
        "audio_model.stem_norm.weight": (768,),
        "audio_model.blocks.11.attention.bias_v": (1, 1, 768),
    }.items():
        assert found[name] == shape
