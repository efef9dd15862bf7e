"""A student that draws in a few evaluations of one row what a pipeline's network draws in many of two.

It takes the guidance scale as a condition (Meng et al., 2023, "On Distillation of Guided Diffusion Models") and follows
the teacher from the same noise: after each of its own steps its state is compared with the teacher's there, and goes on
from where it is (Zhou et al., 2024, "Simple and Fast Distillation of Diffusion Models", Section 4). So noise and
picture still belong together, and its error against the teacher's exact flow is a figure. It begins as the teacher,
with steps that were fitted to that. The teacher's paths are drawn once, before, by steps that were fitted to it too.

Or it is tuned to be consistent (Geng et al., 2024, "Consistency Models Made Easy"): shown nothing but where the
teacher's paths end, D learns to be the same at any two levels of one noise, far ones first and then near ones.
"""

import copy
import dataclasses
import json
import math
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import torch
from diffusers import UNet2DConditionModel
from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt, model_validator
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from tqdm.auto import tqdm

from unitouch_gen.errors import InvalidInputError, NonFiniteError, check_integer, needed
from unitouch_gen.files import replacing, writing_folder
from unitouch_gen.models.added_sensors import DOWN, UP
from unitouch_gen.models.distilled import PROJECTION, UPDATE, distilled_arguments, is_distilled, student_of
from unitouch_gen.numerics.fit import contact_targets, exact_path, fit_pipeline, fit_steps, joint_flow, with_fits
from unitouch_gen.numerics.reference import Flow, relative_rms
from unitouch_gen.numerics.targets import PipelineTarget
from unitouch_gen.sampling import HOPELESS_SIZE, follows_the_flow
from unitouch_gen.schedulers.fitted import Fit, FittedScheduler, combined
from unitouch_gen.schedulers.schedule import NoiseSchedule, alpha, to_denoised
from unitouch_gen.schedulers.solvers import schedule_settings
from unitouch_gen.training.batches import ArrayDataset, Batch, ShuffledSampler
from unitouch_gen.training.recipe import Decay, Rate, Seed, Settings, Steps
from unitouch_gen.training.trainer import Trainer, TrainerConfig, checkpoints_in
from unitouch_gen.world import FIRST_OBJECT, MATERIAL_NAMES

FITTED_ON = 24
"""Contacts that steps are fitted to, and as many others that the student is judged on."""

FIRST_EVALUATIONS = 64
"""Evaluations of the paths that the student's first steps are fitted to."""

GAPS = (1 / 2, 1 / 4, 1 / 8, 1 / 16)
"""Relative distances of the two noise levels of consistency tuning: of its first quarter, its second, and so on."""

LEAST_DISTANCE = 1e-3
"""Below it consistency is asked for by its square, which has a gradient at 0."""

AT_ONCE = 16
"""Contacts whose paths are drawn at once, at a guidance scale of their own."""

MOST_CONTACTS = FIRST_OBJECT["val"] * len(MATERIAL_NAMES)

OF_PATHS = ("steps", "guidance", "teacher_steps", "contacts", "seed")
OF_TRAINER = ("batch_size", "learning_rate", "ema_decay", "mixed_precision", "save_every")

PATHS = "paths.safetensors"

Columns = dict[str, Tensor]


