"""The one trainer: a loop around an objective, with accelerate, a cosine schedule, EMA, checkpoints and resume.

An objective is an `nn.Module` whose `forward(batch)` returns a dict of scalar tensors with a `loss`, and whose
`trained` module is what the optimiser changes. A batch follows from the number of its step, as do noise and
augmentation, so a run that was killed continues with exactly the batches it would have seen, however many workers read
them.

`accelerate launch` runs it in several processes, by `DistributedDataParallel`: each works on its rows of a batch, with
noise of its own, and gradients are averaged.
"""

import json
import math
import shutil
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Annotated, Any, Literal, Self, cast

import torch
from accelerate import Accelerator, DistributedDataParallelKwargs
from accelerate.state import AcceleratorState
from accelerate.tracking import get_available_trackers
from accelerate.utils import broadcast_object_list, set_seed
from diffusers.training_utils import EMAModel
from PIL import Image
from pydantic import (
    BeforeValidator,
    Field,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveInt,
    model_validator,
)
from safetensors.torch import save_file
from torch import nn
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.nn.modules.conv import _ConvNd
from torch.optim.swa_utils import update_bn
from torch.utils.data import DataLoader, Dataset
from tqdm.auto import tqdm

from unitouch_gen.errors import InvalidInputError, NonFiniteError, first_line
from unitouch_gen.files import (
    check_writable,
    complete_folder,
    read_json,
    replacing,
    writing,
    writing_folder,
)
from unitouch_gen.models.vit import UniTouchViT
from unitouch_gen.training.batches import ArrayDataset, Batch
from unitouch_gen.training.distributed import rows_of
from unitouch_gen.training.recipe import Decay, Rate, Seed, Settings, Share, Steps
from unitouch_gen.training.watching import Watch

CHECKPOINTS, PROGRESS, BROKEN, WATCHED = "checkpoints", "progress.json", "broken_batch", "watched"
STATISTICS_STEPS = 100
"""Batches over which running statistics of averaged weights are estimated."""


class TrainerConfig(Settings):
    """How long and how fast.

    Attributes:
        steps, epochs: Optimiser steps, or how often each sample is seen on average; one of them.
        batch_size: Samples a step, of all processes together.
        accumulation: Parts that a batch is taken in, one after the other, for less memory. Losses that compare samples
            with each other compare those of a part.
        learning_rate: Peak of the cosine schedule.
        warmup: Steps of linear warm-up.
        final_rate: Where the cosine ends, as a share of the peak.
        optimizer: "adamw" or "adam".
        weight_decay: The optimiser's, on the weights of linear and convolution layers alone.
        beta2: The optimiser's.
        grad_clip: Largest gradient norm; 0 switches clipping off.
        ema_decay: Decay of the averaged weights, which are the ones kept; 0 keeps the raw weights.
        mixed_precision: "no", "fp16" or "bf16", for accelerate. YAML 1.1 reads a bare no as false.
        gradient_checkpointing: Whether to compute what blocks made once more on the way back, in place of keeping it.
        compile: Whether to compile the objective.
        workers: Processes that read batches ahead, for each that trains; 0 reads in between.
        save_every: Steps between checkpoints.
        keep_checkpoints: The last ones that stay.
        watch_every: Steps between looks at held-out data; 0 never looks.
        trackers: Of accelerate, for figures, such as "tensorboard"; null is tensorboard where it is installed.
        seed: Seed of initial weights, batches and noise.
    """

    steps: Steps | None = None
    epochs: Annotated[float, Field(gt=0, le=1e6)] | None = None
    batch_size: PositiveInt
    accumulation: PositiveInt = 1
    learning_rate: Rate
    warmup: NonNegativeInt = 100
    final_rate: Share = 0.0
    optimizer: Literal["adam", "adamw"] = "adamw"
    weight_decay: NonNegativeFloat = 0.05
    beta2: Decay = 0.98
    grad_clip: NonNegativeFloat = 1.0
    ema_decay: Decay = 0.0
    mixed_precision: Annotated[
        Literal["no", "fp16", "bf16"], BeforeValidator(lambda value: "no" if value is False else value)
    ] = "no"
    gradient_checkpointing: bool = False
    compile: bool = False
    workers: NonNegativeInt = 0
    save_every: PositiveInt = 250
    keep_checkpoints: PositiveInt = 1
    watch_every: NonNegativeInt = 250
    trackers: list[str] | None = None
    seed: Seed = 0

    @model_validator(mode="after")
    def _lasts_one_way(self) -> Self:
        if (self.steps is None) == (self.epochs is None):
            raise InvalidInputError(
                f"`steps` is {self.steps} and `epochs` {self.epochs}; one of them says how long, and the other is null."
            )
        return self

    def steps_for(self, samples: int) -> int:
        """Optimiser steps on a data set of so many samples."""
        if self.steps is not None:
            return self.steps
        assert self.epochs is not None
        return max(math.ceil(self.epochs * samples / self.batch_size), 1)


