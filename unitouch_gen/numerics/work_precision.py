"""Error against run time of any target, in the manner of SciML's work-precision sets and Hairer & Wanner's diagrams.

Every configuration starts from the same noise and is measured against the same reference. A result is the median error
over seeds and conditions with its quartiles, the evaluations of the network, and seconds after a warm-up. What fails is
a result, too.
"""

import csv
import io
import json
import platform
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save

from unitouch_gen.errors import InvalidInputError, check_integer
from unitouch_gen.files import write_file
from unitouch_gen.numerics.reference import Progress, Reference
from unitouch_gen.numerics.targets import DTYPES, Configuration, Target, errors_of
from unitouch_gen.sampling import ReturnCode
from unitouch_gen.schedulers.adaptive import ADAPTIVE

COSTS = {"seconds": "seconds for one sample", "evaluations": "evaluations of the network"}
"""Attributes of a result that an error is charted against, in words."""

ABOVE_FLOOR = 10.0
"""Orders are fitted to errors that many times above what the reference, the dtype or a plateau can tell."""

ASYMPTOTIC = 0.1
"""And below this error, where steps are short enough for an order to show."""

FEWEST = 3
"""Points that an order is fitted to; two of them always lie on a line."""

MOST_REPEATS = 1000

VERSION = 3
"""Version of `results.json`; others are not read."""


@dataclass(frozen=True)
class Result(Configuration):
    """One measured configuration.

    Attributes:
        default: Whether a call without options runs this.
        samples: Seeds times conditions.
        error_low, error, error_high: Quartiles of the relative RMS error of the latents.
        evaluations, rejected: Evaluations of the network in one run; steps that were refused.
        seconds, seconds_median: Least and median time of the denoising of one sample.
        failures: Samples that did not end well.
        reason: For the failure: a return code, or what was raised.
    """

    default: bool = False
    samples: int = 0
    error_low: float | None = None
    error: float | None = None
    error_high: float | None = None
    evaluations: float | None = None
    rejected: float | None = None
    seconds: float | None = None
    seconds_median: float | None = None
    failures: int = 0
    reason: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON: the configuration, its series and key, and what was measured."""
        values = asdict(self)
        configured = {item.name: values.pop(item.name) for item in fields(Configuration)}
        return {**configured, "series": self.series, "key": self.key, **values}


# Measuring ------------------------------------------------------------------------------------------------------------


def configurations(
    solvers: Sequence[str],
    steps: Sequence[int] = (),
    tolerances: Sequence[float] = (),
    dtypes: Sequence[str] = ("float32",),
    guidance_scales: Sequence[float] = (1.0,),
    options: Sequence[dict[str, Any]] = ({},),
) -> list[Configuration]:
    """Every combination, without those that come twice; "adaptive" goes with tolerances, others with steps."""
    points: list[Configuration] = []
    for scale, option, dtype, solver in product(guidance_scales, options, dtypes, solvers):
        named: Any = {"guidance_scale": float(scale), "dtype": dtype, "options": option}
        if solver == ADAPTIVE:
            points += [Configuration(solver, tolerance=value, **named) for value in tolerances]
        else:
            points += [Configuration(solver, value, **named) for value in steps]
    return list({point.key: point for point in points}.values())


def measure(target: Target, configuration: Configuration, reference: Reference, repeats: int = 3) -> Result:
    """One result; what the run raises is its reason."""
    result = Result(**vars(configuration), default=configuration == target.default, samples=target.samples)
    try:
        runs = [target.run(configuration) for _ in range(repeats)]
    except Exception as error:  # whatever it is, the other points are worth having, and this one says what it was
        line = str(error).strip().partition("\n")[0]
        return replace(result, failures=target.samples, reason=f"{type(error).__name__}: {line}".rstrip(": "))
    latents, report = runs[0]
    seconds = [each.seconds["denoising"] / target.samples for _, each in runs]
    codes = [code for code in report.codes if code is not ReturnCode.SUCCESS]
    errors = errors_of(latents, reference).numpy()
    finite = np.isfinite(errors)
    measured: dict[str, Any] = {}
    if finite.any():
        quartiles = np.quantile(errors[finite], (0.25, 0.5, 0.75)).tolist()
        measured |= zip(("error_low", "error", "error_high"), quartiles, strict=True)
    return replace(
        result,
        **measured,
        evaluations=report.evaluations / len(target.parts),
        rejected=report.rejected / len(target.parts),
        seconds=min(seconds),
        seconds_median=float(np.median(seconds)),
        failures=len(codes),
        reason=", ".join(sorted({code.value for code in codes})),
    )


# What the results say -------------------------------------------------------------------------------------------------


def grouped(results: Iterable[Result], name: str) -> dict[Any, list[Result]]:
    """Results by what they are at: "guidance_scale", or "series", whose points differ in steps or tolerance alone."""
    found: dict[Any, list[Result]] = {}
    for result in results:
        found.setdefault(getattr(result, name), []).append(result)
    return found


@dataclass(frozen=True)
class Order:
    """A fitted order of convergence of a series at a guidance scale: the slope of log error over log(1 / steps), `None`
    for less than three usable points, the solver's own one, and how many points it was fitted to."""

    solver: str
    series: str
    guidance_scale: float
    fitted: float | None
    nominal: int | None
    points: int


