"""What rendering a scene took, and what its request left out."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass
class RenderReport:
    """What a call of `World.render` did.

    Attributes:
        contacts: Contacts that were rendered.
        seconds: Wall-clock time of each part, in the order in which they ran.
        left_out: Parts that the request did not need and that were not computed.
    """

    contacts: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Adds the time spent inside to a part."""
        started = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - started

    def __str__(self) -> str:
        parts = ", ".join(f"{name} {1e3 * seconds:.0f} ms" for name, seconds in self.seconds.items())
        left_out = ", ".join(self.left_out) or "nothing"
        return f"{self.contacts} contacts in {sum(self.seconds.values()):.2f} s ({parts}); left out: {left_out}"