class Trainer:
    """Runs one objective.

    Args:
        objective: See the module's docstring.
        dataset: Whose `dataset[indices]` is a whole batch.
        indices_of: Step number -> indices of its batch.
        config: How long and how fast.
        output: Folder for checkpoints (`checkpoints/`), the log (`log.jsonl`), what trackers write and what is watched.
        progress: What is kept with its checkpoints and has to be the same to go on, such as hashes of its inputs.
        watch: Called every `watch_every` steps on the averaged weights, in the main process alone; figures are logged,
            and pictures go into `watched/`.
        quiet: Whether to show no progress.

    Raises:
        InvalidInputError: If the processes cannot share a batch evenly, a setting is not to be had here, or the output
            cannot be written or is too small.
    """

    def __init__(
        self,
        objective: nn.Module,
        dataset: ArrayDataset,
        indices_of: Callable[[int], list[int]],
        config: TrainerConfig,
        output: Path,
        progress: Mapping[str, Any] | None = None,
        watch: Watch | None = None,
        quiet: bool = False,
    ):
        self.quiet = quiet
        self.config, self.output, self.progress, self.watch = config, Path(output), dict(progress or {}), watch
        self.steps = config.steps_for(len(dataset))
        AcceleratorState._reset_state()  # a training before in the same process may have had another precision
        self.accelerator = Accelerator(
            mixed_precision=config.mixed_precision,
            log_with=_trackers(config.trackers) or None,
            project_dir=str(self.output),
            dynamo_backend="inductor" if config.compile else None,
            kwargs_handlers=[DistributedDataParallelKwargs(broadcast_buffers=False)],
        )
        self.main = self.accelerator.is_main_process
        self.part = config.batch_size // config.accumulation
        if config.batch_size % config.accumulation:
            raise InvalidInputError(
                f"`accumulation` is {config.accumulation} and `batch_size` {config.batch_size}; take a divisor of it."
            )
        self.rows = rows_of(self.part, self.accelerator.process_index, self.accelerator.num_processes)
        self.checkpoints, self.log = self.output / CHECKPOINTS, self.output / "log.jsonl"
        self.dataset, self.indices_of = dataset, indices_of
        self.step, self.seconds, self.stopped, self.interrupted = 0, 0.0, False, False

        self.trained: nn.Module = objective.trained  # type: ignore[assignment]
        if config.gradient_checkpointing:
            checkpoint_gradients(self.trained)
        optimizer = _optimizer(self.trained, config)
        self.schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: rate_at(step, config, self.steps))
        self.objective, self.optimizer = self.accelerator.prepare(objective, optimizer)
        self.accelerator.register_for_checkpointing(self.schedule)
        self.ema = None
        if config.ema_decay:
            self.ema = EMAModel(self.trained.parameters(), decay=config.ema_decay, use_ema_warmup=True, power=3 / 4)
            self.ema.to(self.accelerator.device)
            self.accelerator.register_for_checkpointing(self.ema)

        weights = sum(parameter.nbytes for parameter in objective.parameters())
        checkpoint = (3 + (self.ema is not None)) * weights  # Adam keeps two averages of each
        missing = config.keep_checkpoints + 1 - len(checkpoints_in(self.output))  # one more until the next is whole
        check_writable("output", self.log, max(missing, 1) * checkpoint)
        self.output.mkdir(parents=True, exist_ok=True)

    def resume(self) -> None:
        """Continues from the last checkpoint.

        Raises:
            InvalidInputError: If there is none, it is beyond the last step, or it is of another model or optimiser.
        """
        progress = read_progress(self.output, self.steps)
        checkpoint = checkpoints_in(self.output)[-1]
        try:
            self.accelerator.load_state(str(checkpoint))
        except (RuntimeError, ValueError, KeyError) as error:
            raise InvalidInputError(
                f"`resume` finds {str(checkpoint)!r}, which does not fit this recipe's model and trainer; go on "
                "with the recipe it began with, or name another output."
            ) from error
        if self.ema is not None:
            self.ema.to(self.accelerator.device)  # accelerate reads it onto the CPU
        self.step, self.seconds = progress["step"], progress["seconds"]
        # The rate is the configuration's: the one stored may be why the run has to go on with another.
        self.schedule.base_lrs = [self.config.learning_rate] * len(self.schedule.base_lrs)
        for group in self.optimizer.param_groups:
            group["lr"] = self.config.learning_rate * rate_at(self.step, self.config, self.steps)

    def fit(self) -> bool:
        """Trains to the last step, then leaves the averaged weights in the trained module.

        Returns:
            Whether it came to the last step; if not, a SIGTERM or an interrupt stopped it after a checkpoint.
        """
        started = time.monotonic() - self.seconds
        if self.main and self.step == 0:
            self.log.unlink(missing_ok=True)  # of an earlier run
        self.accelerator.init_trackers("log", {**self.config.model_dump(exclude={"trackers"}), "steps": self.steps})
        bar = tqdm(
            self._batches(), initial=self.step, total=self.steps, desc=self.output.name, mininterval=5.0,
            disable=self.quiet or not self.main,
        )  # fmt: skip
        self.objective.train()
        watched = self.watch is not None and self.config.watch_every > 0
        with self._stoppable():
            for batch in bar:
                losses = self.train_step(batch)
                self.step += 1
                self.seconds = time.monotonic() - started
                bar.set_postfix({key: f"{value:.3f}" for key, value in losses.items()}, refresh=False)
                self._log(losses)
                if watched and self.step % self.config.watch_every == 0:
                    self._look()
                self.stopped = self._any(self.stopped)
                if self.stopped or (self.step % self.config.save_every == 0 and self.step < self.steps):
                    self.save()
                if self.stopped:
                    self.accelerator.end_training()
                    return False
        self.save()
        if self.ema is not None:
            self.ema.copy_to(self.trained.parameters())
            # Batch norms have gathered the statistics of the raw weights. Without a batch norm this does nothing.
            first = range(min(STATISTICS_STEPS, self.steps))
            update_bn((self._placed(self.dataset[self._indices(step)]) for step in first), self.objective)
        self.objective.eval()
        self.accelerator.end_training()
        return True

    def train_step(self, batch: Batch) -> dict[str, float]:
        """One optimiser step on this process's rows of a batch; returns the losses of the whole.

        Raises:
            NonFiniteError: If the loss is not finite; the last checkpoint stays as it is, and the batch is kept.
        """
        # Noise and augmentation follow from the step and the process, too. numpy takes no more.
        process = self.accelerator.process_index
        set_seed((self.config.seed * 1_000_003 + process * 500_000_003 + self.step) % 2**32)
        batch = self._placed(batch)
        count, totals = self.config.accumulation, dict[str, torch.Tensor]()
        size = len(next(iter(batch.values()))) // count
        for part in range(count):
            rows = {key: value[part * size : (part + 1) * size] for key, value in batch.items()}
            waits = self.accelerator.no_sync(self.objective) if part < count - 1 else nullcontext()
            with waits, self._attention():  # also on the way back, where checkpointed blocks are computed once more
                with self.accelerator.autocast():
                    losses = self.objective(rows)
                mean = {key: self._mean(value.detach().float()) / count for key, value in losses.items()}
                if not bool(torch.isfinite(mean["loss"])):
                    raise self._broken(batch, mean["loss"].item())
                totals = {key: value + totals.get(key, 0.0) for key, value in mean.items()}
                self.accelerator.backward(losses["loss"] / count)
        if self.config.grad_clip:
            self.accelerator.clip_grad_norm_(self.objective.parameters(), self.config.grad_clip)
        self.optimizer.step()
        self.schedule.step()
        self.optimizer.zero_grad(set_to_none=True)
        if self.ema is not None:
            self.ema.step(self.trained.parameters())
        return {key: value.item() for key, value in totals.items()}

    def save(self) -> None:
        """Writes a checkpoint, and lets older ones go."""
        progress = {"step": self.step, "seconds": self.seconds, **self.progress}
        name = f"step-{self.step:08d}"
        with writing_folder("output", self.checkpoints, replace=True) if self.main else nullcontext() as folder:
            (place,) = broadcast_object_list([str(folder and folder / name)])
            self.accelerator.save_state(place)
            self.accelerator.wait_for_everyone()
            if self.main:
                (Path(place) / PROGRESS).write_text(json.dumps(progress))
        if self.main:
            found = checkpoints_in(self.output)
            here = found.index(self.checkpoints / name) + 1
            kept = found[max(here - self.config.keep_checkpoints, 0) : here]
            for old in {*self.checkpoints.glob("step-*")} - {*kept}:  # or of an earlier run, or left by a kill
                (old / PROGRESS).unlink(missing_ok=True)  # first, by which it seems whole
                shutil.rmtree(old)
        self.accelerator.wait_for_everyone()

    # What goes in -----------------------------------------------------------------------------------------------------

    def _indices(self, step: int) -> list[int]:
        """This process's rows of a step's batch, part by part."""
        indices = self.indices_of(step)
        if self.accelerator.num_processes == 1:
            return indices
        starts = range(0, self.config.batch_size, self.part)
        return [index for start in starts for index in indices[start : start + self.part][self.rows]]

    def _batches(self) -> Iterator[Batch]:
        """Batches of the steps that are left."""
        steps = _Steps(self.dataset, self._indices, range(self.step, self.steps))
        try:
            yield from DataLoader(steps, batch_size=None, num_workers=self.config.workers)
        except RuntimeError as error:
            if "DataLoader worker" not in str(error):
                raise
            raise InvalidInputError(
                f"`workers`: {first_line(error)} Go on with `--resume`, and with fewer if memory ran out."
            ) from error

    def _placed(self, batch: Batch) -> Batch:
        return {key: value.to(self.accelerator.device) for key, value in batch.items()}

    # Around a step ----------------------------------------------------------------------------------------------------

    def _mean(self, value: torch.Tensor) -> torch.Tensor:
        """Mean over processes."""
        return self.accelerator.reduce(value, "mean") if self.accelerator.num_processes > 1 else value

    def _any(self, flag: bool) -> bool:
        """Whether it is so in any process."""
        if self.accelerator.num_processes == 1:
            return flag
        return bool(self.accelerator.reduce(torch.tensor(float(flag), device=self.accelerator.device), "sum"))

    def _attention(self) -> AbstractContextManager[None]:
        """On a CPU, attention as two products: its fused backward in bf16 takes a quarter of a small UNet's step."""
        on_cpu = self.accelerator.device.type == "cpu"
        return sdpa_kernel(SDPBackend.MATH) if on_cpu else nullcontext()

    @contextmanager
    def _stoppable(self) -> Iterator[None]:
        """Within it, a SIGTERM or an interrupt stops the run after its step; a second interrupt at once."""

        def stop(number: int, frame: Any) -> None:
            if self.stopped and number == signal.SIGINT:
                raise KeyboardInterrupt
            self.stopped, self.interrupted = True, number == signal.SIGINT

        try:
            before = {number: signal.signal(number, stop) for number in (signal.SIGTERM, signal.SIGINT)}
        except ValueError:  # not the main thread, which alone gets signals
            yield
            return
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _broken(self, batch: Batch, loss: float) -> NonFiniteError:
        """Keeps the batch of a loss that is not finite, with the indices of its samples."""
        rank = f"-{self.accelerator.process_index}" if self.accelerator.num_processes > 1 else ""
        file = self.output / f"{BROKEN}{rank}.safetensors"
        indices = self._indices(self.step)
        found = {"step": str(self.step), "seed": str(self.config.seed), "samples": json.dumps(indices)}
        with replacing("output", file) as partial:
            save_file({key: value.contiguous().cpu() for key, value in batch.items()}, partial, metadata=found)
        return NonFiniteError(
            f"The loss at step {self.step} is {loss}; its batch, and which samples it is of, is in {str(file)!r}. "
            "Lower `learning_rate` and resume: a batch follows from its step, so the same one comes again."
        )

    # What comes out ---------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def _look(self) -> None:
        """Logs what is watched, of the averaged weights; neither weights nor random numbers are others after it."""
        if self.watch is None or not self.main:
            return
        if self.ema is not None:
            self.ema.store(self.trained.parameters())
            self.ema.copy_to(self.trained.parameters())
        self.objective.eval()
        with torch.random.fork_rng(devices=[]), self.accelerator.autocast(), self._attention():
            seen = self.watch()
        self.objective.train()
        if self.ema is not None:
            self.ema.restore(self.trained.parameters())
        for name, picture in seen.items():
            if isinstance(picture, Image.Image):
                with replacing("output", self.output / WATCHED / f"{name}-{self.step:08d}.png") as partial:
                    picture.save(partial)
        if figures := {name: value for name, value in seen.items() if not isinstance(value, Image.Image)}:
            self._write(figures)

    def _log(self, losses: dict[str, float]) -> None:
        if self.step % 20 == 0 or self.step == self.steps:
            self._write({"rate": float(self.schedule.get_last_lr()[0]), **losses})

    def _write(self, figures: Mapping[str, float]) -> None:
        """A line of the log, and the trackers' share of it."""
        self.accelerator.log(dict(figures), step=self.step)
        if self.main:
            line: dict[str, float] = dict(step=self.step, seconds=round(self.seconds, 1), **figures)
            with writing("output", self.log), self.log.open("a") as log:
                log.write(json.dumps(line) + "\n")


