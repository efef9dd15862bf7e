"""The published size, on networks of a few kilobytes: that both sides are alike, and hold what is said."""

import gc
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from diffusers import UNet2DConditionModel
from torch import Tensor, nn
from torch.nn.modules.module import register_module_forward_pre_hook
from transformers import CLIPTextModel, CLIPVisionModelWithProjection

from tests.benchmarks.measuring import PeakMemory
from tests.benchmarks.published_size import (
    SIDES,
    conversion_figures,
    encoder_figures,
    measure,
    one_picture,
    plain_encoder,
    touch_to_image_figures,
    write_small,
)
from tests.helpers.published_files import small
from unitouch_gen.models import UniTouchModel, UniTouchViT

under_linux = pytest.mark.skipif(PeakMemory().start is None, reason="the system does not say")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("published_size")
    for name in ("small", "measured"):
        write_small(folder / name, "float32")
    return folder


Seen = list[tuple[set[type], torch.Size, torch.dtype]]


@pytest.fixture
def evaluations() -> Iterator[Seen]:
    """Evaluations of UNets: which networks have come into memory, the shape of the latents, and their dtype."""

    def networks() -> Iterator[nn.Module]:
        return (thing for thing in gc.get_objects() if issubclass(type(thing), nn.Module))

    def look(module: nn.Module, inputs: tuple[Tensor, ...]) -> None:
        if isinstance(module, UNet2DConditionModel):
            held = {type(network) for network in networks() if id(network) not in before}
            seen.append((held, inputs[0].shape, inputs[0].dtype))

    gc.collect()
    seen: Seen = []
    before = {id(network) for network in networks()}  # of other tests
    hook = register_module_forward_pre_hook(look)
    yield seen
    hook.remove()


@under_linux
@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_both_sides_evaluate_alike_and_hold_what_is_said(folder: Path, evaluations: Seen, dtype: str) -> None:
    held = {}
    for side in SIDES:
        one_picture(side, folder / "measured", dtype, 2)
        assert [seen[1:] for seen in evaluations] == [((2, 4, 8, 8), getattr(torch, dtype))] * 2
        held[side] = evaluations[0][0]
        evaluations.clear()
        gc.collect()
    encoders = {CLIPTextModel, CLIPVisionModelWithProjection, UniTouchViT}
    assert held["ours"] & encoders == set()
    assert held["diffusers"] & encoders == {CLIPTextModel, CLIPVisionModelWithProjection}


@under_linux
@pytest.mark.parametrize("side", SIDES)
def test_a_side_is_measured(folder: Path, side: str) -> None:
    figures = measure(side, folder, "float32", steps=2)
    assert figures["megabytes"] >= 0.0
    assert 0.0 < figures["seconds_a_step"] < figures["seconds"]


@pytest.mark.slow
@under_linux
def test_both_sides_are_measured_in_processes_of_their_own(tmp_path: Path) -> None:
    figures = touch_to_image_figures(tmp_path, "bfloat16", write_small, repeats=1)
    shares = [figures[f"share_of_{name}"] for name in ("megabytes", "seconds_a_step", "seconds")]
    assert all(share["median"] > 0.0 and share["spread"] == 0.0 for share in shares)
    assert list(tmp_path.iterdir()) == []


def test_the_plain_encoder_is_the_same_network() -> None:
    config = small()
    torch.manual_seed(0)
    encoder = UniTouchModel(config, modalities=("touch",)).eval().touch_model
    with torch.no_grad():
        for weight in encoder.parameters():
            weight.add_(0.1 * torch.randn_like(weight))  # biases, too
        pixels = torch.randn(2, 3, 28, 28)
        frames = pixels[:, :, None].expand(-1, -1, 2, -1, -1)
        torch.testing.assert_close(plain_encoder(encoder, config).embed("touch", frames)[0], encoder(pixels))


def test_throughput_is_of_four_networks_that_take_turns() -> None:
    figures = encoder_figures(repeats=3, batch=2, config=small())
    rates = figures["touches_per_second"]
    assert set(rates) == {"plain_float32", "ours_float32", "plain_bfloat16", "ours_bfloat16"}
    assert all(0.0 < rate["low"] <= rate["median"] <= rate["high"] for rate in rates.values())
    assert figures["relative_error"]["ours_float32"] < 1e-5
    assert figures["relative_error"]["ours_bfloat16"] < 5e-2


@pytest.mark.slow
@under_linux
def test_a_conversion_is_measured_in_a_process_of_its_own(tmp_path: Path) -> None:
    figures = conversion_figures(tmp_path, small())
    for way in ("conversion", "reading"):
        assert figures[way]["seconds"] > 0 and figures[way]["megabytes"] >= 0
    assert sum(figures["parameters"].values()) * 4 / 1e6 == pytest.approx(
        sum(figures["megabytes_of_files"].values()), rel=0.2
    )
    assert list(tmp_path.iterdir()) == []
