"""The guided loop on data whose denoiser and probability-flow solution are known: N(0, s^2) in every dimension.

With alpha = sqrt(abar) and sigma = sqrt((1 - abar) / abar), the best prediction of the noise in
x = alpha (x_0 + sigma n) is E[n | x] = x sigma sqrt(1 + sigma^2) / (s^2 + sigma^2), and the probability-flow ODE takes
z = x / alpha from sigma_T to 0 along z ~ sqrt(s^2 + sigma^2).
"""

import math

import numpy as np
import pytest
import torch
from diffusers import DDIMScheduler, DDPMScheduler, EulerAncestralDiscreteScheduler, PNDMScheduler

from unitouch_gen.errors import InvalidInputError, InvalidTypeError, NonFiniteError
from unitouch_gen.sampling import Guidance, ReturnCode, RunReport, prepare_steps, sample, start_from
from unitouch_gen.schedulers.solvers import SOLVERS, make_scheduler

# numpy 2 on diffusers' DEIS.
pytestmark = pytest.mark.filterwarnings("ignore:__array_wrap__ must accept context:DeprecationWarning")

CPU = torch.device("cpu")
SPREAD = 0.5  # s
OWN = DDIMScheduler(beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear", clip_sample=False)
SIGMAS = ((1 - OWN.alphas_cumprod.double()) / OWN.alphas_cumprod.double()).sqrt().numpy()
NAN = float("nan")


def gaussian_denoiser(state: torch.Tensor, timestep: torch.Tensor) -> torch.Tensor:
    """E[n | x]; between timesteps log sigma is linear, as diffusers has it."""
    sigma = float(np.exp(np.interp(float(timestep), np.arange(len(SIGMAS)), np.log(SIGMAS))))
    return state * sigma * math.sqrt(1 + sigma**2) / (SPREAD**2 + sigma**2)


def zero_denoiser(state: torch.Tensor, timestep: torch.Tensor) -> torch.Tensor:
    return torch.zeros_like(state)


def run(denoise=gaussian_denoiser, solver="ddim", steps=4, scale=1.0, scheduler=None, noise=None, **options):
    """(latents, report) of a batch of two."""
    scheduler = scheduler or make_scheduler(OWN, solver)
    prepare_steps(scheduler, steps, CPU)
    noise = torch.randn(2, 4, 8, 8, generator=torch.Generator().manual_seed(0)) if noise is None else noise
    report = RunReport()
    return sample(denoise, noise, scheduler, report, guidance=Guidance(scale), **options), report


def error(solver: str, steps: int) -> float:
    """Relative distance to the exact solution."""
    noise = torch.randn(2, 4, 8, 8, generator=torch.Generator().manual_seed(0))
    got, _ = run(solver=solver, steps=steps, noise=noise)
    largest = SIGMAS[-1]
    exact = noise * math.sqrt(1 + largest**2) * SPREAD / math.sqrt(SPREAD**2 + largest**2)
    return ((got - exact).norm() / exact.norm()).item()


# Convergence ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", SOLVERS)
def test_solvers_converge_to_the_exact_solution(solver):
    """What stays is the jump from the smallest sigma to 0, sigma^2 / (2 s^2) = 1.7e-3, and the first order of two."""
    assert error(solver, 80) < (3e-3 if SOLVERS[solver].order > 1 else 5e-2)


@pytest.mark.parametrize("solver", SOLVERS)
def test_errors_fall_with_steps_at_the_order_of_the_solver(solver):
    coarse, middle, fine = (error(solver, steps) for steps in (10, 20, 40))
    assert coarse > middle > fine
    assert math.log2(coarse / fine) / 2 > 0.75 * SOLVERS[solver].order


def test_second_order_beats_first():
    first = min(error(name, 40) for name, solver in SOLVERS.items() if solver.order == 1)
    assert all(error(name, 40) < first / 10 for name, solver in SOLVERS.items() if solver.order == 2)


@pytest.mark.parametrize("solver", SOLVERS)
def test_no_noise_stays_in_the_picture(solver):
    """All data is 0: whatever else comes out is noise that was left in."""

    def denoise(state, timestep):
        sigma = float(np.exp(np.interp(float(timestep), np.arange(len(SIGMAS)), np.log(SIGMAS))))
        return state * math.sqrt(1 + sigma**2) / sigma

    latents, _ = run(denoise, solver, steps=20)
    assert latents.abs().max() < 1e-2 * SIGMAS[0]


# Guidance -------------------------------------------------------------------------------------------------------------


def test_guidance_is_the_unconditional_prediction_plus_s_times_the_difference():
    unconditional, conditional = torch.randn(2, 3, 4, 4, 4)
    got = Guidance(2.5).combine(torch.cat([unconditional, conditional]))
    torch.testing.assert_close(got, unconditional + 2.5 * (conditional - unconditional))


@pytest.mark.parametrize(("scale", "active"), [(0.0, False), (0.5, False), (1.0, False), (1.01, True), (9.0, True)])
def test_guidance_is_on_above_one(scale, active):
    assert Guidance(scale).active is active


def test_the_loop_runs_both_branches_at_once_unconditional_first():
    """Unconditional predictions are none, so guidance s is s times the conditional one."""
    batches = []

    def denoise(state, timestep):
        batches.append(len(state))
        assert torch.equal(*state.chunk(2))
        return torch.cat([torch.zeros(2, 4, 8, 8), gaussian_denoiser(state[2:], timestep)])

    got, _ = run(denoise, scale=1.5)
    expected, _ = run(lambda state, timestep: 1.5 * gaussian_denoiser(state, timestep))
    torch.testing.assert_close(got, expected)
    assert batches == [4] * 4


def test_guidance_may_change_from_one_evaluation_to_the_next():
    """Unconditional predictions are none, so guidance s is s times the conditional one."""
    scales, shown = iter([1.0, 2.0, 0.0, 0.0]), []

    def denoise(state, timestep):
        prediction = gaussian_denoiser(state, timestep)
        shown.append(len(state))
        return torch.cat([torch.zeros(2, 4, 8, 8), prediction[2:]]) if len(state) == 4 else prediction

    def change(run, evaluation, timestep):
        run.guidance = Guidance(next(scales))

    got, _ = run(denoise, scale=3.0, on_step=change)
    gains = iter([3.0, 1.0, 2.0, 1.0])
    expected, _ = run(lambda state, timestep: next(gains) * gaussian_denoiser(state, timestep))
    torch.testing.assert_close(got, expected)
    assert shown == [4, 2, 4, 2]


def test_guidance_between_equal_branches_changes_nothing():
    torch.testing.assert_close(run(scale=7.5)[0], run(scale=1.0)[0], atol=1e-5, rtol=1e-5)


# State ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_the_state_is_float32_whatever_the_network_says(solver, dtype):
    states = []

    def denoise(state, timestep):
        states.append(state.dtype)
        return gaussian_denoiser(state, timestep).to(dtype)

    latents, _ = run(denoise, solver, noise=torch.randn(2, 4, 8, 8, dtype=dtype))
    assert {*states, latents.dtype} == {torch.float32}


@pytest.mark.parametrize("solver", SOLVERS)
def test_noise_has_unit_variance_and_the_scheduler_scales_it(solver):
    """A network is always shown a state of about unit variance, here at its start."""
    shown = []

    def denoise(state, timestep):
        shown.append(state)
        return gaussian_denoiser(state, timestep)

    noise = torch.randn(2, 4, 8, 8)
    run(denoise, solver, noise=noise)
    torch.testing.assert_close(shown[0], noise, rtol=5e-3, atol=0)


def test_the_noise_that_came_stays_as_it_was():
    noise = torch.randn(2, 4, 8, 8)
    kept = noise.clone()
    run(noise=noise, solver="euler")
    assert torch.equal(noise, kept)


# Samples that break ---------------------------------------------------------------------------------------------------


def breaks_at(call: int, value: float = NAN):
    """The exact denoiser, whose prediction for sample 0 is `value` at one of its calls."""
    calls = []

    def denoise(state, timestep):
        prediction = gaussian_denoiser(state, timestep)
        if len(calls) == call:
            prediction[0] = value
        calls.append(1)
        return prediction

    return denoise


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("value", [NAN, math.inf])
def test_a_sample_that_breaks_raises_and_names_its_step(solver, value):
    step = 2 if solver == "heun" else 3  # the third evaluation is in Heun's second step
    with pytest.raises(NonFiniteError, match=f"Sample 0 is not finite after step {step}"):
        run(breaks_at(2, value), solver, steps=6)


@pytest.mark.parametrize("solver", SOLVERS)
def test_without_throw_the_others_go_on_as_if_alone(solver):
    """Also in multistep solvers, whose memory of the broken sample is not finite for some steps."""
    whole, _ = run(solver=solver, steps=6)
    latents, report = run(breaks_at(2), solver, steps=6, throw=False)
    assert torch.equal(latents[1], whole[1])
    assert not latents[0].any()
    assert report.codes == [ReturnCode.NON_FINITE, ReturnCode.SUCCESS]
    assert report.failed_at == {0: 1 if solver == "heun" else 2}


def test_a_broken_sample_is_zero_from_there_on():
    states = []

    def note(run, evaluation, timestep):
        states.append(run.latents[0].abs().max().item())

    run(breaks_at(1), "dpm++2m", steps=4, throw=False, on_step=note)
    assert states[0] > 0.0
    assert states[1:] == [0.0, 0.0, 0.0]


def test_each_sample_breaks_at_a_step_of_its_own():
    def callback(run, evaluation, timestep):
        run.latents = run.latents.clone()
        run.latents[1 - evaluation if evaluation < 2 else slice(0)] = NAN

    latents, report = run(throw=False, on_step=callback)
    assert report.failed_at == {1: 0, 0: 1}
    assert not latents.any()


# Steps ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("scheduler", "evaluations"),
    [
        (make_scheduler(OWN, "ddim"), 5),
        (make_scheduler(OWN, "heun"), 9),
        (PNDMScheduler.from_config(OWN.config, skip_prk_steps=True), 6),
    ],
)
def test_steps_are_those_asked_for_and_evaluations_those_made(scheduler, evaluations):
    """2 N - 1 for Heun, whose last step to sigma = 0 is Euler's, and N + 1 for PNDM."""
    told = []
    _, report = run(scheduler=scheduler, steps=5, progress=told.append)
    assert report.steps == 5
    assert len(told) == report.evaluations == evaluations
    assert told == sorted(told) and told[-1] == 1.0


