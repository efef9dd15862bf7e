"""`unitouch-gen doctor`: what is installed, what there is to run on, and what a picture takes there."""

import json
import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from typing import Annotated, Any

import typer

from unitouch_gen import __version__
from unitouch_gen.cli import options
from unitouch_gen.cli.loading import kind_of, load_pipeline
from unitouch_gen.errors import check_dtype

NOT_FIT = 1
"""Exit code."""

DEVELOPERS = ("test", "lint", "docs")
"""Extras that nobody needs who only uses the package."""

MISSING = "missing"


@dataclass
class Package:
    """One that the package runs on.

    Attributes:
        name, wanted, installed: Its name, the versions that will do, and the one there is; `None` if there is none.
        extra: The extra that it comes with; empty for what everybody has.
        fits: Whether it is there in such a version.
    """

    name: str
    wanted: str
    installed: str | None
    extra: str
    fits: bool


@dataclass
class Cost:
    """What one pipeline takes.

    Attributes:
        pipeline: Its name.
        weights: Bytes of the networks that a call needs.
        seconds: Of a picture.
        steps: That it was measured at.
        failed: What went wrong; empty if nothing did.
    """

    pipeline: str
    weights: int = 0
    seconds: float = 0.0
    steps: int = 0
    failed: str = ""


def doctor(
    model: options.Model = None,
    dtype: options.Dtype = None,
    device: options.Device = "auto",
    time: Annotated[bool, typer.Option(help="Whether to make pictures, and time them.")] = True,
    as_json: options.AsJson = False,
) -> None:
    """Says what is installed, what there is to run on, and what a picture takes there; exits with 1 if one fails.

    Example: unitouch-gen doctor
    """
    found = list(packages())
    place: dict[str, Any] = {}
    complete = all(package.installed for package in found if not package.extra)  # or nothing can be imported
    if complete:
        if dtype is not None:
            check_dtype("dtype", dtype)
        place = machine(device)
        if model is not None:
            kind_of(model)
    broken = [package for package in found if not package.fits and (package.installed or not package.extra)]
    if not as_json:
        options.print_table(
            ["package", "wanted", "installed", "extra"],
            [[one.name, one.wanted or "any", one.installed or MISSING, one.extra or "-"] for one in found],
        )
        if complete:
            print_machine(place)
    costs = list(measured(model, dtype, device, options.is_quiet(as_json))) if time and complete else []
    if as_json:
        rows = {"packages": list(map(asdict, found)), "machine": place, "pipelines": list(map(asdict, costs))}
        typer.echo(json.dumps({"version": __version__, **rows}))
    elif costs:
        print_costs(costs)
    for package in broken:
        was = f"is {package.installed}" if package.installed else "is missing"
        options.note(f"{package.name} {was}; run: pip install '{package.name}{package.wanted}'")
    for cost in costs:
        if cost.failed:
            options.note(f"{cost.pipeline}: {cost.failed}")
    if broken or any(cost.failed for cost in costs):
        raise typer.Exit(NOT_FIT)


def packages() -> Iterator[Package]:
    """What the package's metadata ask for, but for what only developers need."""
    from packaging.requirements import Requirement

    try:
        lines = requires("unitouch_gen") or []
    except PackageNotFoundError:  # a clone that is not installed
        lines = []
    for line in lines:
        need = Requirement(line)
        extra = next(iter(re.findall(r'extra == "([\w-]+)"', str(need.marker or ""))), "")
        if extra in DEVELOPERS or need.name.replace("-", "_") == "unitouch_gen":
            continue
        try:
            installed = version(need.name)
        except PackageNotFoundError:
            installed = None
        fits = installed is not None and need.specifier.contains(installed, prereleases=True)
        yield Package(need.name, str(need.specifier), installed, extra, fits)


def machine(device: str) -> dict[str, Any]:
    """What a pipeline would run on: Python, and processor or GPU."""
    import platform

    from unitouch_gen.numerics.work_precision import machine

    place = options.device_of(device)
    return {
        "python": platform.python_version(),
        "system": platform.platform(terse=True),
        "device": str(place),
        "name": machine(str(place)),
    }


def measured(model: str | None, dtype: str | None, device: str, quiet: bool) -> Iterator[Cost]:
    """What a picture takes of each built-in pipeline, or of a saved one."""
    import time

    import torch

    from unitouch_gen.errors import REFUSALS
    from unitouch_gen.examples import examples
    from unitouch_gen.pipelines.tiny import PIPELINES

    touch, photo = (next(iter(examples(modality).values())) for modality in ("touch", "image"))
    inputs = {
        "touch-to-image": {"touch": touch},
        "x-to-touch": {"image": photo},
        "stylization": {"image": photo, "touch": touch},
    }
    for name in PIPELINES if model is None else [kind_of(model)]:
        cost, given = Cost(name), inputs[name]
        try:
            pipe = load_pipeline(name, model, quiet, arguments=given, dtype=dtype, device=device)
            pipe.set_progress_bar_config(disable=quiet, leave=False, desc=name)
            drawn = {"generator": torch.Generator().manual_seed(0)}
            pipe(**given, **drawn, num_inference_steps=2)  # what is made once, such as kernels
            started = time.perf_counter()
            report = pipe(**given, **drawn).report
            cost.seconds, cost.steps = time.perf_counter() - started, report.steps
            modules = [part for part in pipe.components.values() if isinstance(part, torch.nn.Module)]
            weights = {id(one): one.nbytes for module in modules for one in module.parameters()}  # some are shared
            cost.weights = sum(weights.values())
        except REFUSALS as error:
            cost.failed = str(error)
        yield cost


# What is printed ------------------------------------------------------------------------------------------------------


def print_machine(place: dict[str, Any]) -> None:
    """Two lines on what there is to run on."""
    typer.echo(f"unitouch_gen {__version__}, Python {place['python']}, {place['system']}")
    typer.echo(f"Runs on {place['device']}: {place['name']}")


def print_costs(costs: list[Cost]) -> None:
    """A row for each pipeline."""
    rows = [
        [one.pipeline, "failed", "-"]
        if one.failed
        else [one.pipeline, f"{one.seconds:.2g} at {one.steps} steps", size(one.weights)]
        for one in costs
    ]
    options.print_table(["pipeline", "seconds a picture", "weights"], rows)


def size(count: int) -> str:
    """Bytes in words: "84 MB", or "3.2 GB"."""
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.0f} MB"
