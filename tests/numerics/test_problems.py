"""The registry of problems, and its networks in the sampling loop and in a pipeline."""

import pytest
import torch

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.numerics.exact import GaussianMixture
from unitouch_gen.numerics.problems import PROBLEMS, Problem, all_problems, make_problem
from unitouch_gen.numerics.reference import relative_rms, solve_reference
from unitouch_gen.pipelines.tiny import tiny
from unitouch_gen.sampling import RunReport, prepare_steps, sample
from unitouch_gen.schedulers.solvers import make_scheduler

# numpy 2 on diffusers' DEIS.
pytestmark = pytest.mark.filterwarnings("ignore:__array_wrap__ must accept context:DeprecationWarning")

NAMES = list(PROBLEMS)
GAUSSIAN = GaussianMixture(torch.zeros(1, 4), torch.ones(1, 4))


def by_loop(problem: Problem, noise: torch.Tensor, solver: str, steps: int) -> torch.Tensor:
    """Latents of the loop that every pipeline runs."""
    scheduler = make_scheduler(problem.scheduler(), solver)
    prepare_steps(scheduler, steps, torch.device("cpu"))
    return sample(problem.network(), noise, scheduler, RunReport(), guidance=problem.guidance)


# The registry ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_problems_are_as_they_say(name):
    problem = make_problem(name)
    assert problem.name == name and problem.description and "\n" not in problem.description
    assert problem.noise(2).shape == (2, *problem.shape)
    assert problem.guidance.active == problem.network().guided


@pytest.mark.parametrize("name", NAMES)
def test_problems_are_the_same_whenever_they_are_made(name):
    again = PROBLEMS[name](name)
    assert again is not make_problem(name)
    assert again.flow.identity == make_problem(name).flow.identity


def test_problems_differ():
    """In data and guidance, or in the schedule."""
    identities = [(problem.flow.identity, tuple(problem.schedule.log_sigmas.tolist())) for problem in all_problems()]
    assert len(set(identities)) == len(NAMES)


def test_plain_and_stiff():
    plain, stiff = all_problems(stiff=False), all_problems(stiff=True)
    assert len(plain) >= 6 and len(stiff) >= 6 and len(plain) + len(stiff) == len(all_problems()) == len(NAMES)


def test_unknown_name():
    with pytest.raises(InvalidInputError, match="Did you mean 'gaussian'"):
        make_problem("gausian")


@pytest.mark.parametrize(
    ("message", "options"),
    [
        ("`shape` is", {"shape": (1, 2, 3)}),
        ("without `unconditional`", {"guidance_scale": 3.0}),
        ("`guidance_scale` is nan", {"guidance_scale": float("nan")}),
        ("`prediction_type` is 'noise'", {"prediction_type": "noise"}),
    ],
)
def test_no_problem(message, options):
    with pytest.raises(InvalidInputError, match=message):
        Problem(**{"name": "", "description": "", "shape": (4, 1, 1), "data": GAUSSIAN} | options)


# Noise and answers ----------------------------------------------------------------------------------------------------


def test_noise_is_the_same_in_any_batch():
    problem = make_problem("mixture")
    assert torch.equal(problem.noise(5)[:2], problem.noise(2))
    assert not torch.equal(problem.noise(2), problem.noise(2, seed=1))


def test_solvers_in_float32_start_from_the_same_noise():
    noise = make_problem("mixture").noise(3)
    assert noise.dtype == torch.float64 and torch.equal(noise.float().double(), noise)


@pytest.mark.parametrize("name", ["gaussian", "gaussian-guided-30", "pure-noise"])
def test_the_flow_starts_at_the_noise(name):
    problem = make_problem(name)
    noise, largest = problem.noise(2), problem.schedule.sigma_max
    torch.testing.assert_close(problem.solution(noise, largest), noise * (1 + largest**2) ** 0.5)


def test_mixtures_have_no_closed_form():
    problem = make_problem("mixture-7.5")
    assert not problem.has_solution
    with pytest.raises(InvalidInputError, match="solve_reference"):
        problem.solution(problem.noise(1))


# In the sampling loop -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "solver"),
    [
        ("gaussian", "dpm++2m"),
        ("gaussian-guided", "dpm++2m"),
        ("gaussian-cosine", "deis"),
        ("gaussian-50-levels", "deis"),
        ("conditioning-1e4", "dpm++2m"),
    ],
)
def test_the_loop_comes_to_the_closed_form(name, solver):
    problem = make_problem(name)
    noise = problem.noise(2)
    error = relative_rms(by_loop(problem, noise, solver, 80), problem.solution(noise))
    assert (error < 0.02).all()


@pytest.mark.parametrize("name", ["mixture", "mixture-3", "mixture-7.5"])
def test_the_loop_comes_to_the_reference(name):
    problem = make_problem(name)
    noise = problem.noise(4)
    reference = solve_reference(problem.flow, noise, rtol=1e-6, end="zero")
    coarse, fine = (relative_rms(by_loop(problem, noise, "dpm++2m", n), reference.latents).max() for n in (10, 40))
    assert fine < 0.02 and fine < coarse / 2


def test_in_place_of_a_pipelines_unet():
    """The data of both branches is Gaussian: the picture's latents are those of the closed form."""
    pipe = tiny("x-to-touch")
    pipe.set_progress_bar_config(disable=True)
    unet = pipe.unet.config
    shape = (unet.in_channels, unet.sample_size, unet.sample_size)
    size = torch.Size(shape).numel()
    variances = torch.logspace(0, -1, size, dtype=torch.float64)[None]
    problem = Problem(
        "pipeline",
        "Latents of a pipeline",
        shape,
        GaussianMixture(torch.full((1, size), 0.3), variances),
        GaussianMixture(torch.zeros(1, size), variances * 2),
        guidance_scale=3.0,
        prediction_type=pipe.scheduler.config.prediction_type,
    )
    network = problem.network()
    network.config = unet
    pipe.unet = network
    noise = problem.noise(1)
    output = pipe(text="rough brick", latents=noise, guidance_scale=3.0, num_inference_steps=40, output_type="latent")
    assert relative_rms(output.images, problem.solution(noise)).item() < 0.02
