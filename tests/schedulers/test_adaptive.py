"""Steps to a tolerance, on problems whose solution is known."""

import math

import pytest
import torch

from unitouch_gen.errors import NonFiniteError, NotConvergedError
from unitouch_gen.numerics.problems import make_problem
from unitouch_gen.numerics.reference import relative_rms
from unitouch_gen.sampling import ReturnCode, RunReport, sample_to_tolerance


def run(name="gaussian", tolerance=1e-2, count=4, throw=True, network=None, **options):
    """(latents, report, truth) of a problem with a closed form."""
    problem = make_problem(name)
    noise = problem.noise(count)
    report = RunReport()
    arguments = (noise, problem.schedule, problem.prediction_type, tolerance, report)
    options = {"guidance": problem.guidance, "throw": throw, **options}
    return sample_to_tolerance(network or problem.network(), *arguments, **options), report, problem.solution(noise)


@pytest.mark.parametrize("name", ["gaussian", "gaussian-guided", "gaussian-cosine"])
@pytest.mark.parametrize("tolerance", [0.1, 1e-2, 1e-3])
def test_the_result_is_within_tolerance(name, tolerance):
    """Within twice of it: the constant is measured, not proved."""
    latents, report, truth = run(name, tolerance)
    assert relative_rms(latents, truth).max() < 2 * tolerance
    assert report.codes == [ReturnCode.SUCCESS] * 4


def test_a_smaller_tolerance_takes_more_evaluations_and_leaves_less_error():
    results = [run(tolerance=tolerance) for tolerance in (0.1, 1e-2, 1e-3)]
    evaluations = [report.evaluations for _, report, _ in results]
    errors = [relative_rms(latents, truth).max() for latents, _, truth in results]
    assert evaluations == sorted(evaluations) and errors == sorted(errors, reverse=True)
    assert evaluations[-1] < 60


def test_every_step_costs_one_evaluation():
    _, report, _ = run("gaussian-guided")
    assert report.evaluations == 1 + report.steps + report.rejected


def test_a_network_that_turns_sharply_gets_steps_refused():
    """What it predicts jumps by 2 at one noise level."""
    problem = make_problem("gaussian-50-levels")  # predicts data
    network = problem.network()

    def turning(state, timestep):
        return network(state, timestep) + 2.0 * (timestep < 25)

    assert run("gaussian-50-levels", 0.03, network=turning)[1].rejected > 0


def test_a_sample_is_no_worse_for_its_neighbours():
    problem, tolerance = make_problem("gaussian-guided"), 1e-2
    truth = problem.solution(problem.noise(8))
    together, _, _ = run("gaussian-guided", tolerance, count=8)
    assert (relative_rms(together, truth) < 2 * tolerance).all()


def test_running_out_of_evaluations_raises_or_returns_what_there_is():
    with pytest.raises(NotConvergedError, match=r"Stopped after 7 evaluations.*max_evaluations"):
        run(max_evaluations=7)
    latents, report, truth = run(max_evaluations=7, throw=False)
    assert report.codes == [ReturnCode.MAX_EVALUATIONS] * 4
    assert report.evaluations == 7
    assert torch.isfinite(latents).all()
    assert latents.abs().max() < 2 * truth.abs().max()  # D of the last level, not its noise


def test_a_sample_that_breaks_leaves_the_others_alone():
    network = make_problem("gaussian").network()

    def breaking(state, timestep):
        prediction = network(state, timestep)
        if timestep < 600:
            prediction[1] = math.nan
        return prediction

    with pytest.raises(NonFiniteError, match="Sample 1"):
        run(network=breaking)
    latents, report, truth = run(network=breaking, throw=False)
    assert [code.finite for code in report.codes] == [True, False, True, True]
    assert (relative_rms(latents, truth)[[0, 2, 3]] < 2e-2).all()
    assert not latents[1].any()


def test_a_network_that_is_rough_on_every_scale_is_given_up():
    generator = torch.Generator().manual_seed(0)

    def rough(state, timestep):
        return torch.randn(state.shape, generator=generator) * 10

    _, report, _ = run(network=rough, tolerance=1e-5, throw=False)
    assert report.codes == [ReturnCode.STEP_TOO_SMALL] * 4


def test_starting_at_the_smallest_level_takes_one_evaluation():
    problem = make_problem("gaussian")
    sigma = problem.schedule.sigma_min
    clean = torch.randn(2, 4, 8, 8, generator=torch.Generator().manual_seed(0))
    report = RunReport()
    arguments = (torch.zeros_like(clean), problem.schedule, problem.prediction_type, 1e-2, report)
    latents = sample_to_tolerance(problem.network(), *arguments, init=clean, init_strength=0.0)
    assert report.evaluations == 1
    assert (latents - clean).abs().max() < 10 * sigma