def fitted_orders(
    results: Sequence[Result], own_errors: dict[float, float], nominal: Callable[[str], int | None]
) -> list[Order]:
    """The order that each series of fixed steps shows, by least squares.

    Over the points whose median error is below `ASYMPTOTIC` and at least `ABOVE_FLOOR` times above the largest of: the
    reference's own error (at each guidance scale); the rounding of the network's dtype; and, where its last points fall
    by less than the half order, the error that the series levels off at.
    """
    found = []
    fixed = [result for result in results if result.steps is not None]
    for scale, of_scale in grouped(fixed, "guidance_scale").items():
        for series, group in grouped(of_scale, "series").items():
            good = [item for item in group if item.error and not item.failures]
            points = sorted((item.steps or 0, item.error or 0.0) for item in good)
            floor = max(own_errors.get(scale, 0.0), torch.finfo(DTYPES[group[0].dtype]).eps)
            if len(points) > 1:
                (before, earlier), (steps, last) = points[-2:]
                floor = max(floor, last, earlier) if last > earlier * (before / steps) ** 0.5 else floor
            usable = [(steps, error) for steps, error in points if ABOVE_FLOOR * floor <= error <= ASYMPTOTIC]
            logs = np.log(usable).reshape(-1, 2)
            fitted = -float(np.polyfit(logs[:, 0], logs[:, 1], 1)[0]) if len(usable) >= FEWEST else None
            found.append(Order(group[0].solver, series, scale, fitted, nominal(group[0].solver), len(usable)))
    return found


def pareto_front(results: Iterable[Result], cost: str) -> list[Result]:
    """The results of one guidance scale that no other beats in both median error and one of `COSTS`, cheapest first."""
    front: list[Result] = []
    usable = [item for item in results if not item.failures and None not in (item.error, getattr(item, cost))]
    for result in sorted(usable, key=lambda item: (getattr(item, cost), item.error)):
        if not front or result.error < front[-1].error:  # type: ignore[operator]
            front.append(result)
    return front


# Kept in a folder -----------------------------------------------------------------------------------------------------


def machine(device: str = "cpu") -> str:
    """What timings depend on, in words."""
    name = platform.processor() or platform.machine()
    if device.startswith("cuda"):
        name = torch.cuda.get_device_name()
    elif (known := Path("/proc/cpuinfo")).exists():
        lines = known.read_text(encoding="utf-8").splitlines()
        name = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), name)
    threads = torch.get_num_threads()
    return f"{name}, {threads} thread{'s' * (threads > 1)}, torch {torch.__version__}"


