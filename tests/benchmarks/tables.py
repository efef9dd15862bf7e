"""Tables of README.md and docs/, between two comments of a name, such as `<!-- summary -->`, and model cards.

Other figures that the pages quote are in `family.json`, and printed.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from tests.benchmarks.measuring import Figures
from unitouch_gen.files import write_file
from unitouch_gen.world import MATERIAL_NAMES
from unitouch_gen.world.questions import TOPICS

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

ANSWERS = tuple(topic.figure for topic in TOPICS.values() if topic.figure)
SHARES = ("material", "of the touch", "of the photo", "within 20", "among 40", "spectrum", *ANSWERS)
"""Ends of the names of figures that are shares; others are correlations and distances."""

CONTROLS = {"class_mean": "class mean", "shuffled": "shuffled", "ceiling": "reference"}


TOLD = (
    "material",
    "within material",
    "within 20",
    "Frechet distance",
    "layout kept",
    "of the touch",
    "of the photo",
    *ANSWERS,
    "ROUGE-L",
)
"""Ends of the names of figures that the pages show; `family.json` has them all."""


def _shown(name: str, value: float | None) -> str:
    if value is None:
        return "-"
    return percent(value) if name.endswith(SHARES) and "relief" not in name else f"{value:.2f}"


def quality_table(figures: Figures, *beginnings: str) -> str:
    """Figures whose names begin so, each beside its controls."""
    rows = []
    for name, row in figures["quality"]["rows"].items():
        if name.startswith(beginnings) and name.endswith(TOLD):
            value = f"{_shown(name, row['value'])} ({_shown(name, row['spread'])})"
            rows.append([name, value, *(_shown(name, row[key]) for key in CONTROLS)])
    return table(["figure", "measured (spread)", *CONTROLS.values()], rows)


SUMMARY = {
    "touch: material": "material of a touch, zero-shot",
    "image: material": "... of a picture",
    "audio: material": "... of a sound",
    "recorded sound: material": "... of a recorded sound",
    "touch to its touch by another sensor, within material": "the contact by another sensor, among 50 of its material",
    "touch to its touch by a DIGIT, among 40": "the contact by a DIGIT, among 40 surfaces",
    "touch to its picture, among 40": "the picture of a touch, among 40 surfaces",
    "touch to picture: material": "**touch to picture**: material",
    "touch to picture: grain within 20": "... direction of the grain within 20 degrees",
    "touch to picture: contact within material": "... the contact, among 50 of its material",
    "touch to picture: spectrum": "... spectrum of the true picture, among the first five of 40",
    "photo to touch: material": "**photo to touch**: material",
    "photo to touch: grain within 20": "... direction of the grain within 20 degrees",
    "photo to touch: spectrum": "... spectrum of the true touch, among the first five of 40",
    "caption to touch: material": "caption to touch: material",
    "word to touch: material": "bare word to touch: material",
    "sound to touch: material": "sound to touch: material",
    "restyled photo: material of the touch": "**photo restyled by a touch**: named as the touch's material",
    "restyled photo: relief of the touch": "... relief of the touch (correlation)",
    "restyled photo: layout kept": "... layout of the photo (correlation)",
    "answer: material": "**question about a touch**: the material is named",
    "answer: hard or soft": "... hard or soft (balanced)",
    "answer: contact place": "... where the contact is",
}
"""What README.md shows, in its words: figures of drawn objects, of scanned surfaces, or of both."""

SCANNED = {
    "image: material": "material of a picture, zero-shot",
    "touch: material": "... of a touch by a GelSight",
    "touch by a DIGIT: material": "... of a touch by a DIGIT",
    "recorded sound: material": "... of a recorded sound",
    "touch to its picture, among 40": "the picture of a touch by a GelSight, first among 40 surfaces",
    "touch by a DIGIT to its picture, among 40": "... of a touch by a DIGIT",
    "touch to its touch by a DIGIT, among 40": "a GelSight's contact by a DIGIT, first among 40 surfaces",
    "photo to touch: spectrum": "**photo to touch**: spectrum of the true touch, among the first five of 40",
    "touch to picture: spectrum": "**touch to picture**: spectrum of the true picture, among the first five of 40",
    "touch to picture: Frechet distance": "... Frechet distance to held-out pictures",
}
"""Figures of scanned surfaces and recorded sounds."""

SCANNED_CONTROLS = {
    "chance": "chance",
    "class_mean": "class mean",
    "shuffled": "shuffled",
    "ceiling": "reference",
    "reconstruction": "autoencoder",
    "teacher": "teacher, read linearly",
}


def elsewhere(quality: Figures) -> list[str]:
    """A line each on sensors drawn anew, and on what lies beyond the ranges of training."""
    lines = []
    names = ("touch: material", "touch to picture: material", "photo to touch: material")
    for part, words in {"drawn": "By sensors drawn anew", "beyond": "Beyond the ranges of training"}.items():
        found = [(name, quality[part][name]) for name in names if name in quality[part]]
        told = [
            f"{SUMMARY[name].replace('*', '')} {_shown(name, row['value'])} (shuffled {_shown(name, row['shuffled'])})"
            for name, row in found
        ]
        lines.append(f"{words}: {'; '.join(told)}.")
    return lines


def summary_table(figures: Figures) -> str:
    """Figures of a GelSight's touches beside their controls, and a line each on what is harder."""
    quality = figures["quality"]
    scanned = scanned_rows(figures)
    rows = []
    for name, words in SUMMARY.items():
        drawn = quality["rows"].get(name, {})
        controls = (_shown(name, drawn.get(key)) for key in CONTROLS)
        of_scans = _shown(name, scanned.get(name, {}).get("value"))
        rows.append([words, _shown(name, drawn.get("value")), *controls, of_scans])
    lines = elsewhere(quality)
    real = quality["real"]["recordings"]
    lines.append(
        "On a real GelSight, hardness, roughness and bumps of objects it has not seen are read linearly off its "
        f"embeddings in {_deviating(real['touch encoder'])}, off those of the same encoder untrained in "
        f"{_deviating(real['untrained'])}, off plain statistics of the image in "
        f"{_deviating(real['statistics'])}, off an untouched gel in {_deviating(real['untouched gel'])}; "
        f"chance {percent(1 / 3)}."
    )
    head = ["held out, touched by a GelSight", "drawn objects", *CONTROLS.values(), "scanned surfaces"]
    return table(head, rows, "\n".join(f"- {line}" for line in lines))


