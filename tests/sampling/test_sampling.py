"""What a call may say of its steps; the run: starts, interrupts, and what breaks or diverges; and its report."""

import itertools
import json
import math
import time
from contextlib import suppress
from dataclasses import replace

import diffusers
import pytest
import torch

from tests.helpers.calls import seeded
from unitouch_gen.errors import InvalidInputError, InvalidTypeError, NonFiniteError
from unitouch_gen.numerics.problems import PROBLEMS, STABLE_DIFFUSION, relative_rms
from unitouch_gen.sampling import DIVERGED_RMS, SOLVERS, ReturnCode, RunReport, prepare_steps, sample

SUCCESS, NON_FINITE, DIVERGED = ReturnCode.SUCCESS, ReturnCode.NON_FINITE, ReturnCode.DIVERGED
PLAIN, GUIDED = PROBLEMS["conditioning-1e2"], PROBLEMS["gaussian-guided"]
NAN = math.nan
OWN = PLAIN.scheduler()


def run(network=None, problem=PLAIN, guidance=None, prepared=None, scheduler=OWN, count=3, **options):
    """(latents, report) of three samples; options are of `sample` and of `prepare_steps`."""
    report, network = RunReport(), network or problem.network(count)
    names = ("init", "generator", "throw", "on_step", "progress")
    settings = {name: options.pop(name) for name in names if name in options}
    prepared = prepared or prepare_steps(scheduler, **{"solver": "dpm++2m", "num_inference_steps": 8, **options})
    settings["guidance"] = problem.guidance if guidance is None else guidance
    return sample(network, problem.noise(count).float(), prepared, report, **settings), report


# What a call may say of its steps -------------------------------------------------------------------------------------


def test_steps_that_cannot_be_made_are_refused():
    for arguments, words in (
        ({"scheduler": "ddim"}, "`scheduler` is 'ddim'"),
        ({"solver": "ddim", "scheduler": diffusers.FlowMatchEulerDiscreteScheduler()}, "has no noise levels"),
        ({"num_inference_steps": 1001}, "`num_inference_steps` is 1001"),
        ({"tolerance": 0.1, "eta": 0.5}, "`eta` is 0.5, but has no effect with `tolerance`"),
        ({"solver": "euler", "eta": 0.5}, "`eta` is 0.5, but 'euler' adds no noise"),
        ({"tolerance": 0.1, "max_evaluations": 1}, "`max_evaluations` is 1"),
        ({"timesteps": [9], "solver": "heun"}, "`solver` is 'heun', but has no effect with `timesteps`"),
        ({"timesteps": [9], "tolerance": 0.1}, "`timesteps` is .* no effect with `tolerance`"),
        ({"timesteps": [500, 999]}, "`timesteps` is .*; each has to be below the one before"),
        ({"timesteps": [1000, 1]}, "`timesteps` is 1000"), ({"timesteps": 5}, "`timesteps` is"),
        ({"timesteps": [999, 9]}, "DDIMScheduler chooses its own"),
        ({"timesteps": [99, 9], "scheduler": diffusers.DDPMScheduler()}, "99, 9], .* starts at timestep 99 of 1000"),
        ({"init_strength": 0.5, "scheduler": diffusers.FlowMatchEulerDiscreteScheduler()}, "starts at noise alone"),
        ({"num_inference_steps": 1000, "scheduler": diffusers.DDIMScheduler(steps_offset=1)},
         "1000, with .* timestep 1000 of"),
        ({"num_inference_steps": 1, "scheduler": diffusers.EulerDiscreteScheduler(timestep_spacing="leading")},
         "timestep 0 of"),
    ):  # fmt: skip
        with pytest.raises((InvalidInputError, InvalidTypeError), match=words):
            prepare_steps(**{"scheduler": OWN, **arguments})


