"""`python -m tests.benchmarks`: every figure the README quotes, measured on the held-out split.

    python -m tests.benchmarks --write
        also stores them in unitouch_gen/weights/family.json and in README.md
    python -m tests.benchmarks --only touch_runs --touch-runs runs/touch_seed1 runs/touch_seed2 runs/touch_gelslim
        the zero-shot accuracy of other touch encoders
    python -m tests.benchmarks --only surfaces --surfaces FOLDER
        touches imagined from pictures of real surfaces, against those of their height maps
    python -m tests.benchmarks --only published --scratch FOLDER
        the published size, with random weights: needs 11 GB of disk and of memory, and a quarter of an hour

Timings are of this machine and say so; everything else depends on the weights and the seeds alone.
"""

import argparse
import json
from collections.abc import Callable, Sequence
from pathlib import Path

from rich.console import Console

from tests.benchmarks import Figures
from tests.benchmarks.error_and_time import error_and_time_figures
from tests.benchmarks.error_tables import (
    effectivity_table,
    gains_table,
    orders_table,
    price_table,
    stability_text,
)
from tests.benchmarks.generation import touch_to_image_figures
from tests.benchmarks.joint import joint_figures, touch_run_figures
from tests.benchmarks.memory import memory_figures
from tests.benchmarks.overhead import overhead_figures
from tests.benchmarks.published import published_figures
from tests.benchmarks.stylization import stylization_figures
from tests.benchmarks.surfaces import pairs_in, surface_figures
from tests.benchmarks.tables import (
    markdown,
    published_table,
    stylization_table,
    surfaces_text,
    write_between,
    x_to_touch_table,
)
from tests.benchmarks.timing import speed_figures, world_figures
from tests.benchmarks.x_to_touch import x_to_touch_figures
from unitouch_gen import weights
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.files import write_file
from unitouch_gen.numerics.results import machine

README = Path(__file__).resolve().parents[2] / "README.md"

README_PARTS: dict[str, Callable[[Figures], str]] = {
    "figures": markdown,
    "x-to-touch figures": x_to_touch_table,
    "stylization figures": stylization_table,
    "surface figures": surfaces_text,
    "prices": price_table,
    "gains": gains_table,
    "orders": orders_table,
    "effectivity": effectivity_table,
    "stability": stability_text,
    "published figures": published_table,
}
"""What stands between two comments of that name."""


TIMED = ("world", "speed", "memory", "overhead", "error_and_time", "published")
"""Figures that depend on the machine, which is stored beside each."""


def measures(
    split: str, touch_runs: Sequence[Path] = (), surfaces: Path | None = None, scratch: Path | None = None
) -> dict[str, Callable[[], Figures]]:
    """What can be measured, by name."""
    return {
        "joint": lambda: joint_figures(split),
        "touch_runs": lambda: {run.name: touch_run_figures(run, split) for run in touch_runs},
        "touch_to_image": lambda: touch_to_image_figures(split),
        "x_to_touch": lambda: x_to_touch_figures(split),
        "surfaces": lambda: {} if surfaces is None else surface_figures(surfaces),
        "stylization": lambda: stylization_figures(split),
        "world": world_figures,
        "speed": speed_figures,
        "memory": memory_figures,
        "overhead": overhead_figures,
        "error_and_time": error_and_time_figures,
        "published": lambda: {} if scratch is None else published_figures(scratch),
    }


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks")
    parser.add_argument("--split", default="test", choices=("val", "test"))
    parser.add_argument("--only", nargs="+", choices=sorted(measures("")), help="measure these alone")
    parser.add_argument("--touch-runs", nargs="+", type=Path, default=[], help="folders that training.touch has left")
    parser.add_argument("--surfaces", type=Path, help="folder of NAME_albedo and NAME_height pictures")
    parser.add_argument("--scratch", type=Path, help="folder for the files of `published`, with 11 GB free")
    parser.add_argument("--write", action="store_true", help="store the figures beside the weights and in the README")
    arguments = parser.parse_args()
    if arguments.write and (arguments.split != "test" or not README.is_file()):
        parser.error("`--write` stores figures of the test split, in a checkout with its README.")
    missing = [str(run) for run in arguments.touch_runs if not (run / "record.json").is_file()]
    if missing:
        parser.error(f"`--touch-runs` names {missing}, which hold no record.json; pass folders of finished runs.")

    try:
        if arguments.surfaces is not None:
            pairs_in(arguments.surfaces)
    except InvalidInputError as error:
        parser.error(str(error))
    optional = {  # need what no checkout holds, or much room
        "touch_runs": ("--touch-runs", arguments.touch_runs),
        "surfaces": ("--surfaces", arguments.surfaces),
        "published": ("--scratch", arguments.scratch),
    }
    for name, (option, needed) in optional.items():
        if name in (arguments.only or []) and not needed:
            parser.error(f"`--only {name}` needs `{option}`; name what to measure, or where.")

    family = json.loads(weights.FIGURES.read_text())
    stored = family["figures"]
    figures = {**stored, "split": arguments.split}
    every = measures(arguments.split, arguments.touch_runs, arguments.surfaces, arguments.scratch)
    for name, measure in every.items():
        if (arguments.only and name not in arguments.only) or (name in optional and not optional[name][1]):
            continue  # what was stored of it stays
        figures[name] = {**measure(), **({"machine": machine()} if name in TIMED else {})}
        Console(width=110).rule(name)
        rounded = json.loads(json.dumps(figures[name]), parse_float=lambda digits: round(float(digits), 4))
        Console(width=110).print_json(data=rounded)
        if arguments.write:  # at once, as the next one takes minutes
            write_file(weights.FIGURES, json.dumps({**family, "figures": figures}, indent=2) + "\n")
    missing = [name for name in measures("") if name not in figures]
    if arguments.write and missing:
        parser.error(f"{', '.join(missing)} were never measured, so README.md stays as it is.")
    if arguments.write:
        text = README.read_text()
        for mark, content in README_PARTS.items():
            text = write_between(text, mark, content(figures))
        write_file(README, text)


if __name__ == "__main__":
    main()
