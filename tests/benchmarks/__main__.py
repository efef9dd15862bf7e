"""`python -m tests.benchmarks`: the figures of tables in README.md and docs/, measured on the held-out split.

    python -m tests.benchmarks --write
        also stores them in unitouch_gen/weights/family.json and between the marks on the pages
    python -m tests.benchmarks --write --only
        measures nothing, and writes what is stored to the pages
    python -m tests.benchmarks --only quality --textures FOLDER --recordings FOLDER --calibration FOLDER
        what the family is worth on the world, on scanned materials held out, and on real touches
    python -m tests.benchmarks --only calibration --calibration FOLDER
        the calibrated sensors against published measurements of real ones, which tests/benchmarks/calibration.py names
    python -m tests.benchmarks --only adapt --recordings FOLDER
        a sensor adapted to recordings of real ones, see `adaptation`
    python -m tests.benchmarks --only published --scratch FOLDER
        the published size, with random weights: needs 11 GB of disk and of memory, and a quarter of an hour

Timings are of this machine and say so; everything else depends on the weights and the seeds alone.
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path

from rich.console import Console

from tests.benchmarks.adaptation import DIGIT, GELSIGHT, adapt_figures
from tests.benchmarks.calibration import calibration_figures, check_folder
from tests.benchmarks.cost import overhead_figures, speed_figures
from tests.benchmarks.error_and_time import error_and_time_figures
from tests.benchmarks.measuring import Figures
from tests.benchmarks.published_size import published_figures
from tests.benchmarks.quality import quality_figures
from tests.benchmarks.tables import write_pages
from tests.benchmarks.training import training_figures
from tests.benchmarks.world import world_figures
from unitouch_gen import weights
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.files import write_file
from unitouch_gen.numerics.work_precision import machine

PARTS: dict[str, Callable[[argparse.Namespace], Figures]] = {
    "quality": lambda given: quality_figures(given.textures, given.recordings, given.calibration, given.seeds),
    "world": lambda given: world_figures(),
    "calibration": lambda given: calibration_figures(given.calibration),
    "speed": lambda given: speed_figures(),
    "overhead": lambda given: overhead_figures(),
    "error_and_time": lambda given: error_and_time_figures(),
    "training": lambda given: training_figures(),
    "adapt": lambda given: adapt_figures(given.recordings),
    "published": lambda given: published_figures(given.scratch),
}

NEEDED = {
    "quality": ("--textures", "--recordings", "--calibration"),
    "calibration": ("--calibration",),
    "adapt": ("--recordings",),
    "published": ("--scratch",),
}
"""Options of parts that need what no checkout holds, or much room."""

TIMED = ("world", "speed", "overhead", "error_and_time", "training", "published")
"""Figures that depend on the machine, which is stored beside each."""


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks")
    parser.add_argument("--only", nargs="*", choices=sorted(PARTS), help="measure these alone")
    parser.add_argument("--textures", type=Path, help="folder of scanned materials")
    parser.add_argument("--seeds", type=int, default=3, help="worlds that the quality is measured on")
    parser.add_argument("--calibration", type=Path, help="folder of calibration tables, frames and backgrounds")
    parser.add_argument("--recordings", type=Path, help=f"folder with {GELSIGHT} and {DIGIT}, or one of them")
    parser.add_argument("--scratch", type=Path, help="folder for the files of `published`, with 11 GB free")
    parser.add_argument("--write", action="store_true", help="store the figures beside the weights and on the pages")
    given = parser.parse_args()
    try:
        if given.calibration is not None:
            check_folder(given.calibration)
    except InvalidInputError as error:
        parser.error(str(error))
    missing = {name: [each for each in options if not getattr(given, each[2:])] for name, options in NEEDED.items()}
    lacking = {name: " and ".join(options) for name, options in missing.items() if options}
    for name, options in lacking.items():
        if name in (given.only or []):
            parser.error(f"`--only {name}` needs `{options}`; name what to measure, or where.")
    if given.recordings and not any((given.recordings / name).is_file() for name in (GELSIGHT, DIGIT)):
        parser.error(f"`--recordings` is {str(given.recordings)!r}, which holds neither {GELSIGHT} nor {DIGIT}.")
    if lacking and given.only is None:
        left_out = ", ".join(f"{name} (no {options})" for name, options in lacking.items())
        Console(width=110).print(f"Left out: {left_out}.")

    family = json.loads(weights.FIGURES.read_text())
    figures = family["figures"]
    for name, measure in PARTS.items():
        if name in lacking or (given.only is not None and name not in given.only):
            continue  # what was stored of it stays
        figures[name] = {**measure(given), **({"machine": machine()} if name in TIMED else {})}
        Console(width=110).rule(name)
        rounded = json.loads(json.dumps(figures[name]), parse_float=lambda digits: round(float(digits), 4))
        Console(width=110).print_json(data=rounded)
        if given.write:  # at once, as the next one takes minutes
            write_file("figures", weights.FIGURES, json.dumps({**family, "figures": figures}, indent=2) + "\n")
    if given.write:
        never = [name for name in PARTS if name not in figures]
        if never:
            parser.error(f"{', '.join(never)} were never measured, so the pages stay as they are.")
        try:
            write_pages(figures)
        except ValueError as error:
            parser.error(str(error))


if __name__ == "__main__":
    main()
