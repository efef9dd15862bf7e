"""`unitouch-gen doctor`: what is installed, what there is to run on, and what a picture takes there."""

import platform
import re
import time
from importlib.metadata import PackageNotFoundError, requires, version

from typer import Exit, echo

from unitouch_gen import __version__
from unitouch_gen.cli import options
from unitouch_gen.cli.loading import CLASSES, INPUTS, device_of, kind_of, load_pipeline


def doctor(model: options.Model = None, dtype: options.Dtype = None, device: options.Device = "auto") -> None:
    """Says what is installed, what there is to run on, and what a picture takes there; exits with 1 if it cannot be.

    Example: unitouch-gen doctor
    """
    rows, unmet = packages()
    costs = [] if unmet else [cost(kind, model, dtype, device) for kind in ([kind_of(model)] if model else CLASSES)]
    options.print_table(["package", "wanted", "installed", "extra"], rows)
    echo(f"unitouch_gen {__version__}, Python {platform.python_version()}, {platform.platform(terse=True)}")
    options.note(*(f"run: pip install '{need}'" for need in unmet))
    if unmet:
        raise Exit(1)
    from unitouch_gen.weights import FAMILY

    echo(f"Built-in weights: {FAMILY}. Runs on {device_of(device)}")
    options.print_table(["pipeline", "seconds per picture", "weights"], costs)


def cost(kind: str, model: str | None, dtype: str | None, device: str) -> list[str]:
    """Name of a pipeline, seconds of a picture after the first, and bytes of the weights that it has read."""
    import torch

    from unitouch_gen.examples import example

    pipe = load_pipeline(kind, model=model, dtype=dtype, device=device)
    inputs = {modality: example("brick", modality) for modality in INPUTS[kind]}
    pipe(**inputs, num_inference_steps=2)  # reads encoders
    started = time.perf_counter()
    report = pipe(**inputs).report
    seconds = time.perf_counter() - started
    parts = [part for part in pipe.components.values() if isinstance(part, torch.nn.Module)]
    size = sum({id(one): one.nbytes for part in parts for one in part.parameters()}.values())  # some are shared
    return [kind, f"{seconds:.2g} at {report.steps} steps", f"{size / 1e6:.2g} MB"]


def packages() -> tuple[list[list[str]], list[str]]:
    """A row for each package that users need, and the requirements that are not met, those of missing extras aside."""
    from packaging.requirements import Requirement

    rows, unmet = [], []
    for need in map(Requirement, requires("unitouch_gen") or []):
        extra = "".join(re.findall(r'extra == "([\w-]+)"', str(need.marker)))
        if extra in ("test", "lint", "docs"):
            continue
        try:
            found = version(need.name)
        except PackageNotFoundError:
            found = ""
        if not need.specifier.contains(found or "0", prereleases=True) and (found or not extra):
            unmet.append(f"{need.name}{need.specifier}")
        rows.append([need.name, str(need.specifier), found or "missing", extra or "-"])
    return rows, unmet
