"""`unitouch-gen ask`: questions about touches, in words."""

import json
from typing import Annotated, Any

from typer import Argument, Option, echo

from unitouch_gen.cli import options
from unitouch_gen.cli.loading import files_of, load_pipeline
from unitouch_gen.errors import InvalidInputError


def ask(
    touch: Annotated[str, Argument(help=f"Touch images, or videos: {options.SEVERAL}.")],
    question: Annotated[str, Argument(help="What to ask about each.")],
    model: Annotated[str | None, Option(help=f"{options.A_FOLDER} a saved pipeline; or built-in.")] = None,
    stream: Annotated[bool, Option("--stream", metavar="", help="Print words as they are found.")] = False,
    max_new_tokens: Annotated[int | None, Option(min=1, help="Of an answer; the model's own if left out.")] = None,
    sensor: options.Sensor = None, seed: options.Seed = 0, dtype: options.Dtype = None,
    device: options.Device = "auto", as_json: options.AsJson = False,
) -> None:  # fmt: skip
    """Answers a question about each touch.

    Example: unitouch-gen ask example:brick "How does it feel?"
    """
    if stream and as_json:
        raise InvalidInputError("`--stream` prints words as they come, which is no JSON; leave out one of them.")
    touches = files_of("touch", [touch], "touch")
    pipe = load_pipeline("touch-to-text", model=model, dtype=dtype, device=device)
    import torch
    from transformers import TextStreamer

    answers, given = list[dict[str, Any]](), dict[str, Any](sensor=sensor, max_new_tokens=max_new_tokens)
    if stream:
        given["streamer"] = TextStreamer(pipe.tokenizer, skip_prompt=True, skip_special_tokens=True)
    for file in touches:
        name = f"{file.name}: " if len(touches) > 1 else ""
        if stream:
            echo(name, nl=False)
        output = pipe(file, question, generator=torch.Generator().manual_seed(seed), **given)
        answers.append({"touch": str(file), "answer": output.texts[0], "report": output.report.to_dict()})
        if not (stream or as_json):
            echo(name + output.texts[0])
    if as_json:
        echo(json.dumps({"question": question, "touches": answers}))
