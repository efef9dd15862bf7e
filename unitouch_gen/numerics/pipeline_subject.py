"""Pipelines as subjects of error against run time: the denoising of latents, on inputs of the world.

Conditions are made once by each call and are not what is measured, nor is decoding: solvers differ in neither.
"""

import copy
import inspect
import json
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from unitouch_gen.errors import InvalidInputError, check_choice, check_integer, describe
from unitouch_gen.numerics.cache import fingerprint
from unitouch_gen.numerics.flow import Flow, network_flow
from unitouch_gen.numerics.reference import Progress, Reference
from unitouch_gen.numerics.subjects import (
    BASELINES,
    DTYPES,
    OWN,
    Configuration,
    baseline,
    check_solver,
    in_parts,
    nominal_order,
    reference_in_parts,
    run_in_parts,
)
from unitouch_gen.sampling import Guidance, RunReport
from unitouch_gen.schedulers.adaptive import ADAPTIVE
from unitouch_gen.schedulers.fitted import FITTED
from unitouch_gen.schedulers.schedule import NoiseSchedule
from unitouch_gen.schedulers.solvers import make_scheduler, name_of
from unitouch_gen.world import MATERIAL_NAMES, World
from unitouch_gen.world.collections import SPLITS

RESERVED = ("generator", "guidance_scale", "latents", "num_inference_steps", "output_type", "return_dict", "solver",
            "throw", "tolerance")  # fmt: skip
"""Arguments of a call that the measurement sets."""


def world_inputs(modalities: tuple[str, ...], conditions: int) -> dict[str, Any]:
    """Contacts with objects that nothing was trained on, spread over the materials: "image" and "touch" (N, 3, S, S).

    Raises:
        InvalidInputError, InvalidTypeError: If the number of contacts is no integer from 1 to the materials there are.
    """
    materials = len(MATERIAL_NAMES)
    check_integer("conditions", conditions, 1, materials)
    index = torch.arange(conditions) * materials // conditions
    scene = World().render(index, torch.full_like(index, SPLITS["test"][0]), index * 0, modalities=modalities)
    found = {"image": scene.image, "touch": scene.touch.get("gelsight")}
    return {name: found[name] for name in modalities}


@dataclass(frozen=True, eq=False)
class Bound:
    """What a pipeline's network sees of its conditions.

    Attributes:
        arguments: Of the network, both halves of a guided batch.
        shape: Of its states, (rows, C, h, w).
    """

    arguments: dict[str, Any]
    shape: torch.Size

    def denoiser(self, network: nn.Module) -> Any:
        """The network with its conditions bound, for `network_flow`."""
        dtype = next(network.parameters()).dtype
        arguments = {
            name: value.to(dtype) if isinstance(value, Tensor) and value.is_floating_point() else value
            for name, value in self.arguments.items()
        }
        return lambda state, timestep: network(state, timestep, **arguments)[0]