class DistillConfig(Settings):
    """How a student is made.

    Attributes:
        objective: "trajectory" follows the teacher's paths; "consistency" knows only where they end.
        steps: Numbers of steps that it learns; each divides the largest, and that the teacher's.
        guidance: Lowest and highest scale that it learns.
        teacher_steps: Of the teacher's paths.
        contacts: Of the world's training objects, one path each.
        rank: Of low-rank updates (Hu et al., 2022) that are trained in place of all weights; 0 trains these.
        size: Bytes that low-rank updates keep in half precision: the singular values of all layers that tell most for
            their size stay, and are trained on for as long. 0 keeps all.
        updates, batch_size, learning_rate, ema_decay, mixed_precision, save_every, seed: Of the training; see
            `TrainerConfig`.
    """

    objective: Literal["trajectory", "consistency"] = "trajectory"
    steps: list[PositiveInt] = [1, 2, 4, 8]
    guidance: tuple[PositiveFloat, PositiveFloat] = (1.0, 9.0)
    teacher_steps: PositiveInt = 16
    contacts: PositiveInt = 4096
    rank: NonNegativeInt = 0
    size: NonNegativeInt = 0
    updates: Steps = 1500
    batch_size: PositiveInt = 32
    learning_rate: Annotated[Rate, Field(gt=0.0)] = 2e-4
    ema_decay: Decay = 0.99
    mixed_precision: Literal["no", "fp16", "bf16"] = "bf16"
    save_every: PositiveInt = 100
    seed: Seed = 0

    @model_validator(mode="after")
    def _can_be_made(self) -> Self:
        low, high = self.guidance
        if not low < high:
            raise InvalidInputError(f"`guidance` is {low:g} to {high:g}; the first has to be below the second.")
        if not self.steps or any(self.most % number for number in self.steps) or self.teacher_steps % self.most:
            raise InvalidInputError(
                f"`steps` are {self.steps}; the student stops where its teacher does, in {self.teacher_steps} steps, "
                f"so each number has to divide the largest one, and that {self.teacher_steps}."
            )
        if self.size and not self.rank:
            raise InvalidInputError(f"`size` is {self.size} and `rank` 0; low-rank updates alone can be made smaller.")
        if self.contacts < self.batch_size:
            raise InvalidInputError(f"`contacts` is {self.contacts}; a batch takes {self.batch_size}.")
        return self

    @property
    def most(self) -> int:
        """Steps of the student, at most."""
        return max(self.steps)


class DistillObjective(nn.Module):
    """L1 between where the student's steps lead and where its teacher was, at drawn numbers of steps.

    Batches hold "noise" and "states" of `teacher_paths`, the "guidance" of each, and conditions of the network by name.

    Args:
        student: What is trained; it takes the guidance scale and the number of steps.
        scheduler: The teacher's: its noise schedule and prediction type.
        fits: The student's steps, by their number.
    """

    def __init__(self, student: UNet2DConditionModel, scheduler: Any, fits: Mapping[int, Fit]):
        super().__init__()
        self.trained, self.fits = student, dict(fits)
        self.schedule, self.prediction_type = NoiseSchedule.of(scheduler), scheduler.config.prediction_type

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        numbers = sorted(self.fits)
        fit = self.fits[numbers[int(torch.randint(len(numbers), ()))]]
        losses = [(mean - wanted).abs().mean() for mean, wanted in self.steps(batch, fit)]
        return {"loss": torch.stack(losses).mean()}

    @torch.no_grad()
    def errors(self, batch: Batch, fit: Fit) -> Tensor:
        """Relative RMS errors (B,) of the student's results against the teacher's."""
        *_, (result, wanted) = self.steps(batch, fit)
        return relative_rms(result.cpu().double(), wanted.cpu().double())

    def steps(self, batch: Batch, fit: Fit) -> Iterator[tuple[Tensor, Tensor]]:
        """For each step the mean of D over it, and the one that leads to where the teacher was, (B, C, h, w).

        Each begins where the one before has led to, without its gradient; after the last one the mean is the result.
        """
        conditions = self.conditions(batch, fit.steps)
        each = batch["states"].shape[1] // fit.steps
        stops = batch["states"][:, each - 1 :: each]
        state, values = batch["noise"] * math.hypot(1.0, fit.sigmas[0]), list[Tensor]()
        for place, (sigma, weights) in enumerate(zip(fit.sigmas, fit.weights, strict=True)):
            following = fit.sigmas[place + 1] if place + 1 < fit.steps else 0.0
            kept, stop = following / sigma, stops[:, place].to(state) * math.hypot(1.0, following)
            values.append(self.denoise(state, sigma, conditions))
            mean = combined(values, weights)
            yield mean, (stop - kept * state) / (1.0 - kept)
            values[-1], state = values[-1].detach(), (kept * state + (1.0 - kept) * mean).detach()

    def conditions(self, batch: Batch, steps: int) -> dict[str, Tensor]:
        """What the student is given beside its state, in a run of so many steps."""
        given = {name: value for name, value in batch.items() if name not in ("noise", "states", "guidance")}
        return given | distilled_arguments(self.trained, batch["guidance"], steps, batch["noise"])

    def denoise(self, state: Tensor, sigma: Tensor | float, conditions: Mapping[str, Tensor]) -> Tensor:
        """D of the student at noise levels, one or (B, 1, 1, 1), (B, C, h, w)."""
        z = alpha(sigma) * state
        given = {name: values for name, values in conditions.items() if name != "beside"}
        shown = torch.cat([z, conditions["beside"]], dim=1) if "beside" in conditions else z
        timestep = self.schedule.timestep(torch.as_tensor(sigma).cpu()).flatten().to(z)
        prediction = self.trained(shown, timestep, **given, return_dict=False)[0]
        return to_denoised(prediction.float(), z, sigma, self.prediction_type)


