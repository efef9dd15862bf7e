"""What README.md and docs/ say of the figures, between two comments of a name, such as `<!-- orders -->`."""

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


def times(ratio: Mapping[str, float]) -> str:
    """ "4.10 times (3.90 to 4.30)"."""
    return f"{ratio['ratio']:.2f} times ({ratio['low']:.2f} to {ratio['high']:.2f})"


def with_spread(share: Mapping[str, float]) -> str:
    """ "25.0 % (spread 1.0 points)"."""
    return f"{percent(share['median'])} (spread {100 * share['spread']:.1f} points)"


# Quality --------------------------------------------------------------------------------------------------------------


SHARES = ("calibration error", "material", "within material", "its own picture", "as its touch", "within 20")
"""Ends of the names of figures that are shares; others are correlations, angles and distances."""

CONTROLS = {"class_mean": "class mean", "shuffled": "shuffled", "ceiling": "reference"}


def _shown(name: str, value: float | None) -> str:
    if value is None:
        return "-"
    if name.endswith(SHARES):
        return percent(value)
    return f"{value:.0f}°" if name.endswith("degrees") else f"{value:.2f}"


def quality_table(figures: Figures, beginnings: tuple[str, ...]) -> str:
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
    "scan: touch to its own picture": "the picture of a touch, among 64 of scanned materials held out",
    "touch to picture: contact within material": "touch to picture: the contact, among 50 of its material",
    "photo to touch: contact within material": "photo to touch: the same",
    "caption to touch: contact within material": "caption to touch: the same",
    "sound to touch: contact within material": "sound to touch: the same",
    "scan, photo to touch: fine relief": "photo of a scanned material to touch: fine relief",
}
"""What README.md shows, in its words."""


def summary_table(figures: Figures) -> str:
    """A few figures beside their controls, and what is read off real touches."""
    rows = []
    for name, words in SUMMARY.items():
        row = figures["quality"]["rows"][name]
        rows.append([words, *(_shown(name, row[key]) for key in ("value", *CONTROLS))])
    head = ["objects and scans held out; sensors too, but for touches that are made", "measured", *CONTROLS.values()]
    return table(head, rows, _real_sentence(figures))


def _real_sentence(figures: Figures) -> str:
    real = figures["quality"]["real"]["recordings"]
    said = {name: percent(of["mean"]) for name, of in real.items() if "mean" in of}
    low, high = (percent(real["untrained"][bound]) for bound in ("least", "most"))
    return (
        "Of recordings of a real GelSight, which the built-in models have never seen, a linear probe reads hardness, "
        f"roughness and bumps right in {said['touch encoder']} by the touch encoder, in {said['statistics']} by plain "
        f"statistics of the image and in {said['statistics of the relief']} by those of the relief, which need no "
        f"encoder, in {said['untrained']} by the same encoder untrained (mean of five, {low} to {high}), and in "
        f"{said['untouched gel']} by the untouched gel of each clip; chance is {percent(1 / 3)} (balanced accuracy), "
        f"and draws of objects deviate by {100 * real['touch encoder']['deviation']:.1f} points."
    )


def main_table(figures: Figures) -> str:
    """What the joint space and pictures from touches are worth, and seconds."""
    measured = figures["quality"]
    note = (
        f"Means over {len(measured['seeds'])} worlds, and the largest less the least of each. Chance of a material is "
        f"{percent(1 / len(MATERIAL_NAMES))}, and so is naming all alike, as all come equally often. One "
        f"picture takes {figures['speed']['seconds_per_picture']:.2f} s after "
        f"loading; {figures['world']['samples_per_second']:.0f} full samples of the world, under two drawn sensors, "
        f"are rendered a second by two processes ({figures['speed']['machine']})."
    )
    shown = ("touch: ", "image: ", "audio: ", "touch to ", "touch, read", "scan: ")
    return f"{quality_table(figures, shown)}\n\n{note}"


def x_to_touch_table(figures: Figures) -> str:
    """What touches of photos, captions and sounds are worth."""
    return quality_table(figures, ("photo to", "caption to", "sound to", "scan, photo"))


