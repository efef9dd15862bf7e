"""Options that commands share, named after the arguments of the pipelines' calls, and output of commands."""

import inspect
import json
import os
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Context, Option

from unitouch_gen.arguments import SamplingArguments, bounds, description
from unitouch_gen.errors import InvalidInputError, check_choice
from unitouch_gen.files import check_writable

SETTABLE = sorted({name for name, field in SamplingArguments.model_fields.items() if field.description} | {"weights"})
"""Arguments of pipelines' calls that are the same for all pictures of a call."""

MAX_SEED = 2**32 - 1  # torch's CPU generators use 32 bits, so 2**32 would be the same seed as 0

FILE = {"exists": True, "dir_okay": False}
A_FOLDER = "Folder or repository id of"
SEVERAL = "files, folders, patterns or example:NAME"


def sampling_option(name: str, *flags: str) -> Any:
    """The option of a sampling argument, with its bounds and its description."""
    low, high = bounds(name)
    return Option(*flags, min=low, max=high, help=description(name))


# Inputs and outputs
Touches = Annotated[list[str], Argument(help=f"Touch images, or videos: {SEVERAL}.")]
Output = Annotated[Path, Option("--output", "-o", help="A folder, or a .png, .jpg or .webp for one picture.")]
Overwrite = Annotated[bool, Option("--overwrite", metavar="", help="Replace files that are there.")]
AsJson = Annotated[bool, Option("--json", metavar="", help="Print one JSON object instead of text.")]

# Arguments of calls; the checkpoint's own values are used for those that are left out
Prompt = Annotated[str | None, Option(help="Description of the picture beside the touch.")]
NegativePrompt = Annotated[str | None, Option(help="Description that guidance moves the picture away from.")]
Strength = Annotated[float | None, sampling_option("strength")]
NoiseLevel = Annotated[int | None, sampling_option("noise_level")]
Sensor = Annotated[str | None, Option(help="Sensor that took the touches; retrieved from the images if left out.")]
Background = Annotated[
    Path | None, Option(**FILE, help="Image of the untouched sensor, for a sensor that the model does not know.")
]
Steps = Annotated[int | None, sampling_option("num_inference_steps", "--num-inference-steps", "--steps")]
Solver = Annotated[str | None, sampling_option("solver")]
Tolerance = Annotated[float | None, sampling_option("tolerance")]
Guidance = Annotated[float | None, sampling_option("guidance_scale", "--guidance-scale", "--guidance")]
Settings = Annotated[list[str] | None, Option("--set", help="Another argument of the call: width=160, bridge=false.")]
Images = Annotated[int, sampling_option("num_images_per_prompt", "--num-images-per-prompt", "--images")]
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


def targets_of(output: Path, stems: Sequence[str]) -> list[Path]:
    """A file for each name in a folder, or the one file that `output` names."""
    if not output.suffix or os.path.isdir(output):
        return [output / f"{stem}.png" for stem in stems]
    if output.suffix.lower() not in (".png", ".jpg", ".jpeg", ".webp") or len(stems) > 1:
        wanted = "name a folder, or for one a .png, .jpg or .webp"
        raise InvalidInputError(f"`--output` is {str(output)!r} for {len(stems)} pictures; {wanted}.")
    return [output]


def check_output(files: Sequence[Path], overwrite: bool, inputs: Iterable[Path] = ()) -> None:
    """Raises if files would replace inputs, or others without `overwrite`, or cannot be written."""
    input_files = {os.path.realpath(file) for file in inputs}
    for file in files:
        is_input = os.path.realpath(file) in input_files
        if is_input or (not overwrite and os.path.lexists(file)):
            wanted = "name another place" if is_input else "name another place, or pass `--overwrite`"
            raise InvalidInputError(f"`--output` would replace {str(file)!r}; {wanted}.")
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