@pytest.mark.parametrize(("name", "expected"), [("ddim", [1, 2, 3]), ("heun", [1, 1, 2, 2, 3]), ("pndm", [1, 1, 2, 3])])
def test_a_sample_that_breaks_names_the_step_that_its_evaluation_is_in(name, expected):
    named = []
    for call in range(len(expected)):
        pndm = name == "pndm"
        scheduler = PNDMScheduler.from_config(OWN.config, skip_prk_steps=True) if pndm else make_scheduler(OWN, name)
        with pytest.raises(NonFiniteError) as caught:
            run(breaks_at(call), scheduler=scheduler, steps=3)
        named.append(int(str(caught.value).split("after step ")[1][0]))
    assert named == expected


def test_an_interrupt_stops_before_the_next_step():
    def stop(run, evaluation, timestep):
        run.interrupted = evaluation == 1

    latents, report = run(steps=5, on_step=stop)
    assert (report.steps, report.evaluations) == (5, 2)
    assert report.codes == [ReturnCode.INTERRUPTED] * 2
    assert torch.isfinite(latents).all()


def test_an_interrupt_before_the_first_step_leaves_the_noise():
    noise = torch.randn(2, 4, 8, 8)
    latents, report = run(noise=noise, interrupted=True)
    assert report.evaluations == 0
    assert torch.equal(latents, noise)