def style_table(figures: Figures) -> str:
    """What restyled photos keep of the photo, and take of the touch."""
    return quality_table(figures, ("photo as it was", "restyled"))


REAL_ROWS = {
    "touch encoder": "the touch encoder",
    "untrained": "the same encoder, untrained: means of five",
    "statistics": "22 plain statistics of the image",
    "statistics of the relief": "... of the [relief](#the-relief-behind-a-touch)",
    "untouched gel": "the untouched gel of each clip",
}


def real_table(figures: Figures) -> str:
    """What is read off real touches, beside what needs no encoder."""
    real = figures["quality"]["real"]
    objects, balls = real["recordings"], real["ball presses"]
    rows = []
    for key, words in REAL_ROWS.items():
        ball = balls.get(key, {}).get("place")
        rows.append(
            [
                words,
                f"{percent(objects[key]['mean'])} ± {100 * objects[key]['deviation']:.1f}",
                *(percent(objects[key][name]) for name in ("hardness", "roughness", "bumps")),
                "-" if ball is None else f"{ball:.2f}",
            ]
        )
    low, high = (percent(objects["untrained"][bound]) for bound in ("least", "most"))
    head = ["read linearly off", "mean of three", "hardness", "roughness", "bumps", "place of a ball, R²"]
    note = (
        f"{objects['of']['touches']} touches of {objects['of']['objects']} objects by a GelSight, balanced accuracy of "
        f"three classes each, chance {percent(1 / 3)}; ± is the deviation over draws of objects. "
        f"{balls['of']['touches']} presses of balls into another one, chance 0. Each object, and each ball, is "
        f"predicted from the others. Five untrained encoders are drawn; one alone has {low} to {high}."
    )
    return table(head, rows, note)


# Error and time -------------------------------------------------------------------------------------------------------


def _amount(run: Mapping[str, Any]) -> str:
    """ "`unipc`, 20 steps"."""
    return f"`{run['solver']}`, {run['steps']} steps"


def cost_table(figures: Figures) -> str:
    """How many steps for what error, at the built-in pipelines' own guidance."""
    pipelines = {name: figures["error_and_time"]["cost"][name] for name in MADE}
    rows = []
    for error in dict.fromkeys(error for each in pipelines.values() for error in each["cost_at_error"]):
        runs = [each["cost_at_error"].get(error) for each in pipelines.values()]
        rows.append([f"at most {percent(float(error))}", *(_amount(run) if run else "-" for run in runs)])
    heads = [f"{MADE[name]}, guidance {each['guidance_scale']:g}" for name, each in pipelines.items()]
    counts = sorted({each["conditions"] for each in pipelines.values()})
    note = (
        f"Median error of the latents over {' and '.join(map(str, counts))} samples of held-out contacts, relative to "
        "the exact flow of the network; the fewest steps of `unipc`, `dpm++2m` and `deis`."
    )
    return table(["error", *heads], rows, note)


def gains_table(figures: Figures) -> str:
    """Speed-ups and time outside of the networks."""
    rows = []
    for name, each in figures["error_and_time"]["speedup"].items():
        baseline, ours = each["baseline"], each["ours"]
        compiled = f"; ours compiled {times(each['compiled']['denoising'])}" if "compiled" in each else ""
        rows.append(
            (
                f"{MADE[name]}, as close as DDIM in {baseline['steps']} steps at guidance {each['guidance_scale']:g}",
                f"seconds of denoising: {baseline['name']} over {_amount(ours)}",
                f"{times(each['denoising'])}, {baseline['denoising']:.2f} s over {ours['denoising']:.2f} s; whole call "
                f"{times(each['whole'])}{compiled}; {each['evaluations']:.1f} times fewer evaluations; errors "
                f"{percent(baseline['error'])} there and {percent(ours['error'])} here, medians over "
                f"{each['conditions']} contacts",
            )
        )
    overhead = figures["overhead"]
    rows.append(
        (
            "time outside of the networks",
            f"share of a call of {overhead['steps']} steps, {overhead['repeats']} calls each",
            f"{MADE['touch-to-image']}: {with_spread(overhead['touch_to_image'])}; touch from words: "
            f"{with_spread(overhead['x_to_touch'])}",
        )
    )
    return table(["figure", "what it is", "measured"], rows)


