"""Tables of README.md and docs/, between two comments of a name, such as `<!-- summary -->`.

Other figures that the pages quote are in `family.json`, and printed.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from tests.benchmarks.measuring import Figures
from unitouch_gen.files import write_file
from unitouch_gen.world import MATERIAL_NAMES

ROOT = Path(__file__).resolve().parents[2]

MADE = {"touch-to-image": "picture from a touch", "x-to-touch": "touch from a photo"}


def table(head: Sequence[str], rows: Iterable[Sequence[str]], note: str = "") -> str:
    """A table in Markdown, with a paragraph after it."""
    lines = [f"| {' | '.join(row)} |" for row in (head, *rows)]
    lines.insert(1, "|" + "---|" * len(head))
    return "\n".join([*lines, "", note] if note else lines)


def percent(share: float) -> str:
    return f"{100 * share:.1f} %"


# Quality --------------------------------------------------------------------------------------------------------------

SHARES = ("calibration error", "material", "within material", "within 20")
"""Ends of the names of figures that are shares; others are correlations, angles and distances."""

CONTROLS = {"class_mean": "class mean", "shuffled": "shuffled", "ceiling": "reference"}


def _shown(name: str, value: float | None) -> str:
    if value is None:
        return "-"
    if name.endswith(SHARES):
        return percent(value)
    return f"{value:.0f}°" if name.endswith("degrees") else f"{value:.2f}"


def quality_table(figures: Figures, *beginnings: str) -> str:
    """Figures whose names begin so, each beside its controls."""
    rows = []
    for name, row in figures["quality"]["rows"].items():
        if name.startswith(beginnings):
            value = f"{_shown(name, row['value'])} ({_shown(name, row['spread'])})"
            rows.append([name, value, *(_shown(name, row[key]) for key in CONTROLS)])
    return table(["figure", "measured (spread)", *CONTROLS.values()], rows)


SUMMARY = {
    "touch: material": "material of a touch, zero-shot",
    "touch to its touch by another sensor, within material": "the contact by another sensor, among 50 of its material",
    "touch, read linearly: grain within 20": "direction of the grain within 20 degrees, read off a touch",
    "touch to picture: grain within 20": "... off the picture that is made of the touch",
    "touch to picture: extent": "extent of the contact, in the picture that is made of the touch: correlation",
    "touch to picture: fine relief": "fine relief, likewise",
    "touch to picture: contact within material": "touch to picture: the contact, among 50 of its material",
    "photo to touch: contact within material": "photo to touch: the same",
    "caption to touch: contact within material": "caption to touch: the same",
    "sound to touch: contact within material": "sound to touch: the same",
}
"""What README.md shows, in its words."""


def summary_table(figures: Figures) -> str:
    """A few figures beside their controls, and what is read off real touches."""
    rows = []
    for name, words in SUMMARY.items():
        row = figures["quality"]["rows"][name]
        rows.append([words, *(_shown(name, row[key]) for key in ("value", *CONTROLS))])
    head = ["objects held out; sensors too, but for touches that are made", "measured", *CONTROLS.values()]
    real = figures["quality"]["real"]["recordings"]
    probes = [
        [REAL_ROWS[name].replace("[relief](#the-relief-behind-a-touch)", "relief"), _deviating(real[name])]
        for name in REAL_ROWS
    ]
    note = (
        f"Balanced accuracy, chance {percent(1 / 3)}; nothing was trained on these recordings; ± is the deviation over "
        "draws of objects."
    )
    of = "hardness, roughness and bumps of a real GelSight's recordings, by a linear probe off"
    return f"{table(head, rows)}\n\n{table([of, 'right'], probes, note)}"


def main_table(figures: Figures) -> str:
    """What the joint space and pictures from touches are worth, and seconds."""
    note = (
        f"Means over {len(figures['quality']['seeds'])} worlds, and the largest less the least of each. Chance of a "
        f"material is {percent(1 / len(MATERIAL_NAMES))}, and so is naming all alike. One "
        f"picture takes {figures['speed']['seconds_per_picture']:.2f} s after loading; "
        f"{figures['world']['samples_per_second']:.0f} full samples of the world, under two drawn sensors, are "
        f"rendered a second by two processes ({figures['speed']['machine']})."
    )
    return f"{quality_table(figures, 'touch: ', 'image: ', 'audio: ', 'touch to ', 'touch, read')}\n\n{note}"


REAL_ROWS = {
    "touch encoder": "the touch encoder",
    "untrained": "the same encoder, untrained: means of five",
    "statistics": "22 plain statistics of the image",
    "statistics of the relief": "... of the [relief](#the-relief-behind-a-touch)",
    "untouched gel": "the untouched gel of each clip",
}


def _deviating(row: Mapping[str, float]) -> str:
    """A mean and its deviation over draws of objects."""
    return f"{percent(row['mean'])} ± {100 * row['deviation']:.1f}"


def real_table(figures: Figures) -> str:
    """What is read off real touches, beside what needs no encoder."""
    objects, balls = (figures["quality"]["real"].get(name, {}) for name in ("recordings", "ball presses"))
    rows = []
    for key, words in REAL_ROWS.items():
        parts = [percent(objects[key][name]) for name in ("hardness", "roughness", "bumps")]
        rows.append([words, _deviating(objects[key]), *parts, f"{balls[key]['place']:.2f}" if key in balls else "-"])
    low, high = (percent(objects["untrained"][bound]) for bound in ("least", "most"))
    head = ["read linearly off", "mean of three", "hardness", "roughness", "bumps", "place of a ball, R²"]
    note = (
        f"{objects['of']['touches']} touches of {objects['of']['objects']} objects by a GelSight, balanced accuracy of "
        f"three classes each, chance {percent(1 / 3)}; ± is the deviation over draws of objects. Presses of balls are "
        "into another one, chance 0. Each object, and each ball, is predicted from the others. Five untrained encoders "
        f"are drawn; one alone has {low} to {high}."
    )
    return table(head, rows, note)


# Error and time -------------------------------------------------------------------------------------------------------


def _amount(run: Mapping[str, Any] | None) -> str:
    """ "`unipc`, 20 steps"."""
    return "-" if run is None else f"`{run['solver']}`, {run['steps']} steps"


def cost_table(figures: Figures) -> str:
    """How many steps for what error, at the built-in pipelines' own guidance."""
    pipelines = {name: figures["error_and_time"]["cost"][name] for name in MADE}
    errors = dict.fromkeys(error for each in pipelines.values() for error in each["cost_at_error"])
    rows = [
        [
            f"at most {percent(float(error))}",
            *(_amount(each["cost_at_error"].get(error)) for each in pipelines.values()),
        ]
        for error in errors
    ]
    heads = [f"{MADE[name]}, guidance {each['guidance_scale']:g}" for name, each in pipelines.items()]
    counts = sorted({each["conditions"] for each in pipelines.values()})
    note = (
        f"Median error of the latents over {' and '.join(map(str, counts))} samples of held-out contacts, relative to "
        "the exact flow of the network; the fewest steps of `unipc`, `dpm++2m` and `deis`."
    )
    return table(["error", *heads], rows, note)


MARKS: dict[str, Callable[[Figures], str]] = {
    "summary": summary_table,
    "figures": main_table,
    "x-to-touch figures": lambda figures: quality_table(figures, "photo to", "caption to", "sound to"),
    "style figures": lambda figures: quality_table(figures, "photo as it was", "restyled"),
    "real figures": real_table,
    "cost at error": cost_table,
}
"""What stands between two comments of that name, on one page."""


def write_pages(figures: Figures, root: Path = ROOT) -> None:
    """Writes the figures between their marks, wherever these are; a pair stands on one page."""
    for page in [root / "README.md", *sorted((root / "docs").rglob("*.md"))]:
        text = page.read_text(encoding="utf-8")
        for mark, content in MARKS.items():
            comment = f"<!-- {mark} -->"
            if text.count(comment) == 2:
                before, _, after = text.split(comment)
                text = f"{before}{comment}\n{content(figures)}\n{comment}{after}"
        write_file("page", page, text)
