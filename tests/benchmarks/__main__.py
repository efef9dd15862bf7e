"""`python -m tests.benchmarks`: the figures of tables in README.md and docs/, measured on the held-out split.

    python -m tests.benchmarks --write
        also stores them in unitouch_gen/weights/family.json, for model cards, too, and between the marks on the pages
    python -m tests.benchmarks --write --only
        measures nothing, and writes what is stored to the pages and model cards
    python -m tests.benchmarks --only quality --recordings FOLDER --photos FOLDER
        what the family is worth on the world and on real touches
    python -m tests.benchmarks --only scans
        ... and on scanned surfaces and recorded sounds

Timings are of this machine and say so; everything else depends on the weights and the seeds alone.
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import torch
from rich.console import Console

from tests.benchmarks.error_and_time import error_and_time_figures
from tests.benchmarks.measuring import Figures, in_turns, machine, quiet, seconds_of
from tests.benchmarks.quality import quality_figures
from tests.benchmarks.scans import ROUNDS, scans_figures
from tests.benchmarks.tables import card_settings, write_pages
from tests.benchmarks.world import world_figures
from unitouch_gen import example, weights
from unitouch_gen.files import write_file


def speed_figures() -> Figures:
    """Seconds for one picture with default settings, after loading."""
    pipe = quiet("touch-to-image")
    touch = example("brick")
    calls = {"picture": lambda: seconds_of(pipe, touch, generator=torch.Generator().manual_seed(0))}
    return {"seconds_per_picture": min(in_turns(calls, 3)["picture"])}


PARTS: dict[str, Callable[[argparse.Namespace], Figures]] = {
    "quality": lambda given: quality_figures(given.recordings, given.photos, given.seeds),
    "scans": lambda given: scans_figures(given.seeds, given.each, given.trunk),
    "world": lambda given: world_figures(),
    "speed": lambda given: speed_figures(),
    "error_and_time": lambda given: error_and_time_figures(),
}

NEEDED = {"quality": ("recordings",)}
"""Options of parts that need what no checkout holds."""


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks")
    parser.add_argument("--only", nargs="*", choices=sorted(PARTS), help="measure these alone")
    parser.add_argument("--seeds", type=int, default=3, help="worlds that quality and scans are measured on")
    parser.add_argument(
        "--each",
        type=int,
        default=ROUNDS,
        choices=range(1, ROUNDS + 1),
        help="contacts of each scanned surface to generate of",
    )
    parser.add_argument(
        "--trunk", type=Path, help="folder of the teacher's trunk, where the family's joint space has none"
    )
    parser.add_argument("--recordings", type=Path, help="folder of recordings of real sensors, see `quality`")
    parser.add_argument("--photos", type=Path, help="folder of whole photos, which are restyled")
    parser.add_argument("--write", action="store_true", help="store the figures beside the weights and on the pages")
    given = parser.parse_args()
    torch.set_num_threads(1)  # as calls of small pipelines set it, or what is timed beside them would take more
    family = json.loads(weights.FIGURES.read_text())
    console = Console(width=110)
    figures = family["figures"]
    for name, measure in PARTS.items():
        if given.only is not None and name not in given.only:
            continue  # what was stored of it stays
        if lacking := [f"--{option}" for option in NEEDED.get(name, ()) if not getattr(given, option)]:
            if given.only:
                parser.error(f"`--only {name}` needs `{' and '.join(lacking)}`.")
            console.print(f"Left out: {name} (no {' and '.join(lacking)}).")
            continue
        figures[name] = {**measure(given), "machine": machine()}
        console.rule(name)
        rounded = json.loads(json.dumps(figures[name]), parse_float=lambda digits: round(float(digits), 4))
        console.print_json(data=rounded)
        if given.write:  # at once, as the next one takes minutes
            write_file("figures", weights.FIGURES, json.dumps({**family, "figures": figures}, indent=2) + "\n")
    if given.write:
        family |= {"figures": figures, "cards": card_settings(figures)}
        write_file("figures", weights.FIGURES, json.dumps(family, indent=2) + "\n")
        write_pages(figures)


if __name__ == "__main__":
    main()