def test_what_a_step_callback_puts_in_the_latents_place_stays_there():
    def put(run, evaluation, timestep):
        run.latents = torch.ones(2, 4, 8, 8)

    assert torch.equal(run(on_step=put)[0], torch.ones(2, 4, 8, 8))


@pytest.mark.parametrize("latents", [None, torch.ones(2, 4, 8, 9)])
def test_latents_of_another_shape_are_refused(latents):
    def put(run, evaluation, timestep):
        run.latents = latents

    with pytest.raises(InvalidInputError, match=r"`callback_on_step_end` returned `latents`.*\(2, 4, 8, 8\)"):
        run(on_step=put)


def test_a_step_callback_may_leave_everything_as_it_is():
    assert torch.equal(run(on_step=lambda *given: None)[0], run()[0])


@pytest.mark.parametrize("kind", [DDPMScheduler, EulerAncestralDiscreteScheduler, PNDMScheduler])
def test_a_scheduler_gets_of_generator_and_eta_what_its_step_takes(kind):
    def drawn(seed):
        made = kind.from_config(OWN.config)
        return run(scheduler=made, generator=torch.Generator().manual_seed(seed), eta=0.5)[0]

    assert torch.equal(drawn(1), drawn(1))
    assert torch.equal(drawn(1), drawn(2)) == (kind is PNDMScheduler)  # which draws nothing


