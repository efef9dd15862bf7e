"""Runs that blow up but stay finite, and runs that are interrupted: the codes they end with, and what is raised."""

import math
from dataclasses import replace

import pytest
import torch

from unitouch_gen.errors import NotConvergedError
from unitouch_gen.numerics.problems import make_problem
from unitouch_gen.numerics.reference import relative_rms
from unitouch_gen.sampling import (
    DIVERGED_SIZE,
    HOPELESS_SIZE,
    ReturnCode,
    RunReport,
    prepare_steps,
    sample,
    sample_to_tolerance,
)
from unitouch_gen.schedulers.solvers import SOLVERS, make_scheduler

# numpy 2 on diffusers' DEIS.
pytestmark = pytest.mark.filterwarnings("ignore:__array_wrap__ must accept context:DeprecationWarning")

CPU = torch.device("cpu")
PLAIN = make_problem("gaussian")


def guided(scale):
    """Between two Gaussians: its flow has a closed form and stays below an RMS of 1.5 at any guidance."""
    return replace(make_problem("gaussian-guided"), guidance_scale=scale)


def run(problem=PLAIN, solver="dpm++2m", steps=10, *, network=None, tolerance=None, **options):
    """(latents, report) of three samples."""
    noise, network, report = problem.noise(3).float(), network or problem.network(), RunReport()
    if tolerance is None:
        scheduler = make_scheduler(problem.scheduler(), solver)
        prepare_steps(scheduler, steps, CPU)
        return sample(network, noise, scheduler, report, guidance=problem.guidance, **options), report
    arguments = (noise, problem.schedule, problem.prediction_type, tolerance, report)
    options = {"guidance": problem.guidance, "max_evaluations": 300, **options}
    return sample_to_tolerance(network, *arguments, **options), report


def puts(size, row=0, at=2):
    """A callback that puts latents of an RMS in the place of one sample's."""

    def on_step(run, evaluation, timestep):
        run.latents = run.latents.clone()
        if evaluation == at:
            run.latents[row] = size * torch.sign(run.latents[row])

    return on_step


# Unstable -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("scale", [1.0, 7.5, 30.0])
def test_sound_runs_are_a_success(solver, scale):
    assert run(guided(scale), solver, 50)[1].codes == [ReturnCode.SUCCESS] * 3


def test_a_run_that_blows_up_but_stays_finite_is_diverged():
    """50 steps are too few for guidance 100; the exact flow stays small."""
    problem = guided(100.0)
    latents, report = run(problem, "dpm++2m", 50, throw=False)
    assert report.codes == [ReturnCode.DIVERGED] * 3
    assert torch.isfinite(latents).all()
    assert (relative_rms(latents, problem.solution(problem.noise(3))) > 1.0).all()


def test_a_run_that_blows_up_raises_at_its_step():
    with pytest.raises(NotConvergedError, match=r"Sample \d grew to \d+ times .* in step \d+.*`guidance_scale`"):
        run(guided(100.0), "dpm++2m", 50)


@pytest.mark.parametrize("tolerance", [0.1, 0.01])
def test_steps_to_a_tolerance_do_not_follow_what_grows(tolerance):
    """A prediction that grows along with the state must not make its error look small."""
    sizes = []

    def note(run, evaluation, timestep):
        sizes.append(run.latents.square().mean(dim=(1, 2, 3)).sqrt().max().item())

    _, report = run(guided(1000.0), tolerance=tolerance, on_step=note, throw=False)
    assert report.codes == [ReturnCode.MAX_EVALUATIONS] * 3
    assert max(sizes) < 3.0


