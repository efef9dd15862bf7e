"""Cases on problems whose solution is known: solvers at their ends, and networks that misbehave."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any

import torch
from torch import Tensor

from unitouch_gen.numerics.problems import STABLE_DIFFUSION, Problem, all_problems, make_problem, spectrum
from unitouch_gen.numerics.reference import solve_reference
from unitouch_gen.numerics.stability import Case, Ended, Seen, ends, largest_error, raises, refused
from unitouch_gen.sampling import Denoiser, ReturnCode, RunReport, prepare_steps, sample, sample_to_tolerance
from unitouch_gen.schedulers.schedule import PREDICTION_TYPES
from unitouch_gen.schedulers.solvers import SOLVERS, make_scheduler

CPU = torch.device("cpu")
SUCCESS, NON_FINITE, DIVERGED = ReturnCode.SUCCESS, ReturnCode.NON_FINITE, ReturnCode.DIVERGED


@cache
def truth(problem: Problem, batch_size: int) -> Tensor:
    """The exact flow from `problem.noise(batch_size)`, (B, C, h, w)."""
    noise = problem.noise(batch_size)
    if problem.has_solution:
        return problem.solution(noise)
    return solve_reference(problem.flow, noise, rtol=1e-7, end="zero").latents


def solve(
    problem: Problem,
    solver: str | None = None,
    steps: int = 50,
    *,
    tolerance: float | None = None,
    max_evaluations: int = 1000,
    network: Denoiser | None = None,
    batch_size: int = 4,
    throw: bool = False,
    known: bool = True,
) -> Ended:
    """One run from `problem.noise(batch_size)`, by a solver or to a tolerance.

    Args:
        network: In place of the exact one.
        known: Whether the exact solution is what is to come out.
    """
    noise = problem.noise(batch_size).float()
    report, network = RunReport(), network or problem.network()
    options: dict[str, Any] = {"guidance": problem.guidance, "throw": throw}
    if tolerance is not None:
        known = (problem.schedule, problem.prediction_type, tolerance, report)
        latents = sample_to_tolerance(network, noise, *known, max_evaluations=max_evaluations, **options)
    else:
        scheduler = make_scheduler(problem.scheduler(), solver)
        prepare_steps(scheduler, steps, CPU)
        latents = sample(network, noise, scheduler, report, **options)
    rows = [row for row, code in enumerate(report.codes) if code.finite]
    error = largest_error(latents[rows], truth(problem, batch_size)[rows]) if known else math.nan
    return Ended(report.codes, latents[rows], error, max(report.error_indicator, default=math.nan))


def plain() -> Problem:
    """The one on which everything but one thing is ordinary."""
    return make_problem("conditioning-1e2")


# Stiff problems -------------------------------------------------------------------------------------------------------

BOUNDS = {
    "conditioning-1e2": (0.2, 0.005),
    "conditioning-1e4": (0.3, 0.04),
    "conditioning-1e8": (0.25, 0.06),
    "conditioning-1e12": (0.25, 0.03),
    "far-modes": (0.08, 0.008),
    "near-delta": (1e-5, 1e-5),
    "near-deltas": (1e-5, 1e-5),
    "mixture-30": (0.08, 0.004),
    "gaussian-guided-30": (0.03, 0.001),
    "gaussian-cosine": (0.3, 0.1),
    "pure-noise": (0.25, 0.1),
}
"""Largest errors of solvers of order 1, and above, in 50 steps: about twice what was measured. Deviations far below the
schedule's smallest noise level, 0.03, leave an error of that size at any number of steps."""

TOLERANCE = 1e-2


def stiff_cases() -> list[Case]:
    """Every solver, and steps to a tolerance, on every stiff problem."""
    cases = []
    for problem in all_problems(stiff=True):
        first, higher = BOUNDS.get(problem.name, (0.3, 0.1))
        for name, solver in SOLVERS.items():
            run = partial(solve, problem, name)
            if problem.schedule_config.get("rescale_betas_zero_snr") and not solver.zero_snr:
                cases.append(refused(f"{problem.name}, {name}", run, "solver"))
            else:
                cases.append(ends(f"{problem.name}, {name}", run, bound=first if solver.order == 1 else higher))
        to_tolerance = partial(solve, problem, tolerance=TOLERANCE)
        cases.append(ends(f"{problem.name}, tolerance", to_tolerance, bound=max(TOLERANCE, higher)))
    return cases


# Guidance, steps, batches and schedules -------------------------------------------------------------------------------


