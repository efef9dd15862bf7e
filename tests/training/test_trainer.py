"""The trainer on a linear regression, whose solution, averages and rates are known."""

import copy
import json
import math
import os
import signal
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors import safe_open
from safetensors.torch import load_file
from torch import Tensor, nn

from unitouch_gen.errors import InvalidInputError, NonFiniteError
from unitouch_gen.models import UniTouchModel
from unitouch_gen.training.batches import ArrayDataset, ShuffledSampler
from unitouch_gen.training.trainer import Trainer, TrainerConfig, checkpoint_gradients, rate_at

ROWS = 48
CONFIG = TrainerConfig(steps=20, batch_size=8, learning_rate=0.05, warmup=4, weight_decay=0.01, save_every=5, seed=3)


def changed(**fields: object) -> TrainerConfig:
    return CONFIG.model_copy(update=fields)


class Regression(nn.Module):
    """Mean squared error of a linear map, with noise on its input; `stop_at` is the step at which it is killed."""

    def __init__(self, noise: float = 0.0, stop_at: int | None = None):
        super().__init__()
        torch.manual_seed(0)
        self.trained = nn.Linear(3, 2)
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
    weight, noise = rng.standard_normal((3, 2)), rng.standard_normal((ROWS, 2))
    y = (x @ weight + 0.5 + 0.3 * noise).astype(np.float32)
    if broken_row is not None:
        y[broken_row] = np.nan
    return ArrayDataset(x=x, y=y)


def make(output: Path, config: TrainerConfig = CONFIG, **options: float | int | None) -> tuple[Trainer, Regression]:
    objective = Regression(**options)  # type: ignore[arg-type]
    sampler = ShuffledSampler(ROWS, config.batch_size, config.seed)
    return Trainer(objective, data(), sampler, config, output), objective


def last_weights(output: Path) -> Path:
    return max((output / "checkpoints").iterdir()) / "model.safetensors"


# Training -------------------------------------------------------------------------------------------------------------


def test_training_reaches_the_closed_form_of_least_squares(tmp_path: Path) -> None:
    config = TrainerConfig(steps=250, batch_size=ROWS, learning_rate=0.1, warmup=10, weight_decay=0.0, save_every=1000)
    trainer, objective = make(tmp_path, config)
    trainer.fit()
    columns = data().columns
    design = np.concatenate([columns["x"], np.ones((ROWS, 1))], axis=1)
    expected, *_ = np.linalg.lstsq(design, columns["y"], rcond=None)
    np.testing.assert_allclose(objective.trained.weight.detach().T, expected[:3], atol=1e-4)
    np.testing.assert_allclose(objective.trained.bias.detach(), expected[3], atol=1e-4)


def test_the_objective_is_left_in_evaluation_mode(tmp_path: Path) -> None:
    trainer, objective = make(tmp_path)
    trainer.fit()
    assert not objective.training and trainer.step == CONFIG.steps


def test_the_log_holds_the_last_step_with_its_loss_and_rate(tmp_path: Path) -> None:
    make(tmp_path)[0].fit()
    last = json.loads((tmp_path / "log.jsonl").read_text().splitlines()[-1])
    assert last["step"] == CONFIG.steps and math.isfinite(last["loss"])
    assert last["rate"] == pytest.approx(CONFIG.learning_rate * rate_at(CONFIG.steps, CONFIG, CONFIG.steps))


@pytest.mark.parametrize("limit", [0.01, 0.1])
def test_a_gradient_beyond_the_limit_is_scaled_down_to_it(tmp_path: Path, limit: float) -> None:
    assert first_gradient_norm(tmp_path, limit) == pytest.approx(limit, rel=1e-3)


def test_a_gradient_within_the_limit_is_left_as_it_is(tmp_path: Path) -> None:
    assert first_gradient_norm(tmp_path / "a", 1000.0) == pytest.approx(first_gradient_norm(tmp_path / "b", 0.0))


def first_gradient_norm(output: Path, limit: float) -> float:
    """The norm of the gradient the optimiser saw in its first step: Adam's first moment is (1 - 0.9) of it."""
    trainer, objective = make(output, changed(grad_clip=limit))
    trainer.train_step(data()[[0, 1, 2, 3]])
    moments = [trainer.optimizer.state[parameter]["exp_avg"] / 0.1 for parameter in objective.trained.parameters()]
    return math.sqrt(sum(moment.square().sum().item() for moment in moments))