@pytest.mark.parametrize("share", [0.9, 0.5, 0.3])
@pytest.mark.parametrize(
    "how",
    [
        "ddim", "unipc", diffusers.DDIMScheduler(**STABLE_DIFFUSION), diffusers.HeunDiscreteScheduler(),
        diffusers.PNDMScheduler(skip_prk_steps=True, **STABLE_DIFFUSION), diffusers.LCMScheduler(),
        diffusers.UniPCMultistepScheduler(use_exponential_sigmas=True, prediction_type="v_prediction"),
        diffusers.EulerDiscreteScheduler(use_karras_sigmas=True), diffusers.TCDScheduler(),
    ],
)  # fmt: skip
def test_a_start_lies_at_its_share_whatever_the_number_of_steps(how, share):
    given = {"scheduler": OWN, "solver": how} if isinstance(how, str) else {"scheduler": how}

    def start(count: int) -> float:
        steps = prepare_steps(**given, num_inference_steps=count, init_strength=share)
        assert steps.count == max(round(share * count), 1)
        if steps.scheduler is None:
            return math.log(steps.sigmas[0])
        signal, noise = (steps.scheduler.add_noise(*pair, steps.timesteps[:1]).item()
                         for pair in ((torch.ones(1), torch.zeros(1)), (torch.zeros(1), torch.ones(1))))  # fmt: skip
        return math.log(noise / signal)

    starts = [start(count) for count in (1, 2, 3, 4, 10, 50)]
    assert max(starts) - min(starts) < 1e-3
    if "solver" in given:
        whole = prepare_steps(**given, num_inference_steps=100)
        assert starts[0] == pytest.approx(math.log(whole.sigmas[round(100 * (1 - share))]), abs=0.1)


# The run --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", [None, "ddim", "dpm++2m", "unipc"])
def test_from_given_latents_the_flow_goes_on_where_they_lie(solver):
    init = 0.5 * torch.randn(3, 4, 2, 2, generator=seeded(1))
    steps = prepare_steps(OWN, solver=solver, num_inference_steps=60, init_strength=0.5)
    found, _ = run(prepared=steps, init=init)
    sigma = PLAIN.schedule.sigma(steps.timesteps[0]) if solver is None else steps.sigmas[0]
    data = PLAIN.data
    start = (init + sigma * PLAIN.noise(3)).flatten(1)
    exact = (data.variances / (data.variances + sigma**2)).sqrt() * start
    assert relative_rms(found, exact.view(found.shape)).max() < (0.25 if solver in (None, "ddim") else 0.03)


@pytest.mark.parametrize("solver", [None, "heun"])
def test_progress_ends_at_one(solver):
    for options in ({"solver": solver}, {"solver": None, "num_inference_steps": None, "tolerance": 0.1}):
        shares = []
        run(progress=shares.append, **options)
        assert shares == sorted(shares) and shares[-1] == 1.0


@pytest.mark.parametrize(
    "options", [{}, {"solver": None}, {"solver": None, "num_inference_steps": None, "tolerance": 0.1}]
)
def test_an_interrupt_ends_the_run_before_its_next_evaluation_and_never_raises(options):
    def stop(step, timestep, latents, run):
        run.interrupted = step == 1
        return latents * torch.tensor([NAN if step == 0 and not run.throw else 1.0, 1.0, 1.0]).view(3, 1, 1, 1)

    latents, report = run(on_step=stop, **options)
    assert report.codes == [ReturnCode.INTERRUPTED] * 3 and "interrupted" in str(report)
    assert report.evaluations in (2, 3) and torch.isfinite(latents).all()  # a tolerance starts with one more
    _, report = run(on_step=stop, throw=False, **options)
    assert report.codes == [NON_FINITE, ReturnCode.INTERRUPTED, ReturnCode.INTERRUPTED]


# Samples that break or diverge ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("solver", "value"), [(None, NAN), *zip(SOLVERS, itertools.cycle([NAN, math.inf]))])
def test_a_sample_that_breaks_raises_or_leaves_the_others_as_if_alone(solver, value):
    """Also in multistep solvers, whose memory of the broken sample is not finite for some steps."""

    def breaking():
        calls, network = [], PLAIN.network(3)

        def predict(z, timestep):
            calls.append(timestep)
            prediction = network(z, timestep)
            prediction[1] = value if len(calls) == 3 else prediction[1]
            return prediction

        return predict

    with pytest.raises(NonFiniteError, match=r"Sample 1 is not finite after step [23]"):
        run(breaking(), solver=solver)
    latents, report = run(breaking(), solver=solver, throw=False)
    assert torch.equal(latents[[0, 2]], run(solver=solver)[0][[0, 2]])
    assert not latents[1].any() and report.failed_at[1] in (1, 2)
    assert report.codes == [SUCCESS, NON_FINITE, SUCCESS]


