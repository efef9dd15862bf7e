"""The README's tables of error against run time; what was not measured is left out of them."""

from collections.abc import Mapping
from typing import Any

from tests.benchmarks import Figures
from tests.benchmarks.tables import percent

MADE = {"touch-to-image": "picture from a touch", "x-to-touch": "touch from a photo"}


def table(head: list[str], rows: list[list[str]]) -> str:
    """In Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def times(ratio: Mapping[str, float]) -> str:
    """ "4.10 times (3.90 to 4.30)"."""
    return f"{ratio['ratio']:.2f} times ({ratio['low']:.2f} to {ratio['high']:.2f})"


def amount_of(run: Mapping[str, Any]) -> str:
    """ "`unipc`, 20 steps"."""
    amount = f"tolerance {run['tolerance']:g}" if run.get("steps") is None else f"{run['steps']} steps"
    return f"`{run['solver']}`, {amount}"


def price_table(figures: Figures) -> str:
    """How many seconds for what error, at the built-in pipelines' own guidance."""
    measured = figures.get("error_and_time", {}).get("effectivity", {})
    pipelines = {name: measured[name] for name in MADE if measured.get(name, {}).get("prices")}
    if not pipelines:
        return ""
    rows = []
    for error in dict.fromkeys(error for each in pipelines.values() for error in each["prices"]):
        cells = [f"at most {percent(float(error))}"]
        for each in pipelines.values():
            price = each["prices"].get(error)
            cells.append(
                "-"
                if price is None
                else f"{price['seconds']:.2f} s ({price['low']:.2f} to {price['high']:.2f}): {amount_of(price)}"
            )
        rows.append(cells)
    head = [f"{MADE[name]}, guidance {each['guidance_scale']:g}" for name, each in pipelines.items()]
    counts = {each["conditions"] for each in pipelines.values()}
    note = (
        f"Median error of the latents over {' and '.join(map(str, sorted(counts)))} held-out contacts, relative to the "
        "exact flow of the network; seconds of denoising one sample, median and range. "
        f"Timings: {figures['error_and_time'].get('machine', 'one machine')}."
    )
    return f"{table(['error', *head], rows)}\n\n{note}"


def gains_table(figures: Figures) -> str:
    """Speed-ups, eliminations, memory and time outside of the networks."""
    rows = [*_speedups(figures), *_eliminations(figures), *_memory(figures), *_overhead(figures)]
    return table(["figure", "what it is", "measured"], rows) if rows else ""


def _speedups(figures: Figures) -> list[list[str]]:
    rows = []
    for name, each in figures.get("error_and_time", {}).get("speedup", {}).items():
        usual, ours = each["usual"], each["ours"]
        compiled = f"; ours compiled {times(each['compiled']['denoising'])}" if "compiled" in each else ""
        rows.append(
            [
                f"{MADE[name]}, as close as DDIM in {usual['steps']} steps at guidance {each['guidance_scale']:g}",
                f"seconds of denoising: {usual['name']} over {amount_of(ours)}",
                f"{times(each['denoising'])}, {usual['denoising']:.2f} s over {ours['denoising']:.2f} s; whole call "
                f"{times(each['whole'])}{compiled}; {each['evaluations']:.1f} times fewer evaluations; errors "
                f"{percent(usual['error'])} there and {percent(ours['error'])} here, medians over "
                f"{each['conditions']} contacts",
            ]
        )
    return rows


def _eliminations(figures: Figures) -> list[list[str]]:
    rows = []
    for name, each in figures.get("error_and_time", {}).get("eliminations", {}).items():
        ratios = "; ".join(f"{batch}: {times(found)}" for batch, found in each.items())
        largest = max(found["difference"] for found in each.values())
        rows.append(
            [
                f"exact eliminations, {MADE[name]}",
                "seconds of the UNet without over with them, by rows of a guided batch",
                f"{ratios}; predictions differ by {largest:.0e} at most",
            ]
        )
    return rows


