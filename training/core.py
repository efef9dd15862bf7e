"""The one trainer: a loop around an objective, with accelerate, a cosine schedule, EMA, checkpoints and resume.

An objective is an `nn.Module` whose `forward(batch)` returns a dict of scalar tensors with a `loss`, and whose
`trained` module is what the optimiser changes. Batches come from a map of a step number to indices, so a run that was
killed continues with exactly the batches it would have seen.
"""

import json
import math
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch
import yaml
from accelerate import Accelerator
from accelerate.utils import set_seed
from diffusers.training_utils import EMAModel
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.data import DataLoader, Dataset, Sampler
from tqdm.auto import tqdm

from unitouch_gen.errors import InvalidInputError, check_choice, check_integer, check_number
from unitouch_gen.training.folders import replace_folder, restore_folder

Batch = dict[str, Tensor]
RECIPES = Path(__file__).parent / "recipes"


@dataclass(frozen=True)
class TrainerConfig:
    """How long and how fast.

    Attributes:
        steps: Optimiser steps.
        batch_size: Samples a step.
        learning_rate: Peak of the cosine schedule.
        warmup: Steps of linear warm-up.
        final_rate: Where the cosine ends, as a share of the peak.
        optimizer: "adamw" or "adam".
        weight_decay, beta2: Of the optimiser; norms, biases and tokens are not decayed.
        grad_clip: Largest gradient norm; 0 switches clipping off.
        ema_decay: Of the averaged weights, which are the ones kept; 0 keeps the raw weights.
        mixed_precision: "no", "fp16" or "bf16", for accelerate.
        save_every: Steps between checkpoints.
        seed: Of initial weights, batches and noise.
    """

    steps: int
    batch_size: int
    learning_rate: float
    warmup: int = 100
    final_rate: float = 0.0
    optimizer: str = "adamw"
    weight_decay: float = 0.05
    beta2: float = 0.98
    grad_clip: float = 1.0
    ema_decay: float = 0.0
    mixed_precision: str = "no"
    save_every: int = 250
    seed: int = 0

    def __post_init__(self) -> None:
        for name, low in {"steps": 1, "batch_size": 1, "warmup": 0, "save_every": 1, "seed": 0}.items():
            check_integer(name, getattr(self, name), low)
        for name in ("learning_rate", "weight_decay", "grad_clip"):
            check_number(name, getattr(self, name), 0.0)
        for name in ("final_rate", "beta2", "ema_decay"):
            check_number(name, getattr(self, name), 0.0, 1.0)
        check_choice("mixed_precision", self.mixed_precision, ("no", "fp16", "bf16"))


def read_recipe(path: str | Path, overrides: list[str] | None = None) -> dict[str, Any]:
    """A YAML recipe with `section.key=value` overrides laid over it.

    Args:
        path: A file, or the name of one in `training/recipes`.

    Raises:
        InvalidInputError: If the file is missing, or an override names nothing in it and no field of `TrainerConfig`.
    """
    file = Path(path) if Path(path).is_file() else RECIPES / f"{path}.yaml"
    if not file.is_file():
        known = sorted(p.stem for p in RECIPES.glob("*.yaml"))
        raise InvalidInputError(f"`recipe` is {str(path)!r}; pass a YAML file or one of {known}.")
    recipe = yaml.safe_load(file.read_text())
    for override in overrides or []:
        key, separator, value = override.partition("=")
        section = recipe
        *parents, leaf = key.split(".")
        for parent in parents:
            section = section.get(parent) if isinstance(section, dict) else None
        allowed = TrainerConfig.__dataclass_fields__ if parents == ["trainer"] else section  # a recipe leaves some out
        if not separator or not isinstance(section, dict) or leaf not in allowed:
            raise InvalidInputError(f"`set` is {override!r}; write section.key=value with a key of {file.name}.")
        section[leaf] = _value(value)
    return recipe


def _value(text: str) -> Any:
    """YAML, and 1e-3 is a number: YAML 1.1 takes it for a string, as it holds no point."""
    value = yaml.safe_load(text)
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value