class ConsistencyObjective(DistillObjective):
    """Distance between D at two levels of one noise, at the lower one without its gradient; below the schedule's least
    level that is the clean state itself (Geng et al., 2024, Section 3).

    The student's steps are deterministic, as all of this package; the paper's draw noise anew between them.

    Args:
        student, scheduler, fits: As of `DistillObjective`; batches are the same.
        gap: Relative distance of the two levels where noise is much; where it is little, it is up to five times that.
    """

    def __init__(self, student: UNet2DConditionModel, scheduler: Any, fits: Mapping[int, Fit], gap: float):
        super().__init__(student, scheduler, fits)
        self.gap = gap

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        clean, numbers = batch["states"][:, -1].float(), sorted(self.fits)
        conditions = self.conditions(batch, numbers[int(torch.randint(len(numbers), ()))])
        noise, last = torch.randn_like(clean), len(self.schedule.log_sigmas) - 1
        sigma = self.schedule.sigma(last * torch.rand(len(clean))).to(clean)[:, None, None, None]
        nearer = sigma * (1.0 - self.gap * (1.0 + 8.0 * torch.sigmoid(-sigma))).clamp(min=0.0)
        seen = nearer >= self.schedule.sigma_min
        found = self.denoise(clean + sigma * noise, sigma, conditions)  # first, as it is the one with a gradient
        with torch.no_grad():
            wanted = self.denoise(clean + nearer * noise, nearer.clamp(min=self.schedule.sigma_min), conditions)
        squares = (found - torch.where(seen, wanted, clean)).square().mean(dim=(1, 2, 3), keepdim=True)
        losses = ((squares + LEAST_DISTANCE**2).sqrt() - LEAST_DISTANCE) / (sigma - nearer * seen)
        return {"loss": losses.mean()}


# The teacher ----------------------------------------------------------------------------------------------------------


@torch.no_grad()
def teacher_paths(
    targets: Sequence[PipelineTarget], scheduler: FittedScheduler, config: DistillConfig, quiet: bool = False
) -> Columns:
    """What the student is shown: paths, each part at a guidance scale of its own, and the network's conditions there.

    Returns:
        "noise" (N, C, h, w); "states" (N, steps at most, C, h, w), variance-preserving, in half precision, the last one
        the result; "guidance" (N,); and of the conditional branch what the network is given by name, and "beside".

    Raises:
        NonFiniteError: If the teacher leaves the range of numbers, or diverges.
    """
    generator, columns = torch.Generator().manual_seed(config.seed), dict[str, list[Tensor]]()
    low, high = config.guidance
    parts = [(target, part) for target in targets for part in target.parts]
    for target, part in tqdm(parts, desc="paths", mininterval=5.0, disable=quiet):
        scale = low + (high - low) * torch.rand((), generator=generator).item()
        fit = scheduler.find(config.teacher_steps, scale)
        assert fit is not None
        inputs = target.network_inputs(scale, part)
        given = {name: value for name, value in inputs.conditions.items() if isinstance(value, Tensor)}
        given |= {} if inputs.beside is None else {"beside": inputs.beside}
        count = len(part)
        states = path_of(target.flow(scale, part), target.noise[part], fit, config.most)
        if not bool(states.isfinite().all()) or states.square().mean(dim=(2, 3, 4)).max() > HOPELESS_SIZE**2:
            raise NonFiniteError(
                f"The teacher diverges at guidance {scale:.1f}; give a lower highest `guidance`, {high:g} came."
            )
        rows = {"noise": target.noise[part], "states": states.half(), "guidance": torch.full((count,), scale)}
        rows |= {name: value[-count:].expand(count, *value.shape[1:]).cpu() for name, value in given.items()}
        for name, value in rows.items():
            columns.setdefault(name, []).append(value)
    return {name: torch.cat(values).contiguous() for name, values in columns.items()}


