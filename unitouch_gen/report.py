"""What a run did, and how it ended: return codes in the manner of SciML and diffrax, and the run report."""

import math
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
    MAX_EVALUATIONS = "max_evaluations"
    STEP_TOO_SMALL = "step_too_small"
    DIVERGED = "diverged"
    INTERRUPTED = "interrupted"

    @property
    def finite(self) -> bool:
        """Whether there is a sample to return, finished or not."""
        return self is not ReturnCode.NON_FINITE

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
    ReturnCode.MAX_EVALUATIONS: (
        "The tolerance was not reached within `max_evaluations`; the sample is finite, but unfinished. Allow more "
        "evaluations, or a larger `tolerance`."
    ),
    ReturnCode.STEP_TOO_SMALL: (
        "No step was small enough for the tolerance; the sample is finite, but unfinished. Allow a larger `tolerance`, "
        "lower `guidance_scale`, or run the network in float32."
    ),
    ReturnCode.DIVERGED: (
        "The latents grew far beyond those of any picture, where the network was never trained; the sample is finite, "
        "but not to be trusted. Lower `guidance_scale`, keep it to a `guidance_interval`, or take more steps."
    ),
    ReturnCode.INTERRUPTED: (
        "The call was interrupted; the sample is finite, but unfinished, with noise left in it. Call again without the "
        "interrupt to finish it."
    ),
}


@dataclass
class RunReport:
    """What a pipeline call did.

    Attributes:
        solver: Name of the solver, or class of the pipeline's own scheduler.
        steps: Solver steps asked for, or accepted to a tolerance.
        rejected: Steps that were tried and refused, to a tolerance.
        evaluations: Calls of the denoising network that were made; with guidance one call holds both branches.
        guided: How many of them held both branches of guidance.
        guidance_scale: At the start; a callback may change it.
        seconds: Wall-clock time of each stage.
        codes: One return code for each sample.
        failed_at: Step at which a sample broke or became diverged, from 0, by its index; the number of steps if it
            broke in decoding.
        sensors: Sensor whose tokens each touch got; `None` where none were used.
        sensor_distances: L1 distance to that sensor's prototype, in units of full scale.
        chosen: Index of the sample that each picture is of, where it was chosen among candidates.
        scores: Of those: cosine of their embedding to the condition.
        left_out: What the request did not need and was not run.
        saved: Bytes of weights that were not in memory, by the part in `left_out` which they are of.
        peak_memory: Bytes that the call took at most above what was held when it began: on a GPU of what torch has
            allocated, on a CPU of the process's resident size; `None` where the system does not say.
        tolerance: Relative RMS error of the latents that was asked for.
        error_indicator: Of each sample, for solvers of the probability-flow ODE: see `schedulers.estimate`.
        error_estimate: Relative RMS error of each sample's latents that the indicator stands for.
        calibrated: Whether the checkpoint says what its indicators stand for; otherwise the estimate is a rough guess.
    """

    solver: str = ""
    steps: int = 0
    rejected: int = 0
    evaluations: int = 0
    guided: int = 0
    guidance_scale: float = 1.0
    seconds: dict[str, float] = field(default_factory=dict)
    codes: list[ReturnCode] = field(default_factory=list)
    failed_at: dict[int, int] = field(default_factory=dict)
    sensors: list[str | None] = field(default_factory=list)
    sensor_distances: list[float | None] = field(default_factory=list)
    chosen: list[int] = field(default_factory=list)
    scores: list[float] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    saved: dict[str, int] = field(default_factory=dict)
    peak_memory: int | None = None
    tolerance: float | None = None
    error_indicator: list[float] = field(default_factory=list)
    error_estimate: list[float] = field(default_factory=list)
    calibrated: bool = False

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
        """One report of several calls with the same arguments: their samples in a row, evaluations and seconds summed,
        the largest peak of memory.

        Args:
            reports: At least one.
        """
        first = reports[0]
        whole = cls(
            first.solver,
            max(report.steps for report in reports),
            guidance_scale=first.guidance_scale,
            left_out=list(dict.fromkeys(item for report in reports for item in report.left_out)),
            peak_memory=max((report.peak_memory for report in reports if report.peak_memory is not None), default=None),
            tolerance=first.tolerance,
            calibrated=first.calibrated,
        )
        for report in reports:
            whole.evaluations += report.evaluations
            whole.rejected += report.rejected
            whole.guided += report.guided
            for stage, seconds in report.seconds.items():
                whole.seconds[stage] = whole.seconds.get(stage, 0.0) + seconds
            whole.saved |= report.saved
            whole.failed_at |= {len(whole.codes) + sample: step for sample, step in report.failed_at.items()}
            whole.chosen += [len(whole.codes) + sample for sample in report.chosen]
            whole.codes += report.codes
            whole.scores += report.scores
            whole.error_indicator += report.error_indicator
            whole.error_estimate += report.error_estimate
            whole.sensors += report.sensors
            whole.sensor_distances += report.sensor_distances
        return whole

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        values = asdict(self)
        values["codes"] = [code.value for code in self.codes]
        for name in ("error_indicator", "error_estimate"):  # of samples that broke: JSON has no NaN
            values[name] = [number if math.isfinite(number) else None for number in values[name]]
        return values

    def __str__(self) -> str:
        total = sum(self.seconds.values())
        stages = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in self.seconds.items())
        ended = "all finite" if self.success else ", ".join(code.value for code in self.codes)
        known = [error for error in self.error_estimate if math.isfinite(error)]
        if known:
            kind = "" if self.calibrated else ", uncalibrated"
            ended = f"{ended}; error about {max(known):.1e}{kind}"
        refused = f" ({self.rejected} rejected)" if self.rejected else ""
        steps = f"{self.steps} steps{refused}, {self.evaluations} evaluations"
        memory = "" if self.peak_memory is None else f", {self.peak_memory / 1e6:.0f} MB more at most"
        if self.saved:
            memory += f", {sum(self.saved.values()) / 1e6:.0f} MB of weights not read"
        return f"{self.solver}: {steps}, {total:.2f} s ({stages}){memory}; {ended}"