SHARP = {
    0.0: (50, 0.004),
    1.0: (50, 0.004),
    1.0001: (50, 0.004),
    2.0: (50, 0.008),
    7.5: (50, 0.008),
    30.0: (50, 0.001),
    100.0: (200, 1e-4),
}
"""Steps of DPM-Solver++ that resolve a guidance scale, and the largest error then."""


def guidance_cases() -> list[Case]:
    """Scales from none to a thousand between two Gaussians, where the flow has a closed form."""
    cases = []
    for scale in (*SHARP, 1000.0):
        problem = replace(make_problem("gaussian-guided"), guidance_scale=scale)
        if scale in SHARP:
            steps, bound = SHARP[scale]
            cases.append(ends(f"guidance {scale:g}, ddim", partial(solve, problem, "ddim", steps), bound=0.25))
            cases.append(ends(f"guidance {scale:g}, dpm++2m", partial(solve, problem, "dpm++2m", steps), bound=bound))
            to_tolerance = partial(solve, problem, tolerance=TOLERANCE)
            cases.append(ends(f"guidance {scale:g}, tolerance", to_tolerance, bound=TOLERANCE))
        else:
            # Beyond what so many explicit steps can follow: the states grow until float32 ends.
            cases.append(ends(f"guidance {scale:g}, ddim", partial(solve, problem, "ddim"), NON_FINITE))
            cases.append(ends(f"guidance {scale:g}, dpm++2m", partial(solve, problem, "dpm++2m"), NON_FINITE))
            for tolerance in (TOLERANCE, 0.1):
                run = partial(solve, problem, tolerance=tolerance)
                cases.append(ends(f"guidance {scale:g}, tolerance {tolerance:g}", run, ReturnCode.MAX_EVALUATIONS))
            # The states grow a billion times on the way, where no network but an exact one would lead them back.
            thousand = partial(solve, problem, "euler", 1000)
            cases.append(ends(f"guidance {scale:g}, 1000 steps", thousand, DIVERGED, bound=0.01))
            cases.append(raises(f"guidance {scale:g}, raising", partial(thousand, throw=True), DIVERGED))
    few = partial(solve, replace(make_problem("gaussian-guided"), guidance_scale=100.0), "dpm++2m", 50)
    cases.append(ends("guidance 100 in 50 steps", few, DIVERGED))
    for scale, steps in ((30.0, 20), (60.0, 50)):
        problem = replace(make_problem("gaussian-guided"), guidance_scale=scale)
        cases.append(says_so(f"guidance {scale:g} in {steps} steps", partial(solve, problem, "dpm++2m", steps)))
    return cases


def says_so(name: str, run: Callable[[], Ended]) -> Case:
    """A run of too few steps for a problem is called so: by its code, or by its own indicator where it is far off."""

    def judge() -> Seen:
        ended = run()
        words = f"{_codes(ended)}, error {ended.error:.1e}, indicator {ended.indicator:.1e}"
        silent = not bool(torch.isfinite(ended.output).all())
        told = DIVERGED in ended.codes or ended.error <= 0.5 or ended.indicator > 0.4
        return Seen(told and set(ended.codes) <= {SUCCESS, DIVERGED}, words, ended.error, silent)

    return Case(name, "diverged, or an indicator > 0.4 where the error is > 0.5", judge)


def _codes(ended: Ended) -> str:
    return ", ".join(sorted({code.value for code in ended.codes}))


def few_step_cases() -> list[Case]:
    """Guidance in three to five steps, which blows multistep solvers up."""
    return [
        says_so(f"{name}, {solver}, {steps} steps", partial(solve, make_problem(name), solver, steps))
        for name in ("mixture-7.5", "mixture-30", "gaussian-guided", "gaussian-guided-30")
        for solver in SOLVERS
        for steps in (3, 5)
    ]


