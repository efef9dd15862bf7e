"""The one trainer: a loop around an objective, with accelerate, a cosine schedule, EMA, checkpoints and resume.

An objective is an `nn.Module` whose `forward(batch)` returns a dict of scalar tensors with a `loss`. The optimiser
trains its module `trained`, or all of it if it has none. The batch, its noise and its augmentation are functions of the
step's number, so a run that was killed goes on with exactly the batches it would have seen. `accelerate launch` runs
it in several processes, by `DistributedDataParallel`: each works on its rows of a batch, with noise of its own, and
gradients are averaged.
"""

import json
import math
import pickle
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import torch
from accelerate import Accelerator, DistributedDataParallelKwargs, PartialState
from accelerate.utils import send_to_device, set_seed
from diffusers.training_utils import EMAModel
from pydantic import BeforeValidator, Field, NonNegativeFloat, NonNegativeInt, PositiveInt, model_validator
from safetensors import SafetensorError
from torch import nn
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.nn.modules.conv import _ConvNd
from torch.optim.lr_scheduler import LambdaLR
from torch.optim.swa_utils import update_bn
from tqdm.auto import tqdm

from unitouch_gen.errors import InvalidInputError, NonFiniteError, first_line
from unitouch_gen.files import read_settings, write_file
from unitouch_gen.training.batches import ArrayDataset, Batch
from unitouch_gen.training.checkpoints import (
    checkpoint_folders,
    checkpoints_in,
    files_of_checkpoint,
    flush,
    last_checkpoint,
    remove_checkpoint,
)
from unitouch_gen.training.recipe import Settings, Share

Decay = Annotated[float, Field(ge=0.0, lt=1.0)]


class TrainerConfig(Settings):
    """Settings of the trainer. Either `steps` or `epochs` is set."""

    steps: Annotated[int, Field(gt=0, le=10**9)] | None = None  # optimiser steps
    epochs: Annotated[float, Field(gt=0, le=1e6)] | None = None  # how often each sample is seen on average
    batch_size: PositiveInt  # samples a step, of all processes together
    learning_rate: Annotated[float, Field(ge=0.0, le=1e3)]  # peak of the cosine schedule
    warmup: NonNegativeInt = 100  # steps of linear warm-up
    final_rate: Share = 0.0  # where the cosine ends, as a share of the peak
    weight_decay: NonNegativeFloat = 0.05  # for the weights of linear and convolution layers only
    beta2: Decay = 0.98
    grad_clip: NonNegativeFloat = 1.0  # largest gradient norm; 0 switches clipping off
    ema_decay: Decay = 0.0  # decay of the averaged weights, which are kept; 0 keeps the raw weights
    mixed_precision: Annotated[
        Literal["no", "fp16", "bf16"],
        BeforeValidator(lambda value: "no" if value is False else value),  # YAML 1.1 reads a bare no as False
    ] = "no"
    save_every: PositiveInt = 250  # steps between checkpoints
    keep_checkpoints: PositiveInt = 1  # number of the latest checkpoints that are kept
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0  # of initial weights, batches and noise

    @model_validator(mode="after")
    def _check_length(self) -> Self:
        if (self.steps is None) == (self.epochs is None):
            raise InvalidInputError(f"`steps` is {self.steps} and `epochs` {self.epochs}; set one, the other to null.")
        return self


