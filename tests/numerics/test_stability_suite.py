"""The table of cases: its bounds against closed forms, and pipelines that are loaded once, when first needed."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from unitouch_gen.numerics.problems import all_problems, make_problem
from unitouch_gen.numerics.stability import choose, run_case
from unitouch_gen.numerics.stability_suite import a_priori, carried, pipeline_cases, solve, suite, truth
from unitouch_gen.numerics.stability_world import apart, beyond, energy, falling
from unitouch_gen.schedulers.solvers import SOLVERS


class Refusing:
    """In the place of a pipeline: refuses every call."""

    vae_scale_factor = 4
    quiet = False

    def set_progress_bar_config(self, disable: bool) -> None:
        self.quiet = disable

    def __call__(self, **arguments: Any) -> None:
        raise ValueError("`guidance_scale` is wrong")


def unwanted(kind: str, dtype: torch.dtype) -> None:
    pytest.fail(f"{kind} was loaded")


# The table ------------------------------------------------------------------------------------------------------------


def test_names_are_unique_and_nothing_is_loaded_to_list_them():
    cases = suite(unwanted)
    names = [case.name for _, case in choose(cases)]
    assert len(names) == len(set(names))
    assert all(case.expected for group in cases.values() for case in group)


def test_every_case_asks_for_more_than_success():
    for case in (case for cases in suite(unwanted).values() for case in cases):
        assert case.because or case.raises or case.codes != "success", case.name


def test_every_solver_is_tried_on_every_stiff_problem():
    names = {case.name for case in suite(unwanted)["stiff"]}
    for problem in all_problems(stiff=True):
        able = [name for name, solver in SOLVERS.items() if problem.name != "pure-noise" or solver.zero_snr]
        assert names >= {f"{problem.name}, {name}" for name in [*able, "tolerance"]}


def test_a_table_of_one_pipeline_calls_no_other():
    names = [case.name for cases in pipeline_cases(unwanted, ["x-to-touch"]).values() for case in cases]
    assert len(names) == len(set(names)) and not [name for name in names if "touch-to-image" in name]


def test_cases_share_a_pipeline_without_bars():
    loaded = {}

    def load(kind: str, dtype: torch.dtype) -> Refusing:
        assert (kind, dtype) not in loaded
        return loaded.setdefault((kind, dtype), Refusing())

    cases = [case for case in pipeline_cases(load)["calls"] if case.name.startswith("guidance_scale=1e6")]
    assert [run_case(case).seen for case in cases] == ["raised ValueError: `guidance_scale` is wrong"] * 2
    assert [(key, pipe.quiet) for key, pipe in loaded.items()] == [(("touch-to-image", torch.float32), True)]


# Bounds ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [1.0, 7.5])
def test_what_a_difference_becomes_is_that_of_two_exact_flows(scale):
    problem = replace(make_problem("gaussian-guided"), guidance_scale=scale)
    noise, sigma = problem.noise(2), problem.schedule.sigma_max
    ends, starts = (problem.data.to_axes(x) for x in (problem.solution(noise), problem.flow.start(noise)))
    torch.testing.assert_close(ends[1] - ends[0], carried(problem, sigma) * (starts[1] - starts[0]))


@pytest.mark.parametrize(("solver", "least"), [("ddim", 0.95), ("euler", 0.95), ("dpm++2m", 0.45)])
def test_a_priori_errors_are_above_those_of_solvers_and_near_them(solver, least):
    problem = make_problem("conditioning-1e2")
    for steps in (50, 100, 200):
        error = solve(problem, solver, steps).error
        assert least * a_priori(problem, solver, steps) < error < a_priori(problem, solver, steps)


def test_an_error_is_that_of_the_worst_sample():
    problem = make_problem("conditioning-1e2")
    ended, exact = solve(problem, "ddim", 10, batch_size=8), truth(problem, 8).flatten(1)
    errors = (ended.output.double().flatten(1) - exact).norm(dim=1) / exact.norm(dim=1)
    assert ended.error == pytest.approx(errors.max().item())


@pytest.mark.parametrize("ratio", [0.0, 1e-3, 0.1])
def test_the_energy_of_a_mode_is_its_closed_form(ratio):
    w = 2000.0
    b, t = w * (1 - ratio**2) ** 0.5, torch.linspace(1e-6, 0.3, 400, dtype=torch.float64)
    decay = torch.exp(-ratio * w * t)
    place = w * decay * torch.sin(b * t) / b
    speed = decay * (torch.cos(b * t) - ratio * w / b * torch.sin(b * t))
    torch.testing.assert_close(energy(ratio), place**2 + speed**2, rtol=1e-9, atol=1e-12)


def test_what_differs_leaves_a_range_or_falls_is_seen():
    values = torch.tensor([0.0, 0.5, 0.25])
    assert apart(values, torch.zeros(3)).error == 0.5
    assert (beyond(values).error, beyond(values, 0.125, 0.25).error) == (0.0, 0.25)
    assert (falling(values).error, falling(values[:2]).error) == (0.25, 0.0)