def step_cases() -> list[Case]:
    """The fewest and the most steps of each solver, and the loosest and the tightest tolerance."""
    cases = []
    for name in SOLVERS:
        lone = partial(solve, plain(), name, 1)
        if name in ("euler", "heun"):
            cases.append(refused(f"1 step, {name}", lone, "num_inference_steps"))
        else:
            cases.append(ends(f"1 step, {name}", lone, bound=1.0))
        cases.append(ends(f"2 steps, {name}", partial(solve, plain(), name, 2)))
        cases.append(ends(f"1000 steps, {name}", partial(solve, plain(), name, 1000), bound=0.02))
        cases.append(refused(f"0 steps, {name}", partial(solve, plain(), name, 0), "num_inference_steps"))
    mixture = make_problem("mixture-7.5")
    for tolerance in (1.0, 1e-1, 1e-2, 1e-3, 1e-4, 1e-5):
        bound = max(tolerance, 1e-4)  # below, float32 is in the way
        cases.append(ends(f"tolerance {tolerance:g}", partial(solve, mixture, tolerance=tolerance), bound=bound))
    for most in (2, 5):
        run = partial(solve, mixture, tolerance=1e-4, max_evaluations=most, known=False)
        cases.append(ends(f"tolerance within {most} evaluations", run, ReturnCode.MAX_EVALUATIONS))
        cases.append(
            raises(
                f"tolerance within {most} evaluations, raising",
                partial(run, throw=True),
                ReturnCode.MAX_EVALUATIONS,
            )
        )
    return cases


def batch_cases() -> list[Case]:
    """One sample and many, of one value and of odd sides."""
    cases = []
    for size in (1, 64, 256):
        for name, run in (("dpm++2m", partial(solve, plain(), "dpm++2m")),
                          ("tolerance", partial(solve, plain(), tolerance=TOLERANCE))):  # fmt: skip
            cases.append(ends(f"batch of {size}, {name}", partial(run, batch_size=size), bound=0.01))
    for shape in ((1, 1, 1), (3, 7, 5), (4, 1, 64)):
        data = spectrum(100.0, torch.Size(shape).numel(), mean=0.1)
        problem = Problem("odd", "Gaussian of odd sides", shape, data)
        cases.append(ends(f"latents {shape}", partial(solve, problem, "unipc"), bound=0.01))
    return cases


SCHEDULES: dict[str, dict[str, Any]] = {
    "largest level 0.1": {"beta_start": 1e-6, "beta_end": 2e-5, "beta_schedule": "linear"},
    "cosine": {"beta_schedule": "squaredcos_cap_v2"},
    "zero terminal SNR": {**STABLE_DIFFUSION, "rescale_betas_zero_snr": True},
    "2 levels": {"num_train_timesteps": 2, "trained_betas": [0.01, 0.999]},
    "10000 levels": {"num_train_timesteps": 10_000, "beta_start": 1e-5, "beta_end": 2e-3, "beta_schedule": "linear"},
}
"""That can be run on."""

HOPELESS: dict[str, dict[str, Any]] = {
    "smallest level below float32": {"beta_start": 1e-8, "beta_end": 0.02, "beta_schedule": "linear"},
    "largest level beyond float32": {"beta_start": 1e-4, "beta_end": 0.999, "beta_schedule": "linear"},
    "1 level": {"num_train_timesteps": 1, "trained_betas": [0.9]},
    "levels of another number": {"trained_betas": [0.01, 0.999]},
}
"""That cannot."""


def schedule_cases() -> list[Case]:
    """Schedules with ends far away, with few levels and with many, and all kinds of predictions."""
    cases = []
    for name, config in SCHEDULES.items():
        for kind in PREDICTION_TYPES:
            problem = replace(plain(), name=name, schedule_config=config, prediction_type=kind)
            steps = min(20, problem.scheduler().config.num_train_timesteps)
            for solver in ("ddim", "euler", "dpm++2m"):
                label, run = f"{name}, {kind}, {solver}", partial(solve, problem, solver, steps)
                if name == "zero terminal SNR" and not SOLVERS[solver].zero_snr:
                    cases.append(refused(label, run, "solver"))
                elif name == "zero terminal SNR" and (kind, solver) == ("epsilon", "ddim"):
                    cases.append(refused(label, run, "num_inference_steps"))
                else:
                    cases.append(ends(label, run, bound=1.0))
            run = partial(solve, problem, tolerance=TOLERANCE)
            cases.append(ends(f"{name}, {kind}, tolerance", run, bound=0.05 if steps == 2 else TOLERANCE))
    for name, config in HOPELESS.items():
        problem = replace(plain(), name=name, schedule_config=config)
        for solver in ("euler", "dpm++2m"):
            cases.append(refused(f"{name}, {solver}", partial(solve, problem, solver, 1000), "num_inference_steps"))
    for name in ("smallest level below float32", "largest level beyond float32", "1 level"):
        problem = replace(plain(), name=name, schedule_config=HOPELESS[name])
        cases.append(refused(f"{name}, tolerance", partial(solve, problem, tolerance=TOLERANCE), "scheduler"))
    return cases


