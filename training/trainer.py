"""The one trainer: a loop around an objective, with accelerate, a cosine schedule, EMA, checkpoints and resume.

An objective is an `nn.Module` whose `forward(batch)` returns a dict of scalar tensors with a `loss`, and whose
`trained` module is what the optimiser changes. A batch follows from the number of its step, as do noise and
augmentation, so a run that was killed continues with exactly the batches it would have seen.
"""

import json
import math
import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from accelerate import Accelerator
from accelerate.utils import set_seed
from diffusers.training_utils import EMAModel
from pydantic import BeforeValidator, Field, NonNegativeFloat, NonNegativeInt, PositiveInt
from torch import nn
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.nn.modules.conv import _ConvNd
from torch.optim.swa_utils import update_bn
from tqdm.auto import tqdm

from unitouch_gen.errors import InvalidInputError, NonFiniteError
from unitouch_gen.files import check_writable, complete_folder, write_file, writing, writing_folder
from unitouch_gen.training.batches import ArrayDataset, Batch
from unitouch_gen.training.recipe import Settings, Share

CHECKPOINT, PROGRESS = "checkpoint", "progress.json"
STATISTICS_STEPS = 100
"""Batches over which running statistics of averaged weights are estimated."""


class TrainerConfig(Settings):
    """How long and how fast.

    Attributes:
        steps: Optimiser steps.
        batch_size: Samples a step.
        learning_rate: Peak of the cosine schedule.
        warmup: Steps of linear warm-up.
        final_rate: Where the cosine ends, as a share of the peak.
        optimizer: "adamw" or "adam".
        weight_decay: The optimiser's, on the weights of linear and convolution layers alone.
        beta2: The optimiser's.
        grad_clip: Largest gradient norm; 0 switches clipping off.
        ema_decay: Decay of the averaged weights, which are the ones kept; 0 keeps the raw weights.
        mixed_precision: "no", "fp16" or "bf16", for accelerate. YAML 1.1 reads a bare no as false.
        save_every: Steps between checkpoints.
        seed: Seed of initial weights, batches and noise.
    """

    steps: PositiveInt
    batch_size: PositiveInt
    learning_rate: NonNegativeFloat
    warmup: NonNegativeInt = 100
    final_rate: Share = 0.0
    optimizer: Literal["adam", "adamw"] = "adamw"
    weight_decay: NonNegativeFloat = 0.05
    beta2: Share = 0.98
    grad_clip: NonNegativeFloat = 1.0
    ema_decay: Share = 0.0
    mixed_precision: Annotated[
        Literal["no", "fp16", "bf16"], BeforeValidator(lambda value: "no" if value is False else value)
    ] = "no"
    save_every: PositiveInt = 250
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0