@pytest.mark.parametrize("solver", ["ddim", "euler", "heun", "dpm++2m"])
@pytest.mark.parametrize(("size", "code"), [(0.5, ReturnCode.SUCCESS), (2.0, ReturnCode.DIVERGED)])
def test_states_are_judged_as_networks_see_them(solver, size, code):
    """Also of solvers that keep x = z sqrt(1 + sigma^2)."""
    shown = []

    def network(state, timestep):
        shown.append(state.square().mean(dim=(1, 2, 3)).sqrt())
        return PLAIN.network()(state, timestep)

    def grow(run, evaluation, timestep):
        run.latents = run.latents * (size * DIVERGED_SIZE / shown[-1].min() if evaluation == 0 else 1.0)

    _, report = run(solver=solver, network=network, on_step=grow, throw=False)
    assert shown[1].min() > 0.8 * size * DIVERGED_SIZE
    assert report.codes == [code] * 3


def test_a_sample_is_diverged_alone_and_at_its_step():
    (latents, report), (whole, _) = run(on_step=puts(2 * DIVERGED_SIZE)), run()
    assert report.codes == [ReturnCode.DIVERGED, ReturnCode.SUCCESS, ReturnCode.SUCCESS]
    assert report.failed_at == {0: 2}
    assert torch.equal(latents[1:], whole[1:])


def test_an_diverged_sample_does_not_hold_the_others_up():
    """Steps to a tolerance go on for those that count."""
    (latents, report), (whole, alone) = run(tolerance=0.05, on_step=puts(2 * DIVERGED_SIZE)), run(tolerance=0.05)
    assert report.codes == [ReturnCode.DIVERGED, ReturnCode.SUCCESS, ReturnCode.SUCCESS]
    assert report.evaluations <= alone.evaluations + 2
    assert (relative_rms(latents, whole)[1:] < 0.05).all()


def test_what_no_longer_is_finite_is_not_diverged_as_well():
    def on_step(run, evaluation, timestep):
        factor = {2: 2 * DIVERGED_SIZE, 4: math.inf}.get(evaluation, 1.0)
        run.latents = run.latents * torch.tensor([factor, 1.0, 1.0]).view(3, 1, 1, 1)

    _, report = run(on_step=on_step, throw=False)
    assert report.codes == [ReturnCode.NON_FINITE, ReturnCode.SUCCESS, ReturnCode.SUCCESS]


def test_a_call_raises_from_ten_times_that_size():
    run(on_step=puts(0.9 * HOPELESS_SIZE))
    with pytest.raises(NotConvergedError, match=r"Sample 0 grew to .* in step 3"):
        run(on_step=puts(1.1 * HOPELESS_SIZE))


def test_noise_that_no_network_takes_away_does_not_raise():
    """An untrained network that predicts no noise leaves all of it: 15 times the data's size, in this schedule."""
    latents, report = run(network=lambda state, timestep: torch.zeros_like(state))
    assert report.codes == [ReturnCode.DIVERGED] * 3
    assert 10 < latents.square().mean().sqrt() < 20


# Interrupted ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tolerance", [None, 0.1])
def test_an_interrupted_run_has_a_code_and_does_not_raise(tolerance):
    def stop(run, evaluation, timestep):
        run.interrupted = evaluation >= 3

    latents, report = run(tolerance=tolerance, on_step=stop)
    assert report.codes == [ReturnCode.INTERRUPTED] * 3
    assert report.evaluations == 4
    assert torch.isfinite(latents).all()
    assert not report.success
    assert "interrupted" in str(report)


@pytest.mark.parametrize("tolerance", [None, 0.1])
def test_an_interrupt_after_the_last_step_comes_too_late(tolerance):
    last = run(tolerance=tolerance)[1].evaluations - 1

    def stop(run, evaluation, timestep):
        run.interrupted = evaluation == last

    _, report = run(tolerance=tolerance, on_step=stop)
    assert report.codes == [ReturnCode.SUCCESS] * 3


def test_a_sample_that_broke_before_an_interrupt_stays_broken():
    put = puts(math.nan)

    def stop(run, evaluation, timestep):
        put(run, evaluation, timestep)
        run.interrupted = evaluation == 3

    _, report = run(on_step=stop, throw=False)
    assert report.codes == [ReturnCode.NON_FINITE, ReturnCode.INTERRUPTED, ReturnCode.INTERRUPTED]
