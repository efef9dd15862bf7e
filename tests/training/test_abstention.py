"""Fitting what a joint space does not know: what is written, and that nothing else changes."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from unitouch_gen.conditioning import EmbeddingBank
from unitouch_gen.models import MODALITIES, UniTouchModel, UniTouchProcessor
from unitouch_gen.training.abstention import abstention, direction_of
from unitouch_gen.training.data import Rendered
from unitouch_gen.training.stages import run_command, save_modalities

SETTINGS = ("data.drawn={sensors: [digit], objects: 8, contacts_per_object: 1, held_out: 4}",)


@pytest.fixture
def space(model: UniTouchModel, processor: UniTouchProcessor, split: Rendered, tmp_path: Path) -> Path:
    model.sensor_bank.set_prototype("digit", torch.from_numpy(split.touch[:].copy()).float().mean(dim=0) / 255)
    save_modalities(model.half(), MODALITIES, processor, tmp_path / "space")
    return tmp_path / "space"


def test_temperatures_and_scores_are_written_and_weights_stay(
    space: Path, cache: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = load_file(space / "model.safetensors")
    width = UniTouchModel.from_pretrained(space).config.projection_dim
    EmbeddingBank.of(torch.randn(9, width)).save_pretrained(space.parent / "embedding-bank")
    abstention(joint=space, overrides=list(SETTINGS), cache=cache)
    after = load_file(space / "model.safetensors")
    assert {key for key in after if not key.startswith("out_of_distribution.")} == set(before)
    assert all(torch.equal(after[key], tensor) for key, tensor in before.items())
    new = {key: tensor for key, tensor in after.items() if key not in before}
    assert new.pop("out_of_distribution.text.vocabulary").dtype == torch.bool
    assert all(tensor.dtype == torch.float16 for tensor in new.values())
    again = UniTouchModel.from_pretrained(space)
    assert (
        set(again.config.temperatures) == {*MODALITIES, "touch by pictures"} == set(again.config.temperature_exponents)
    )
    assert set(again.config.ood_thresholds) == set(MODALITIES)
    assert set(again.config.ood_thresholds["touch"]) >= {"distance", "foreign"}
    assert set(again.config.sensor_reaches) == {"digit"} and 0.0 < again.config.sensor_reaches["digit"] < 0.3
    assert [line.partition(":")[0] for line in capsys.readouterr().out.splitlines()] == list(MODALITIES)


def test_what_is_known_is_named_and_noise_is_not(
    space: Path, cache: Path, processor: UniTouchProcessor, split: Rendered
) -> None:
    abstention(joint=space, overrides=list(SETTINGS), cache=cache)
    model = UniTouchModel.from_pretrained(space)
    noise = torch.rand(16, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    for pixels, low, high in ((torch.from_numpy(split.touch[:].copy()) / 255, 0.0, 0.15), (noise, 0.5, 1.0)):
        values = processor.touch(pixels)
        reasons = model.abstains("touch", model.get_touch_features(values), values)
        assert low <= sum(map(bool, reasons)) / len(reasons) <= high


def test_a_share_that_is_none_is_refused_in_one_line(
    space: Path, cache: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        run_command("abstention", abstention, ["--joint", str(space), "--share", "0.9"])
    (line,) = capsys.readouterr().err.splitlines()
    assert "`share` is 0.9" in line


def test_the_direction_of_gels_at_rest_is_fishers() -> None:
    """Logistic regression of Gaussians of one covariance finds their linear discriminant (Fisher, 1936)."""
    generator = torch.Generator().manual_seed(0)
    mixing, apart = torch.randn(4, 4, generator=generator).double(), torch.tensor([1.0, -0.5, 0.0, 2.0]).double()
    known, at_rest = (torch.randn(rows, 4, generator=generator).double() @ mixing for rows in (9000, 900))
    found = direction_of(at_rest + apart, known).weight.double()
    expected = torch.linalg.solve(mixing.T @ mixing, apart)
    assert torch.cosine_similarity(found, expected, dim=0) > 0.98
