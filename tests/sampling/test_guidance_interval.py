"""Guidance in an interval, on a mixture whose guided flow scipy integrates piece by piece to 1e-10."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from unitouch_gen.numerics.problems import make_problem
from unitouch_gen.numerics.reference import relative_rms
from unitouch_gen.sampling import Guidance, ReturnCode, RunReport, prepare_steps, sample, sample_to_tolerance
from unitouch_gen.schedulers.adaptive import BESIDE, discontinuity_levels
from unitouch_gen.schedulers.solvers import make_scheduler

# numpy 2 on diffusers' DEIS.
pytestmark = pytest.mark.filterwarnings("ignore:__array_wrap__ must accept context:DeprecationWarning")

CPU = torch.device("cpu")
PROBLEM = make_problem("mixture-7.5")
SCALE = PROBLEM.guidance_scale
INTERVALS = [(200.0, 800.0), (350.0, 999.0), (0.0, 500.5)]
COUNT = 3


@pytest.fixture(scope="module", params=INTERVALS, ids=str)
def interval(request):
    return request.param


@pytest.fixture(scope="module")
def truth(interval):
    """x at sigma = 0, each piece solved on its own by DOP853."""
    schedule, data, other = PROBLEM.schedule, PROBLEM.data, PROBLEM.unconditional
    noise = PROBLEM.noise(COUNT)

    def slope(guided):
        def of(u, y):
            x, sigma = torch.from_numpy(y).view(noise.shape), math.exp(u)
            conditional = data.denoise(x, sigma)
            if guided:
                unconditional = other.denoise(x, sigma)
                conditional = unconditional + SCALE * (conditional - unconditional)
            return (x - conditional).reshape(-1).numpy()

        return of

    smallest = math.log(1e-4 * data.smallest_deviation)
    edges = {math.log(schedule.sigma(edge).item()) for edge in interval if 0.0 < edge < 999.0}
    ends = [math.log(schedule.sigma_max), *sorted(edges, reverse=True), smallest]
    low = schedule.sigma(interval[0]).item() if interval[0] > 0.0 else 0.0
    high = schedule.sigma(interval[1]).item()
    y = (noise * math.hypot(1.0, schedule.sigma_max)).reshape(-1).numpy()
    for begin, end in pairwise(ends):
        guided = low < math.exp((begin + end) / 2) < high
        y = solve_ivp(slope(guided), (begin, end), y, "DOP853", rtol=1e-10, atol=1e-12).y[:, -1]
    return torch.from_numpy(np.array(y)).view(noise.shape)


def denoise(state, timestep):
    """The exact network; of a doubled batch the first half is unconditional."""
    network = PROBLEM.network()
    network.guided = len(state) == 2 * COUNT
    return network(state, timestep)


def adaptive(interval, tolerance, told=True, denoise=denoise, scale=SCALE, discontinuities=None, **options):
    report = RunReport()
    known = (interval if told else ()) if discontinuities is None else discontinuities
    arguments = (PROBLEM.noise(COUNT), PROBLEM.schedule, PROBLEM.prediction_type, tolerance, report)
    guidance = Guidance(scale, interval)
    return sample_to_tolerance(denoise, *arguments, guidance=guidance, discontinuities=known, **options), report


def fixed(interval, solver, steps):
    scheduler = make_scheduler(PROBLEM.scheduler(), solver)
    prepare_steps(scheduler, steps, CPU)
    report = RunReport()
    return sample(denoise, PROBLEM.noise(COUNT), scheduler, report, guidance=Guidance(SCALE, interval)), report


# Steps to a tolerance -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tolerance", [0.1, 1e-2, 1e-3])
def test_the_result_is_within_tolerance(interval, truth, tolerance):
    latents, report = adaptive(interval, tolerance)
    assert relative_rms(latents, truth).max() < tolerance
    assert report.codes == [ReturnCode.SUCCESS] * COUNT


def test_steps_that_know_of_the_edges_are_fewer_and_none_is_refused():
    """Where guidance starts and ends while noise is large, and D jumps by more than the data's size."""
    (_, told), (_, untold) = (adaptive(INTERVALS[0], 0.1, told=told) for told in (True, False))
    assert told.evaluations < 0.75 * untold.evaluations
    assert told.rejected <= 1 < untold.rejected


def test_a_step_ends_at_every_edge_on_either_side(interval):
    """One evaluation at each side, guided on the one and not on the other."""
    asked = []

    def noting(state, timestep):
        asked.append((float(timestep), len(state) == 2 * COUNT))
        return denoise(state, timestep)

    adaptive(interval, 0.1, denoise=noting)
    for edge in (edge for edge in interval if 0.0 < edge < 999.0):
        near = [(timestep > edge, guided) for timestep, guided in asked if abs(timestep - edge) < 3e-3]
        assert near == [(True, edge == interval[0]), (False, edge == interval[1])]


def test_an_edge_costs_an_evaluation_and_is_no_step(interval):
    _, report = adaptive(interval, 1e-2)
    edges = sum(0.0 < edge < 999.0 for edge in interval)
    assert report.evaluations == 1 + report.steps + report.rejected + edges


def test_running_out_of_evaluations_at_an_edge_returns_the_prediction_before_it():
    latents, report = adaptive(None, 0.1, scale=1.0, discontinuities=(998.0,), max_evaluations=2, throw=False)
    assert report.codes == [ReturnCode.MAX_EVALUATIONS] * COUNT
    assert torch.isfinite(latents).all()


@pytest.mark.parametrize(("jumps", "count"), [((0.0, 999.0), 0), ((200.0, 800.0), 2), ((500.0, 500.0001), 1)])
def test_edges_are_inside_the_schedule_and_apart(jumps, count):
    pairs = discontinuity_levels(PROBLEM.schedule, jumps)
    assert len(pairs) == count
    assert all(before < behind for before, behind in pairs)


def test_edges_that_lie_behind_the_start_are_ignored():
    """Each costs an evaluation that is no step, as the first does."""
    start = {"init": torch.zeros_like(PROBLEM.noise(COUNT)), "init_strength": 0.5}
    _, report = adaptive(None, 0.1, scale=1.0, discontinuities=(200.0, 998.0), **start)
    assert report.evaluations - report.steps - report.rejected == 2


def test_the_sides_of_an_edge_are_apart_in_float32():
    for pair in discontinuity_levels(PROBLEM.schedule, (0.5, 998.5)):
        timesteps = [PROBLEM.schedule.timestep(math.exp(-level)).float() for level in pair]
        assert (timesteps[0] - timesteps[1]).item() == pytest.approx(2 * BESIDE * 1000, rel=0.1)


# Fixed steps ----------------------------------------------------------------------------------------------------------


def test_fixed_steps_converge_all_the_same(truth, interval):
    errors = [relative_rms(fixed(interval, "dpm++2m", steps)[0], truth).max() for steps in (25, 50, 100)]
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 1e-3