# Scanned surfaces -----------------------------------------------------------------------------------------------------


def scanned_rows(figures: Figures) -> Figures:
    """Figures of scanned surfaces by name; none where they were not measured."""
    return figures.get("scans", {}).get("rows", {})


def scanned_table(figures: Figures) -> str:
    """Figures of scanned surfaces and recorded sounds, beside their controls."""
    found = scanned_rows(figures)
    rows = []
    for name, words in SCANNED.items():
        row = found.get(name, {})
        value = _shown(name, row.get("value"))
        if row.get("spread") is not None:
            value += f" ({_shown(name, row['spread'])})"
        rows.append([words, value, *(_shown(name, row.get(key)) for key in SCANNED_CONTROLS)])
    return table(["figure", "measured (spread)", *SCANNED_CONTROLS.values()], rows)


def scanned_summary(figures: Figures) -> str:
    """The same for README.md, less the spread and the autoencoder."""
    found = scanned_rows(figures)
    controls = [key for key in SCANNED_CONTROLS if key != "reconstruction"]
    rows = [
        [words, *(_shown(name, found.get(name, {}).get(key)) for key in ("value", *controls))]
        for name, words in SCANNED.items()
    ]
    return table(["held-out surfaces, scanned", "measured", *(SCANNED_CONTROLS[key] for key in controls)], rows)


def main_table(figures: Figures) -> str:
    """What the joint space and pictures from touches are worth, and seconds."""
    note = (
        f"Means over {len(figures['quality']['seeds'])} worlds, and the largest less the least of each. Chance of a "
        f"material is {percent(1 / len(MATERIAL_NAMES))}. One picture takes "
        f"{figures['speed']['seconds_per_picture']:.2f} s after loading ({figures['speed']['machine']})."
    )
    rows = quality_table(figures, "touch: ", "image: ", "audio: ", "text: ", "touch to ", "touch, read")
    return "\n\n".join([rows, *elsewhere(figures["quality"]), note])


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


def cost_table(figures: Figures) -> str:
    """How many steps for what error, at the built-in pipelines' own guidance."""
    pipelines = {name: figures["error_and_time"]["cost"][name] for name in MADE}
    errors = dict.fromkeys(error for each in pipelines.values() for error in each["cost_at_error"])
    rows = []
    for error in errors:
        runs = [each["cost_at_error"].get(error) for each in pipelines.values()]
        told = ["-" if run is None else f"`{run['solver']}`, {run['steps']} steps" for run in runs]
        rows.append([f"at most {percent(float(error))}", *told])
    heads = [f"{MADE[name]}, guidance {each['guidance_scale']:g}" for name, each in pipelines.items()]
    counts = sorted({each["conditions"] for each in pipelines.values()})
    note = (
        f"Median error of the latents over {' and '.join(map(str, counts))} samples of held-out contacts, relative to "
        "the exact flow of the network; the fewest steps of `unipc` and `dpm++2m`."
    )
    return table(["error", *heads], rows, note)


SETTINGS = (
    ("results", "`pipe(...)`, as it is", "default", ""),
    ("speed", '`tiny("touch-to-image-turbo")`, `tiny("x-to-touch-turbo")`', "turbo", "in four evaluations, "),
    ("what the paper did", '`solver="ddim", num_inference_steps=50, guidance_scale=9.0`', "ddim", None),
    ("the exact flow, to an error", "`tolerance=0.05`", None, None),
)
"""Which setting to take for what: the call, its name among the times, and what its figures' names begin with."""


