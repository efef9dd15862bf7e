"""Inputs that are tried one after the other: each ends in a clear refusal, in what is documented, or in a result."""

import resource
import shutil
import signal
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from unitouch_gen.errors import InvalidInputError, InvalidTypeError, NonFiniteError, NotConvergedError

SECONDS = 30.0
"""An input may take."""

MEMORY = 8 * 2**30
"""Bytes of address space that inputs may add to those of the process."""

LONGEST = 2000
"""Characters of a message."""


class TooLongError(BaseException):
    """An input took more than `SECONDS`; nobody catches it on the way."""


class Attempts:
    """Tries inputs, and notes what came of each.

    Args:
        here: Empty folder to be in; what is refused leaves nothing in it.
        temporary: Empty folder of temporary files, in which nothing is left.

    Attributes:
        counts: Inputs that were refused before they began, ended on their way by an error that is documented, or used.
        wrong: What else came, in words.
    """

    def __init__(self, here: Path, temporary: Path):
        self.here, self.temporary = here, temporary
        self.wrong, self.counts = list[str](), dict.fromkeys(("refused", "ended", "used"), 0)

    def __call__(self, name: str, call: Callable[[], Any], *, refused: bool = False, used: bool = False) -> Any:
        """Tries an input.

        Args:
            name: Of the input.
            call: Uses it. What it makes of it has to be finite; what it writes is removed.
            refused, used: Whether it has to be; it may be either where both are left out.

        Returns:
            What it made of it, if it was used.
        """
        result, outcome, said = None, "used", ""
        signal.setitimer(signal.ITIMER_REAL, SECONDS)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                result = call()
        except (InvalidInputError, InvalidTypeError) as error:
            outcome, said = "refused", str(error)
            if "`" not in said or "\n" in said or len(said) > LONGEST:
                self.wrong.append(f"{name}: refused without a name, or in no line of readable length: {said[:300]}")
        except (NonFiniteError, NotConvergedError) as error:
            outcome, said = "ended", str(error)
        except (Exception, TooLongError) as error:  # whatever it is, the others are to be tried, too
            self.wrong.append(f"{name}: {type(error).__name__}: {str(error)[:200]}")
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        self.counts[outcome] += 1
        if (refused and outcome == "used") or (used and outcome != "used"):
            self.wrong.append(f"{name}: {outcome} {said[:200]}")
        if not all_finite(result):
            self.wrong.append(f"{name}: became values that are not finite")
        written, left = self._clear(self.here), self._clear(self.temporary)
        if left or (written and outcome != "used"):
            self.wrong.append(f"{name}: {outcome}, and left {written + left}")
        return result

    @staticmethod
    def _clear(place: Path) -> list[str]:
        """Empties a folder; what was in it."""
        found = list(place.iterdir())
        for path in found:
            shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
        return [path.name for path in found]


def all_finite(result: Any) -> bool:
    """Whether numbers in what was made are finite; true where there are none."""
    values = getattr(result, "images", result)
    values = values[0] if isinstance(values, tuple | list) and len(values) else values
    if isinstance(values, torch.Tensor) and values.is_floating_point() and values.layout == torch.strided:
        return bool(values.isfinite().all())
    return not (isinstance(values, np.ndarray) and values.dtype.kind == "f" and not np.isfinite(values).all())


@contextmanager
def bounds() -> Iterator[None]:
    """A block in which `Attempts` may count the seconds of an input, and inputs may take `MEMORY`."""

    def ring(*_: object) -> None:
        raise TooLongError

    before, threads = signal.signal(signal.SIGALRM, ring), torch.get_num_threads()
    limits = resource.getrlimit(resource.RLIMIT_AS)
    held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (held + MEMORY, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)
        signal.signal(signal.SIGALRM, before)
        torch.set_num_threads(threads)  # commands may choose a number for the process that they run in


def drawn(examples: int, **strategies: st.SearchStrategy) -> Callable[[Callable[..., None]], None]:
    """Calls the function below with a number of examples, the same each time."""
    rules = settings(
        max_examples=examples, derandomize=True, deadline=None, database=None, phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    return lambda function: rules(given(**strategies)(function))()