def path_of(flow: Flow, noise: Tensor, fit: Fit, stops: int) -> Tensor:
    """Variance-preserving states (B, stops, C, h, w) along a flow by a fit, evenly over its steps, up to the end."""
    state, values, seen = flow.start(noise), list[Tensor](), list[Tensor]()
    for place, (sigma, weights) in enumerate(zip(fit.sigmas, fit.weights, strict=True)):
        following = fit.sigmas[place + 1] if place + 1 < fit.steps else 0.0
        values.append(flow.denoise(state, sigma))
        kept = following / sigma
        state = kept * state + (1.0 - kept) * combined(values, weights)
        if (place + 1) % (fit.steps // stops) == 0:
            seen.append((state / math.hypot(1.0, following)).float())
    return torch.stack(seen, dim=1)


def fits_of(
    targets: Sequence[PipelineTarget], config: DistillConfig, told: Callable[[str], object]
) -> tuple[FittedScheduler, dict[int, Fit]]:
    """The teacher's scheduler, with steps fitted to it where it brings none, and the student's first steps, at some of
    the teacher's noise levels, fitted to it in the middle of the guidance scales."""
    low, high = config.guidance
    scheduler, number = targets[0].pipe.scheduler, config.teacher_steps
    middle = math.sqrt(low * high)
    scales = (low, middle, high)
    if not isinstance(scheduler, FittedScheduler) or None in [scheduler.find(number, scale) for scale in scales]:
        scheduler = with_fits(scheduler, fit_pipeline(targets, scales, [number], told), "dpm++2m")
    teacher = scheduler.find(number, middle)
    assert teacher is not None
    if config.objective == "consistency":  # D leads to the end at once, so that no step takes another into account
        levels = {steps: teacher.sigmas[:: number // steps] for steps in config.steps}
        return scheduler, {
            steps: Fit(middle, sigmas, tuple((0.0,) * place for place in range(steps)))
            for steps, sigmas in levels.items()
        }
    flow, noise = joint_flow(targets, middle)
    path, fits = exact_path(flow, noise, FIRST_EVALUATIONS), {}
    for steps in config.steps:
        fits[steps], error = fit_steps(flow, path, middle, teacher.sigmas[:: number // steps])
        told(f"{steps} steps of two rows begin with an error of {error:.3f} at guidance {middle:g}")
    return scheduler, fits


# The student ----------------------------------------------------------------------------------------------------------


def low_rank_updates(student: UNet2DConditionModel, update: int | Mapping[str, Tensor]) -> None:
    """Makes a student train low-rank updates of its linear and convolutional layers alone, and what its conditions go
    through: new ones of a rank, or those that there are."""
    peft = needed("peft")
    if isinstance(update, int):
        ranks = {name: update for name, layer in student.named_modules() if isinstance(layer, nn.Linear | nn.Conv2d)}
        del ranks[PROJECTION.removesuffix(".weight")]
    else:
        ranks = {name.removesuffix(DOWN): len(value) for name, value in update.items() if name.endswith(DOWN)}
    # Ranks are by regular expressions.
    exact = {f"^{re.escape(name)}": rank for name, rank in ranks.items()}
    student.add_adapter(peft.LoraConfig(target_modules=[*ranks], rank_pattern=exact, alpha_pattern=exact))
    if not isinstance(update, int):
        peft.set_peft_model_state_dict(student, {name: value for name, value in update.items() if name != PROJECTION})
        student.time_embedding.cond_proj.weight.data.copy_(update[PROJECTION])  # type: ignore[attr-defined]
    student.time_embedding.cond_proj.requires_grad_(True)


def low_rank_of(student: UNet2DConditionModel) -> Columns:
    """What `low_rank_updates` came to, as `student_of` takes it."""
    found = needed("peft").get_peft_model_state_dict(student)
    weight = student.time_embedding.cond_proj.weight  # type: ignore[attr-defined]
    return {name: value.detach().cpu().contiguous() for name, value in {**found, PROJECTION: weight}.items()}


def pruned(update: Columns, size: int) -> Columns:
    """The low-rank updates of so many bytes in half precision that are nearest to those of all layers together.

    Singular values are kept in the order of their squares over what they take.
    """
    parts, ranked = {}, list[tuple[float, int, str]]()
    for name in (name.removesuffix(DOWN) for name in update if name.endswith(DOWN)):
        down, up = update[name + DOWN].double(), update[name + UP].double()
        left, right = torch.linalg.qr(up.flatten(1)), torch.linalg.qr(down.flatten(1).T)
        u, values, v = torch.linalg.svd(left.R @ right.R.T)
        parts[name] = (left.Q @ u, values.sqrt(), v @ right.Q.T)
        cost = 2 * (len(up) + down[0].numel())
        ranked += [(float(value) ** 2 / cost, cost, name) for value in values]
    ranks, used = dict[str, int](), update[PROJECTION].numel() * 2
    for _, cost, name in sorted(ranked, reverse=True):
        if used + cost <= size:
            ranks[name], used = ranks.get(name, 0) + 1, used + cost
    kept = {PROJECTION: update[PROJECTION]}
    for name, rank in ranks.items():
        u, roots, v = parts[name]
        down, up = update[name + DOWN], update[name + UP]
        kept[name + DOWN] = (roots[:rank, None] * v[:rank]).view(rank, *down.shape[1:]).to(down)
        kept[name + UP] = (u[:, :rank] * roots[:rank]).view(len(up), rank, *up.shape[2:]).to(up)
    return kept


def distill(
    pipe: Any,
    modalities: Sequence[str],
    output: Path,
    config: DistillConfig | None = None,
    *,
    apart: bool = False,
    resume: bool = False,
    told: Callable[[str], object] = print,
    quiet: bool = False,
) -> None:
    """Makes the student of a pipeline and saves it with the pipeline's other parts, as a pipeline like any other.

    Args:
        pipe: The teacher, whose parts stay as they are.
        modalities: What contacts of the world are shown to it as: "touch" or "image".
        output: Folder to write; paths and checkpoints lie in one beside it until it is written.
        config: How.
        apart: Whether to save only what the teacher does not have, as families of weights hold it.
        resume: Go on from the paths and the last checkpoint.
        told: Gets a line on each fit, and what the student is worth on other contacts.
        quiet: Whether to show no progress.

    Raises:
        InvalidInputError: If the network was distilled before, its scheduler has no exact flow to follow, or what there
            is to go on from is of another configuration.
        NonFiniteError: If the teacher or the student leaves the range of numbers.
    """
    config = config or DistillConfig()
    if is_distilled(pipe.unet):
        raise InvalidInputError("`model` was distilled already; take the model that it was made from.")
    if not follows_the_flow(pipe.scheduler, eta=0.0):
        raise InvalidInputError(
            f"`model` has a {type(pipe.scheduler).__name__}, which follows no exact flow; `unitouch-gen fit` gives it "
            "steps that do."
        )
    if apart and not config.rank:
        raise InvalidInputError("`rank` is 0; families hold students as low-rank updates, so pass one, such as 16.")
    if config.rank:
        needed("peft")
    place = output.with_name(f"{output.name}.training")
    if (place / PATHS).is_file() and not resume:
        raise InvalidInputError(f"`output`: {str(place)!r} holds a run; go on with `--resume`, or remove it.")
    if resume and not (place / PATHS).is_file():
        raise InvalidInputError(f"`--resume`: {str(place)!r} holds nothing to go on from; leave it out.")
    check_integer("contacts", config.contacts, 1, MOST_CONTACTS)
    some = contact_targets(pipe, modalities, FITTED_ON, seed=config.seed)
    scheduler, fits = fits_of(some, config, told)
    rows = ArrayDataset(**_paths(pipe, modalities, scheduler, config, place / PATHS, resume, quiet))

    def train(student: UNet2DConditionModel, folder: Path) -> DistillObjective:
        if config.objective == "trajectory":
            return run(DistillObjective(student, scheduler, fits), config.updates, folder, config.seed)
        for number, gap in enumerate(GAPS):
            objective = ConsistencyObjective(student, scheduler, fits, gap)
            run(objective, -(-config.updates // len(GAPS)), folder / f"gap-{number}", config.seed + number)
        return objective

    def run(objective: DistillObjective, updates: int, folder: Path, seed: int) -> DistillObjective:
        how = TrainerConfig(
            steps=updates, weight_decay=0.0, watch_every=0, trackers=[], seed=seed,
            **config.model_dump(include={*OF_TRAINER}),
        )  # fmt: skip
        sampler = ShuffledSampler(config.contacts, config.batch_size, seed)
        trainer = Trainer(objective, rows, sampler, how, folder, quiet=quiet)
        if resume and checkpoints_in(folder):
            trainer.resume()
        if not trainer.fit():
            raise KeyboardInterrupt
        return objective.eval()

    student, update = student_of(pipe.unet), Columns()
    if config.rank:
        low_rank_updates(student, config.rank)
    objective = train(student, place)
    if config.size:
        update = pruned(low_rank_of(student), config.size)
        student = student_of(pipe.unet)
        low_rank_updates(student, update)
        objective = train(student, place / "pruned")
    if config.rank:
        update = {name: value.half() for name, value in low_rank_of(student).items()}
        student = student_of(pipe.unet, update)
        objective = DistillObjective(student.eval(), scheduler, fits)
    errors, (low, high) = errors_of(objective, pipe, modalities, scheduler, config, quiet), config.guidance
    for number, error in errors.items():
        told(
            f"{number} steps: an error of {error:.3f} against the teacher over guidance {low:g} to {high:g}, median of "
            f"{FITTED_ON} other contacts"
        )
    made = _pipeline(pipe, student, fits, config)
    made._card = card_of(pipe._card, errors, config)
    if apart:
        record = {"recipe": config.model_dump(), "errors": errors}
        with writing_folder("output", output) as folder:
            save_file(update, folder / UPDATE, metadata={"format": "pt"})
            made.scheduler.save_pretrained(folder / "scheduler")
            for name, content in {"defaults.json": defaults_of(pipe, config), "record.json": record}.items():
                (folder / name).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    else:
        made.save_pretrained(output)
    shutil.rmtree(place)


def _pipeline(pipe: Any, student: UNet2DConditionModel, fits: Mapping[int, Fit], config: DistillConfig) -> Any:
    """The student with the parts of its teacher's pipeline."""
    ends = [dataclasses.replace(fit, guidance_scale=scale) for fit in fits.values() for scale in config.guidance]
    settings = schedule_settings(pipe.scheduler)
    settings.pop("steps_offset", None)
    made = copy.copy(pipe)
    made.register_modules(
        unet=student.to(pipe.unet.device),
        scheduler=FittedScheduler(**settings, fits=[dataclasses.asdict(fit) for fit in ends], otherwise=None),
    )
    made.register_to_config(**defaults_of(pipe, config))
    return made


def card_of(known: Any, errors: Mapping[int, float], config: DistillConfig) -> Any:
    """The model card of a student by its teacher's, without what was measured of that; none by that of a folder."""
    if not dataclasses.is_dataclass(known):
        return None
    (low, high), steps = config.guidance, ", ".join(map(str, errors))
    of = "distance from its teacher's results, relative RMS of the latents, median of contacts"
    return dataclasses.replace(
        known,  # type: ignore[type-var]
        description=f"A student that was distilled to draw in {steps} steps, at guidance {low:g} to {high:g}.",
        figures={f"{number} steps: {of}": f"{error:.1%}" for number, error in errors.items()},
        pictures={},
    )


def defaults_of(pipe: Any, config: DistillConfig) -> dict[str, Any]:
    """What the student of a pipeline does where a call says nothing and its teacher does otherwise."""
    low, high = config.guidance
    return {
        "default_num_inference_steps": 4 if 4 in config.steps else config.most,
        "default_guidance_scale": min(max(pipe.config["default_guidance_scale"], low), high),
        "calibration": {},
    }


def errors_of(
    objective: DistillObjective,
    pipe: Any,
    modalities: Sequence[str],
    scheduler: FittedScheduler,
    config: DistillConfig,
    quiet: bool = False,
) -> dict[int, float]:
    """Median distance of the student's results from the teacher's by number of steps, relative RMS, on contacts that
    neither was shown."""
    others = contact_targets(pipe, modalities, FITTED_ON, FIRST_OBJECT["val"], seed=config.seed + 1, batch_size=1)
    columns = teacher_paths(others, scheduler, config, quiet)
    device = next(objective.parameters()).device
    batch = {name: value.to(device) for name, value in columns.items()}
    return {number: float(objective.errors(batch, fit).median()) for number, fit in sorted(objective.fits.items())}


def _paths(
    pipe: Any,
    modalities: Sequence[str],
    scheduler: FittedScheduler,
    config: DistillConfig,
    file: Path,
    resume: bool,
    quiet: bool,
) -> Columns:
    """`teacher_paths` of the configuration, read where they were left."""
    asked = json.dumps({name: getattr(config, name) for name in OF_PATHS})
    if resume and file.is_file():
        with safe_open(file, "pt") as stored:
            known = (stored.metadata() or {}).get("config")
        if known != asked:
            raise InvalidInputError(f"`--resume`: {str(file)!r} was made for {known}, and {asked} came; take the same.")
        return load_file(file)
    targets = contact_targets(pipe, modalities, config.contacts, seed=config.seed, batch_size=AT_ONCE)
    columns = teacher_paths(targets, scheduler, config, quiet)
    file.parent.mkdir(parents=True, exist_ok=True)
    with replacing("output", file) as partial:
        save_file(columns, partial, metadata={"config": asked})
    return columns
