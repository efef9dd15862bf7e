"""`unitouch-gen classify`: what touches are of, by any labels in words."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from unitouch_gen.cli import options
from unitouch_gen.cli.loading import load_classifier
from unitouch_gen.cli.pictures import check_inputs, files_of, shown


def classify(
    touch: options.Touches,
    labels: Annotated[
        str | None, typer.Option(help="What they may be of, by comma; the world's seventeen materials if left out.")
    ] = None,
    template: Annotated[str, typer.Option(help="What a label is put into, at {}.")] = "this feels like {}",
    sensor: options.Sensor = None,
    top: Annotated[int, typer.Option(help="How many labels are told of each.")] = 3,
    model: Annotated[
        str | None,
        typer.Option(help="Folder or repository id of a joint space or a saved pipeline; built-in if left out."),
    ] = None,
    device: options.Device = "auto",
    as_json: options.AsJson = False,
) -> None:
    """Says what each touch is most likely of, zero-shot, or that the model does not know it.

    Example: unitouch-gen classify example:brick example:wood --labels brick,wood,grass
    """
    from unitouch_gen.errors import check_integer

    check_integer("--top", top, 1, options.MOST)
    touches = files_of("touch", touch, "touch")
    from unitouch_gen.evaluation.zero_shot import check_labels  # takes seconds, a mistake should not
    from unitouch_gen.world import MATERIAL_NAMES

    given = list(MATERIAL_NAMES) if labels is None else [name.strip() for name in labels.split(",")]
    names = check_labels(given, template)
    check_inputs("touch", touches)
    classifier = load_classifier(model, device)
    rows: list[dict[str, Any]] = []
    for file in touches:  # one by one, as they may be of several sizes
        [named] = classifier(file, names, template, sensor=sensor, top=top)
        rows.append({"touch": shown(file), "labels": named, "unknown": named.unknown})
    if as_json:
        typer.echo(json.dumps({"touches": rows}))
        return
    options.print_table(
        ["touch", template.replace("{}", "...")], [[Path(row["touch"]).name, str(row["labels"])] for row in rows]
    )
    kept = "calibrated on" if classifier.calibrated else "not calibrated, even on"
    typer.echo(
        f"A percentage is how sure the model is among these labels, {kept} touches like those it was trained on."
    )
