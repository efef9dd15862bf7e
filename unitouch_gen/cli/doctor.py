"""`unitouch-gen doctor`: installed packages, the device, and the time of a picture on it."""

import platform
import re
import time
from importlib.metadata import PackageNotFoundError, distributions, requires

from typer import echo

from unitouch_gen import __version__
from unitouch_gen.cli import options
from unitouch_gen.cli.loading import DRAWING, device_of, kind_of, load_pipeline
from unitouch_gen.examples import example
from unitouch_gen.weights import FAMILY


def doctor(model: options.Model = None, dtype: options.Dtype = None, device: options.Device = "auto") -> None:
    """Reports installed packages, the device, and the time of a picture on it.

    Example: unitouch-gen doctor
    """
    kinds = [kind_of(model)] if model else list(DRAWING)
    costs = [cost(kind, model, dtype, device) for kind in kinds]
    packages = installed_packages()
    if packages:
        options.print_table(["package", "installed"], packages)
    echo(f"unitouch_gen {__version__}, Python {platform.python_version()}, {platform.platform(terse=True)}")
    echo(f"Built-in weights: {FAMILY}. Runs on {device_of(device)}")
    options.print_table(["pipeline", "seconds per picture", "weights"], costs)


def installed_packages() -> list[list[str]]:
    """Names and versions of the packages that this one requires; none if it is not installed."""
    try:
        requirements = requires("unitouch_gen") or []
    except PackageNotFoundError:  # a clone that is not installed
        return []
    requirements = [line for line in requirements if not re.search("extra == .(test|lint|docs)", line)]
    versions = {normalised(package.name): package.version for package in distributions()}
    names = dict.fromkeys(re.split(r"[^\w-]", line)[0] for line in requirements)
    return [[name, versions.get(normalised(name), "missing")] for name in names]


def normalised(name: str) -> str:
    """The name of a package in lower case with dashes."""
    return name.lower().replace("_", "-")


def cost(kind: str, model: str | None, dtype: str | None, device: str) -> list[str]:
    """Name of a pipeline, seconds of a picture after the first one, and bytes of the weights in memory."""
    import torch

    pipe = load_pipeline(kind, model=model, dtype=dtype, device=device)
    inputs = {modality: example("brick", modality) for modality in DRAWING[kind]}
    pipe(**inputs, num_inference_steps=2)  # reads the encoders
    started = time.perf_counter()
    report = pipe(**inputs).report
    seconds = time.perf_counter() - started
    bytes_of = dict[int, int]()  # by parameter, since some are shared
    for component in pipe.components.values():
        if isinstance(component, torch.nn.Module):
            bytes_of |= {id(parameter): parameter.nbytes for parameter in component.parameters()}
    size = sum(bytes_of.values())
    return [kind, f"{seconds:.2g} at {report.steps} steps", f"{size / 1e6:.2g} MB"]
