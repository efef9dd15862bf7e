"""`unitouch-gen ask` and `classify`: answers about touches, and their classes."""

import json
from typing import Annotated

from typer import Argument, Option, echo

from unitouch_gen.cli import options
from unitouch_gen.cli.loading import files_of, load_joint_space, load_pipeline


def ask(
    touch: Annotated[str, Argument(help=f"Touch images, or videos: {options.SEVERAL}.")],
    question: Annotated[str, Argument(help="A question about each touch.")],
    model: options.Model = None,
    max_new_tokens: Annotated[
        int | None, Option(min=1, help="Longest answer, tokens; the model's own if left out.")
    ] = None,
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
            name = f"{file.name}: " if len(touches) > 1 else ""
            echo(name + output.texts[0])
    if as_json:
        echo(json.dumps({"question": question, "touches": answers}))


def classify(
    touch: options.Touches,
    labels: Annotated[str | None, Option(help="Labels by comma; the world's materials if left out.")] = None,
    template: Annotated[str, Option(help="Prompt with {} for the label.")] = "this feels like {}",
    sensor: options.Sensor = None,
    top: Annotated[int, Option(min=1, help="Number of labels to print for each touch.")] = 3,
    model: Annotated[str | None, Option(help=f"{options.A_FOLDER} a joint space or pipeline; or built-in.")] = None,
    device: options.Device = "auto",
    as_json: options.AsJson = False,
) -> None:
    """Classifies each touch zero-shot, or says that it is unlike anything the model knows.

    Example: unitouch-gen classify example:brick example:wood --labels brick,wood,grass
    """
    touches = files_of("touch", touch, "touch")
    from unitouch_gen.evaluation.zero_shot import ZeroShotTouchClassifier  # slow to import, so after the checks
    from unitouch_gen.world import MATERIAL_NAMES

    classifier = ZeroShotTouchClassifier(*load_joint_space(model, device))
    names = options.by_comma(labels) or MATERIAL_NAMES
    results = {file: classifier(file, names, template, sensor=sensor, top=top)[0] for file in touches}
    if as_json:
        rows = [{"touch": str(file), "labels": named, "unknown": named.unknown} for file, named in results.items()]
        echo(json.dumps({"touches": rows}))
        return
    columns = ["touch", template.replace("{}", "...")]
    options.print_table(columns, [[file.name, str(named)] for file, named in results.items()])
    echo("A percentage is how sure the model is among these labels, not how often it is right.")