def test_the_weights_kept_are_the_average_over_the_steps(tmp_path: Path) -> None:
    config = changed(ema_decay=0.9)
    raw, objective = make(tmp_path / "raw")
    average = [torch.zeros_like(weight) for weight in objective.weights()]
    for step in range(config.steps):
        raw.train_step(data()[raw.indices_of(step)])
        # Karras et al.'s warm-up of the decay, as in diffusers: 1 - (1 + n)^(-3/4), at most `ema_decay`.
        decay = 0.0 if step == 0 else min(0.9, 1.0 - (1.0 + step) ** -0.75)
        average = [decay * a + (1.0 - decay) * w for a, w in zip(average, objective.weights(), strict=True)]
    trainer, averaged = make(tmp_path / "ema", config)
    trainer.fit()
    for kept, expected, last in zip(averaged.weights(), average, objective.weights(), strict=True):
        torch.testing.assert_close(kept, expected)
        assert not torch.allclose(kept, last, atol=1e-4)


class Normalised(Regression):
    """A regression on inputs that a batch norm has standardised."""

    def __init__(self) -> None:
        super().__init__()
        self.trained = nn.Sequential(nn.Linear(3, 4), nn.BatchNorm1d(4), nn.Linear(4, 2))


def test_a_batch_norms_statistics_are_those_of_the_averaged_weights(tmp_path: Path) -> None:
    objective, everything = Normalised(), list(range(ROWS))
    config = changed(ema_decay=0.9, learning_rate=0.3)
    Trainer(objective, data(), lambda step: everything, config, tmp_path).fit()
    linear, norm, _ = objective.trained
    with torch.no_grad():
        inside = linear(torch.from_numpy(data().columns["x"]))
    torch.testing.assert_close(norm.running_mean, inside.mean(dim=0), atol=1e-5, rtol=0.0)
    torch.testing.assert_close(norm.running_var, inside.var(dim=0), atol=1e-5, rtol=1e-4)


def test_the_checkpoint_holds_the_raw_weights_beside_the_average(tmp_path: Path) -> None:
    make(tmp_path / "raw")[0].fit()
    make(tmp_path / "ema", changed(ema_decay=0.9))[0].fit()
    raw, beside = (load_file(last_weights(tmp_path / name)) for name in ("raw", "ema"))
    assert all(torch.equal(raw[key], beside[key]) for key in raw)


# Stopping and going on ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("killed_at", "ema_decay"), [(5, 0.9), (13, 0.9), (13, 0.0)])
def test_a_killed_run_goes_on_to_the_same_bits(tmp_path: Path, killed_at: int, ema_decay: float) -> None:
    config = changed(ema_decay=ema_decay)
    whole, expected = make(tmp_path / "whole", config, noise=0.1)
    whole.fit()
    killed, _ = make(tmp_path / "killed", config, noise=0.1, stop_at=killed_at)
    with pytest.raises(KeyboardInterrupt):
        killed.fit()
    again, objective = make(tmp_path / "killed", config, noise=0.1)
    again.resume()
    assert again.step == killed_at // 5 * 5
    again.fit()
    for kept, weight in zip(objective.weights(), expected.weights(), strict=True):
        assert torch.equal(kept, weight)


def test_a_finished_run_goes_on_to_where_it_is(tmp_path: Path) -> None:
    config = changed(ema_decay=0.9)
    first, expected = make(tmp_path, config)
    first.fit()
    again, objective = make(tmp_path, config)
    again.resume()
    again.fit()
    assert objective.calls == 0
    assert all(torch.equal(a, b) for a, b in zip(objective.weights(), expected.weights(), strict=True))


def test_a_run_killed_as_it_wrote_a_checkpoint_goes_on_from_the_one_before(tmp_path: Path) -> None:
    make(tmp_path, changed(keep_checkpoints=2))[0].fit()
    (tmp_path / "checkpoints" / "step-00000020" / "progress.json").unlink()  # it is written last
    trainer, _ = make(tmp_path)
    trainer.resume()
    assert trainer.step == 15


def test_the_last_checkpoints_stay(tmp_path: Path) -> None:
    make(tmp_path, changed(keep_checkpoints=3))[0].fit()
    steps = [folder.name for folder in sorted((tmp_path / "checkpoints").iterdir())]
    assert steps == ["step-00000010", "step-00000015", "step-00000020"]