def orders_table(figures: Figures) -> str:
    """Nominal and fitted orders of the solvers by name."""
    measured = figures["error_and_time"]["orders"]
    problems = list(dict.fromkeys(problem for each in measured.values() for problem in each["fitted"]))
    rows = []
    for solver, each in measured.items():
        fitted = [each["fitted"].get(problem) for problem in problems]
        cells = ["-" if order is None else f"{order:.2f}" for order in fitted]
        rows.append([f"`{solver}`", str(each["nominal"]), *cells])
    return table(["solver", "order", *(f"on `{problem}`" for problem in problems)], rows)


def physics_text(figures: Figures) -> str:
    """Errors of the world's own physics, and what they cost."""
    lines = []
    for problem, each in figures["error_and_time"]["physics"].items():
        settings = [
            f"{percent(row['error'])} in {1e3 * row['seconds']:.1f} ms at "
            + (f"{value} Hz" if value.isdigit() else f"{value} its resolution")
            for value, row in each.items()
        ]
        order = next(iter(each.values()))["order"]
        lines.append(
            f"What the world renders, {problem}, against a far finer one: {', '.join(settings)}, which is order "
            f"{order:.1f}."
        )
    return "\n\n".join(lines)


def calibration_table(figures: Figures) -> str:
    """What the calibrated sensors leave of real ones' tables and ball presses, beside their controls."""
    measured = figures["calibration"]
    rows = []
    for name, each in measured["tables"].items():
        left = [f"{percent(each[what]['held_out']['share'])}" for what in ("no change", "guessed")]
        ours = each["calibrated"]
        cells = [f"{percent(ours[part]['share'])} ({ours[part]['grey_levels']:.1f})" for part in ("fitted", "held_out")]
        rows.append([f"`{name}`", *left, *cells])
    balls = measured["balls"]
    said = {
        what: f"{percent(balls[what]['share'])} of what the ball changes ({balls[what]['grey_levels']:.1f} grey "
        f"levels, correlation {round(balls[what]['correlation'], 2) + 0.0:.2f})"
        for what in ("calibrated", "guessed", "table")
    }
    note = (
        f"On {balls['held_out_frames']} held-out frames of a ball pressed into ObjectFolder's GelSight, the picture "
        f"errs by {said['calibrated']}; where the table itself colours the same gel, by {said['table']}; with a "
        f"sensor with plausible numbers in its place, by {said['guessed']}."
    )
    head = ["sensor", "no change", "guessed", "calibrated, fitted bins", "calibrated, held-out bins"]
    return table(head, rows, note)


# The published size ---------------------------------------------------------------------------------------------------


def published_table(figures: Figures) -> str:
    """What the published size takes."""
    measured = figures["published"]
    conversion, encoder = measured["conversion"], measured["touch_encoder"]
    largest = max(conversion["megabytes_of_files"].values()) / 1e3
    parameters = sum(conversion["parameters"].values()) / 1e9
    rows = [
        (
            f"{words} both files, {parameters:.2f} billion parameters",
            f"{conversion[way]['seconds']:.0f} s; memory at most {conversion[way]['share_of_largest']:.2f} times the "
            f"larger file ({largest:.2f} GB)",
        )
        for way, words in (("conversion", "converting"), ("reading", "reading into memory"))
    ]
    ours, plain = (percent(encoder["relative_error"][f"{whose}_bfloat16"]) for whose in ("ours", "plain"))
    beside = times(encoder["times_as_fast"]["bfloat16_of_plain_bfloat16"])
    errors = {
        "float32": "",
        "bfloat16": f"; of that network in bfloat16 {beside}; embeddings err by {ours}, that network's by {plain}",
    }
    rows += [
        (
            f"touches a second in {dtype}, of the touch encoder in `nn.MultiheadAttention` and float32",
            f"{times(encoder['times_as_fast'][dtype])}{error}",
        )
        for dtype, error in errors.items()
    ]
    for dtype, seen in measured["touch_to_image"].items():
        if not seen:  # the system does not say how much memory is held
            continue
        ours, theirs, steps = seen["ours"], seen["diffusers"], seen["share_of_seconds_a_step"]
        rows += [
            (
                f"768 x 768 from a touch in {dtype} with `low_memory`, peak memory, of diffusers' own pipeline",
                f"{with_spread(seen['share_of_megabytes'])}: {ours['megabytes']['median'] / 1e3:.2f} of "
                f"{theirs['megabytes']['median'] / 1e3:.2f} GB",
            ),
            (
                "... seconds a step, both branches of guidance",
                f"{ours['seconds_a_step']['median']:.1f}, {steps['median']:.2f} times as many (spread "
                f"{steps['spread']:.2f})",
            ),
        ]
    return table(["at the published size", "measured"], rows, f"Random weights; {measured['machine']}.")


