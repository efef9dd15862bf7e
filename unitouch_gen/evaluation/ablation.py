"""Table 8 of the paper and its parameter sigma: small touch encoders trained alike, but for what is asked about.

Whether a claim of the paper holds here is counted over seeds and said below the table.
"""

from collections.abc import Mapping, Sequence
from statistics import mean

from unitouch_gen.evaluation.classification import Embed, labelled, named
from unitouch_gen.evaluation.contacts import EvaluationSet
from unitouch_gen.evaluation.controls import others
from unitouch_gen.evaluation.probing import share_right
from unitouch_gen.evaluation.retrieval import mean_average_precision
from unitouch_gen.evaluation.tables import Table
from unitouch_gen.evaluation.zero_shot import PROMPTS

CHANCE = "chance"
ONE, ALL = "baseline, one data set", "baseline, all"
TOKENS, SAMPLING, BOTH = "baseline, all + sensor tokens", "baseline, all + sampling", "all + tokens + sampling"

PAPERS_SIGMA = "sigma = 0.75"

CLAIMS = {
    "Without tokens and sampling, one data set is better than all": (ONE, ALL),
    "Sensor tokens help": (TOKENS, ALL),
    "Sampling within data sets helps": (SAMPLING, ALL),
    "Both are better than tokens alone": (BOTH, TOKENS),
    "Both are better than sampling alone": (BOTH, SAMPLING),
    "With both, all data sets are better than one": (BOTH, ONE),
}
"""The paper's claims: the first row is better than the second."""

PAPER = {
    "ablation": {
        name: {"Touch and Go": value}
        for name, value in {CHANCE: 16.7, ONE: 43.1, ALL: 21.4, TOKENS: 38.1, SAMPLING: 40.3, BOTH: 52.7}.items()
    },
    "sigma": {PAPERS_SIGMA: {"Touch and Go": 52.7}},
}


def ablation_table(sets: Sequence[EvaluationSet], rows: Sequence[str], embed: Embed, steps: int) -> Table:
    """Table 8: what sensor tokens and sampling are worth.

    Args:
        sets: Of one or several seeds, with the features of small encoders.
        rows: Names of these features, which become those of rows.
        embed: Of texts in the joint space.
        steps: That each was trained for.
    """
    figures = figures_of(sets, rows, embed)
    return Table(
        "ablation", "Sensor tokens and sampling (Table 8)", "%", columns_of(figures), figures,
        notes=[_trained_for(steps), *claims(figures, columns_of(figures))], paper=PAPER["ablation"],
        beside={BOTH: [row for row in figures if row != BOTH]},
    )  # fmt: skip


def sigma_table(sets: Sequence[EvaluationSet], rows: Sequence[str], embed: Embed, steps: int) -> Table:
    """The share of a batch that is of one data set, with sensor tokens; see `ablation_table`."""
    figures = figures_of(sets, rows, embed)
    columns = columns_of(figures)
    notes = [_trained_for(steps), *(_best(figures, column) for column in columns)]
    return Table(
        "sigma", "The share of a batch from one data set (sigma)", "%", columns, figures, notes=notes,
        paper=PAPER["sigma"], beside={PAPERS_SIGMA: [row for row in figures if row != PAPERS_SIGMA]},
    )  # fmt: skip


def _trained_for(steps: int) -> str:
    return f"Small encoders, each trained for {steps} steps by the paper's loss alone: they compare with each other."


def figures_of(sets: Sequence[EvaluationSet], rows: Sequence[str], embed: Embed) -> dict[str, dict[str, list[float]]]:
    """Materials named right, zero-shot, and mean average precision of pictures, by row and column, for each seed.

    Columns are of the first sensor that training knew, of all of these, and of others; a seed's figure is the mean over
    its sets.
    """
    figures: dict[str, dict[str, list[float]]] = {}
    for seed in dict.fromkeys(one.seed for one in sets):
        found: dict[str, dict[str, list[float]]] = {}
        for one in (one for one in sets if one.seed == seed):
            test, material = labelled(one, "test", "material")
            classes = embed([PROMPTS["touch"].format(name) for name in one.classes["material"]])
            pictures = test.features["image"]
            first_known = next((other.name for other in sets if other.known), None)
            groups = ["all known sensors"] if one.known else ["sensors drawn anew"]
            groups = [one.name, *groups] if one.name == first_known else groups
            first = test.features[rows[0]]
            shown = {CHANCE: first[others(len(first))], **{row: test.features[row] for row in rows}}
            for row, features in shown.items():
                right = share_right(named(features, classes, material), material)
                if row == CHANCE:
                    right = 1 / len(material.unique())
                precision = mean_average_precision(features, pictures, test.objects, test.objects)
                for group in groups:
                    found.setdefault(row, {}).setdefault(f"material, {group}", []).append(100.0 * right)
                    found[row].setdefault(f"picture found, {group}", []).append(100.0 * precision)
        for row, columns in found.items():
            for column, values in columns.items():
                figures.setdefault(row, {}).setdefault(column, []).append(mean(values))
    return figures


def columns_of(figures: Mapping[str, Mapping[str, Sequence[float]]]) -> dict[str, str]:
    """Columns of materials, then those of pictures."""
    names = next(iter(figures.values()))
    return dict.fromkeys(sorted(names, key=lambda name: not name.startswith("material")), "")


def claims(figures: Mapping[str, Mapping[str, Sequence[float]]], columns: Mapping[str, str]) -> list[str]:
    """For each claim of the paper, in which columns it holds in every seed, and in which it does not."""
    notes = []
    for claim, (better, worse) in CLAIMS.items():
        held, open_ = list[str](), list[str]()
        for column in columns:
            pairs = list(zip(figures[better][column], figures[worse][column], strict=True))
            says = f"{column} {mean(a for a, _ in pairs):.1f} against {mean(b for _, b in pairs):.1f}"
            (held if all(a > b for a, b in pairs) else open_).append(says)
        parts = [f"holds in every seed for {', '.join(held)}"] if held else []
        parts += [f"does not hold in every seed for {', '.join(open_)}"] if open_ else []
        notes.append(f"{claim}: {'; '.join(parts)}.")
    return notes


def _best(figures: Mapping[str, Mapping[str, Sequence[float]]], column: str) -> str:
    means = {row: mean(columns[column]) for row, columns in figures.items() if row != CHANCE}
    best = max(means, key=lambda row: means[row])
    spread = max(max(figures[row][column]) - min(figures[row][column]) for row in means)
    least = min(means.values())
    within = "which is within" if means[best] - least <= spread else "beyond"
    return (
        f"{column}: {best} is best here, {means[best]:.1f} against {least:.1f} at worst, {within} the spread over "
        f"seeds, {spread:.1f}; the paper takes 0.75."
    )
