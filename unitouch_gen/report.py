"""What a pipeline call did: return codes, and a report of steps, evaluations and seconds."""

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


MESSAGES = {
    ReturnCode.SUCCESS: "The sample is finite.",
    ReturnCode.NON_FINITE: "The latents are not finite. Lower `guidance_scale` or `strength`, raise "
    "`num_inference_steps`, or run the network in float32.",
    ReturnCode.MAX_EVALUATIONS: "The tolerance was not reached within `max_evaluations`, and the sample is unfinished. "
    "Allow more evaluations, or a larger `tolerance`.",
    ReturnCode.STEP_TOO_SMALL: "No step was small enough for the tolerance, and the sample is unfinished. Allow a "
    "larger `tolerance`, lower `guidance_scale`, or run the network in float32.",
    ReturnCode.DIVERGED: "The latents grew far beyond those of any picture, and are not to be trusted. Lower "
    "`guidance_scale`, keep it to a `guidance_interval`, or take more steps.",
    ReturnCode.INTERRUPTED: "The call was interrupted, and noise is left in the sample. Call again to finish it.",
}


@dataclass
class RunReport:
    """What a pipeline call did."""

    solver: str = ""  #: a name in `SOLVERS`, "adaptive", or the class of the pipeline's own scheduler
    steps: int = 0  #: asked for, or accepted to a tolerance
    rejected: int = 0  #: steps that were tried and refused, to a tolerance
    evaluations: int = 0  #: calls of the denoising network; with guidance one call holds both branches
    guided: int = 0  #: how many of them held both
    guidance_scale: float = 1.0  #: at the start; a callback may change it
    seconds: dict[str, float] = field(default_factory=dict)  #: wall-clock time of each stage
    codes: list[ReturnCode] = field(default_factory=list)  #: one for each sample
    #: step at which a sample broke or diverged, from 0, by its index; the number of steps if it broke in decoding
    failed_at: dict[int, int] = field(default_factory=dict)
    sensors: list[str | None] = field(default_factory=list)  #: whose tokens each touch got
    #: L1 distance of each touch to that sensor's prototype, or the nearest one, in units of full scale
    sensor_distances: list[float | None] = field(default_factory=list)
    #: by modality, why the model abstains from naming each input, such as "unlike anything known", or `None`
    unknown: dict[str, list[str | None]] = field(default_factory=dict)
    chosen: list[int] = field(default_factory=list)  #: samples whose pictures were chosen among candidates
    scores: list[float] = field(default_factory=list)  #: of those, cosine of embedding and condition
    left_out: list[str] = field(default_factory=list)  #: what the request did not need and was not run
    tolerance: float | None = None  #: relative RMS error of the latents that was asked for

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
        """One report of several calls with the same arguments: samples in a row, evaluations and seconds summed."""
        first = reports[0]
        whole = cls(first.solver, guidance_scale=first.guidance_scale, tolerance=first.tolerance)
        for report in reports:
            before = len(whole.codes)
            whole.steps = max(whole.steps, report.steps)
            whole.failed_at |= {before + sample: step for sample, step in report.failed_at.items()}
            whole.chosen += [before + sample for sample in report.chosen]
            whole.left_out += [part for part in report.left_out if part not in whole.left_out]
            for name in ("rejected", "evaluations", "guided", "codes", "scores", "sensors", "sensor_distances"):
                setattr(whole, name, getattr(whole, name) + getattr(report, name))
            for stage, seconds in report.seconds.items():
                whole.seconds[stage] = whole.seconds.get(stage, 0.0) + seconds
            for modality, reasons in report.unknown.items():
                whole.unknown[modality] = whole.unknown.get(modality, []) + reasons
        return whole

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return {**asdict(self), "codes": [code.value for code in self.codes]}

    def __str__(self) -> str:
        stages = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in self.seconds.items())
        ended = "all finite" if self.success else ", ".join(code.value for code in self.codes)
        abstained = sum(reason is not None for reasons in self.unknown.values() for reason in reasons)
        if abstained:
            ended = f"{ended}; {abstained} {'input is' if abstained == 1 else 'inputs are'} unknown to the model"
        refused = f" ({self.rejected} rejected)" if self.rejected else ""
        steps = f"{self.steps} steps{refused}, {self.evaluations} evaluations"
        return f"{self.solver}: {steps}, {sum(self.seconds.values()):.2f} s ({stages}); {ended}"
