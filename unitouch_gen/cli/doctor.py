"""`unitouch-gen doctor`: what is installed, what there is to run on, and what a picture takes there."""

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
    """Says what is installed, what there is to run on, and what a picture takes there.

    Example: unitouch-gen doctor
    """
    costs = [cost(kind, model, dtype, device) for kind in ([kind_of(model)] if model else DRAWING)]
    try:
        needs = [need for need in requires("unitouch_gen") or [] if not re.search("extra == .(test|lint|docs)", need)]
    except PackageNotFoundError:  # of a clone that nobody has installed
        needs = []
    known = {one.name.lower().replace("_", "-"): one.version for one in distributions()}
    names = dict.fromkeys(re.split(r"[^\w-]", need)[0] for need in needs)
    packages = [[name, known.get(name.lower().replace("_", "-"), "missing")] for name in names]
    if packages:
        options.print_table(["package", "installed"], packages)
    echo(f"unitouch_gen {__version__}, Python {platform.python_version()}, {platform.platform(terse=True)}")
    echo(f"Built-in weights: {FAMILY}. Runs on {device_of(device)}")
    options.print_table(["pipeline", "seconds per picture", "weights"], costs)


def cost(kind: str, model: str | None, dtype: str | None, device: str) -> list[str]:
    """Name of a pipeline, seconds of a picture after the first, and bytes of the weights that it has read."""
    import torch

    pipe = load_pipeline(kind, model=model, dtype=dtype, device=device)
    inputs = {modality: example("brick", modality) for modality in DRAWING[kind]}
    pipe(**inputs, num_inference_steps=2)  # reads encoders
    started = time.perf_counter()
    report = pipe(**inputs).report
    seconds = time.perf_counter() - started
    parts = [part for part in pipe.components.values() if isinstance(part, torch.nn.Module)]
    size = sum({id(one): one.nbytes for part in parts for one in part.parameters()}.values())  # some are shared
    return [kind, f"{seconds:.2g} at {report.steps} steps", f"{size / 1e6:.2g} MB"]
