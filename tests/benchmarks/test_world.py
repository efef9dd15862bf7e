"""The error of what the world renders, and what its requests cost."""

import math
from typing import Any

import numpy as np
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_iter

from tests.benchmarks.world import REQUESTS, fitted_error, physics_figures, sound_spectrum
from unitouch_gen.world import World


def test_the_error_of_a_sound_does_not_know_its_loudness() -> None:
    x, y = np.random.default_rng(0).standard_normal((2, 3, 50))
    np.testing.assert_allclose(fitted_error(7.0 * x, y), fitted_error(x, y))
    np.testing.assert_allclose(fitted_error(3.0 * y, y), 0.0, atol=1e-12)


def test_the_error_of_a_sound_is_the_sine_of_its_angle_to_the_reference() -> None:
    x, y = np.random.default_rng(1).standard_normal((2, 1, 50))
    x = x * np.sign((x * y).sum())
    cosine = (x * y).sum() / np.sqrt((x * x).sum() * (y * y).sum())
    np.testing.assert_allclose(fitted_error(x, y), math.sqrt(1 - cosine**2))


def test_spectra_of_one_wave_agree_at_all_rates() -> None:
    def spectrum(rate: int) -> np.ndarray:
        time = torch.arange(round(0.25 * rate), dtype=torch.float64) / rate
        return sound_spectrum(torch.sin(2 * math.pi * 440.0 * time)[None], rate)[:, :500]

    np.testing.assert_allclose(spectrum(8000), spectrum(32_000), atol=1e-4 * np.abs(spectrum(8000)).max())


def test_finer_touches_and_sounds_are_nearer_to_the_finest() -> None:
    for settings in physics_figures(2, 1).values():
        errors = [figures["error"] for figures in settings.values()]
        assert errors == sorted(errors, reverse=True) and errors[0] < 1.0
        assert all(figures["seconds"] > 0.0 and figures["order"] > 1.0 for figures in settings.values())


class Elements(TorchDispatchMode):
    """Counts the elements that operations write."""

    count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **kwargs or {})
        self.count += sum(part.numel() for part in tree_iter(result) if isinstance(part, torch.Tensor))
        return result


def elements_of(request: dict[str, Any]) -> int:
    index = torch.arange(8)
    with Elements() as elements:
        World().render(index, 0 * index, 0 * index, **request)
    return elements.count


def test_each_request_does_less_than_everything() -> None:
    counts = {name: elements_of(request) for name, request in REQUESTS.items()}
    everything = counts.pop("everything")
    assert max(counts.values()) < 0.9 * everything and counts["caption"] < 0.01 * everything