class Trainer:
    """Runs one objective.

    Args:
        objective: See the module's docstring.
        dataset: Whose `dataset[indices]` is a whole batch.
        indices_of: Step number -> indices of its batch.
        config: How long and how fast.
        output: Folder for checkpoints (`checkpoint/`) and the log (`log.jsonl`).
        inputs: Hashes of what it is built on, kept with its checkpoints.

    Raises:
        InvalidInputError: If it runs in several processes, or the output cannot be written or is too small.
    """

    def __init__(
        self,
        objective: nn.Module,
        dataset: ArrayDataset,
        indices_of: Callable[[int], list[int]],
        config: TrainerConfig,
        output: Path,
        inputs: Mapping[str, str] | None = None,
    ):
        self.config, self.output, self.inputs = config, Path(output), dict(inputs or {})
        self.accelerator = Accelerator(mixed_precision=config.mixed_precision)
        check_one_process(self.accelerator.num_processes)
        self.output.mkdir(parents=True, exist_ok=True)
        self.checkpoint, self.log = self.output / CHECKPOINT, self.output / "log.jsonl"
        self.dataset, self.indices_of = dataset, indices_of
        self.step, self.seconds = 0, 0.0

        self.trained: nn.Module = objective.trained  # type: ignore[assignment]
        optimizer = _optimizer(self.trained, config)
        self.schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: rate_at(step, config))
        self.objective, self.optimizer = self.accelerator.prepare(objective, optimizer)
        self.accelerator.register_for_checkpointing(self.schedule)
        self.ema = None
        if config.ema_decay:
            self.ema = EMAModel(self.trained.parameters(), decay=config.ema_decay, use_ema_warmup=True, power=3 / 4)
            self.ema.to(self.accelerator.device)
            self.accelerator.register_for_checkpointing(self.ema)

        state, trained = (
            sum(values.nbytes for values in module.state_dict().values()) for module in (objective, self.trained)
        )
        checkpoint = state + (2 + (self.ema is not None)) * trained  # Adam keeps two averages of each weight
        check_writable(
            "output", self.checkpoint / PROGRESS, 2 * checkpoint
        )  # the last one stays until the next is whole

    def resume(self) -> None:
        """Continues from the last checkpoint.

        Raises:
            InvalidInputError: If there is none, it is beyond the last step, or it is of another model or optimiser.
        """
        progress = read_progress(self.output, self.config.steps)
        try:
            self.accelerator.load_state(str(self.checkpoint))
        except (RuntimeError, ValueError, KeyError) as error:
            raise InvalidInputError(
                f"`resume` finds {str(self.checkpoint)!r}, which does not fit this recipe's model and trainer; go on "
                "with the recipe it began with, or name another output."
            ) from error
        if self.ema is not None:
            self.ema.to(self.accelerator.device)  # accelerate reads what is registered with it onto the CPU
        self.step, self.seconds = progress["step"], progress["seconds"]
        # The rate is the configuration's: the one stored may be why the run has to go on with another.
        self.schedule.base_lrs = [self.config.learning_rate] * len(self.schedule.base_lrs)
        for group in self.optimizer.param_groups:
            group["lr"] = self.config.learning_rate * rate_at(self.step, self.config)

    def fit(self) -> None:
        """Trains to the last step, then leaves the averaged weights in the trained module."""
        started = time.monotonic() - self.seconds
        self._trim_log()
        steps = range(self.step, self.config.steps)
        bar = tqdm(steps, initial=self.step, total=self.config.steps, desc=self.output.name, mininterval=5.0)
        self.objective.train()
        for step in bar:
            losses = self.train_step(self._batch(step))
            self.step = step + 1
            self.seconds = time.monotonic() - started
            bar.set_postfix({key: f"{value:.3f}" for key, value in losses.items()}, refresh=False)
            self._log(losses)
            if self.step % self.config.save_every == 0 and self.step < self.config.steps:
                self.save()
        self.save()
        if self.ema is not None:
            self.ema.copy_to(self.trained.parameters())
            # Batch norms have gathered the statistics of the raw weights. Without a batch norm this does nothing.
            update_bn(map(self._batch, range(min(STATISTICS_STEPS, self.config.steps))), self.objective)
        self.objective.eval()

    def train_step(self, batch: Batch) -> dict[str, float]:
        """One optimiser step; returns its losses.

        Raises:
            NonFiniteError: If the loss is not finite; the last checkpoint stays as it is.
        """
        with self.accelerator.autocast(), self._attention():
            losses = self.objective(batch)
        loss = losses["loss"]
        if not bool(torch.isfinite(loss)):
            raise NonFiniteError(f"The loss at step {self.step} is {loss.item()}; lower `learning_rate` and resume.")
        self.accelerator.backward(loss)
        if self.config.grad_clip:
            self.accelerator.clip_grad_norm_(self.trained.parameters(), self.config.grad_clip)
        self.optimizer.step()
        self.schedule.step()
        self.optimizer.zero_grad(set_to_none=True)
        if self.ema is not None:
            self.ema.step(self.trained.parameters())
        return {key: value.item() for key, value in losses.items()}

    def save(self) -> None:
        """Writes a checkpoint beside the last one, then takes its place."""
        progress = {"step": self.step, "seconds": self.seconds, "inputs": self.inputs}
        with writing_folder("output", self.output, replace=True) as place:
            self.accelerator.save_state(str(place / CHECKPOINT))
            (place / CHECKPOINT / PROGRESS).write_text(json.dumps(progress))

    def _batch(self, step: int) -> Batch:
        """What a step is trained on; noise and augmentation follow from the step, too."""
        set_seed((self.config.seed * 1_000_003 + step) % 2**32)  # numpy takes no more
        batch = self.dataset[self.indices_of(step)]
        return {key: value.to(self.accelerator.device) for key, value in batch.items()}

    def _attention(self) -> AbstractContextManager[None]:
        """On a CPU, attention as two products: its fused backward in bf16 takes a quarter of a small UNet's step."""
        on_cpu = self.accelerator.device.type == "cpu"
        return sdpa_kernel(SDPBackend.MATH) if on_cpu else nullcontext()

    def _trim_log(self) -> None:
        """Drops what the log holds of steps that are yet to come: of an earlier run, or after the last checkpoint."""
        if self.log.is_file():
            whole = (line for line in self.log.read_text().splitlines() if line.endswith("}"))  # a kill may cut one
            lines = [line for line in whole if json.loads(line)["step"] <= self.step]
            write_file("output", self.log, "".join(f"{line}\n" for line in lines))

    def _log(self, losses: dict[str, float]) -> None:
        if self.step % 20 == 0 or self.step == self.config.steps:
            rate = self.schedule.get_last_lr()[0]
            line = {"step": self.step, "seconds": round(self.seconds, 1), "rate": rate, **losses}
            with writing("output", self.log), self.log.open("a") as log:
                log.write(json.dumps(line) + "\n")


