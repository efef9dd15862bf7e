"""References by DOP853, against closed forms, and their own error against the true one."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from diffusers import DDIMScheduler, UNet2DConditionModel

from unitouch_gen.errors import InvalidInputError, NonFiniteError, NotConvergedError
from unitouch_gen.numerics.problems import Problem, all_problems, make_problem
from unitouch_gen.numerics.reference import Flow, Reference, relative_rms, solve_reference
from unitouch_gen.numerics.targets import network_flow
from unitouch_gen.sampling import Guidance
from unitouch_gen.schedulers.schedule import PREDICTION_TYPES

SOLVED = [problem for problem in all_problems() if problem.has_solution]
UNSOLVED = [problem for problem in all_problems() if not problem.has_solution]


def true_error(problem: Problem, noise: torch.Tensor, **settings) -> tuple[float, float]:
    """(error, disagreement), of the worst sample, to sigma = 0."""
    reference = solve_reference(problem.flow, noise, end="zero", **settings)
    return relative_rms(reference.latents, problem.solution(noise)).max().item(), reference.disagreement.max().item()


# Against closed forms -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("problem", SOLVED, ids=lambda problem: problem.name)
def test_closed_form_to_zero(problem):
    error, disagreement = true_error(problem, problem.noise(2), rtol=1e-10)
    assert error < 1e-9 and disagreement < 1e-8


@pytest.mark.parametrize("problem", UNSOLVED, ids=lambda problem: problem.name)
def test_mixtures_agree(problem):
    assert solve_reference(problem.flow, problem.noise(2), rtol=1e-10, end="zero").disagreement.max() < 1e-8


def test_closed_form_to_the_final_denoise():
    problem = make_problem("gaussian-guided")
    noise, smallest = problem.noise(2), problem.schedule.sigma_min
    reference = solve_reference(problem.flow, noise, rtol=1e-10)
    expected = problem.denoise(problem.solution(noise, smallest), smallest)
    assert relative_rms(reference.latents, expected).max() < 1e-9


def test_default_tolerance_bounds_the_error():
    for name in ("gaussian", "conditioning-1e8"):
        problem = make_problem(name)
        assert true_error(problem, problem.noise(4))[0] < 1e-6


def test_result_is_float64_in_the_shape_of_the_noise():
    problem = make_problem("mixture")
    reference = solve_reference(problem.flow, problem.noise(3).float(), rtol=1e-3)
    assert reference.latents.dtype == torch.float64 and reference.latents.shape == (3, 4, 2, 2)
    assert reference.disagreement.shape == (3,)
    assert set(reference.evaluations) == set(reference.seconds) == {"coarse", "fine"}


# Its own error --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["mixture-7.5", "conditioning-1e8"])
def test_looser_tolerances_disagree_more(name):
    problem = make_problem(name)
    errors = [
        solve_reference(problem.flow, problem.noise(2), rtol=rtol).disagreement.max() for rtol in (1e-3, 1e-5, 1e-7)
    ]
    assert errors[0] > 10 * errors[1] > 100 * errors[2]


@pytest.mark.parametrize("rtol", [1e-3, 1e-5, 1e-8])
@pytest.mark.parametrize("name", ["gaussian", "gaussian-guided", "conditioning-1e4", "near-delta"])
def test_the_disagreement_is_about_the_error_or_more(name, rtol):
    problem = make_problem(name)
    error, disagreement = true_error(problem, problem.noise(2), rtol=rtol)
    assert error < 3 * disagreement


def test_ending_too_early_shows():
    """To sigma = 0 the flow has to run to far below the data's smallest deviation, here 0.1."""
    problem = make_problem("gaussian")
    noise = problem.noise(2)
    reference = solve_reference(replace(problem.flow, last_sigma=0.08), noise, rtol=1e-10, end="zero")
    error = relative_rms(reference.latents, problem.solution(noise)).max().item()
    assert 1e-6 < error < reference.disagreement.max().item()