def test_a_new_run_leaves_no_checkpoint_of_an_earlier_one(tmp_path: Path) -> None:
    make(tmp_path, changed(steps=40))[0].fit()
    killed, _ = make(tmp_path, stop_at=8)
    with pytest.raises(KeyboardInterrupt):
        killed.fit()
    assert [folder.name for folder in (tmp_path / "checkpoints").iterdir()] == ["step-00000005"]


def test_without_a_checkpoint_there_is_nothing_to_go_on_from(tmp_path: Path) -> None:
    trainer, _ = make(tmp_path)
    with pytest.raises(InvalidInputError, match=f"`resume` finds no checkpoint in '{tmp_path}'"):
        trainer.resume()


def test_a_damaged_checkpoint_is_refused_by_its_file(tmp_path: Path) -> None:
    trainer, _ = make(tmp_path)
    trainer.fit()
    (last_weights(tmp_path).parent / "progress.json").write_text("{")
    with pytest.raises(InvalidInputError, match=r"`resume` names '.*progress\.json', which cannot be read as JSON"):
        trainer.resume()


def test_a_run_cannot_go_on_to_an_earlier_step(tmp_path: Path) -> None:
    make(tmp_path)[0].fit()
    again, _ = make(tmp_path, changed(steps=15))
    with pytest.raises(InvalidInputError, match=r"`steps` is 15, but the checkpoint in .* is at step 20"):
        again.resume()


@pytest.mark.parametrize("change", ["model", "ema"])
def test_a_run_cannot_go_on_with_another_model(tmp_path: Path, change: str) -> None:
    make(tmp_path)[0].fit()
    objective = Regression()
    if change == "model":
        objective.trained = nn.Linear(3, 4)
    config = changed(ema_decay=0.9 if change == "ema" else 0.0)
    again = Trainer(objective, data(), lambda step: [0], config, tmp_path)
    with pytest.raises(InvalidInputError, match=r"`resume` finds .*/checkpoints/step-00000020', which does not fit"):
        again.resume()


@pytest.mark.parametrize("seed", [4294, 4295, 2**32 - 1])
def test_every_seed_trains(tmp_path: Path, seed: int) -> None:
    make(tmp_path, changed(seed=seed), noise=0.1)[0].fit()


def test_a_new_run_in_an_old_folder_starts_its_log_anew(tmp_path: Path) -> None:
    make(tmp_path, changed(steps=40))[0].fit()
    make(tmp_path)[0].fit()
    assert [json.loads(line)["step"] for line in (tmp_path / "log.jsonl").read_text().splitlines()] == [20]


def test_seconds_add_up_over_sittings(tmp_path: Path) -> None:
    killed, _ = make(tmp_path, stop_at=7)
    with pytest.raises(KeyboardInterrupt):
        killed.fit()
    stored = json.loads((tmp_path / "checkpoints" / "step-00000005" / "progress.json").read_text())["seconds"]
    again, _ = make(tmp_path)
    again.resume()
    again.fit()
    assert again.seconds > stored > 0.0


def test_a_lower_rate_holds_after_going_on(tmp_path: Path) -> None:
    make(tmp_path, changed(steps=10))[0].fit()
    slower = changed(learning_rate=1e-4)
    again, _ = make(tmp_path, slower)
    again.resume()
    assert again.optimizer.param_groups[0]["lr"] == pytest.approx(1e-4 * rate_at(10, slower, 20))
    again.train_step(data()[again.indices_of(10)])
    assert again.schedule.get_last_lr()[0] == pytest.approx(1e-4 * rate_at(11, slower, 20))


def test_a_loss_that_is_not_finite_stops_the_run_at_its_last_checkpoint(tmp_path: Path) -> None:
    trainer = Trainer(Regression(), data(broken_row=7), lambda step: [step], CONFIG, tmp_path)
    with pytest.raises(NonFiniteError, match=r"loss at step 7 is nan; its batch, .*broken_batch\.safetensors"):
        trainer.fit()
    with safe_open(tmp_path / "broken_batch.safetensors", framework="pt") as kept:
        assert kept.metadata() == {"step": "7", "seed": "3", "samples": "[7]"}
        assert bool(kept.get_tensor("y").isnan().all())
    stored = load_file(tmp_path / "checkpoints" / "step-00000005" / "model.safetensors")
    assert all(bool(torch.isfinite(tensor).all()) for tensor in stored.values())


def test_nothing_but_checkpoints_and_logs_is_left(tmp_path: Path) -> None:
    make(tmp_path)[0].fit()
    assert {path.name for path in tmp_path.iterdir()} == {"checkpoints", "log", "log.jsonl"}


