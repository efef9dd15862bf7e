"""What a run did, and how it ended: return codes in the manner of SciML and diffrax, and the run report."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import Any


class ReturnCode(StrEnum):
    """How one sample ended."""

    SUCCESS = "success"
    NON_FINITE = "non_finite"

    @property
    def message(self) -> str:
        """What it means and what to try next."""
        return MESSAGES[self]


MESSAGES: dict[ReturnCode, str] = {
    ReturnCode.SUCCESS: "The sample is finite.",
    ReturnCode.NON_FINITE: (
        "The latents left the range of floating-point numbers. Lower `guidance_scale` or `strength`, raise "
        "`num_inference_steps`, or run the network in float32."
    ),
}


@dataclass
class RunReport:
    """What a pipeline call did.

    Attributes:
        solver: Name of the solver, or class of the pipeline's own scheduler.
        steps: Solver steps asked for.
        evaluations: Calls of the denoising network that were made; with guidance one call holds both branches.
        guidance_scale: At the start; a callback may change it.
        seconds: Wall-clock time of each stage.
        codes: One return code for each sample.
        failed_at: Step at which a sample broke, from 0, by its index; the number of steps if it broke in decoding.
        sensors: Sensor whose tokens each touch got; `None` where none were used.
        sensor_distances: L1 distance to that sensor's prototype, in units of full scale.
        scores: Of candidates that were chosen by re-ranking: cosine of their embedding to the condition.
        left_out: What the request did not need and was not run.
    """

    solver: str = ""
    steps: int = 0
    evaluations: int = 0
    guidance_scale: float = 1.0
    seconds: dict[str, float] = field(default_factory=dict)
    codes: list[ReturnCode] = field(default_factory=list)
    failed_at: dict[int, int] = field(default_factory=dict)
    sensors: list[str | None] = field(default_factory=list)
    sensor_distances: list[float | None] = field(default_factory=list)
    scores: list[float] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)

    @property
    def success(self) -> bool:
        """Whether every sample ended well."""
        return all(code is ReturnCode.SUCCESS for code in self.codes)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Adds the time spent inside to a stage."""
        started = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - started

    @classmethod
    def joined(cls, reports: Sequence["RunReport"]) -> "RunReport":
        """One report of several calls with the same arguments: their samples in a row, evaluations and seconds summed.

        Args:
            reports: At least one.
        """
        first = reports[0]
        whole = cls(first.solver, first.steps, guidance_scale=first.guidance_scale, left_out=list(first.left_out))
        for report in reports:
            whole.evaluations += report.evaluations
            for stage, seconds in report.seconds.items():
                whole.seconds[stage] = whole.seconds.get(stage, 0.0) + seconds
            whole.failed_at |= {len(whole.codes) + sample: step for sample, step in report.failed_at.items()}
            whole.codes += report.codes
            whole.sensors += report.sensors
            whole.sensor_distances += report.sensor_distances
        return whole

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        values = asdict(self)
        values["codes"] = [code.value for code in self.codes]
        return values

    def __str__(self) -> str:
        total = sum(self.seconds.values())
        stages = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in self.seconds.items())
        ended = "all finite" if self.success else ", ".join(code.value for code in self.codes)
        return f"{self.solver}: {self.steps} steps, {self.evaluations} evaluations, {total:.2f} s ({stages}); {ended}"