class ResultFolder:
    """What a sweep has measured so far: it can be gone on with, and extended.

    `results.json` holds all of it and is written after every result; `results.csv` is made of its results; references
    that took solvers are in `references`, as those of pipelines take minutes. All of it goes with one target, one
    tolerance of references and one machine, so a folder takes no others, and no damaged ones.

    Attributes:
        folder: Made when the first result is written. What is there already is read.
        target: What is measured.
        rtol: Tolerance of its references; `None` is the target's own.
        results: By the key of their configuration.
        references: Figures of the reference by guidance scale.
    """

    def __init__(self, folder: Path, target: Target, rtol: float | None = None):
        self.folder, self.target, self.rtol = folder, target, rtol
        self.machine = machine(target.device)
        described = ("name", "identity", "samples", "batch_size")
        self.described = {**{name: getattr(target, name) for name in described}, "rtol": rtol}
        self.results: dict[str, Result] = {}
        self.references: dict[float, dict[str, Any]] = {}
        file, why = folder / "results.json", ""
        if not file.exists():
            return
        try:
            found = json.loads(file.read_text(encoding="utf-8"))
            if found["version"] != VERSION:
                why = "in another format"
            elif found["target"] != self.described:
                why = f"of {found['target'].get('name')!r} with other inputs, weights or settings"
            elif found["machine"] != self.machine:
                why = f"from another machine ({found['machine']})"
            else:
                names = [item.name for item in fields(Result)]
                rows = [Result(**{name: row[name] for name in names}) for row in found["rows"]]
                self.results = {row.key: row for row in rows}
                self.references = {float(scale): figures for scale, figures in found["references"].items()}
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise InvalidInputError(
                f"`output` holds {str(file)!r}, which cannot be read ({type(error).__name__}: {error}); name "
                "another folder."
            ) from error
        if why:
            raise InvalidInputError(
                f"`output` holds results {why}, which do not go on one chart with these; name another folder."
            )

    @property
    def own_errors(self) -> dict[float, float]:
        """Errors of the references, by guidance scale."""
        return {scale: figures["own_error"] for scale, figures in self.references.items()}

    def sweep(
        self, wanted: Sequence[Configuration], repeats: int = 3, progress: Progress | None = None
    ) -> Iterator[Result]:
        """Measures what the folder lacks, one configuration after the other, and keeps each result at once.

        All are checked before the first is run. `repeats` runs of each are timed; a run of two steps that is not goes
        before the first of its kind. `progress` is that of references, see `solve_reference`.
        """
        check_integer("repeats", repeats, 1, MOST_REPEATS)
        for configuration in wanted:
            self.target.check(configuration)
        left, scale, warm = [item for item in wanted if item.key not in self.results], None, set()
        for configuration in sorted(left, key=lambda item: item.guidance_scale):  # stable: in order for each scale
            if configuration.guidance_scale != scale:
                scale = configuration.guidance_scale
                truth = self.reference(scale, progress)
            kind = (configuration.dtype, scale > 1.0)
            if kind not in warm:
                with suppress(Exception):  # which the runs to come raise as well
                    self.target.run(Configuration("ddim", 2, None, scale, configuration.dtype))
                warm.add(kind)
            result = measure(self.target, configuration, truth, repeats)
            self.results[result.key] = result
            self.save()
            yield result

    def reference(self, guidance_scale: float, progress: Progress | None = None) -> Reference:
        """That of the target; solved if it has not been before, and kept."""
        file = self.folder / "references" / f"guidance-{guidance_scale}.safetensors"
        if (figures := self.references.get(guidance_scale)) and file.exists():
            try:
                return Reference(**load_file(file), evaluations=figures["evaluations"], seconds=figures["seconds"])
            except (SafetensorError, TypeError):
                pass  # damaged: it is solved anew
        found = self.target.reference(guidance_scale, self.rtol, progress)
        if found.evaluations:
            tensors = {"latents": found.latents, "disagreement": found.disagreement}
            write_file("output", file, save({name: value.contiguous() for name, value in tensors.items()}))
        self.references[guidance_scale] = {
            "own_error": found.disagreement.median().item(),
            "own_error_largest": found.disagreement.max().item(),
            "evaluations": found.evaluations,
            "seconds": found.seconds,
        }
        self.save()
        return found

    def save(self, orders: Sequence[Order] = ()) -> Path:
        """Writes `results.json`."""
        whole = {
            "version": VERSION,
            "target": self.described,
            "machine": self.machine,
            "references": {str(scale): figures for scale, figures in self.references.items()},
            "orders": [asdict(order) for order in orders],
            "rows": [result.to_dict() for result in self.results.values()],
        }
        return write_file("output", self.folder / "results.json", json.dumps(whole, indent=1))

    def save_csv(self) -> Path:
        """Writes `results.csv`, a line for each result; options are JSON."""
        rows = [{**result.to_dict(), "options": json.dumps(result.options)} for result in self.results.values()]
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, rows[0])
        writer.writeheader()
        writer.writerows(rows)
        return write_file("output", self.folder / "results.csv", text.getvalue())
