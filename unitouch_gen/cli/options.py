"""Options that several commands share."""

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from unitouch_gen.errors import InvalidInputError, check_device, check_dtype

Touches = Annotated[list[Path], typer.Argument(help="Touch images; one picture is made for each.")]
Output = Annotated[Path, typer.Option("--output", "-o", help="A folder, or a file name for a single picture.")]
Prompt = Annotated[str | None, typer.Option(help="What else the picture should be.")]
Steps = Annotated[int | None, typer.Option(help="Number of solver steps; the checkpoint's own if left out.")]
SolverName = Annotated[
    str | None,
    typer.Option("--solver", help="Name of the solver, such as ddim or dpm++2m; the checkpoint's own if left out."),
]
Tolerance = Annotated[
    float | None, typer.Option(help="Relative error of the latents to keep to, in place of --steps and --solver.")
]
GuidanceScale = Annotated[
    float | None, typer.Option(help="Scale of classifier-free guidance, on above 1; the checkpoint's own if left out.")
]
Seed = Annotated[int, typer.Option(help="Seed of the noise; the same one makes the same pictures.")]
Sensor = Annotated[
    str | None, typer.Option(help="Name of the sensor that took the touches; found by their looks if left out.")
]
Background = Annotated[
    Path | None, typer.Option(help="Picture of the sensor untouched, to re-centre one that the model does not know.")
]
LoadSensor = Annotated[
    list[Path] | None,
    typer.Option(help="File of a sensor that `unitouch-gen adapt` wrote, to know it too; may be repeated."),
]
Model = Annotated[str | None, typer.Option(help="Folder or repository id of a saved pipeline; built-in if left out.")]
Dtype = Annotated[
    str | None, typer.Option(help="Dtype of the networks: float32, float16, bfloat16 or float64; float32 if left out.")
]
Device = Annotated[
    str, typer.Option(help="Where the networks run: cpu, cuda, cuda:1 or such; auto is a GPU where torch finds one.")
]
BatchSize = Annotated[int, typer.Option(help="Pictures in work at once; fewer take less memory.")]
AsJson = Annotated[bool, typer.Option("--json", metavar="", help="Print one JSON object instead of text.")]

OTHER_NAMES = {
    "`num_inference_steps`": "`--steps`",
    "`guidance_scale`": "`--guidance`",
    "`num_candidates`": "`--candidates`",
    "`source_sensor`": "`--source-sensor`",
    "`file`": "`--load-sensor`",
    **{f"`{name}`": f"`--{name}`" for name in ("imagebind", "tokenizer", "ldm", "config")},
}
"""Options of the arguments that pipelines know under other names."""


def dtype_of(name: str | None) -> Any:
    """The torch.dtype of a name, or `None` for none.

    Raises:
        InvalidInputError: If weights have none of that name.
    """
    return None if name is None else check_dtype("dtype", name)


def device_of(name: str) -> Any:
    """The torch.device of a name, or what there is for "auto".

    Raises:
        InvalidInputError: If torch finds none of that name, or it holds no numbers.
    """
    import torch

    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    device = check_device("--device", name)
    if device.type == "meta":
        raise InvalidInputError("`--device` is 'meta', which holds no numbers; pass cpu or cuda, or leave it out.")
    return device


def is_quiet(as_json: bool) -> bool:
    """Whether progress bars would be in the way."""
    return as_json or not sys.stderr.isatty()


def note(message: str) -> None:
    """A line on standard error, as those of warnings and errors."""
    print(f"unitouch-gen: {message}", file=sys.stderr)


def print_table(columns: list[str], rows: list[list[str]]) -> None:
    """A table as wide as the terminal."""
    from rich.console import Console
    from rich.table import Table

    table = Table(*columns)
    for row in rows:
        table.add_row(*row)
    Console(width=None if sys.stdout.isatty() else 120).print(table)


def as_options(message: str) -> str:
    """A message that names options as the command line does."""
    for argument, option in OTHER_NAMES.items():
        message = message.replace(argument, option)
    return message
