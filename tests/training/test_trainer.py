"""The trainer on a linear regression, whose solution, averages and rates are known."""

import json
import math
import re
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from platform import machine
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from tests.helpers.processes import Child
from unitouch_gen.errors import InvalidInputError, NonFiniteError
from unitouch_gen.models import UniTouchModel
from unitouch_gen.training.batches import ArrayDataset, shuffled_indices
from unitouch_gen.training.checkpoints import checkpoints_in
from unitouch_gen.training.trainer import Trainer, TrainerConfig, precision_here, rate_at

ROWS = 48
CONFIG = TrainerConfig(steps=20, batch_size=8, learning_rate=0.05, warmup=4, weight_decay=0.01, save_every=5, seed=3)


class Regression(nn.Module):
    """Mean squared error of a linear map, with noise on its input; in its call `stop_at` it is killed."""

    def __init__(self, noise: float = 0.0, stop_at: int | None = None):
        super().__init__()
        torch.manual_seed(0)
        self.trained: nn.Module = nn.Linear(3, 2)
        self.noise, self.stop_at, self.calls = noise, stop_at, 0

    def forward(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        if self.calls == self.stop_at:
            raise KeyboardInterrupt
        self.calls += 1
        x = batch["x"] + self.noise * torch.randn_like(batch["x"])
        return {"loss": (self.trained(x) - batch["y"]).square().mean()}

    def weights(self) -> list[Tensor]:
        return [parameter.detach().clone() for parameter in self.trained.parameters()]


def data(broken_row: int | None = None) -> ArrayDataset:
    rng = np.random.default_rng(0)
    x = rng.standard_normal((ROWS, 3)).astype(np.float32)
    weight = rng.standard_normal((3, 2))
    noise = rng.standard_normal((ROWS, 2))
    y = (x @ weight + 0.5 + 0.3 * noise).astype(np.float32)
    if broken_row is not None:
        y[broken_row] = np.nan
    return ArrayDataset(x=x, y=y)


def make(output: Path, *, options: dict[str, Any] | None = None, **changes: Any) -> tuple[Trainer, Regression]:
    objective = Regression(**(options or {}))
    config = CONFIG.model_copy(update=changes)
    indices_of = partial(shuffled_indices, size=ROWS, batch_size=config.batch_size, seed=config.seed)
    return Trainer(objective, data(), indices_of, config, output), objective


def test_training_reaches_the_closed_form_of_least_squares(tmp_path: Path) -> None:
    changes = {"steps": 250, "batch_size": ROWS, "learning_rate": 0.1, "weight_decay": 0.0, "save_every": 1000}
    trainer, objective = make(tmp_path, **changes)
    trainer.fit()
    columns = data().columns
    design = np.concatenate([columns["x"], np.ones((ROWS, 1))], axis=1)
    expected, *_ = np.linalg.lstsq(design, columns["y"], rcond=None)
    np.testing.assert_allclose(objective.weights()[0].T, expected[:3], atol=1e-4)
    np.testing.assert_allclose(objective.weights()[1], expected[3], atol=1e-4)
    assert json.loads((tmp_path / "log.jsonl").read_text().splitlines()[-1])["step"] == 250
    assert not objective.training
    assert make(tmp_path, steps=None, epochs=2.5)[0].steps == 15  # 2.5 * 48 / 8


def test_the_weights_kept_are_the_average_over_the_steps(tmp_path: Path) -> None:
    raw, objective = make(tmp_path / "raw")
    average = [torch.zeros_like(weight) for weight in objective.weights()]
    for step in range(20):
        raw.train_step(data()[raw.indices_of(step)])
        # Karras et al.'s warm-up of the decay, as in diffusers: 1 - (1 + n)^(-3/4), at most `ema_decay`.
        decay = 0.0 if step == 0 else min(0.9, 1.0 - (1.0 + step) ** -0.75)
        average = [decay * a + (1.0 - decay) * w for a, w in zip(average, objective.weights(), strict=True)]
    trainer, averaged = make(tmp_path / "ema", ema_decay=0.9)
    trainer.fit()
    torch.testing.assert_close(averaged.weights(), average)
    stored = load_file(checkpoints_in(tmp_path / "ema")[-1] / "model.safetensors")  # the raw weights, to go on from
    torch.testing.assert_close([stored["trained.weight"], stored["trained.bias"]], objective.weights())


def test_a_batch_norms_statistics_are_those_of_the_averaged_weights(tmp_path: Path) -> None:
    objective = Regression()
    config = CONFIG.model_copy(update={"ema_decay": 0.9, "learning_rate": 0.3})
    objective.trained = nn.Sequential(nn.Linear(3, 4), norm := nn.BatchNorm1d(4), nn.Linear(4, 2))
    Trainer(objective, data(), lambda step: range(ROWS), config, tmp_path).fit()
    with torch.no_grad():
        inside = objective.trained[0](torch.from_numpy(data().columns["x"]))  # type: ignore[index]
    torch.testing.assert_close(norm.running_mean, inside.mean(dim=0), atol=1e-5, rtol=0.0)
    torch.testing.assert_close(norm.running_var, inside.var(dim=0), atol=1e-5, rtol=1e-4)


def test_the_rate_warms_up_in_a_line_and_falls_as_half_a_cosine() -> None:
    final = 0.1
    config = CONFIG.model_copy(update={"warmup": 10, "final_rate": 0.1})
    np.testing.assert_allclose([rate_at(step, config, 110) for step in range(10)], np.arange(1, 11) / 10)
    expected = [1.0, final + (1 - final) * (1 + math.sqrt(0.5)) / 2, (1 + final) / 2, final, final]
    np.testing.assert_allclose([rate_at(step, config, 110) for step in (10, 35, 60, 110, 500)], expected, atol=1e-12)


def test_weights_of_linear_and_convolution_layers_alone_are_decayed(tmp_path: Path, model: UniTouchModel) -> None:
    objective = Regression()
    objective.trained = model  # with tokens of sensors and of the class, tables, norms, and a learned key and value
    trainer = Trainer(objective, data(), lambda step: [0], CONFIG, tmp_path)
    names = {id(parameter): name for name, parameter in model.named_parameters()}
    groups = [group["params"] for group in trainer.optimizer.param_groups if group["weight_decay"]]
    decayed = {names[id(parameter)] for group in groups for parameter in group}
    kinds = {name: type(model.get_submodule(name.rpartition(".")[0])) for name in names.values()}
    layers = {name for name, kind in kinds.items() if issubclass(kind, (nn.Linear, nn.Conv2d, nn.MultiheadAttention))}
    assert decayed == {name for name in layers if name.endswith((".weight", ".in_proj_weight"))}
    assert {"Embedding", "LayerNorm", "SensorBank"} <= {kinds[name].__name__ for name in {*kinds} - decayed}


@pytest.mark.parametrize(("killed_at", "ema_decay"), [(5, 0.9), (13, 0.0)])
def test_a_killed_run_goes_on_to_the_same_bits(tmp_path: Path, killed_at: int, ema_decay: float) -> None:
    whole, expected = make(tmp_path / "whole", ema_decay=ema_decay, options={"noise": 0.1})
    whole.fit()
    for stop_at, steps in ((killed_at, killed_at // 5 * 5), (None, 20), (None, 20)):
        options = {"noise": 0.1, "stop_at": stop_at}
        trainer, objective = make(tmp_path / "killed", ema_decay=ema_decay, options=options)
        if stop_at is not None:
            with pytest.raises(KeyboardInterrupt):
                trainer.fit()
        else:
            trainer.resume()
            trainer.fit()  # the second time there is nothing left to do
            assert all(map(torch.equal, objective.weights(), expected.weights()))
        assert checkpoints_in(tmp_path / "killed")[-1].name == f"step-{steps:08d}"


def test_the_last_checkpoints_stay_and_nothing_of_half_ones_or_an_earlier_run(tmp_path: Path) -> None:
    """Copies under other names, and files that others put there, stay."""
    make(tmp_path, keep_checkpoints=3)[0].fit()
    assert [folder.name for folder in checkpoints_in(tmp_path)] == [f"step-{step:08d}" for step in (10, 15, 20)]
    (tmp_path / "checkpoints" / "step-00000020" / "progress.json").unlink()  # as if killed while it was written
    (tmp_path / "checkpoints" / ".DS_Store").touch()
    for name in ("model_notes.json", "model-best.pt"):
        (tmp_path / "checkpoints" / "step-00000010" / name).touch()
    shutil.copytree(tmp_path / "checkpoints" / "step-00000015", tmp_path / "checkpoints" / "step-00000015-best")
    trainer, _ = make(tmp_path)
    trainer.resume()
    assert trainer.step == 15
    trainer.fit()
    killed, _ = make(tmp_path, options={"stop_at": 8})
    with pytest.raises(KeyboardInterrupt):
        killed.fit()
    theirs = {".DS_Store", "step-00000010", "step-00000015-best"}
    assert {path.name for path in (tmp_path / "checkpoints").iterdir()} == {"step-00000005", *theirs}
    kept = {path.name for path in (tmp_path / "checkpoints" / "step-00000010").iterdir()}
    assert kept == {"model_notes.json", "model-best.pt"}
    assert (tmp_path / "checkpoints" / "step-00000015-best" / "model.safetensors").is_file()
    assert not (tmp_path / "log.jsonl").exists()


def test_other_settings_of_the_optimiser_hold_after_going_on(tmp_path: Path) -> None:
    make(tmp_path, steps=10, ema_decay=0.9)[0].fit()
    again, _ = make(tmp_path, learning_rate=1e-4, weight_decay=0.5, beta2=0.9, ema_decay=0.99)
    again.resume()
    held = [(group["weight_decay"], group["betas"]) for group in again.optimizer.param_groups]
    assert held == [(0.5, (0.9, 0.9)), (0.0, (0.9, 0.9))]
    assert again.ema.decay == 0.99
    assert again.optimizer.param_groups[0]["lr"] == pytest.approx(1e-4 * rate_at(10, CONFIG, 20))
    again.train_step(data()[again.indices_of(10)])
    assert again.schedule.get_last_lr()[0] == pytest.approx(1e-4 * rate_at(11, CONFIG, 20))


def test_a_run_that_cannot_go_on_says_why_and_stays_as_it_is(tmp_path: Path) -> None:
    make(tmp_path)[0].fit()
    with pytest.raises(InvalidInputError, match=r"`steps` is 15, but .*step-00000020' is beyond it"):
        make(tmp_path, steps=15)[0].resume()
    objective = Regression()
    objective.trained = nn.Linear(3, 4)
    with pytest.raises(InvalidInputError, match="step-00000020', which does not fit this recipe's model"):
        Trainer(objective, data(), lambda step: [0], CONFIG, tmp_path).resume()
    trainer, _ = make(tmp_path)
    trainer.resume()
    assert trainer.step == 20


class Opened:
    """An object whose unpickling would make a file."""

    def __init__(self, file: Path):
        self.file = file

    def __reduce__(self) -> Any:
        return Path.touch, (self.file,)


DAMAGES: dict[str, Callable[[Path], Any]] = {
    "cut": lambda file: file.write_bytes(file.read_bytes()[:-40]),
    "of zeros": lambda file: file.write_bytes(bytes(file.stat().st_size)),
    "missing": Path.unlink,
}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("name", ["model.safetensors", "optimizer.bin", "random_states_0.pkl"])
def test_a_damaged_checkpoint_is_named_and_the_one_before_it_taken(tmp_path: Path, name: str, damage: str) -> None:
    make(tmp_path, steps=10, keep_checkpoints=2)[0].fit()
    before, last = checkpoints_in(tmp_path)
    DAMAGES[damage](last / name)
    trainer, _ = make(tmp_path)
    with pytest.warns(UserWarning, match=rf"{last.name}/{name}' is missing or damaged; .* {before.name}"):
        trainer.resume()
    assert trainer.step == 5
    DAMAGES[damage](before / name)
    with pytest.raises(InvalidInputError, match=rf"`resume` finds '.*{last.name}/{name}' missing or damaged"):
        make(tmp_path)[0].resume()


def fit(output: Path, keep_checkpoints: int) -> None:
    make(output, keep_checkpoints=keep_checkpoints)[0].fit()


@pytest.mark.parametrize("longest", [100, 3000])
def test_a_full_disk_ends_training_in_one_line(tmp_path: Path, longest: int) -> None:
    child = Child(fit, tmp_path / "run", 1, folder=tmp_path, longest=longest)
    assert child.wait() == 1
    last = child.err.splitlines()[-1]
    assert re.search(r"InvalidInputError: `output` cannot be written to '.*step-00000005': .*--resume", last)
    assert checkpoints_in(tmp_path / "run") == []


def test_a_checkpoint_with_a_hostile_pickle_is_one_line_and_runs_nothing(tmp_path: Path) -> None:
    make(tmp_path / "run")[0].fit()
    (checkpoint,) = checkpoints_in(tmp_path / "run")
    torch.save(Opened(tmp_path / "ran"), checkpoint / "optimizer.bin")
    with pytest.raises(InvalidInputError, match=r"^`resume` finds .* of which nothing was run.*$"):
        make(tmp_path / "run")[0].resume()
    assert not (tmp_path / "ran").exists()


def test_a_loss_that_is_not_finite_stops_the_run_at_its_last_checkpoint(tmp_path: Path) -> None:
    trainer = Trainer(Regression(), data(broken_row=7), lambda step: [step], CONFIG, tmp_path)
    with pytest.raises(NonFiniteError, match=r"loss at step 7 is nan; its samples are \[7\]"):
        trainer.fit()
    assert [folder.name for folder in checkpoints_in(tmp_path)] == ["step-00000005"]


@pytest.mark.skipif(not Path("/proc/cpuinfo").is_file() or machine() != "x86_64", reason="the flags are told elsewhere")
def test_bfloat16_is_left_to_cpus_that_compute_in_it() -> None:
    flags = Path("/proc/cpuinfo").read_text()
    expected = "bf16" if "avx512_bf16" in flags or "amx_bf16" in flags else "no"
    assert precision_here("bf16") == expected
    assert precision_here("no") == "no"