def puts(size, row=0, at=2):
    """A callback that puts latents of an RMS in the place of one sample's."""

    def on_step(step, timestep, latents, run):
        latents = latents.clone()
        if step == at:
            latents[row] = size * torch.sign(latents[row])
        return latents

    return on_step


def test_a_sample_is_diverged_alone_and_at_its_step():
    (latents, report), (whole, _) = run(on_step=puts(2 * DIVERGED_RMS)), run()
    assert (report.codes, report.failed_at) == ([DIVERGED, SUCCESS, SUCCESS], {0: 2})
    torch.testing.assert_close(latents[1:], whole[1:])


def test_a_diverged_sample_does_not_hold_steps_to_a_tolerance_up():
    options = {"tolerance": 0.05, "solver": None, "num_inference_steps": None}
    (latents, report), (whole, alone) = run(on_step=puts(2 * DIVERGED_RMS), **options), run(**options)
    assert report.codes == [DIVERGED, SUCCESS, SUCCESS]
    assert report.evaluations <= alone.evaluations + 2 and relative_rms(latents, whole)[1:].max() < 0.05


@pytest.mark.parametrize(("solver", "size", "code"), [(None, 2.0, DIVERGED), ("dpm++2m", 0.5, SUCCESS)])
def test_states_are_judged_as_networks_see_them(solver, size, code):
    """Also of a diffusers scheduler that keeps x = z sqrt(1 + sigma^2)."""
    shown = []

    def network(z, timestep):
        shown.append(z.square().mean(dim=(1, 2, 3)).sqrt())
        return PLAIN.network(3)(z, timestep)

    def grow(step, timestep, latents, run):
        return latents * (size * DIVERGED_RMS / shown[-1].min() if step == 0 else 1.0)

    scheduler = diffusers.EulerDiscreteScheduler(**STABLE_DIFFUSION, use_karras_sigmas=True)
    _, report = run(network, scheduler=scheduler, solver=solver, on_step=grow, throw=False)
    assert shown[1].min() > 0.8 * size * DIVERGED_RMS and report.codes == [code] * 3


@pytest.mark.parametrize("solver", SOLVERS)
def test_sound_runs_are_a_success_and_too_few_steps_for_a_guidance_diverge(solver):
    assert run(problem=replace(GUIDED, guidance_scale=30.0), solver=solver, num_inference_steps=50)[1].success
    _, report = run(problem=replace(GUIDED, guidance_scale=1000.0), solver=solver, num_inference_steps=6, throw=False)
    assert report.codes[0] in (DIVERGED, NON_FINITE)


# The report -----------------------------------------------------------------------------------------------------------


def test_a_stage_adds_up_the_time_spent_inside_and_counts_where_it_fails():
    report, started = RunReport(), time.perf_counter()
    for _ in range(2):
        with suppress(KeyError), report.stage("touch"):
            time.sleep(0.01)
            raise KeyError
    assert 0.02 <= report.seconds["touch"] <= time.perf_counter() - started


def test_it_is_a_line_of_solver_counts_time_and_outcome_and_goes_through_json_as_a_copy():
    report = RunReport(solver="unipc", steps=10, evaluations=10, seconds={"touch": 0.25, "denoising": 1.5},
                       codes=[SUCCESS, NON_FINITE], failed_at={1: 3}, left_out=["VAE"],
                       unknown={"touch": ["unlike anything known", None]})  # fmt: skip
    values = json.loads(json.dumps(report.to_dict()))
    assert values["codes"] == ["success", "non_finite"] and values["failed_at"] == {"1": 3}
    assert values["seconds"] == report.seconds
    report.to_dict()["left_out"].append("x")
    assert report.left_out == ["VAE"] and "\n" not in str(report)
    for part in ("unipc: 10 steps, 10 evaluations, 1.75 s (touch", "success, non_finite; 1 of the inputs unknown"):
        assert part in str(report)
    assert str(RunReport(codes=[SUCCESS])).endswith("0 evaluations, 0.00 s (); all finite")


def test_every_code_has_a_message():
    assert all(code.message.endswith(".") for code in ReturnCode)
