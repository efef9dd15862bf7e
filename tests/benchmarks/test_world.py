"""The error of what the world renders, and what its requests cost."""

from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_iter

from tests.benchmarks.world import REQUESTS, physics_figures
from unitouch_gen.world import World


def test_finer_touches_are_nearer_to_the_finest() -> None:
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