# Schedule and groups --------------------------------------------------------------------------------------------------


def test_the_rate_warms_up_in_a_line() -> None:
    config = changed(warmup=10, steps=110)
    np.testing.assert_allclose([rate_at(step, config, 110) for step in range(10)], np.arange(1, 11) / 10)


@pytest.mark.parametrize("final", [0.0, 0.1])
def test_the_rate_falls_as_half_a_cosine(final: float) -> None:
    config = changed(warmup=10, steps=110, final_rate=final)
    quarter = final + (1 - final) * (1 + math.sqrt(0.5)) / 2
    expected = [1.0, quarter, (1 + final) / 2, final, final]
    np.testing.assert_allclose([rate_at(step, config, 110) for step in (10, 35, 60, 110, 500)], expected, atol=1e-12)


def test_the_rate_may_do_without_warming_up() -> None:
    assert rate_at(0, changed(warmup=0), 20) == 1.0


def test_weights_of_linear_and_convolution_layers_alone_are_decayed(tmp_path: Path, model: UniTouchModel) -> None:
    objective = Regression()
    objective.trained = model  # with tokens of sensors and of the class, tables, norms, and a learned key and value
    trainer = Trainer(objective, data(), lambda step: [0], changed(weight_decay=0.3), tmp_path)
    names = {id(parameter): name for name, parameter in model.named_parameters()}
    decayed = {names[id(p)] for g in trainer.optimizer.param_groups for p in g["params"] if g["weight_decay"] == 0.3}
    spared = {names[id(p)] for g in trainer.optimizer.param_groups for p in g["params"] if g["weight_decay"] == 0.0}
    assert decayed | spared == set(names.values()) and not decayed & spared
    kinds = {name: type(model.get_submodule(name.rpartition(".")[0])).__name__ for name in names.values()}
    assert {kinds[name] for name in decayed} == {"Linear", "Conv2d"}
    assert all(name.endswith(".weight") for name in decayed)
    assert not [name for name in spared if kinds[name] in ("Linear", "Conv2d") and name.endswith(".weight")]
    tokens = {"sensor_bank.tokens", "touch_model.class_token", "touch_model.position"}
    assert tokens <= spared and {"Embedding", "LayerNorm", "SensorBank"} <= {kinds[name] for name in spared}


# Ways of training that leave the result as it is ----------------------------------------------------------------------


def test_workers_read_the_same_batches(tmp_path: Path) -> None:
    alone, expected = make(tmp_path / "alone", noise=0.1)
    alone.fit()
    stopped, _ = make(tmp_path / "workers", changed(workers=1), noise=0.1, stop_at=8)
    with pytest.raises(KeyboardInterrupt):
        stopped.fit()
    again, objective = make(tmp_path / "workers", changed(workers=2), noise=0.1)
    again.resume()
    again.fit()
    assert all(torch.equal(a, b) for a, b in zip(objective.weights(), expected.weights(), strict=True))


def test_a_batch_in_parts_has_the_gradient_of_the_whole(tmp_path: Path) -> None:
    whole, expected = make(tmp_path / "whole", changed(grad_clip=0.1))
    parts, objective = make(tmp_path / "parts", changed(grad_clip=0.1, accumulation=4))
    whole.fit()
    parts.fit()
    for kept, weight in zip(objective.weights(), expected.weights(), strict=True):
        torch.testing.assert_close(kept, weight, atol=1e-6, rtol=0)


def test_parts_have_to_divide_a_batch(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="`accumulation` is 3 and `batch_size` 8; take a divisor"):
        make(tmp_path, changed(accumulation=3))


@pytest.mark.parametrize("module", ["touch_model", "text_model", "vision_model"])
def test_gradients_are_the_same_where_blocks_compute_once_more(model: UniTouchModel, module: str) -> None:
    network = getattr(model, module).train()
    generator = torch.Generator().manual_seed(0)
    if module == "text_model":
        inputs = torch.randint(0, 100, (2, 12), generator=generator)
    else:
        inputs = torch.randn(2, 3, 32, 32, generator=generator)
    found = []
    for again in (False, True):
        if again:
            checkpoint_gradients(network)
        network.zero_grad()
        output = network(inputs)
        (output if isinstance(output, Tensor) else output[0]).square().mean().backward()
        found.append({name: p.grad.clone() for name, p in network.named_parameters() if p.grad is not None})
    assert found[0].keys() == found[1].keys() and found[0]
    for name, gradient in found[0].items():
        torch.testing.assert_close(found[1][name], gradient)


