"""`unitouch-gen classify`: what touches are of, by any labels in words."""

import json
from typing import Annotated

from typer import Option, echo

from unitouch_gen.cli import options
from unitouch_gen.cli.loading import files_of, load_joint_space


def classify(
    touch: options.Touches,
    labels: Annotated[str | None, Option(help="By comma; the world's materials if left out.")] = None,
    template: Annotated[str, Option(help="What a label is put into, at {}.")] = "this feels like {}",
    sensor: options.Sensor = None,
    top: Annotated[int, Option(min=1, help="How many labels are printed for each.")] = 3,
    model: Annotated[str | None, Option(help=f"{options.A_FOLDER} a joint space or pipeline; or built-in.")] = None,
    device: options.Device = "auto", as_json: options.AsJson = False,
) -> None:  # fmt: skip
    """Says what each touch is most likely of, zero-shot, or that the model does not know it.

    Example: unitouch-gen classify example:brick example:wood --labels brick,wood,grass
    """
    touches = files_of("touch", touch, "touch")
    from unitouch_gen.evaluation.zero_shot import ZeroShotTouchClassifier  # takes seconds, a mistake should not
    from unitouch_gen.world import MATERIAL_NAMES

    joint, processor = load_joint_space(model, device)
    classifier = ZeroShotTouchClassifier(joint, processor)
    names = MATERIAL_NAMES if labels is None else [name.strip() for name in labels.split(",")]
    found = {file: classifier(file, names, template, sensor=sensor, top=top)[0] for file in touches}
    if as_json:
        rows = [{"touch": str(file), "labels": one, "unknown": one.unknown} for file, one in found.items()]
        echo(json.dumps({"touches": rows}))
        return
    table = [[file.name, str(one)] for file, one in found.items()]
    options.print_table(["touch", template.replace("{}", "...")], table)
    echo("A percentage is how sure the model is among these labels, not how often it is right.")