def test_eta_adds_noise_from_the_generator():
    first, again, other = (run(eta=1.0, generator=torch.Generator().manual_seed(seed))[0] for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert not torch.equal(first, run()[0])


def test_timesteps_are_those_of_the_scheduler():
    scheduler = make_scheduler(OWN, "unipc")
    assert torch.equal(prepare_steps(scheduler, 7, CPU), scheduler.timesteps)


@pytest.mark.parametrize("scheduler", [DDIMScheduler, PNDMScheduler])
def test_steps_beyond_the_last_noise_level_are_refused(scheduler):
    with pytest.raises(InvalidInputError, match=rf"`num_inference_steps` is 1000, .*{scheduler.__name__}"):
        prepare_steps(scheduler(steps_offset=1), 1000, CPU)


@pytest.mark.parametrize("solver", ["euler", "heun"])
def test_one_step_that_would_return_the_noise_is_refused(solver):
    """diffusers spaces a single step at the lowest noise level."""
    with pytest.raises(InvalidInputError, match=r"`num_inference_steps` is 1, .* at noise level 0 of 1000"):
        prepare_steps(make_scheduler(OWN, solver), 1, CPU)


@pytest.mark.parametrize("solver", ["ddim", "dpm++2m", "unipc", "deis"])
def test_one_step_goes_all_the_way_where_it_can(solver):
    assert error(solver, 1) < 1.0


def test_steps_that_the_scheduler_refuses_are_an_error_of_the_argument():
    with pytest.raises(InvalidInputError, match="`num_inference_steps` is 1001, which DDIMScheduler cannot make"):
        prepare_steps(DDIMScheduler(), 1001, CPU)
    with pytest.raises(InvalidInputError, match=r"`num_inference_steps` is 1000000000; it has to be .* to 100000"):
        prepare_steps(make_scheduler(DDIMScheduler(), "euler"), 10**9, CPU)


@pytest.mark.parametrize("steps", [0, -1, 1.5, True, "10", None])
def test_what_is_no_number_of_steps_is_refused(steps):
    with pytest.raises((InvalidInputError, InvalidTypeError), match=f"`num_inference_steps` is .*{steps}"):
        prepare_steps(DDIMScheduler(), steps, CPU)


# Starting from latents ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", sorted(SOLVERS))
def test_from_given_latents_the_flow_goes_on_where_they_lie(solver):
    """z = x_0 + sigma n at the sigma that is left, and from there along z ~ sqrt(s^2 + sigma^2)."""
    generator = torch.Generator().manual_seed(0)
    latents, noise = (torch.randn(2, 4, 8, 8, generator=generator) for _ in range(2))
    scheduler = make_scheduler(OWN, solver)
    timesteps = prepare_steps(scheduler, 60, CPU)
    left, steps, _ = start_from(scheduler, timesteps, 60, SPREAD * latents, noise, 0.5)
    assert steps == 30 and len(left) == pytest.approx(len(timesteps) / 2, abs=1)
    found, _ = run(scheduler=scheduler, steps=60, noise=noise, init=SPREAD * latents, init_strength=0.5)
    sigma = float(np.exp(np.interp(float(left[0]), np.arange(len(SIGMAS)), np.log(SIGMAS))))
    exact = (SPREAD * latents + sigma * noise) * SPREAD / math.sqrt(SPREAD**2 + sigma**2)
    assert ((found - exact).norm() / exact.norm()).item() < 0.06


@pytest.mark.parametrize(("strength", "steps"), [(1.0, 10), (0.5, 5), (0.26, 3), (0.0, 1)])
def test_strength_is_the_share_of_steps_that_is_made(strength, steps):
    scheduler = make_scheduler(OWN, "ddim")
    timesteps = prepare_steps(scheduler, 10, CPU)
    latents = torch.zeros(1, 1, 2, 2)
    assert start_from(scheduler, timesteps, 10, latents, latents, strength)[1] == steps