def test_one_hard_sample_among_easy_ones_keeps_its_tolerance():
    """However many others there are: here the others rest where they are."""
    problem = make_problem("gaussian-guided")
    noise = torch.zeros(64, *problem.shape, dtype=torch.float64)
    noise[0] = problem.noise(1)[0]
    x = problem.flow.start(noise)

    def denoise(states: torch.Tensor, sigma: float) -> torch.Tensor:
        resting = states * problem.flow.scale**2 / (sigma**2 + problem.flow.scale**2)
        return torch.cat([problem.denoise(states[:1], sigma), resting[1:]])

    reference = solve_reference(replace(problem.flow, denoise=denoise), noise, end="zero")
    assert (x[1:] == 0).all()
    assert relative_rms(reference.latents[:1], problem.solution(noise[:1])).item() < 1e-6


# Networks -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["mixture-7.5", "gaussian-cosine", "gaussian-50-levels"])
def test_networks_flow_as_their_data(name):
    problem = make_problem(name)
    flow = network_flow(problem.network().double(), problem.scheduler(), problem.guidance, {})
    noise = problem.noise(2)
    expected = solve_reference(problem.flow, noise, rtol=1e-7).latents
    assert relative_rms(solve_reference(flow, noise, rtol=1e-7).latents, expected).max() < 1e-6


@pytest.mark.parametrize("prediction_type", PREDICTION_TYPES)
def test_networks_in_float32(prediction_type):
    problem = replace(make_problem("mixture-3"), prediction_type=prediction_type)
    flow = network_flow(problem.network(), problem.scheduler(), problem.guidance, {})
    noise = problem.noise(2)
    expected = solve_reference(problem.flow, noise, rtol=1e-8).latents
    reference = solve_reference(flow, noise, rtol=1e-5)
    assert relative_rms(reference.latents, expected).max() < 1e-4


def small_unet() -> UNet2DConditionModel:
    torch.manual_seed(0)
    return UNet2DConditionModel(
        sample_size=4,
        block_out_channels=(8, 8),
        layers_per_block=1,
        down_block_types=("DownBlock2D", "CrossAttnDownBlock2D"),
        up_block_types=("CrossAttnUpBlock2D", "UpBlock2D"),
        cross_attention_dim=8,
        attention_head_dim=2,
        norm_num_groups=4,
    ).eval()


def test_a_unet_with_guidance():
    unet, hidden = small_unet(), torch.randn(4, 1, 8, generator=torch.Generator().manual_seed(0))
    calls = []

    def look(module: torch.nn.Module, args: tuple) -> None:
        assert not torch.is_grad_enabled()
        calls.append((args[0].shape, args[0].dtype))

    unet.register_forward_pre_hook(look)
    # Of few levels: a network of random weights changes with every one of them.
    scheduler = DDIMScheduler(num_train_timesteps=10, beta_start=0.05, beta_end=0.5, prediction_type="v_prediction")
    flow = network_flow(unet, scheduler, Guidance(3.0), {"encoder_hidden_states": hidden})
    noise = torch.randn(2, 4, 4, 4, generator=torch.Generator().manual_seed(1))
    reference = solve_reference(flow, noise, rtol=1e-3)
    assert reference.disagreement.max() < 1e-2 and reference.latents.std() > 0
    assert set(calls) == {((4, 4, 4, 4), torch.float32)}
    assert len(calls) == sum(reference.evaluations.values())


def test_networks_know_nothing_below_their_schedule():
    problem = make_problem("mixture")
    flow = network_flow(problem.network(), problem.scheduler(), problem.guidance, {})
    with pytest.raises(InvalidInputError, match="`end` is 'zero', but this flow's denoiser"):
        solve_reference(flow, problem.noise(1), end="zero")


# What goes wrong ------------------------------------------------------------------------------------------------------


def breaking(flow: Flow, below: float) -> Flow:
    """A flow whose sample 1 turns NaN below a noise level."""

    def denoise(x: torch.Tensor, sigma: float) -> torch.Tensor:
        denoised = flow.denoise(x, sigma)
        if sigma < below:
            denoised[1] = float("nan")
        return denoised

    return replace(flow, denoise=denoise)