def precision_here(wanted: str) -> str:
    """The mixed precision to train in: "no" in place of "bf16" on CPUs that lack its instructions.

    They emulate bfloat16 and take some fifty times as long as in float32.
    """
    if wanted != "bf16" or PartialState().device.type != "cpu":
        return wanted
    capabilities: dict[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()  # of newer torch
    if capabilities.get("architecture") != "x86_64" or capabilities["avx512_bf16"] or capabilities["amx_bf16"]:
        return wanted
    return "no"


class Trainer:
    """Trains an objective (see the module's docstring) on batches `dataset[indices_of(step)]`.

    The log and checkpoints are written to `output`. `progress`, such as hashes of inputs, is stored in each checkpoint.
    """

    def __init__(
        self,
        objective: nn.Module,
        dataset: ArrayDataset,
        indices_of: Callable[[int], Sequence[int]],
        config: TrainerConfig,
        output: Path,
        progress: Mapping[str, Any] | None = None,
    ):
        self.config = config
        self.output = output
        self.progress = dict(progress or {})
        self.dataset = dataset
        self.indices_of = indices_of
        self.steps = config.steps or max(math.ceil((config.epochs or 0) * len(dataset) / config.batch_size), 1)
        self.step = 0
        self.seconds = 0.0
        self.accelerator = Accelerator(
            mixed_precision=precision_here(config.mixed_precision),
            kwargs_handlers=[DistributedDataParallelKwargs(broadcast_buffers=False)],
        )
        self.main = self.accelerator.is_main_process
        processes = self.accelerator.num_processes
        if config.batch_size % processes:
            raise InvalidInputError(f"`batch_size` is {config.batch_size}; take a multiple of {processes} processes.")
        self.trained: nn.Module = getattr(objective, "trained", objective)
        optimizer = _optimizer(self.trained, config)
        self.schedule = LambdaLR(optimizer, lambda step: rate_at(step, config, self.steps))
        self.objective, self.optimizer = self.accelerator.prepare(objective, optimizer)
        self.accelerator.register_for_checkpointing(self.schedule)
        self.ema = None
        if config.ema_decay:
            self.ema = EMAModel(self.trained.parameters(), decay=config.ema_decay, use_ema_warmup=True, power=3 / 4)
            self.ema.to(self.accelerator.device)
            self.accelerator.register_for_checkpointing(self.ema)

    def resume(self) -> None:
        """Continues from the last checkpoint, if it is of this model and optimiser."""
        checkpoint = last_checkpoint(self.output)
        progress = read_settings("resume", checkpoint / "progress.json")
        if progress["step"] > self.steps:
            raise InvalidInputError(f"`steps` is {self.steps}, but {str(checkpoint)!r} is beyond it; ask for more.")
        configured = [
            {"betas": group["betas"], "weight_decay": group["weight_decay"]} for group in self.optimizer.param_groups
        ]
        try:
            self.accelerator.load_state(str(checkpoint))
        except pickle.UnpicklingError as error:
            why = "holds a pickle of more than numbers, of which nothing was run; begin anew in another `output`."
            raise InvalidInputError(f"`resume` finds {str(checkpoint)!r}, which {why}") from error
        except (RuntimeError, ValueError, LookupError, TypeError, AttributeError, OSError, EOFError) as error:
            why = f"does not fit this recipe's model and trainer: {first_line(error)}"
            raise InvalidInputError(f"`resume` finds {str(checkpoint)!r}, which {why}") from error
        if self.ema is not None:
            self.ema.to(self.accelerator.device)  # accelerate loads it on the CPU
            self.ema.decay = self.config.ema_decay
        self.step = progress["step"]
        self.seconds = progress["seconds"]
        # The configuration's settings replace the stored ones, so that a run can go on with, say, a lower rate.
        self.schedule.base_lrs = [self.config.learning_rate] * len(self.schedule.base_lrs)
        rate = self.config.learning_rate * rate_at(self.step, self.config, self.steps)
        for group, settings in zip(self.optimizer.param_groups, configured, strict=True):
            group.update(settings, lr=rate)

    def fit(self) -> None:
        """Trains to the last step, then leaves the averaged weights in the trained module, in evaluation mode."""
        started = time.monotonic() - self.seconds
        self.output.mkdir(parents=True, exist_ok=True)
        if self.main and self.step == 0:
            self._remove_earlier_run()
        self.objective.train()
        bar = {"desc": self.output.name, "mininterval": 5.0, "disable": not self.main}
        with tqdm(range(self.step, self.steps), initial=self.step, total=self.steps, **bar) as steps:
            for step in steps:
                losses = self.train_step(self.dataset[self._rows(step)])
                self.step += 1
                self.seconds = time.monotonic() - started
                steps.set_postfix({key: f"{value:.3f}" for key, value in losses.items()}, refresh=False)
                is_last = self.step == self.steps
                if self.main and (self.step % 20 == 0 or is_last):
                    self._log(losses)
                if self.step % self.config.save_every == 0 or is_last:
                    self.save()
        if self.ema is not None:
            self.ema.copy_to(self.trained.parameters())
            # Batch norms have gathered the statistics of the raw weights. Without a batch norm this does nothing.
            device = self.accelerator.device
            first_steps = range(min(100, self.steps))
            batches = (send_to_device(self.dataset[self._rows(step)], device) for step in first_steps)
            update_bn(batches, self.objective)
        self.objective.eval()
        self.accelerator.end_training()

    def _remove_earlier_run(self) -> None:
        """Removes the log and the checkpoints that an earlier run left in `output`."""
        (self.output / "log.jsonl").unlink(missing_ok=True)
        for folder in checkpoint_folders(self.output):
            remove_checkpoint(folder)

    def _log(self, losses: Mapping[str, float]) -> None:
        """Appends a line to `log.jsonl`."""
        rate = float(self.schedule.get_last_lr()[0])
        line = {"step": self.step, "seconds": round(self.seconds, 1), "rate": rate, **losses}
        with (self.output / "log.jsonl").open("a") as log:
            log.write(json.dumps(line) + "\n")

    def train_step(self, batch: Batch) -> dict[str, float]:
        """One optimiser step on this process's rows of a batch; returns the losses of the whole."""
        # Noise and augmentation are functions of step and process. numpy's seeds have 32 bits.
        process = self.accelerator.process_index
        set_seed((self.config.seed * 1_000_003 + process * 500_000_003 + self.step) % 2**32)
        # On a CPU, attention is two matrix products: the backward pass of fused attention in bf16 takes a quarter of a
        # small UNet's step.
        device = self.accelerator.device
        with sdpa_kernel(SDPBackend.MATH) if device.type == "cpu" else nullcontext():
            with self.accelerator.autocast():
                losses = self.objective(send_to_device(batch, device))
            detached = {key: value.detach().float().to(device) for key, value in losses.items()}
            means: Any = self.accelerator.reduce(detached, "mean")
            if not bool(means["loss"].isfinite()):
                raise NonFiniteError(
                    f"The loss at step {self.step} is {means['loss'].item()}; its samples are {self._rows(self.step)}. "
                    "Lower `learning_rate` and resume: the same batch comes again."
                )
            self.accelerator.backward(losses["loss"])
        if self.config.grad_clip:
            self.accelerator.clip_grad_norm_(self.objective.parameters(), self.config.grad_clip)
        self.optimizer.step()
        self.schedule.step()
        self.optimizer.zero_grad(set_to_none=True)
        if self.ema is not None:
            self.ema.step(self.trained.parameters())
        return {key: value.item() for key, value in means.items()}

    def save(self) -> None:
        """Writes a checkpoint, `progress.json` last, and removes older ones."""
        folder = self.output / "checkpoints" / f"step-{self.step:08d}"
        try:
            self.accelerator.save_state(str(folder))
        except (OSError, RuntimeError, SafetensorError) as error:  # torch raises RuntimeError if the disk is full
            why = f"{first_line(error)}. Make room, then go on with `--resume`."
            raise InvalidInputError(f"`output` cannot be written to {str(folder)!r}: {why}") from error
        self.accelerator.wait_for_everyone()
        if self.main:
            files = files_of_checkpoint(folder)
            for file in files:
                flush(file)  # so that a power cut after older checkpoints are removed does not lose this one
            progress = {
                "step": self.step,
                "seconds": self.seconds,
                "files": [file.name for file in files],
                **self.progress,
            }
            flush(write_file("output", folder / "progress.json", json.dumps(progress)))
            kept = checkpoints_in(self.output)[-self.config.keep_checkpoints :]
            for old in checkpoint_folders(self.output):
                if old not in kept:
                    remove_checkpoint(old)
        self.accelerator.wait_for_everyone()

    def _rows(self, step: int) -> list[int]:
        """Indices of this process's rows of a step's batch."""
        indices = self.indices_of(step)
        count = len(indices) // self.accelerator.num_processes
        start = self.accelerator.process_index * count
        return [*indices[start : start + count]]


def rate_at(step: int, config: TrainerConfig, steps: int) -> float:
    """Learning rate at one of `steps` steps, as a share of its peak: linear warm-up, then half a cosine."""
    if step < config.warmup:
        return (step + 1) / config.warmup
    progress = min((step - config.warmup) / max(steps - config.warmup, 1), 1.0)
    return config.final_rate + (1.0 - config.final_rate) * 0.5 * (1.0 + math.cos(math.pi * progress))


def _optimizer(module: nn.Module, config: TrainerConfig) -> torch.optim.Optimizer:
    """AdamW. The weights of linear and convolution layers decay; tokens, tables, norms and biases do not."""
    weights = {id(layer.weight) for layer in module.modules() if isinstance(layer, nn.Linear | _ConvNd)}
    weights |= {id(layer.in_proj_weight) for layer in module.modules() if isinstance(layer, nn.MultiheadAttention)}
    trained = [parameter for parameter in module.parameters() if parameter.requires_grad]
    groups = [
        {"params": [p for p in trained if id(p) in weights], "weight_decay": config.weight_decay},
        {"params": [p for p in trained if id(p) not in weights], "weight_decay": 0.0},
    ]
    return torch.optim.AdamW(groups, lr=config.learning_rate, betas=(0.9, config.beta2))