def read_progress(output: Path, steps: int) -> dict[str, Any]:
    """`step`, `seconds` and `inputs` of the checkpoint in a folder that a run of `steps` is to continue from.

    Raises:
        InvalidInputError: If there is none, or it is beyond the last step.
    """
    complete_folder(output / CHECKPOINT)
    file = output / CHECKPOINT / PROGRESS
    if not file.is_file():
        raise InvalidInputError(f"`resume` finds no checkpoint in {str(output)!r}; leave it out, or name its output.")
    progress = json.loads(file.read_text())
    if progress["step"] > steps:
        raise InvalidInputError(
            f"`steps` is {steps}, but the checkpoint in {str(output)!r} is at step {progress['step']}; ask for at "
            "least as many, or name another output."
        )
    return progress


def check_one_process(count: int) -> None:
    """Checks that training was not started in several processes: all would see the same batches.

    Raises:
        InvalidInputError: If it was.
    """
    if count > 1:
        raise InvalidInputError(
            f"`num_processes` is {count}; training runs in one process, on the CPU or one GPU. Start it with "
            "`python -m`, or with `accelerate launch --num_processes 1`."
        )


def rate_at(step: int, config: TrainerConfig) -> float:
    """Learning rate at a step, as a share of its peak: linear warm-up, then half a cosine."""
    if step < config.warmup:
        return (step + 1) / config.warmup
    progress = min((step - config.warmup) / max(config.steps - config.warmup, 1), 1.0)
    return config.final_rate + (1.0 - config.final_rate) * 0.5 * (1.0 + math.cos(math.pi * progress))


def _optimizer(module: nn.Module, config: TrainerConfig) -> torch.optim.Optimizer:
    """Adam, with decay of the weights of linear and convolution layers; tokens, tables, norms and biases have none."""
    weights = {id(layer.weight) for layer in module.modules() if isinstance(layer, nn.Linear | _ConvNd)}
    trained = [p for p in module.parameters() if p.requires_grad]
    decayed, others = [p for p in trained if id(p) in weights], [p for p in trained if id(p) not in weights]
    groups = [{"params": decayed, "weight_decay": config.weight_decay}, {"params": others, "weight_decay": 0.0}]
    kind = torch.optim.AdamW if config.optimizer == "adamw" else torch.optim.Adam
    return kind(groups, lr=config.learning_rate, betas=(0.9, config.beta2))