def test_values_that_are_not_finite_stop_it():
    problem = make_problem("mixture")
    with pytest.raises(NonFiniteError, match="sample 1 is not finite at noise level"):
        solve_reference(breaking(problem.flow, 5.0), problem.noise(2), rtol=1e-6)


def test_errors_of_the_network_come_through():
    problem = make_problem("mixture")

    def denoise(x: torch.Tensor, sigma: float) -> torch.Tensor:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        solve_reference(replace(problem.flow, denoise=denoise), problem.noise(1))


def test_too_many_evaluations():
    problem = make_problem("mixture")
    with pytest.raises(NotConvergedError, match=r"The reference is at noise level .* after 50 evaluations"):
        solve_reference(problem.flow, problem.noise(1), max_evaluations=50)


def test_discontinuous_denoisers_end_all_the_same():
    """Raises rather than stepping on without end."""
    problem = make_problem("mixture")
    generator = np.random.default_rng(0)

    def denoise(x: torch.Tensor, sigma: float) -> torch.Tensor:
        return problem.denoise(x, sigma) * generator.uniform(0.5, 1.5)

    with pytest.raises(NotConvergedError):
        solve_reference(replace(problem.flow, denoise=denoise), problem.noise(1), rtol=1e-9, max_evaluations=2000)


@pytest.mark.parametrize(
    ("name", "value"), [("rtol", 0.0), ("rtol", float("nan")), ("end", "middle"), ("max_evaluations", 0)]
)
def test_bad_settings(name, value):
    problem = make_problem("mixture")
    with pytest.raises(InvalidInputError, match=f"`{name}` is"):
        solve_reference(problem.flow, problem.noise(1), **{name: value})


def test_bad_noise():
    problem = make_problem("mixture")
    with pytest.raises(InvalidInputError, match="`noise` holds"):
        solve_reference(problem.flow, problem.noise(1) * float("nan"))


def test_progress_runs_from_start_to_end_for_both():
    problem, seen = make_problem("mixture"), {"coarse": [], "fine": []}
    solve_reference(problem.flow, problem.noise(1), rtol=1e-3, progress=lambda name, share: seen[name].append(share))
    for shares in seen.values():
        assert shares == sorted(shares) and shares[0] == 0.0 and shares[-1] == pytest.approx(1.0)


def test_parts_are_joined():
    one, other = (
        Reference(torch.full((2, 1), value), torch.zeros(2), {"fine": 3}, {"fine": value}) for value in (1.0, 2.0)
    )
    whole = Reference.joined([one, other])
    assert whole.latents.flatten().tolist() == [1, 1, 2, 2] and len(whole.disagreement) == 4
    assert (whole.evaluations, whole.seconds) == ({"fine": 6}, {"fine": 3.0})


# The measure ----------------------------------------------------------------------------------------------------------


def test_relative_rms():
    truth = torch.tensor([[3.0, 4.0], [0.6, 0.8]])
    error = relative_rms(truth + torch.tensor([[0.0, 0.5], [0.0, 0.0]]), truth)
    torch.testing.assert_close(error, torch.tensor([0.1, 0.0]).double())


def test_relative_rms_of_another_shape():
    with pytest.raises(InvalidInputError, match="pass the same shape"):
        relative_rms(torch.ones(2, 3), torch.ones(2, 4))


# The end --------------------------------------------------------------------------------------------------------------


def test_extrapolation_is_that_of_the_flow_at_two_levels():
    """D on the line in sigma^2 through the smallest level and 1.5 times it, with x there in closed form."""
    problem = make_problem("gaussian-guided")
    noise, smallest = problem.noise(2), problem.schedule.sigma_min
    low, high = (problem.denoise(problem.solution(noise, sigma), sigma) for sigma in (smallest, 1.5 * smallest))
    expected = low + (low - high) / (1.5**2 - 1)
    reference = solve_reference(problem.flow, noise, rtol=1e-10, end="extrapolate")
    assert relative_rms(reference.latents, expected).max() < 1e-8
    assert relative_rms(expected, problem.solution(noise)).max() < relative_rms(low, problem.solution(noise)).min()