def trainer_config(section: dict[str, Any]) -> TrainerConfig:
    """`TrainerConfig` of a recipe's `trainer` section.

    Raises:
        InvalidInputError: On a key that is none of its fields.
    """
    known = {field.name for field in fields(TrainerConfig)}
    unknown = sorted(set(section) - known)
    if unknown:
        raise InvalidInputError(f"`trainer` holds {unknown}; its keys are {sorted(known)}.")
    if section.get("mixed_precision") is False:  # YAML 1.1 reads a bare no as false
        section = {**section, "mixed_precision": "no"}
    return TrainerConfig(**section)


class StepSampler(Sampler[list[int]]):
    """Index lists for steps `start` ... `steps` - 1, each a function of the step alone."""

    def __init__(self, indices_of: Callable[[int], list[int]], steps: int, start: int = 0):
        self.indices_of, self.steps, self.start = indices_of, steps, start

    def __len__(self) -> int:
        return self.steps - self.start

    def __iter__(self) -> Iterator[list[int]]:
        return (self.indices_of(step) for step in range(self.start, self.steps))


class Trainer:
    """Runs one objective.

    Args:
        objective: See the module's docstring.
        dataset: Its `__getitems__(indices)` returns a whole batch.
        indices_of: Step number -> indices of its batch.
        config: How long and how fast.
        output: Folder for checkpoints (`checkpoint/`) and the log (`log.jsonl`).
    """

    def __init__(
        self,
        objective: nn.Module,
        dataset: Dataset,
        indices_of: Callable[[int], list[int]],
        config: TrainerConfig,
        output: Path,
    ):
        self.config, self.output = config, Path(output)
        self.output.mkdir(parents=True, exist_ok=True)
        self.accelerator = Accelerator(mixed_precision=config.mixed_precision)
        self.dataset, self.indices_of = dataset, indices_of
        self.step, self.seconds = 0, 0.0

        self.trained: nn.Module = objective.trained  # type: ignore[assignment]
        optimizer = _optimizer(self.trained, config)
        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: rate_at(step, config))
        self.objective, self.optimizer = self.accelerator.prepare(objective, optimizer)
        self.schedule = schedule
        self.accelerator.register_for_checkpointing(schedule)
        self.ema = None
        if config.ema_decay:
            self.ema = EMAModel(self.trained.parameters(), decay=config.ema_decay, use_ema_warmup=True, power=3 / 4)
            self.ema.to(self.accelerator.device)
            self.accelerator.register_for_checkpointing(self.ema)

    @property
    def checkpoint(self) -> Path:
        return self.output / "checkpoint"

    def resume(self) -> bool:
        """Continues from the last checkpoint, if there is one; says whether there was."""
        restore_folder(self.checkpoint)
        progress = self.checkpoint / "progress.json"
        if not progress.is_file():
            return False
        self.accelerator.load_state(str(self.checkpoint))
        if self.ema is not None:
            self.ema.to(self.accelerator.device)  # accelerate reads what is registered with it onto the CPU
        state = json.loads(progress.read_text())
        self.step, self.seconds = state["step"], state["seconds"]
        # The rate is the configuration's: the one stored may be why the run has to go on with another.
        self.schedule.base_lrs = [self.config.learning_rate] * len(self.schedule.base_lrs)
        for group in self.optimizer.param_groups:
            group["lr"] = self.config.learning_rate * rate_at(self.step, self.config)
        return True

    def fit(self) -> None:
        """Trains to the last step, then leaves the averaged weights in the trained module."""
        started = time.monotonic() - self.seconds
        self._trim_log()
        sampler = StepSampler(self.indices_of, self.config.steps, self.step)
        loader = DataLoader(self.dataset, batch_sampler=sampler, collate_fn=_whole_batch)  # type: ignore[arg-type]
        bar = tqdm(loader, initial=self.step, total=self.config.steps, desc=self.output.name, mininterval=5.0)
        self.objective.train()
        for batch in bar:
            set_seed(self.config.seed * 1_000_003 + self.step)  # noise and augmentation follow from the step
            losses = self.train_step({key: value.to(self.accelerator.device) for key, value in batch.items()})
            self.step += 1
            self.seconds = time.monotonic() - started
            bar.set_postfix({key: f"{value:.3f}" for key, value in losses.items()}, refresh=False)
            self._log(losses)
            if self.step % self.config.save_every == 0 and self.step < self.config.steps:
                self.save()
        self.save()
        if self.ema is not None:
            self.ema.copy_to(self.trained.parameters())
        self.objective.eval()

    def train_step(self, batch: Batch) -> dict[str, float]:
        """One optimiser step; returns its losses.

        Raises:
            ArithmeticError: If the loss is not finite; the last checkpoint stays as it is.
        """
        with self.accelerator.autocast(), self._attention():
            losses = self.objective(batch)
        loss = losses["loss"]
        if not bool(torch.isfinite(loss)):
            raise ArithmeticError(f"The loss at step {self.step} is {loss.item()}; lower `learning_rate` and resume.")
        self.accelerator.backward(loss)
        if self.config.grad_clip:
            self.accelerator.clip_grad_norm_(self.trained.parameters(), self.config.grad_clip)
        self.optimizer.step()
        self.schedule.step()
        self.optimizer.zero_grad(set_to_none=True)
        if self.ema is not None:
            self.ema.step(self.trained.parameters())
        return {key: value.item() for key, value in losses.items()}

    def _attention(self) -> AbstractContextManager[None]:
        """On a CPU, attention as two products: its fused backward in bf16 takes a quarter of a small UNet's step."""
        on_cpu = self.accelerator.device.type == "cpu"
        return sdpa_kernel(SDPBackend.MATH) if on_cpu else nullcontext()

    def save(self) -> None:
        """Writes a checkpoint beside the last one, then takes its place."""
        if not self.accelerator.is_main_process:
            return
        partial = self.output / "checkpoint.partial"
        self.accelerator.save_state(str(partial))
        (partial / "progress.json").write_text(json.dumps({"step": self.step, "seconds": self.seconds}))
        replace_folder(partial, self.checkpoint)

    def _trim_log(self) -> None:
        """Drops what the log holds of steps that are yet to come: of an earlier run, or after the last checkpoint."""
        log = self.output / "log.jsonl"
        if self.accelerator.is_main_process and log.is_file():
            whole = (line for line in log.read_text().splitlines() if line.endswith("}"))  # a kill may cut the last one
            lines = [line for line in whole if json.loads(line)["step"] <= self.step]
            log.write_text("".join(f"{line}\n" for line in lines))

    def _log(self, losses: dict[str, float]) -> None:
        if self.accelerator.is_main_process and (self.step % 20 == 0 or self.step == self.config.steps):
            line = {
                "step": self.step,
                "seconds": round(self.seconds, 1),
                "rate": self.schedule.get_last_lr()[0],
                **losses,
            }
            with (self.output / "log.jsonl").open("a") as log:
                log.write(json.dumps(line) + "\n")