def settings_table(figures: Figures) -> str:
    """Which setting to take: seconds of a call for one, and the Frechet distance of what it draws, where measured."""
    made = {"touch-to-image": "touch to picture", "x-to-touch": "photo to touch"}
    rows = []
    for *words, key, beginning in SETTINGS:
        cells = []
        for pipeline, name in made.items():
            seconds = figures["error_and_time"]["turbo"][f"{pipeline}, 1 at once"]["seconds"]
            told = ["by the tolerance" if key is None else f"{seconds[key]:.2f} s"]
            if beginning is not None:
                told.append(f"{figures['quality']['rows'][f'{beginning}{name}: Frechet distance']['value']:.2f}")
            cells.append(", ".join(told))
        rows.append([*words, *cells])
    return table(["for", "take", *(f"{name}: seconds, Frechet distance" for name in made.values())], rows)


def turbo_table(figures: Figures) -> str:
    """What is drawn by default and in four evaluations, and how much faster that is than DDIM in 50 steps."""
    quality = figures["quality"]["rows"]
    rows = []
    ends = ("material", "grain within 20", "contact within material", "Frechet distance")
    for name in (f"{made}: {end}" for made in ("touch to picture", "photo to touch") for end in ends):
        both = [quality[name], quality[f"in four evaluations, {name}"]]
        values = (f"{_shown(name, row['value'])} ({_shown(name, row['spread'])})" for row in both)
        rows.append([name, *values, *(_shown(name, both[1][key]) for key in CONTROLS)])
    times = [
        f"{name}: {row['over ddim']['ratio']:.1f} and {row['over default']['ratio']:.1f}"
        for name, row in figures["error_and_time"]["turbo"].items()
    ]
    note = (
        f"Times as fast, in whole calls, as diffusers' DDIM in 50 steps at guidance 9, and as the default: "
        f"{'; '.join(times)}. Distances are to real images, smaller is better. Controls are those of four evaluations."
    )
    return table(["figure", "default (spread)", "four evaluations (spread)", *CONTROLS.values()], rows, note)


def answers_table(figures: Figures) -> str:
    """Answers, beside those to other contacts' touches, about the pictures, and the most frequent ones."""
    rows = []
    for name, row in figures["quality"]["rows"].items():
        if name.startswith("answer: "):
            value = f"{_shown(name, row['value'])} ({_shown(name, row['spread'])})"
            controls = [_shown(name, row[key]) for key in ("ceiling", "shuffled", "usual")]
            rows.append([name.removeprefix("answer: "), value, *controls])
    head = ["right in answers", "touch (spread)", "picture", "another's touch", "most frequent answer"]
    return table(head, rows)


# Model cards ----------------------------------------------------------------------------------------------------------

CARDS = {
    "touch-to-image": [
        f"touch to picture: {end}" for end in ("material", "grain within 20", "contact within material")
    ],
    "stylization": [
        f"restyled photo: {end}" for end in ("material of the touch", "relief of the touch", "layout kept")
    ],
    "x-to-touch": [
        *(f"photo to touch: {end}" for end in ("material", "grain within 20", "contact within material")),
        *(f"{source} to touch: material" for source in ("caption", "word", "sound")),
    ],
    "touch-to-text": [f"answer: {end}" for end in ("material", "grain", "hard or soft", "contact place", "grasp")],
}
"""Figures on the cards of the built-in pipelines."""

DRAWN = {
    "touch-to-image": "Unseen touches, and below each the picture generated from it, of invented colours.",
    "stylization": "Photos, touches of other materials, and the photos restyled by them.",
    "x-to-touch": "Photos of unseen objects, and below each the touch generated from it.",
}
"""What the picture of a card shows."""


def card_settings(figures: Figures) -> dict[str, dict[str, Any]]:
    """Arguments of `Card` by built-in pipeline; pictures are names of files in the family's `cards`."""
    cards = {}
    for pipeline, names in CARDS.items():
        told = {}
        for name in names:
            row = figures["quality"]["rows"][name]
            controls = (f"{words} {_shown(name, row[key])}" for key, words in CONTROLS.items() if row[key] is not None)
            told[name] = f"{_shown(name, row['value'])} ({', '.join(controls)})"
        cards[pipeline] = {
            "figures": told,
            "data": "The procedural world of touches, pictures, sounds and captions that `unitouch_gen` renders "
            "itself; no recording of a real sensor.",
            "license": "apache-2.0",
            "limits": "It is small and knows a procedural world; of real touches it says little.",
            "pictures": {DRAWN[pipeline]: f"{pipeline}.jpg"} if pipeline in DRAWN else {},
        }
    return cards


# Pages ----------------------------------------------------------------------------------------------------------------

MARKS: dict[str, Callable[[Figures], str]] = {
    "summary": summary_table,
    "scanned summary": scanned_summary,
    "scanned figures": scanned_table,
    "figures": main_table,
    "x-to-touch figures": lambda figures: quality_table(figures, "photo to", "caption to", "word to", "sound to"),
    "style figures": lambda figures: quality_table(figures, "photo as it was", "restyled"),
    "real figures": real_table,
    "answers": answers_table,
    "cost at error": cost_table,
    "four evaluations": turbo_table,
    "settings": settings_table,
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