class PipelineSubject:
    """A pipeline on given inputs.

    Its reference is of two solvers, with its network in float32, continued to sigma = 0 from the schedule's smallest
    level.

    Args:
        pipe: A pipeline of this package. It is as before after each run, but not while one is made.
        inputs: Arguments of its call that hold a value for each condition, by name.
        name: To show.
        seeds: Noises to start from under each condition.
        batch_size: In work at once; all by default.

    Raises:
        InvalidInputError, InvalidTypeError: If inputs differ in number, or seeds or batch size are out of range.
    """

    RTOL = 1e-4
    """A trained network's prediction ripples with the fast waves of the timestep's embedding, by about one percent over
    some ten levels. Far below this tolerance solvers follow every ripple, in thousands of evaluations."""

    def __init__(
        self,
        pipe: Any,
        inputs: Mapping[str, Any],
        *,
        name: str = "",
        seeds: int = 2,
        batch_size: int | None = None,
    ):
        sizes = {len(value) for value in inputs.values()}
        if len(sizes) != 1:
            raise InvalidInputError(f"`inputs` hold {sorted(sizes)} values; pass one for each condition, of each kind.")
        self.pipe, self.inputs, self.name = pipe, dict(inputs), name or type(pipe).__name__
        conditions = sizes.pop()
        self.samples = conditions * check_integer("seeds", seeds, 1)
        self.seeds, self.parts = seeds, in_parts(self.samples, batch_size)
        self.batch_size = len(self.parts[0])
        self.guidance_scale = float(pipe.config["default_guidance_scale"])
        self.default: Configuration | None = Configuration(
            OWN, pipe.config["default_num_inference_steps"], guidance_scale=self.guidance_scale
        )
        self.networks = {str(pipe.unet.dtype).removeprefix("torch."): pipe.unet}
        shape = self.bound(self.guidance_scale, self.parts[0][:1]).shape
        generator = torch.Generator().manual_seed(0)
        noises = torch.stack([torch.randn(shape[1:], generator=generator) for _ in range(seeds)])
        self.noise = noises.repeat(conditions, 1, 1, 1)
        self.identity = self._fingerprint()

    def _fingerprint(self) -> str:
        """Of the network, what it sees, and what the pipeline's own solver and estimates depend on."""
        bound = [self.bound(self.guidance_scale, part).arguments for part in self.parts]
        settings = [
            {key: value for key, value in config.items() if not key.startswith("_")}
            for config in (self.pipe.scheduler.config, self.pipe.config)
        ]
        written = json.dumps(settings, sort_keys=True, default=repr)
        return fingerprint(self.pipe.unet, bound, written, self.noise, self.batch_size)

    # What is there to be run ------------------------------------------------------------------------------------------

    def check(self, configuration: Configuration) -> None:
        levels = self.pipe.scheduler.config.num_train_timesteps
        check_solver(configuration.solver, configuration.steps, levels, (OWN, FITTED))
        if configuration.solver == FITTED:
            own, scale = self.pipe.scheduler, configuration.guidance_scale
            make_scheduler(own, FITTED, steps=configuration.steps, guidance_scale=scale)
        known = set(inspect.signature(self.pipe.__call__).parameters) - {*RESERVED, *self.inputs}
        for name in configuration.options:
            check_choice("option", name, sorted(known))

    def nominal_order(self, solver: str) -> int | None:
        if solver != OWN:
            return nominal_order(solver)
        own = self.pipe.scheduler
        name = name_of(own)
        return own.config.get("solver_order") if name is None else nominal_order(name)

    def run(self, configuration: Configuration) -> tuple[Tensor, RunReport]:
        solver = {} if configuration.solver in (OWN, ADAPTIVE, *BASELINES) else {"solver": configuration.solver}
        amount = {"num_inference_steps": configuration.steps, "tolerance": configuration.tolerance}
        settings = {**solver, **amount, "guidance_scale": configuration.guidance_scale, **configuration.options}

        def run(part: list[int]) -> tuple[Tensor, RunReport]:
            images, report = self._call(part, latents=self.noise[part], **settings)
            latents = torch.full_like(self.noise[part], torch.nan)
            latents[[code.finite for code in report.codes]] = images.float().cpu()
            return latents, report

        with self._parts_exchanged(configuration):
            return run_in_parts(run, self.parts)

    def seconds_beside(self) -> float:
        """What a sample takes beside its denoising: conditions and decoding, after a warm-up."""
        for _ in range(2):
            call: dict[str, Any] = {
                "num_inference_steps": 2,
                "guidance_scale": self.guidance_scale,
                "output_type": "pt",
            }
            report = self._call(self.parts[0], latents=self.noise[self.parts[0]], solver="ddim", **call)[1]
        seconds = sum(report.seconds.values()) - report.seconds["denoising"]
        return seconds / self.batch_size

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
            output = self.pipe(**inputs, generator=generator, output_type=output_type, throw=False, **settings)
        return output.images, output.report

    @contextmanager
    def _parts_exchanged(self, configuration: Configuration) -> Iterator[None]:
        """The pipeline with the network in another dtype, or with a scheduler of diffusers, for the time of a run."""
        own = {"unet": self.pipe.unet, "scheduler": self.pipe.scheduler}
        try:
            self.pipe.unet = self.network(configuration.dtype)
            if configuration.solver in BASELINES:
                self.pipe.scheduler = baseline(own["scheduler"], configuration.solver)
            yield
        finally:
            for name, part in own.items():
                setattr(self.pipe, name, part)

    def network(self, dtype: str) -> Any:
        """The pipeline's network in a dtype, by name."""
        if dtype not in self.networks:
            self.networks[dtype] = copy.deepcopy(self.pipe.unet).to(DTYPES[dtype])
        return self.networks[dtype]

    # The reference ----------------------------------------------------------------------------------------------------

    def bound(self, guidance_scale: float, part: list[int]) -> Bound:
        """What the network sees of the conditions of some rows; it makes one evaluation.

        Raises:
            InvalidInputError: If the pipeline does not call its `unet`.
        """
        seen: list[Bound] = []

        def look(module: nn.Module, args: tuple, kwargs: dict[str, Any]) -> None:
            seen.append(Bound({**kwargs, "return_dict": False}, args[0].shape))

        handle = self.pipe.unet.register_forward_pre_hook(look, with_kwargs=True)
        try:
            self._call(part, solver="ddim", num_inference_steps=1, guidance_scale=guidance_scale)
        finally:
            handle.remove()
        if not seen:
            raise InvalidInputError(f"`pipe` is {describe(self.pipe)}, which does not call its `unet`.")
        return seen[0]

    def flow(self, guidance_scale: float, part: list[int]) -> Flow:
        """The probability-flow ODE that the pipeline's solvers follow, of some rows."""
        bound, network = self.bound(guidance_scale, part), self.network("float32")
        return network_flow(
            bound.denoiser(network),
            NoiseSchedule.of(self.pipe.scheduler),
            self.pipe.scheduler.config.prediction_type,
            Guidance(guidance_scale),
            identity=fingerprint(network, bound.arguments),
            device=network.device,
        )

    def reference(
        self,
        guidance_scale: float,
        *,
        folder: Path | None = None,
        rtol: float | None = None,
        progress: Progress | None = None,
    ) -> Reference:
        rtol = self.RTOL if rtol is None else rtol
        return reference_in_parts(
            lambda part: self.flow(guidance_scale, part),
            self.noise,
            self.parts,
            rtol=rtol,
            end="extrapolate",
            folder=folder,
            progress=progress,
        )
