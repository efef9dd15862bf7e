"""Exponential integration against quadrature and against problems with a solution."""

import math

import pytest
import torch
from scipy.integrate import quad

from unitouch_gen.schedulers.exponential import FinalExtrapolation, advance, exponential_integral, weights


@pytest.mark.parametrize("step", [0.01, 0.3, 2.0, 6.0])
@pytest.mark.parametrize("nodes", [[0.0], [0.0, -0.4], [1.0, 0.0], [0.7, 0.0, -0.5], [0.5, 0.0, -0.2, -0.9]])
def test_weights_integrate_polynomials_through_the_nodes(step, nodes):
    """As many powers as there are nodes, against adaptive quadrature."""
    found = weights(step, nodes)
    for power in range(len(nodes)):
        exact, _ = quad(lambda tau: math.exp(tau - step) * tau**power, 0.0, step)  # noqa: B023
        assert sum(w * node**power for w, node in zip(found, nodes, strict=True)) == pytest.approx(exact, abs=1e-10)


def test_a_step_with_constant_data_is_exact():
    """x goes to D as e^-h, however long the step."""
    state, data = torch.full((1, 1, 2, 2), 5.0), torch.full((1, 1, 2, 2), 2.0)
    assert torch.allclose(
        advance(state, 3.0, exponential_integral(3.0, [0.0], [data])), data + (state - data) * math.exp(-3.0)
    )


def test_the_last_jump_continues_data_that_goes_with_sigma_squared():
    final = FinalExtrapolation()
    for sigma in (0.9, 0.5, 0.2, 0.1):
        final.add(sigma, torch.full((1,), 3.0 + 4.0 * sigma**2))
    torch.testing.assert_close(final.result(), torch.full((1,), 3.0))


def test_the_last_jump_looks_back_far_enough_for_noise_not_to_grow():
    """Levels one percent apart would magnify an error of the last evaluation fifty times."""
    final = FinalExtrapolation()
    for power in range(200, -1, -1):
        final.add(0.03 * 1.01**power, torch.zeros(1))
    final.add(0.03, torch.ones(1))  # in the place of the last one
    assert 1.0 < final.result().item() < 1.0 + 1 / (FinalExtrapolation.APART**2 - 1) + 1e-6


def test_the_last_jump_from_one_level_is_the_denoiser():
    final = FinalExtrapolation()
    final.add(14.6, torch.full((1,), 7.0))
    assert final.result().item() == 7.0