def rate_at(step: int, config: TrainerConfig) -> float:
    """Learning rate at a step, as a share of its peak: linear warm-up, then half a cosine."""
    if step < config.warmup:
        return (step + 1) / config.warmup
    progress = min((step - config.warmup) / max(config.steps - config.warmup, 1), 1.0)
    return config.final_rate + (1.0 - config.final_rate) * 0.5 * (1.0 + math.cos(math.pi * progress))


def _optimizer(module: nn.Module, config: TrainerConfig) -> torch.optim.Optimizer:
    decayed = [p for p in module.parameters() if p.requires_grad and p.ndim >= 2 and 1 not in p.shape[:1]]
    ids = {id(p) for p in decayed}
    others = [p for p in module.parameters() if p.requires_grad and id(p) not in ids]
    groups = [{"params": decayed, "weight_decay": config.weight_decay}, {"params": others, "weight_decay": 0.0}]
    kinds = {"adamw": torch.optim.AdamW, "adam": torch.optim.Adam}
    if config.optimizer not in kinds:
        raise InvalidInputError(f"`optimizer` is {config.optimizer!r}; it has to be one of {sorted(kinds)}.")
    return kinds[config.optimizer](groups, lr=config.learning_rate, betas=(0.9, config.beta2))


def _whole_batch(batch: Batch) -> Batch:
    """`__getitems__` has collated already."""
    return batch