class Squares(nn.Module):
    """The mean square of what a network makes of pictures."""

    def __init__(self, network: nn.Module):
        super().__init__()
        self.trained = network

    def forward(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        return {"loss": self.trained(batch["image"]).square().mean()}


def test_a_run_is_the_same_where_blocks_compute_once_more(model: UniTouchModel, tmp_path: Path) -> None:
    images = np.random.default_rng(0).standard_normal((16, 3, 32, 32)).astype(np.float32)
    found = []
    for again in (False, True):
        network = copy.deepcopy(model.touch_model)
        config = changed(gradient_checkpointing=again, steps=2)
        sampler = ShuffledSampler(len(images), config.batch_size, 0)
        Trainer(Squares(network), ArrayDataset(image=images), sampler, config, tmp_path / str(again)).fit()
        found.append(network.state_dict())
    torch.testing.assert_close(*found)


def test_a_network_without_blocks_has_nothing_to_compute_once_more(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="`gradient_checkpointing` is true, but"):
        make(tmp_path, changed(gradient_checkpointing=True))


# How long, how it stops, and what it shows ----------------------------------------------------------------------------


def test_epochs_say_how_often_each_sample_is_seen(tmp_path: Path) -> None:
    trainer, objective = make(tmp_path, changed(steps=None, epochs=2.5))
    assert trainer.steps == 15  # 2.5 times 48 samples in batches of 8
    trainer.fit()
    assert objective.calls == 15


@pytest.mark.parametrize("given", [{"steps": 3, "epochs": 1.0}, {}])
def test_a_run_lasts_steps_or_epochs(given: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="one of them says how long"):
        TrainerConfig(batch_size=8, learning_rate=0.1, **given)


class Told(Regression):
    """A regression whose process is told to end in its third step."""

    told: tuple[signal.Signals, ...] = ()

    def forward(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        for number in self.told if self.calls == 2 else ():
            os.kill(os.getpid(), number)
        return super().forward(batch)


def told(folder: Path, *numbers: signal.Signals) -> Trainer:
    objective = Told(noise=0.1)
    objective.told = numbers
    return Trainer(objective, data(), ShuffledSampler(ROWS, CONFIG.batch_size, CONFIG.seed), CONFIG, folder)


def test_a_second_interrupt_is_heard_at_once(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        told(tmp_path, signal.SIGINT, signal.SIGINT).fit()
    assert not list(tmp_path.rglob("step-*"))


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_run_that_is_told_to_end_saves_first(tmp_path: Path, number: signal.Signals) -> None:
    before = signal.getsignal(number)
    trainer = told(tmp_path, number)
    assert not trainer.fit()
    assert trainer.interrupted == (number == signal.SIGINT)
    assert signal.getsignal(number) is before
    again, objective = make(tmp_path, noise=0.1)
    again.resume()
    assert again.step == 3
    again.fit()
    whole, expected = make(tmp_path / "whole", noise=0.1)
    whole.fit()
    assert all(torch.equal(a, b) for a, b in zip(objective.weights(), expected.weights(), strict=True))


def test_what_is_watched_is_of_the_averaged_weights_and_leaves_training_alone(tmp_path: Path) -> None:
    config = changed(ema_decay=0.9, watch_every=5)
    plain, expected = make(tmp_path / "plain", config)
    plain.fit()
    objective, seen = Regression(), []

    def watch() -> dict[str, float | Image.Image]:
        assert not objective.training
        seen.append(objective.weights())
        torch.rand(3)
        return {"weight": float(objective.weights()[0].mean()), "picture": Image.new("RGB", (4, 4))}

    sampler = ShuffledSampler(ROWS, config.batch_size, config.seed)
    Trainer(objective, data(), sampler, config, tmp_path / "watched", watch=watch).fit()
    for kept, weight, last in zip(objective.weights(), expected.weights(), seen[-1], strict=True):
        assert torch.equal(kept, weight) and torch.equal(last, weight)
    steps = (5, 10, 15, 20)
    assert sorted(file.name for file in (tmp_path / "watched" / "watched").iterdir()) == [
        f"picture-{step:08d}.png" for step in steps
    ]
    lines = [json.loads(line) for line in (tmp_path / "watched" / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines if "weight" in line] == list(steps)


def test_trackers_that_are_not_installed_are_named(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"`trackers` names \['nothing'\], which are not installed"):
        make(tmp_path, changed(trackers=["nothing"]))
