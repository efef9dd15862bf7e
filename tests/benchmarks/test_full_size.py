"""The benchmark of the published size, on networks of a few kilobytes: that both sides run, and hold what it says."""

import gc
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from diffusers import UNet2DConditionModel
from torch import Tensor, nn
from torch.nn.modules.module import register_module_forward_pre_hook
from transformers import CLIPTextModel, CLIPVisionModelWithProjection

from tests.benchmarks.full_size import (
    SIDES,
    SMALL,
    Peak,
    full_size_figures,
    measure,
    ours,
    spread_of,
    write_checkpoint,
)
from tests.benchmarks.throughput import plain_of, throughput_figures
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.memory import resident
from unitouch_gen.models import UniTouchConfig, UniTouchModel, UniTouchViT

under_linux = pytest.mark.skipif(resident("VmHWM") is None, reason="the system does not say")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("full_size")
    for name in ("small", "measured"):
        write_checkpoint(folder / name, SMALL, torch.float32)
    return folder


Seen = list[tuple[set[type], torch.Size, torch.dtype]]


@pytest.fixture
def evaluations() -> Iterator[Seen]:
    """Of UNets: which networks have come into memory, the shape of the latents, and their dtype."""

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
@pytest.mark.parametrize("side", SIDES)
def test_a_side_is_measured(folder: Path, side: str) -> None:
    figures = measure(side, folder, torch.float32, steps=2)
    assert figures["megabytes"] >= 0.0
    assert 0.0 < figures["seconds_a_step"] < figures["seconds"]


@under_linux
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_both_sides_evaluate_alike_and_hold_what_is_said(folder: Path, evaluations: Seen, dtype: torch.dtype) -> None:
    held = {}
    for side, run in SIDES.items():
        run(folder / "measured", dtype, 2, Peak())
        assert [(shape, at) for _, shape, at in evaluations] == [((2, 4, 8, 8), dtype)] * 2
        held[side] = evaluations[0][0]
        evaluations.clear()
        gc.collect()
    encoders = {CLIPTextModel, CLIPVisionModelWithProjection, UniTouchViT}
    assert held["ours"] & encoders == set()
    assert held["diffusers"] & encoders == {CLIPTextModel, CLIPVisionModelWithProjection}


@under_linux
def test_a_peak_outlasts_calls_that_start_the_record_anew(folder: Path) -> None:
    peak = Peak()
    held = torch.ones(32 * 2**20)  # 128 MB
    peak.note()
    del held
    ours(folder / "small", torch.float32, 2, peak)
    peak.note()
    assert peak.most >= 100e6


def test_spreads_are_of_the_values() -> None:
    assert spread_of([3.0, 1.0, 2.0]) == {"median": 2.0, "spread": 2.0}


@pytest.mark.parametrize("setting", [{"repeats": 0}, {"steps": 1}, {"dtype": "float16"}])
def test_settings_that_cannot_be_used_are_refused_by_name(setting: dict) -> None:
    with pytest.raises(InvalidInputError, match=f"`{next(iter(setting))}`"):
        full_size_figures(small=True, **setting)


def test_an_unknown_side_is_refused(folder: Path) -> None:
    with pytest.raises(InvalidInputError, match="`side`"):
        measure("theirs", folder, torch.float32, 1)


@pytest.mark.slow
@under_linux
def test_both_sides_are_measured_in_processes_of_their_own(tmp_path: Path) -> None:
    figures = full_size_figures(repeats=1, small=True, scratch=tmp_path)
    assert figures["dtype"] == "bfloat16"
    shares = [figures[f"share_of_{name}"] for name in ("megabytes", "seconds_a_step", "seconds")]
    assert all(share["median"] > 0.0 and share["spread"] == 0.0 for share in shares)
    assert list(tmp_path.iterdir()) == []


# The touch encoder ----------------------------------------------------------------------------------------------------


def test_the_plain_encoder_is_the_same_network() -> None:
    config = UniTouchConfig(**SMALL.joint)
    torch.manual_seed(0)
    encoder = UniTouchModel(config, modalities=("touch",)).eval().touch_model
    with torch.no_grad():
        for weight in encoder.parameters():
            weight.add_(0.1 * torch.randn_like(weight))  # biases, too
        pixels = torch.randn(2, 3, 32, 32)
        torch.testing.assert_close(plain_of(encoder, config.touch_config)(pixels), encoder(pixels))


def test_throughput_is_of_four_networks_that_take_turns() -> None:
    figures = throughput_figures(repeats=3, batch=2, settings=dict(SMALL.joint))
    rates = figures["touches_per_second"]
    assert set(rates) == {"plain_float32", "ours_float32", "plain_bfloat16", "ours_bfloat16"}
    assert all(0.0 < rate["low"] <= rate["median"] <= rate["high"] for rate in rates.values())
    for ratio in figures["times_as_fast"].values():
        assert 0.0 < ratio["low"] <= ratio["high"]
    assert figures["relative_error"]["ours_float32"] < 1e-5
    assert figures["relative_error"]["ours_bfloat16"] < 5e-2