# Networks that misbehave ----------------------------------------------------------------------------------------------


class Misbehaving:
    """The exact network of a problem, but for what `change` makes of some of its predictions.

    Args:
        change: (prediction (B, C, h, w), number of the call) -> another.
    """

    def __init__(self, problem: Problem, change: Callable[[Tensor, int], Tensor]):
        self.network, self.change, self.calls = problem.network(), change, 0

    def __call__(self, state: Tensor, timestep: Tensor) -> Tensor:
        """As the sampling loop calls networks."""
        self.calls += 1
        return self.change(self.network(state, timestep), self.calls - 1)


def sets(value: float, call: int | None = None, row: int | None = None) -> Callable[[Tensor, int], Tensor]:
    """Sets predictions to a value: all of them or one sample's, at every call or at one."""

    def change(prediction: Tensor, now: int) -> Tensor:
        if call is None or now == call:
            prediction = prediction.clone()
            prediction[slice(None) if row is None else row] = value
        return prediction

    return change


def rounded(dtype: torch.dtype, gain: float = 1.0) -> Callable[[Tensor, int], Tensor]:
    """Predictions of a network in half precision."""
    return lambda prediction, now: (prediction * gain).to(dtype)


def restless(prediction: Tensor, now: int) -> Tensor:
    """Other noise at every call, on top of what is right."""
    return prediction + 0.3 * torch.randn(prediction.shape, generator=torch.Generator().manual_seed(now))


WAYS: dict[str, dict[str, Any]] = {
    **{name: {"solver": name, "steps": 10} for name in SOLVERS},
    "tolerance": {"tolerance": TOLERANCE},
}
"""To run a network, by name."""


def network_cases() -> list[Case]:
    """Networks that break, and networks that are only odd."""

    def behaving(change: Callable[[Tensor, int], Tensor], known: bool = False, **way: Any) -> Callable[[], Ended]:
        return lambda: solve(plain(), network=Misbehaving(plain(), change), known=known, **way)

    cases = []
    for name, way in WAYS.items():
        for what, value in (("NaN", math.nan), ("Inf", math.inf)):
            for when, call in (("first", 0), ("later", 5)):
                label = f"{what} at the {when} evaluation" if call == 0 else f"{what} at a later evaluation"
                cases.append(ends(f"{label}, {name}", behaving(sets(value, call), **way), NON_FINITE))
        mixed = behaving(sets(math.nan, 3, 1), known=True, **way)
        bound = 0.4 if name in SOLVERS else TOLERANCE
        cases.append(ends(f"NaN in one of four, {name}", mixed, [SUCCESS, NON_FINITE, SUCCESS, SUCCESS], bound))
        cases.append(raises(f"NaN, raising, {name}", behaving(sets(math.nan, 3), throw=True, **way), NON_FINITE))
        cases.append(ends(f"1e38 throughout, {name}", behaving(sets(1e38), **way), NON_FINITE))
        # Noise that is not taken away is at 15 times the size of the data where the schedule ends.
        for what, value in (("zeros", 0.0), ("a constant 1", 1.0), ("a constant 1e4", 1e4)):
            cases.append(ends(f"{what}, {name}", behaving(sets(value), **way), DIVERGED))
        for dtype, bound in ((torch.float16, 2e-3), (torch.bfloat16, 2e-2)):
            label = f"predictions in {str(dtype).removeprefix('torch.')}, {name}"
            fine = {**way, "steps": 50} if "steps" in way else way
            worst = 0.15 if name in SOLVERS and SOLVERS[name].order == 1 else max(bound, TOLERANCE)
            cases.append(ends(label, behaving(rounded(dtype), known=True, **fine), bound=worst))
        cases.append(ends(f"beyond float16, {name}", behaving(rounded(torch.float16, 1e5), **way), NON_FINITE))
        if name in SOLVERS:
            cases.append(ends(f"another noise each time, {name}", behaving(restless, **way)))
    restlessly = behaving(restless, tolerance=1e-4)
    cases.append(ends("another noise each time, tolerance", restlessly, ReturnCode.STEP_TOO_SMALL))
    return cases


def problem_suite() -> dict[str, list[Case]]:
    """All cases on exact problems, by group."""
    return {
        "stiff": stiff_cases(),
        "guidance": guidance_cases(),
        "few steps": few_step_cases(),
        "steps": step_cases(),
        "batches": batch_cases(),
        "schedules": schedule_cases(),
        "predictions": network_cases(),
    }
