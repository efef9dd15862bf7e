"""`unitouch-gen ask` and `classify`: what touches are, in words."""

import json
from typing import Annotated

from typer import Argument, Option, echo

from unitouch_gen.cli import options
from unitouch_gen.cli.loading import files_of, load_joint_space, load_pipeline


def ask(
    touch: Annotated[str, Argument(help=f"Touch images, or videos: {options.SEVERAL}.")],
    question: Annotated[str, Argument(help="What to ask about each.")],
    model: options.Model = None,
    max_new_tokens: Annotated[int | None, Option(min=1, help="Of an answer; the model's own if left out.")] = None,
    sensor: options.Sensor = None,
    seed: options.Seed = 0,
    dtype: options.Dtype = None,
    device: options.Device = "auto",
    as_json: options.AsJson = False,
) -> None:
    """Answers a question about each touch.

    Example: unitouch-gen ask example:brick "How does it feel?"
    """
    touches = files_of("touch", [touch], "touch")
    pipe = load_pipeline("touch-to-text", model=model, dtype=dtype, device=device)
    import torch

    answers = []
    for file in touches:
        generator = torch.Generator().manual_seed(seed)
        output = pipe(file, question, sensor=sensor, max_new_tokens=max_new_tokens, generator=generator)
        answers.append({"touch": str(file), "answer": output.texts[0], "report": output.report.to_dict()})
        if not as_json:
            echo((f"{file.name}: " if len(touches) > 1 else "") + output.texts[0])
    if as_json:
        echo(json.dumps({"question": question, "touches": answers}))


def classify(
    touch: options.Touches,
    labels: Annotated[str | None, Option(help="By comma; the world's materials if left out.")] = None,
    template: Annotated[str, Option(help="What a label is put into, at {}.")] = "this feels like {}",
    sensor: options.Sensor = None,
    top: Annotated[int, Option(min=1, help="How many labels are printed for each.")] = 3,
    model: Annotated[str | None, Option(help=f"{options.A_FOLDER} a joint space or pipeline; or built-in.")] = None,
    device: options.Device = "auto",
    as_json: options.AsJson = False,
) -> None:
    """Says what each touch is most likely of, zero-shot, or that the model does not know it.

    Example: unitouch-gen classify example:brick example:wood --labels brick,wood,grass
    """
    touches = files_of("touch", touch, "touch")
    from unitouch_gen.evaluation.zero_shot import ZeroShotTouchClassifier  # takes seconds, a mistake should not
    from unitouch_gen.world import MATERIAL_NAMES

    classifier = ZeroShotTouchClassifier(*load_joint_space(model, device))
    names = options.by_comma(labels) or MATERIAL_NAMES
    found = {file: classifier(file, names, template, sensor=sensor, top=top)[0] for file in touches}
    if as_json:
        rows = [{"touch": str(file), "labels": one, "unknown": one.unknown} for file, one in found.items()]
        echo(json.dumps({"touches": rows}))
        return
    options.print_table(
        ["touch", template.replace("{}", "...")], [[file.name, str(one)] for file, one in found.items()]
    )
    echo("A percentage is how sure the model is among these labels, not how often it is right.")
