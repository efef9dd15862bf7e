"""Options that commands share, named after the arguments of the pipelines' calls, and output of commands."""

import inspect
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Context, Option

from unitouch_gen.errors import InvalidInputError, check_choice
from unitouch_gen.files import check_writable

SETTABLE = (
    "bridge",
    "eta",
    "guidance_scale",
    "height",
    "init_strength",
    "keep_colours",
    "layout",
    "max_evaluations",
    "mix",
    "noise_level",
    "num_inference_steps",
    "solver",
    "strength",
    "tolerance",
    "touch_weight",
    "weights",
    "width",
)
"""Arguments of pipelines' calls that `--set` takes, which are the same for all pictures of a call."""

MAX_SEED = 2**32 - 1  # torch's CPU generators use 32 bits, so 2**32 would be the same seed as 0

FILE = {"exists": True, "dir_okay": False}
A_FOLDER = "Folder or repository id of"
SEVERAL = "files, folders, patterns or example:NAME"

# Inputs and outputs
Touches = Annotated[list[str], Argument(help=f"Touch images, or videos: {SEVERAL}.")]
Output = Annotated[Path, Option("--output", "-o", help="A folder, or a .png, .jpg or .webp for one picture.")]
Overwrite = Annotated[bool, Option("--overwrite", metavar="", help="Replace files that are there.")]
AsJson = Annotated[bool, Option("--json", metavar="", help="Print one JSON object instead of text.")]

# Arguments of calls; the checkpoint's own values are used for those that are left out
Prompt = Annotated[str | None, Option(help="Description of the picture beside the touch.")]
NegativePrompt = Annotated[str | None, Option(help="Description that guidance moves the picture away from.")]
Strength = Annotated[float | None, Option(min=0, help="Scale of the touch embedding.")]
NoiseLevel = Annotated[
    int | None, Option(min=0, max=999, help="Noise added to the embedding; more noise gives more variety.")
]
Sensor = Annotated[str | None, Option(help="Sensor that took the touches; retrieved from the images if left out.")]
Background = Annotated[
    Path | None, Option(**FILE, help="Image of the untouched sensor, for a sensor that the model does not know.")
]
Steps = Annotated[
    int | None, Option("--num-inference-steps", "--steps", min=1, max=1000, help="Number of solver steps.")
]
Solver = Annotated[str | None, Option(help="Name of the solver, such as ddim or dpm++2m.")]
Tolerance = Annotated[
    float | None, Option(min=1e-5, max=1, help="Relative error of the latents, in place of a number of steps.")
]
Guidance = Annotated[
    float | None, Option("--guidance-scale", "--guidance", min=0, help="Guidance scale; active above 1.")
]
Settings = Annotated[list[str] | None, Option("--set", help="Another argument of the call: width=160, bridge=false.")]
Images = Annotated[
    int, Option("--num-images-per-prompt", "--images", min=1, max=10_000, help="Number of pictures for each input.")
]
Seed = Annotated[int, Option(min=0, max=MAX_SEED, help="Seed of the noise; equal seeds give equal pictures.")]
BatchSize = Annotated[int, Option(min=1, help="Pictures in one call; fewer take less memory.")]

# Models and data sets
Model = Annotated[str | None, Option(help=f"{A_FOLDER} a saved pipeline; built-in if left out.")]
Dtype = Annotated[str | None, Option(help="float32, float16, bfloat16 or float64; float32 if left out.")]
Device = Annotated[str, Option(help="cpu, cuda, cuda:1 or such; auto is a GPU if there is one.")]
Materials = Annotated[str | None, Option(help="Names of the materials by comma, in the order of their numbers.")]


def call_arguments(context: Context, pipeline: Any) -> dict[str, Any]:
    """Arguments of a pipeline's call, from the options of the same names and from `--set`."""
    parameters = inspect.signature(pipeline.__call__).parameters
    arguments: dict[str, Any] = {}
    for name, value in context.params.items():
        if name in parameters and value not in (None, (), []):
            arguments[name] = value
    settable = [name for name in SETTABLE if name in parameters]
    for word in context.params["settings"] or ():
        name, _, value = word.partition("=")
        check_choice("--set", name, settable)
        arguments[name] = value_of(value)
    return arguments


def model_options(context: Context) -> dict[str, Any]:
    """The options of a command for the model, its precision and its device."""
    return {name: context.params[name] for name in ("model", "dtype", "device")}


def value_of(word: str) -> Any:
    """The value of a word: a number, a list, true or false, as in JSON or Python; any other word is a string."""
    word = {"True": "true", "False": "false", "None": "null"}.get(word, word)
    try:
        return json.loads(word)
    except ValueError:
        return word


def by_comma(words: str | None) -> list[str] | None:
    """The words of an option that takes several, separated by commas."""
    return None if words is None else [word.strip() for word in words.split(",")]


def check_output(files: Sequence[Path], overwrite: bool) -> None:
    """Raises if files would be replaced without `overwrite`, or cannot be written."""
    for file in files:
        if not overwrite and os.path.lexists(file):
            raise InvalidInputError(
                f"`--output` would replace {str(file)!r}; name another place, or pass `--overwrite`."
            )
    check_writable("--output", files[0])


def is_quiet(as_json: bool) -> bool:
    """Whether progress bars would be in the way."""
    return as_json or not sys.stderr.isatty()


def note(*messages: str) -> None:
    """Prints lines on standard error, as warnings and errors are printed."""
    for message in messages:
        print(f"unitouch-gen: {message}", file=sys.stderr)


def print_table(columns: list[str], rows: list[list[str]]) -> None:
    """Prints a table as wide as the terminal."""
    from rich.console import Console
    from rich.table import Table

    table = Table(*columns)
    for row in rows:
        table.add_row(*row)
    width = None if sys.stdout.isatty() else 120
    Console(width=width, markup=False, emoji=False).print(table)  # names of files may contain [red] or :brick:
