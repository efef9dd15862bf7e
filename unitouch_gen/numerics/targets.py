"""What error against run time is measured on, and how a point of it is configured.

A target has a start, the same for every solver; for each guidance scale a reference of where the exact flow ends from
there; and a way to run one configuration. Exact problems are targets, and pipelines on inputs of the world.
"""

import copy
import hashlib
import inspect
import json
import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import torch
from diffusers import (
    DDIMScheduler,
    DPMSolverMultistepScheduler,
    EulerDiscreteScheduler,
    PNDMScheduler,
    UniPCMultistepScheduler,
)
from diffusers.schedulers.scheduling_utils import SchedulerMixin
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, check_choice, check_integer, check_number, describe
from unitouch_gen.numerics.problems import Problem
from unitouch_gen.numerics.reference import Flow, Progress, Reference, relative_rms, solve_reference
from unitouch_gen.sampling import Guidance, RunReport
from unitouch_gen.schedulers.adaptive import ADAPTIVE
from unitouch_gen.schedulers.schedule import NoiseSchedule, to_denoised
from unitouch_gen.schedulers.solvers import SOLVERS, Solver, make_scheduler, name_of, schedule_settings
from unitouch_gen.world import FIRST_OBJECT, MATERIAL_NAMES, World

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}
"""Dtypes of the network; the state of the solver is float32."""

MOST_SEEDS = 100_000

DEFAULT = "default"
"""The scheduler that a pipeline came with."""

LEADING: dict[str, Any] = {"timestep_spacing": "leading", "steps_offset": 1}
KARRAS: dict[str, Any] = {"use_karras_sigmas": True}

BASELINES: dict[str, Solver] = {
    "diffusers:ddim": Solver(DDIMScheduler, 1, {**LEADING, "set_alpha_to_one": False, "clip_sample": False}),
    "diffusers:pndm": Solver(PNDMScheduler, 2, {**LEADING, "set_alpha_to_one": False, "skip_prk_steps": True}),
    "diffusers:euler": Solver(EulerDiscreteScheduler, 1, LEADING),
    "diffusers:dpm++2m": Solver(DPMSolverMultistepScheduler, 2, KARRAS),
    "diffusers:unipc": Solver(UniPCMultistepScheduler, 3, KARRAS),
}
"""diffusers' own schedulers as its pipelines run them, Stable Diffusion's settings: what ours are measured against."""

RESERVED = ("generator", "guidance_scale", "init_strength", "latents", "num_inference_steps", "output_type",
            "return_dict", "solver", "throw", "tolerance")  # fmt: skip
"""Arguments of a pipeline's call that the measurement sets."""


@dataclass(frozen=True)
class Configuration:
    """One point of error against run time.

    Attributes:
        solver: A name in `SOLVERS` or `BASELINES`, "default" or "adaptive".
        steps, tolerance: Number of steps; for "adaptive" a tolerance, from 1e-5 to 1 as pipelines take it.
        guidance_scale: Scale of the flow; on above 1.
        dtype: Dtype of the network, a name in `DTYPES`.
        options: More arguments of a pipeline's call, or settings of a problem's scheduler. They are what is measured,
            so the reference is without them.
    """

    solver: str
    steps: int | None = None
    tolerance: float | None = None
    guidance_scale: float = 1.0
    dtype: str = "float32"
    options: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.solver == ADAPTIVE:
            check_number("tolerances", self.tolerance, 1e-5, 1.0)
        else:
            check_integer("steps", self.steps, 1)
        check_number("guidance", self.guidance_scale, 0.0)
        check_choice("dtypes", self.dtype, DTYPES)

    @property
    def series(self) -> str:
        """What points share that differ in steps or tolerance alone: "unipc, bfloat16, eta=0.5"."""
        options = [f"{name}={value}" for name, value in sorted(self.options.items())]
        return ", ".join([self.solver, *([] if self.dtype == "float32" else [self.dtype]), *options])

    @property
    def amount(self) -> str:
        """ "20 steps" or "tolerance 0.01"."""
        return f"tolerance {self.tolerance:g}" if self.steps is None else f"{self.steps} steps"

    @property
    def key(self) -> str:
        """All of it in words: "unipc, bfloat16, 20 steps, guidance 7.5"."""
        return f"{self.series}, {self.amount}, guidance {self.guidance_scale}"

    @property
    def expected_evaluations(self) -> int:
        """A guess, for the time that is left."""
        if self.tolerance is not None:
            return round(10 * self.tolerance ** (-1 / 3))
        return (self.steps or 0) * (2 if self.solver == "heun" else 1)


def replaced_scheduler(scheduler: SchedulerMixin, solver: str) -> SchedulerMixin:
    """A named solver in the place of a scheduler; one of `BASELINES` as users of diffusers exchange them."""
    if solver not in BASELINES:
        return make_scheduler(scheduler, solver)
    chosen = BASELINES[solver]
    return chosen.scheduler.from_config({**schedule_settings(scheduler), **chosen.settings})  # type: ignore[attr-defined]


def errors_of(latents: Tensor, reference: Reference) -> Tensor:
    """Relative RMS error of each sample, float64 (N,); infinite where a sample broke."""
    return relative_rms(latents.cpu(), reference.latents).nan_to_num(nan=math.inf, posinf=math.inf)


class Target:
    """What can be measured: a problem or a pipeline, with the noises to start from.

    Attributes:
        name: To show.
        identity: Hash of all that its results depend on but the configuration.
        noise: To start from, (N, C, h, w): one for each sample.
        batch_size: Samples in work at once.
        guidance_scale: Where none is asked for.
        scheduler: Of the noise schedule and prediction type that solvers are made for.
        end, rtol: How its reference is solved, see `solve_reference`.
        default: What a call without options runs, if there is such a thing.
        solvers: That it knows, beside `BASELINES`.
        device: That it runs on.
    """

    end = "zero"
    rtol = 1e-10
    default: Configuration | None = None
    solvers: tuple[str, ...] = (*SOLVERS, ADAPTIVE)
    device = "cpu"

    def __init__(self, name: str, scheduler: Any, guidance_scale: float, samples: int, batch_size: int | None):
        self.name, self.scheduler, self.guidance_scale, self.samples = name, scheduler, guidance_scale, samples
        self.batch_size = samples if batch_size is None else min(check_integer("batch_size", batch_size, 1), samples)
        self.noise, self.identity = torch.empty(0), ""

    @property
    def parts(self) -> list[list[int]]:
        """Row numbers of each batch."""
        return [part.tolist() for part in torch.arange(self.samples).split(self.batch_size)]

    def check(self, configuration: Configuration) -> None:
        """Refuses what cannot be run, before anything is."""
        check_choice("solvers", configuration.solver, [*self.solvers, *BASELINES])
        if configuration.steps is not None:
            check_integer("steps", configuration.steps, 1, self.scheduler.config.num_train_timesteps)

    def nominal_order(self, solver: str) -> int | None:
        """Order of convergence, where it is known."""
        name = name_of(self.scheduler) if solver == DEFAULT else solver
        if name is None:
            return self.scheduler.config.get("solver_order")
        known = {**SOLVERS, **BASELINES}
        return known[name].order if name in known else None

    def reference(
        self, guidance_scale: float, rtol: float | None = None, progress: Progress | None = None
    ) -> Reference:
        """Where the exact flow ends, of all samples; solved to the target's own tolerance when none is given."""
        settings: dict[str, Any] = {"rtol": self.rtol if rtol is None else rtol, "end": self.end, "progress": progress}
        return Reference.joined(
            [solve_reference(self.flow(guidance_scale, part), self.noise[part], **settings) for part in self.parts]
        )

    def run(self, configuration: Configuration) -> tuple[Tensor, RunReport]:
        """Latents (N, C, h, w), NaN for samples that broke, and what it took; "denoising" in seconds counts."""
        runs = [self._run(configuration, part) for part in self.parts]
        return torch.cat([latents for latents, _ in runs]), RunReport.joined([report for _, report in runs])

    def flow(self, guidance_scale: float, part: list[int]) -> Flow:
        """The probability-flow ODE that solvers follow, of some rows."""
        raise NotImplementedError

    def _run(self, configuration: Configuration, part: list[int]) -> tuple[Tensor, RunReport]:
        raise NotImplementedError


class ProblemTarget(Target):
    """An exact problem from a number of noises. Its reference is the closed form where there is one, otherwise that of
    DOP853; at other guidance scales than its own it is the same data under those."""

    def __init__(self, problem: Problem, seeds: int = 8, batch_size: int | None = None):
        check_integer("seeds", seeds, 1, MOST_SEEDS)
        super().__init__(problem.name, problem.scheduler(), problem.guidance_scale, seeds, batch_size)
        self.problem, self.noise = problem, problem.noise(seeds)
        branches = [data for data in (problem.data, problem.unconditional) if data is not None]
        tensors = [value for data in branches for value in (data.means, data.variances, data.weights, data.rotation)]
        settings = (problem.guidance_scale, dict(problem.schedule_config), problem.prediction_type, self.batch_size)
        self.identity = fingerprint(settings, [*tensors, self.noise])

    def at(self, guidance_scale: float) -> Problem:
        """The problem at a guidance scale."""
        if guidance_scale == self.problem.guidance_scale:
            return self.problem
        if self.problem.unconditional is None:
            raise InvalidInputError(
                f"`guidance` is {guidance_scale:g}, but {self.name!r} has no unconditional branch; leave it out."
            )
        return replace(self.problem, guidance_scale=guidance_scale)

    def check(self, configuration: Configuration) -> None:
        self.at(configuration.guidance_scale)
        super().check(configuration)
        if configuration.options and configuration.solver == ADAPTIVE:
            raise InvalidInputError("`option` is for schedulers, and 'adaptive' is none; leave one of them out.")
        if configuration.options:
            self._scheduler(configuration)

    def reference(
        self, guidance_scale: float, rtol: float | None = None, progress: Progress | None = None
    ) -> Reference:
        problem = self.at(guidance_scale)
        if problem.has_solution and self.end == "zero":
            return Reference.exact(problem.solution(self.noise))
        return super().reference(guidance_scale, rtol, progress)

    def flow(self, guidance_scale: float, part: list[int]) -> Flow:
        return self.at(guidance_scale).flow

    def _scheduler(self, configuration: Configuration) -> SchedulerMixin:
        """Fresh, with the options laid over the solver's settings."""
        plain: Any = replaced_scheduler(self.scheduler, configuration.solver)
        for name in configuration.options:
            check_choice("option", name, [key for key in plain.config if not key.startswith("_")])
        try:
            return type(plain).from_config(plain.config, **configuration.options) if configuration.options else plain
        except (ValueError, NotImplementedError, TypeError) as error:
            raise InvalidInputError(f"`option` is {dict(configuration.options)}: {error}") from error

    def _run(self, configuration: Configuration, part: list[int]) -> tuple[Tensor, RunReport]:
        problem, dtype = self.at(configuration.guidance_scale), DTYPES[configuration.dtype]
        exact = problem.network()
        settings: dict[str, Any] = {"tolerance": configuration.tolerance}
        if configuration.steps is not None:
            settings = {"solver": self._scheduler(configuration), "steps": configuration.steps}

        def network(state: Tensor, timestep: Tensor) -> Tensor:
            return exact(state.to(dtype), timestep)

        latents, report = problem.run(self.noise[part], network=network, throw=False, **settings)
        latents[[not code.finite for code in report.codes]] = math.nan
        return latents, report


class NetworkInputs(NamedTuple):
    """What a pipeline's network is given: the shape of its states, its conditions by name, and what it is shown beside
    the states as further channels, if anything."""

    shape: torch.Size
    conditions: dict[str, Any]
    beside: Tensor | None


class PipelineTarget(Target):
    """The denoising of a pipeline's latents, on given inputs.

    Conditions are made once by each call and are not what is measured, nor is decoding: solvers differ in neither. Its
    reference is of DOP853, with its network in float32, continued to sigma = 0 from the schedule's smallest level.

    Args:
        pipe: A pipeline of this package. It is as before after each run, but not while one is made.
        inputs: Arguments of its call that hold a value for each condition, by name.
        name: To show.
        seeds: Noises to start from under each condition.
        batch_size: In work at once; all by default.
        noise_seed: A seed by which every sample gets a noise of its own; else conditions share those of `seeds`.
        options: More arguments of every call, such as `noise_level`.
    """

    end = "extrapolate"
    rtol = 1e-4
    """A trained network's prediction ripples with the fast waves of the timestep's embedding, by about one percent over
    some ten levels. Far below this tolerance solvers follow every ripple, in thousands of evaluations."""
    solvers = (*Target.solvers, DEFAULT)

    def __init__(
        self,
        pipe: Any,
        inputs: Mapping[str, Any],
        *,
        name: str = "",
        seeds: int = 2,
        batch_size: int | None = None,
        noise_seed: int | None = None,
        options: Mapping[str, Any] | None = None,
    ):
        sizes = {len(value) for value in inputs.values()}
        if len(sizes) != 1:
            raise InvalidInputError(f"`inputs` hold {sorted(sizes)} values; pass one for each condition, of each kind.")
        samples = sizes.pop() * check_integer("seeds", seeds, 1, MOST_SEEDS)
        scale, steps = float(pipe.config["default_guidance_scale"]), pipe.config["default_num_inference_steps"]
        super().__init__(name or type(pipe).__name__, pipe.scheduler, scale, samples, batch_size)
        self.pipe, self.inputs, self.seeds, self.device = pipe, dict(inputs), seeds, str(pipe.device)
        self.options = dict(options or {})
        self.default = Configuration(DEFAULT, steps, guidance_scale=scale)
        self.networks = {str(pipe.unet.dtype).removeprefix("torch."): pipe.unet}
        looked = [self.network_inputs(scale, part) for part in self.parts]
        shape = looked[0].shape[1:]
        generator = torch.Generator().manual_seed(noise_seed or 0)
        if noise_seed is None:
            noises = torch.stack([torch.randn(shape, generator=generator) for _ in range(seeds)])
            self.noise = noises.repeat(samples // seeds, 1, 1, 1)
        else:
            self.noise = torch.randn(samples, *shape, generator=generator)
        settings = [
            {key: value for key, value in config.items() if not key.startswith("_")}
            for config in (pipe.unet.config, pipe.scheduler.config, pipe.config)
        ]
        tensors = [[inputs.beside, *inputs.conditions.values()] for inputs in looked]
        seen = [value for values in tensors for value in values if isinstance(value, Tensor)]
        self.identity = fingerprint((settings, self.batch_size), [*pipe.unet.state_dict().values(), *seen, self.noise])

    def check(self, configuration: Configuration) -> None:
        super().check(configuration)
        known = set(inspect.signature(self.pipe.__call__).parameters) - {*RESERVED, *self.inputs}
        for name in configuration.options:
            check_choice("option", name, sorted(known))

    def flow(self, guidance_scale: float, part: list[int]) -> Flow:
        inputs = self.network_inputs(guidance_scale, part)
        guidance = Guidance(guidance_scale)
        return network_flow(self.network("float32"), self.pipe.scheduler, guidance, inputs.conditions, inputs.beside)

    def network(self, dtype: str) -> Any:
        """The pipeline's network in a dtype, by name."""
        if dtype not in self.networks:
            self.networks[dtype] = copy.deepcopy(self.pipe.unet).to(DTYPES[dtype])
        return self.networks[dtype]

    def network_inputs(self, guidance_scale: float, part: list[int]) -> NetworkInputs:
        """What the network is given for some rows; takes one evaluation."""
        seen: list[NetworkInputs] = []

        def look(module: Any, args: tuple, kwargs: dict[str, Any]) -> None:
            conditions = {name: value for name, value in kwargs.items() if name != "return_dict"}
            state, beside = args[0].tensor_split([module.config.out_channels], dim=1)
            seen.append(NetworkInputs(state.shape, conditions, beside if beside.shape[1] else None))

        handle = self.pipe.unet.register_forward_pre_hook(look, with_kwargs=True)
        try:
            self._call(part, solver="ddim", num_inference_steps=1, guidance_scale=guidance_scale)
        finally:
            handle.remove()
        if not seen:
            raise InvalidInputError(f"`pipe` is {describe(self.pipe)}, which does not call its `unet`.")
        return seen[0]

    def seconds_beside(self) -> float:
        """What a sample takes beside its denoising: conditions and decoding, after a warm-up."""
        call: dict[str, Any] = {"num_inference_steps": 2, "guidance_scale": self.guidance_scale, "output_type": "pt"}
        for _ in range(2):
            report = self._call(self.parts[0], latents=self.noise[self.parts[0]], solver="ddim", **call)[1]
        return (sum(report.seconds.values()) - report.seconds["denoising"]) / self.batch_size

    def _run(self, configuration: Configuration, part: list[int]) -> tuple[Tensor, RunReport]:
        solver = {} if configuration.solver in (DEFAULT, ADAPTIVE, *BASELINES) else {"solver": configuration.solver}
        amount = {"num_inference_steps": configuration.steps, "tolerance": configuration.tolerance}
        settings = {**solver, **amount, "guidance_scale": configuration.guidance_scale, **configuration.options}
        pipe, plain = self.pipe, (self.pipe.unet, self.pipe.scheduler)
        try:
            pipe.unet = self.network(configuration.dtype)
            if configuration.solver in BASELINES:
                pipe.scheduler = replaced_scheduler(pipe.scheduler, configuration.solver)
            images, report = self._call(part, latents=self.noise[part], **settings)
        finally:
            pipe.unet, pipe.scheduler = plain
        latents = torch.full_like(self.noise[part], torch.nan)
        latents[[code.finite for code in report.codes]] = images.float().cpu()
        return latents, report

    def _call(self, part: list[int], output_type: str = "latent", **settings: Any) -> tuple[Tensor, RunReport]:
        """The pipeline on some rows: latents of those that are finite, and the report."""
        conditions, seeds = zip(*(divmod(row, self.seeds) for row in part), strict=True)
        inputs = {
            name: value[list(conditions)] if isinstance(value, Tensor) else [value[row] for row in conditions]
            for name, value in self.inputs.items()
        }
        generator = [torch.Generator().manual_seed(seed) for seed in seeds]  # of the noise on conditions
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of unfamiliar touches
            if "init_strength" in inspect.signature(self.pipe.__call__).parameters:
                settings["init_strength"] = 1.0  # from noise
            settings = {**self.options, **settings}
            output = self.pipe(**inputs, generator=generator, output_type=output_type, throw=False, **settings)
        return output.images, output.report


def network_flow(
    network: Any, scheduler: Any, guidance: Guidance, conditions: Mapping[str, Any], beside: Tensor | None = None
) -> Flow:
    """The probability-flow ODE of a trained network.

    It is called without autograd, at exact timesteps of the scheduler's noise schedule, with its conditions and states
    in its own dtype, and what it is shown `beside` as further channels of these; where guidance is active, with a
    doubled batch, the unconditional half first.
    """
    dtype, schedule = network.dtype, NoiseSchedule.of(scheduler)
    conditions = {
        name: value.to(dtype) if isinstance(value, Tensor) and value.is_floating_point() else value
        for name, value in conditions.items()
    }

    @torch.no_grad()
    def denoise(x: Tensor, sigma: float) -> Tensor:
        z = x / math.hypot(1.0, sigma)
        state = (torch.cat([z] * 2) if guidance.active else z).to(network.device, dtype)
        if beside is not None:
            state = torch.cat([state, beside.to(state)], dim=1)
        timestep = schedule.timestep(sigma).to(network.device, torch.promote_types(dtype, torch.float32))
        prediction = network(state, timestep, **conditions, return_dict=False)[0].cpu().double()
        if guidance.active:
            prediction = guidance.combine(prediction)
        return to_denoised(prediction, z, sigma, scheduler.config.prediction_type)

    return Flow(denoise, schedule)


def world_inputs(modalities: Sequence[str], conditions: int) -> dict[str, Any]:
    """Contacts with objects that nothing was trained on, spread over as many materials: "image" and "touch"
    (N, 3, S, S), of those that are asked for."""
    materials = len(MATERIAL_NAMES)
    check_integer("conditions", conditions, 1, materials)
    material = torch.arange(conditions) * materials // conditions
    objects = torch.full_like(material, FIRST_OBJECT["test"])
    scene = World().render(material, objects, torch.zeros_like(material), modalities=tuple(modalities))
    return {name: scene.image if name == "image" else scene.touch["gelsight"] for name in modalities}


def fingerprint(settings: Any, tensors: Iterable[Tensor | None]) -> str:
    """SHA-256 of plain values and of the contents of tensors, 64 hexadecimal digits."""
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True, default=repr).encode())
    for tensor in tensors:
        if tensor is not None:
            digest.update(f"{tensor.dtype} {tuple(tensor.shape)}".encode())
            digest.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()