class _Steps(Dataset):
    """The batches of some steps, for workers to read."""

    def __init__(self, dataset: ArrayDataset, indices_of: Callable[[int], list[int]], steps: range):
        self.dataset, self.indices_of, self.steps = dataset, indices_of, steps

    def __len__(self) -> int:
        return len(self.steps)

    def __getitem__(self, place: int) -> Batch:
        return self.dataset[self.indices_of(self.steps[place])]


def checkpoints_in(output: Path) -> list[Path]:
    """The whole checkpoints of a run, the last one last."""
    return sorted(folder.parent for folder in (output / CHECKPOINTS).glob(f"step-*/{PROGRESS}"))


def read_progress(output: Path, steps: int | None) -> dict[str, Any]:
    """What the last checkpoint in a folder holds beside the state, of a run to go on with: `step`, `seconds`, and more.

    Args:
        output: The run's.
        steps: How many it is to have; `None` where that is not known yet.

    Raises:
        InvalidInputError: If there is none, or it is beyond the last step.
    """
    complete_folder(output / CHECKPOINTS)
    found = checkpoints_in(output)
    if not found:
        raise InvalidInputError(f"`resume` finds no checkpoint in {str(output)!r}; leave it out, or name its output.")
    progress = read_json("resume", found[-1] / PROGRESS)
    if steps is not None and progress["step"] > steps:
        raise InvalidInputError(
            f"`steps` is {steps}, but the checkpoint in {str(output)!r} is at step {progress['step']}; ask for at "
            "least as many, or name another output."
        )
    return progress


