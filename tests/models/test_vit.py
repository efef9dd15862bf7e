"""`UniTouchViT` against a transcription onto torch's own attention, and where its tokens enter."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy.ndimage import uniform_filter
from torch import Tensor, nn

from unitouch_gen.models import UniTouchConfig, UniTouchModel, UniTouchViT, UniTouchViTConfig
from unitouch_gen.models.vit import CONTRAST_FLOOR, LocalContrast

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
    return norm(x, "norm")[:, 0] @ weights["projection.weight"].T


@torch.no_grad()
@pytest.mark.parametrize(
    "changes",
    [{}, {"add_bias_kv": False}, {"stem_norm": True}, {"patch_stride": 4}, {"num_channels": 1, "mlp_ratio": 2.0}],
    ids=["paper", "no bias_kv", "stem norm", "overlapping patches", "one channel"],
)
@pytest.mark.parametrize("with_prefix", [False, True])
def test_features_equal_those_of_torchs_attention(changes: dict, with_prefix: bool) -> None:
    config, vit = UniTouchViTConfig(**{**TINY, **changes}), random_vit(**changes)
    pixels = torch.randn(2, config.num_channels, 24, 40)
    prefix = torch.randn(2, 5, 32) if with_prefix else None
    torch.testing.assert_close(vit(pixels, prefix), reference(vit, config, pixels, prefix), rtol=1e-5, atol=1e-5)


@torch.no_grad()
def test_prefix_tokens_carry_no_position() -> None:
    vit, pixels, prefix = random_vit(), torch.randn(2, 3, 24, 40), torch.randn(2, 5, 32)
    shuffled = prefix[:, torch.tensor([3, 1, 4, 0, 2])]
    torch.testing.assert_close(vit(pixels, shuffled), vit(pixels, prefix), rtol=1e-5, atol=1e-5)


@torch.no_grad()
def test_a_prefix_changes_the_features_of_its_own_image_only() -> None:
    vit, pixels, prefix = random_vit(), torch.randn(2, 3, 24, 40), torch.randn(2, 5, 32)
    other = torch.stack([prefix[0], torch.randn(5, 32)])
    before, after = vit(pixels, prefix), vit(pixels, other)
    torch.testing.assert_close(after[0], before[0])
    assert not torch.allclose(after[1], before[1], atol=1e-3)


@torch.no_grad()
def test_patches_carry_positions() -> None:
    vit, pixels = random_vit(), torch.randn(1, 3, 24, 40)
    swapped = torch.cat([pixels[..., 8:16], pixels[..., :8], pixels[..., 16:]], dim=-1)
    assert not torch.allclose(vit(swapped), vit(pixels), atol=1e-3)


@pytest.mark.parametrize(("stride", "grid"), [(8, (3, 5)), (4, (5, 9)), (5, (4, 7))])
def test_the_patch_stem_makes_the_grid_of_the_config(stride: int, grid: tuple[int, int]) -> None:
    config = UniTouchViTConfig(**{**TINY, "patch_stride": stride})
    assert config.grid == grid
    assert UniTouchViT(config).stem(torch.zeros(1, 3, 24, 40)).shape == (1, 32, *grid)


@pytest.mark.parametrize("stem", ["residual", "relief"])
@pytest.mark.parametrize("patch", [2, 4, 8])
def test_convolutional_stems_make_the_same_grid_as_patches(patch: int, stem: str) -> None:
    config = UniTouchViTConfig(**{**TINY, "patch_size": patch, "patch_stride": patch, "stem": stem})
    vit = UniTouchViT(config)
    assert vit.stem(torch.zeros(1, 3, 24, 40)).shape == (1, 32, 24 // patch, 40 // patch)
    assert vit(torch.zeros(2, 3, 24, 40)).shape == (2, 12)


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
    expected = np.clip(detail / (np.sqrt((detail**2).mean()) + CONTRAST_FLOOR), -4.0, 4.0)
    torch.testing.assert_close(LocalContrast(100)(pixels)[0, 2:], torch.from_numpy(expected), rtol=0, atol=1e-4)


def test_the_residual_stem_in_evaluation_sees_each_image_alone() -> None:
    config = UniTouchViTConfig(**{**TINY, "patch_size": 8, "patch_stride": 8, "stem": "residual"})
    torch.manual_seed(0)
    vit, pixels = UniTouchViT(config), torch.randn(4, 3, 24, 40)
    vit.train()(pixels)
    vit.eval()
    torch.testing.assert_close(vit(pixels)[:1], vit(pixels[:1]), rtol=0, atol=1e-5)


def test_dropped_branches_keep_their_expectation() -> None:
    config = UniTouchViTConfig(**{**TINY, "drop_path": 0.5})
    block = UniTouchViT(config).blocks[-1].train()
    torch.manual_seed(0)
    branch = block._drop(torch.ones(20_000, 1, 1))
    assert set(branch.unique().tolist()) == {0.0, 2.0}
    assert branch.mean().item() == pytest.approx(1.0, abs=0.03)


def test_nothing_is_dropped_in_evaluation() -> None:
    vit = random_vit(drop_path=0.9)
    pixels = torch.randn(2, 3, 24, 40)
    torch.testing.assert_close(vit(pixels), vit(pixels), rtol=0, atol=0)


def test_every_weight_gets_a_gradient() -> None:
    vit = random_vit().train()
    vit(torch.randn(2, 3, 24, 40), torch.randn(2, 3, 32)).square().sum().backward()
    assert all(parameter.grad is not None and parameter.grad.abs().sum() > 0 for parameter in vit.parameters())


# The paper's size, by configuration alone -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def paper() -> UniTouchModel:
    with torch.device("meta"):
        return UniTouchModel(UniTouchConfig(sensors=["gelsight", "digit", "taxim"]))


def millions(module: nn.Module) -> float:
    return sum(parameter.numel() for parameter in module.parameters()) / 1e6


def test_the_default_touch_trunk_has_24_blocks_of_16_heads_and_width_1024(paper: UniTouchModel) -> None:
    assert len(paper.touch_model.blocks) == 24
    assert paper.touch_model.blocks[0].attention.heads == 16
    assert paper.touch_model.norm.normalized_shape == (1024,)
    assert paper.touch_model.projection.weight.shape == (1024, 1024)
    assert paper.touch_model.position.shape == (1, 257, 1024)


def test_the_default_encoders_have_the_published_number_of_weights(paper: UniTouchModel) -> None:
    # The published stems are 3-D over two frames, twice the 2-D kernel; its text count leaves the projection out.
    assert millions(paper.touch_model) + 1024 * 3 * 14 * 14 / 1e6 == pytest.approx(304.9, abs=0.05)
    assert millions(paper.vision_model) + 1280 * 3 * 14 * 14 / 1e6 == pytest.approx(632.8, abs=0.05)
    assert millions(paper.text_model) - 1024 * 1024 / 1e6 == pytest.approx(353.0, abs=0.05)
    assert millions(paper.audio_model) == pytest.approx(86.2, abs=0.05)


def test_the_default_audio_trunk_has_the_published_positions(paper: UniTouchModel) -> None:
    assert paper.audio_model.position.shape == (1, 229, 768)


def test_the_default_bank_holds_five_tokens_for_each_sensor(paper: UniTouchModel) -> None:
    assert paper.sensor_bank.tokens.shape == (3, 5, 1024)


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