# Where they stand -----------------------------------------------------------------------------------------------------


def input_text(figures: Figures) -> str:
    """How fast touches come in, against how fast they are learned from."""
    found = figures["training"]
    memory = found["memory"]
    return (
        f"What lies decoded on the disk is read and augmented {times(found['from_disk'])} as fast as the\ntiny touch "
        f"encoder learns from it, and frames of 640 x 480 decoded at every step {times(found['decoded'])},\ncore by "
        f"core ({found['machine']}). In the trainer a step takes\n{times(found['trainer']['times_as_long'])} as long "
        f"as in a bare loop, and from step {memory['from']} to {memory['steps']} memory grows by "
        f"{100 * memory['growth']:.1f} %."
    )


def adapt_table(figures: Figures) -> str:
    """What a sensor adapted to recordings of real ones gains, beside controls."""
    gelsight = "hardness, roughness and bumps of {objects} objects, learned from touches of others "
    gelsight += "without labels (GelSight)"
    digit = "nearest other touch is of the same part, of {touches} held-out touches of {parts} parts (DIGIT)"
    rows = (("gelsight_objects", gelsight, "untouched gel"), ("digit_parts", digit, None))
    lines = ["| | before | after | beside it |", "|---|---|---|---|"]
    for key, what, background in rows:
        found = figures["adapt"][key]

        def share(name: str, found: Figures = found) -> str:
            return f"{100 * found[name]['mean']:.1f} %"

        beside = [f"image statistics {share('statistics')}", f"an untrained encoder {share('untrained')}"]
        beside += [f"{background} {share('background')}"] if background else []
        beside += [f"chance {100 * found['chance']:.1f} %"]
        lines.append(f"| {what.format(**found)} | {share('before')} | {share('after')} | {', '.join(beside)} |")
    return "\n".join(lines)


MARKS: dict[str, Callable[[Figures], str]] = {
    "summary": summary_table,
    "figures": main_table,
    "x-to-touch figures": x_to_touch_table,
    "style figures": style_table,
    "real figures": real_table,
    "cost at error": cost_table,
    "gains": gains_table,
    "orders": orders_table,
    "physics": physics_text,
    "calibration figures": calibration_table,
    "published figures": published_table,
    "input speed": input_text,
    "adapt figures": adapt_table,
}
"""What stands between two comments of that name, on one page."""


def pages(root: Path = ROOT) -> list[Path]:
    """README.md and the pages of docs/."""
    return [root / "README.md", *sorted((root / "docs").rglob("*.md"))]


def write_pages(figures: Figures, root: Path = ROOT) -> None:
    """Writes the figures between their marks, wherever these are.

    Raises:
        ValueError: If a pair of marks is nowhere, or there are several; nothing is written then.
    """
    texts = {page: page.read_text(encoding="utf-8") for page in pages(root)}
    for mark, content in MARKS.items():
        comment = f"<!-- {mark} -->"
        found = [page for page, text in texts.items() for _ in range(text.count(comment))]
        if len(found) != 2 or len(set(found)) != 1:
            where = ", ".join(str(page.relative_to(root)) for page in found) or "no page"
            raise ValueError(f"{comment} has to stand before and after its figures on one page; it is on {where}.")
        before, _, after = texts[found[0]].split(comment)
        texts[found[0]] = f"{before}{comment}\n{content(figures)}\n{comment}{after}"
    for page, text in texts.items():
        write_file("page", page, text)