def _memory(figures: Figures) -> list[list[str]]:
    measured = figures.get("memory", {})
    if "planned" not in measured:  # nothing is known of memory but under Linux
        return []
    planned = measured["planned"]
    others = {"everything": "the whole pipeline's", "family": "the whole family's"}
    shares = "; ".join(
        f"{percent(measured[f'share_of_{case}']['median'])} of {words} {measured[case]['megabytes']:.0f} MB "
        f"(spread {100 * measured[f'share_of_{case}']['spread']:.1f} points)"
        for case, words in others.items()
    )
    return [
        [
            "peak memory of text-to-touch by its plan",
            f"weights in float16, {measured['repeats']} processes each",
            f"{planned['megabytes']:.0f} MB: {shares}; {measured['seconds_in_float16']['ratio']:.2f} times the seconds",
        ]
    ]


def _overhead(figures: Figures) -> list[list[str]]:
    measured = figures.get("overhead")
    if not measured:
        return []
    shares = "; ".join(
        f"{words}: {percent(measured[key]['median'])} (spread {100 * measured[key]['spread']:.1f} points)"
        for key, words in (("touch_to_image", MADE["touch-to-image"]), ("x_to_touch", "touch from words"))
    )
    return [
        [
            "time outside of the networks",
            f"share of a call of {measured['steps']} steps, {measured['repeats']} calls each",
            shares,
        ]
    ]


def orders_table(figures: Figures) -> str:
    """Nominal and fitted orders of the solvers by name."""
    measured = figures.get("error_and_time", {}).get("orders")
    if not measured:
        return ""
    problems = list(dict.fromkeys(problem for each in measured.values() for problem in each["fitted"]))
    rows = []
    for solver, each in measured.items():
        fitted = [each["fitted"].get(problem) for problem in problems]
        rows.append(
            [f"`{solver}`", str(each["nominal"]), *("-" if order is None else f"{order:.2f}" for order in fitted)]
        )
    return table(["solver", "order", *(f"on `{problem}`" for problem in problems)], rows)


def effectivity_table(figures: Figures) -> str:
    """How runs' estimates of their own error compare with true errors, as a histogram."""
    measured = figures.get("error_and_time", {}).get("effectivity")
    if not measured:
        return ""
    shown = {name: each for name, each in measured.items() if each.get("estimates")}
    heads = {"exact": "exact problems", **MADE}
    bins = list(dict.fromkeys(bin_ for each in shown.values() for bin_ in each["histogram"]))
    rows = [
        [bin_, *(percent(each["histogram"].get(bin_, 0) / each["estimates"]) for each in shown.values())]
        for bin_ in bins
    ]
    for bounds in ("0.5 to 2", "0.3 to 3"):
        rows.append([f"**{bounds}**", *(f"**{percent(each[f'within {bounds}'])}**" for each in shown.values())])
    rows.append(["estimates", *(f"{each['estimates']:,}" for each in shown.values())])
    runs = {name: each.get("by_run", {}) for name, each in shown.items()}
    if any(each.get("estimates") for each in runs.values()):
        cells = [
            f"{percent(each['within 0.3 to 3'])} of {each['estimates']}" if each.get("estimates") else "-"
            for each in runs.values()
        ]
        rows.append(["0.3 to 3, medians of whole runs", *cells])
    text = table(["estimate over true error", *(heads[name] for name in shown)], rows) if shown else ""
    without = [heads[name] for name in measured if name not in shown]
    note = f"No calibration is stored for: {', '.join(without)}." if without else ""
    return "\n\n".join(part for part in (text, note) if part)


def stability_text(figures: Figures) -> str:
    """What the stiff and extreme cases and the world's own physics came to."""
    measured = figures.get("error_and_time", {})
    lines = []
    if "stability" in measured:
        each = measured["stability"]
        lines.append(
            f"Of {each['cases']} stiff and extreme cases {each['as_expected']} end as expected; {each['silent']} leave "
            "a value that is silently not finite."
        )
    for problem, each in measured.get("physics", {}).items():
        settings = [
            f"{percent(row['error'])} in {1e3 * row['seconds']:.1f} ms at "
            + (f"{value} Hz" if value.isdigit() else f"{value} its resolution")
            for value, row in each.items()
        ]
        orders = [row["order"] for row in each.values() if row["order"] is not None]
        order = f", which is order {orders[0]:.1f}" if orders else ""
        if settings:
            lines.append(f"What the world renders, {problem}, against a far finer one: {', '.join(settings)}{order}.")
    return "\n\n".join(lines)
