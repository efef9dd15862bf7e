"""The closed form of Gaussian flows, against scipy on dense covariances, and against what such flows conserve."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.numerics.exact import GaussianMixture
from unitouch_gen.numerics.gaussian_flow import gaussian_flow, has_flow
from unitouch_gen.numerics.problems import random_rotation

AXES = random_rotation(3)


def draw(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def gaussian(variances: list[float], seed: int = 0, axes: torch.Tensor | None = AXES) -> GaussianMixture:
    return GaussianMixture(draw(1, len(variances), seed=seed), torch.tensor([variances]), rotation=axes)


def solved(data: GaussianMixture, other: GaussianMixture, scale: float, x: torch.Tensor, high: float, low: float):
    """scipy's answer, with E[x_0 | x] = m + C (C + sigma^2 I)^-1 (x - m) by linear algebra."""

    def denoise(gaussian: GaussianMixture, x: np.ndarray, sigma: float) -> np.ndarray:
        mean = gaussian.means[0].numpy()
        covariance = (gaussian.rotation * gaussian.variances[0] @ gaussian.rotation.T).numpy()
        return mean + covariance @ np.linalg.solve(covariance + sigma**2 * np.eye(3), x - mean)

    def slope(u: float, x: np.ndarray) -> np.ndarray:
        conditional, unconditional = (denoise(one, x, math.exp(u)) for one in (data, other))
        return x - unconditional - scale * (conditional - unconditional)

    options = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-12}
    rows = [solve_ivp(slope, (math.log(high), math.log(low)), row.numpy(), **options).y[:, -1] for row in x]
    return torch.from_numpy(np.stack(rows))


@pytest.mark.parametrize("scale", [1.0, 2.5, 7.5])
def test_as_scipy_solves_it(scale):
    """Narrower along one axis, wider along another, the same along the third; the means apart."""
    data, other = gaussian([0.1, 1.5, 0.4]), gaussian([0.9, 0.5, 0.4], seed=1)
    x = draw(2, 3, seed=2) * 14
    got = gaussian_flow(data, x, 14.0, 0.05, unconditional=other, guidance_scale=scale)
    torch.testing.assert_close(got, solved(data, other, scale, x, 14.0, 0.05), rtol=1e-9, atol=1e-9)


def test_distance_in_deviations_is_conserved():
    """Without guidance the flow takes N(m, C + sigma^2 I) to N(m, C), so (x - m) / deviation stays along every axis."""
    data, x = gaussian([1e-12, 0.3, 100.0]), draw(4, 3, seed=1) * 20
    end = gaussian_flow(data, x, 20.0)
    before = data.to_axes(x - data.means) / (data.variances + 400.0).sqrt()
    after = data.to_axes(end - data.means) / data.variances.sqrt()
    torch.testing.assert_close(after[:, 1:], before[:, 1:], rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(after[:, 0], before[:, 0], rtol=0, atol=1e-9)  # 1e-6 beside means of 1: digits are lost


@pytest.mark.parametrize("scale", [1.0, 7.5, 30.0])
def test_two_parts_of_the_way_are_the_whole(scale):
    data, other, x = gaussian([0.01, 1.0, 0.3]), gaussian([0.5, 0.2, 0.3], seed=1), draw(2, 3, seed=2) * 20
    guidance = {"unconditional": other, "guidance_scale": scale}
    middle = gaussian_flow(data, x, 20.0, 0.7, **guidance)
    whole = gaussian_flow(data, x, 20.0, **guidance)
    torch.testing.assert_close(gaussian_flow(data, middle, 0.7, **guidance), whole, rtol=1e-11, atol=1e-11)


def test_the_slope_is_that_of_the_ode():
    """dx/dsigma = (x - D) / sigma at sigma = 0.5, by central differences."""
    data, other, x = gaussian([0.01, 1.0, 0.3]), gaussian([0.5, 0.2, 0.3], seed=1), draw(2, 3, seed=2)
    guidance = {"unconditional": other, "guidance_scale": 3.0}
    start = gaussian_flow(data, x, 0.6, 0.5, **guidance)
    ahead, behind = (gaussian_flow(data, x, 0.6, 0.5 + step, **guidance) for step in (1e-5, -1e-5))
    denoised = 3 * data.denoise(start, 0.5) - 2 * other.denoise(start, 0.5)
    torch.testing.assert_close((ahead - behind) / 2e-5, (start - denoised) / 0.5, rtol=1e-6, atol=1e-6)


def test_no_way_to_go():
    data, other, x = gaussian([0.01, 1.0, 0.3]), gaussian([0.5, 0.2, 0.3], seed=1), draw(2, 3, seed=2)
    got = gaussian_flow(data, x, 0.5, 0.5, unconditional=other, guidance_scale=3.0)
    torch.testing.assert_close(got, x, rtol=1e-14, atol=1e-14)


def test_guidance_of_one_is_none():
    data, x = gaussian([0.01, 1.0, 0.3]), draw(2, 3, seed=2)
    guided = gaussian_flow(data, x, 5.0, unconditional=gaussian([0.5, 0.2, 0.3], seed=1), guidance_scale=1.0)
    assert torch.equal(guided, gaussian_flow(data, x, 5.0))


@pytest.mark.parametrize("scale", [1.0, 30.0, 300.0])
def test_extremes_are_finite(scale):
    data, other = gaussian([1e-12, 1e-3, 1.0]), gaussian([1e-12, 2e-3, 1.0], seed=1)
    x = draw(2, 3, seed=2) * 1e6
    assert torch.isfinite(gaussian_flow(data, x, 1e6, unconditional=other, guidance_scale=scale)).all()


def test_shape_of_latents_is_kept():
    x = draw(2, 3, 1, 1)
    assert gaussian_flow(gaussian([0.1, 1.0, 2.0]), x, 5.0).shape == x.shape


# What is refused ------------------------------------------------------------------------------------------------------

MIXTURE = GaussianMixture(draw(2, 3), torch.ones(2, 3))


@pytest.mark.parametrize(
    ("data", "other"),
    [
        (MIXTURE, None),
        (gaussian([1.0, 1.0, 2.0], axes=None), MIXTURE),
        (gaussian([1.0, 1.0, 2.0]), gaussian([1.0, 1.0, 2.0], axes=None)),
        (gaussian([1.0, 1.0, 2.0]), gaussian([1.0, 1.0, 2.0], axes=random_rotation(3, seed=1))),
    ],
)
def test_no_closed_form(data, other):
    assert not has_flow(data, other)
    with pytest.raises(InvalidInputError, match="no closed form; solve it with `solve_reference`"):
        gaussian_flow(data, draw(1, 3), 1.0, unconditional=other, guidance_scale=2.0)


@pytest.mark.parametrize(("name", "levels"), [("sigma_from", (1.0, 2.0)), ("sigma_to", (1.0, -1.0))])
def test_levels_out_of_range(name, levels):
    with pytest.raises(InvalidInputError, match=f"`{name}`"):
        gaussian_flow(gaussian([1.0, 1.0, 2.0]), draw(1, 3), *levels)