def checkpoint_gradients(network: nn.Module) -> None:
    """Makes the blocks of a network compute once more on the way back, in place of keeping what they made.

    Raises:
        InvalidInputError: If it has none that can.
    """
    found = False
    for module in network.modules():
        if isinstance(module, UniTouchViT):
            module.gradient_checkpointing = found = True
        elif hasattr(module, "activation_checkpointing_enable"):  # transformers
            cast(Any, module).activation_checkpointing_enable()
            found = True
        elif getattr(module, "_supports_gradient_checkpointing", False):  # diffusers
            cast(Any, module).enable_gradient_checkpointing()
            found = True
    if not found:
        raise InvalidInputError("`gradient_checkpointing` is true, but this stage's network has no blocks for it.")


def _trackers(names: list[str] | None) -> list[str]:
    """Those of accelerate that a run writes to."""
    installed = sorted(str(kind) for kind in get_available_trackers())
    if names is None:
        return [kind for kind in installed if kind == "tensorboard"]
    if missing := sorted({*names} - {*installed}):
        raise InvalidInputError(f"`trackers` names {missing}, which are not installed; there are {installed}.")
    return names


def rate_at(step: int, config: TrainerConfig, steps: int) -> float:
    """Learning rate at one of some steps, as a share of its peak: linear warm-up, then half a cosine."""
    if step < config.warmup:
        return (step + 1) / config.warmup
    progress = min((step - config.warmup) / max(steps - config.warmup, 1), 1.0)
    return config.final_rate + (1.0 - config.final_rate) * 0.5 * (1.0 + math.cos(math.pi * progress))


def _optimizer(module: nn.Module, config: TrainerConfig) -> torch.optim.Optimizer:
    """Adam, with decay of the weights of linear and convolution layers; tokens, tables, norms and biases have none."""
    weights = {id(layer.weight) for layer in module.modules() if isinstance(layer, nn.Linear | _ConvNd)}
    trained = [p for p in module.parameters() if p.requires_grad]
    decayed, others = [p for p in trained if id(p) in weights], [p for p in trained if id(p) not in weights]
    groups = [{"params": decayed, "weight_decay": config.weight_decay}, {"params": others, "weight_decay": 0.0}]
    kind = torch.optim.AdamW if config.optimizer == "adamw" else torch.optim.Adam
    return kind(groups, lr=config.learning_rate, betas=(0.9, config.beta2))
