"""Options that commands share, named after the arguments of the pipelines' calls, and what commands print."""

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
"""Arguments of pipelines' calls that are the same for all pictures of a call."""

MAX_SEED = 2**32 - 1  # torch's generators of the CPU start from 32 bits: 2**32 would draw what 0 does

FILE = {"exists": True, "dir_okay": False}
A_FOLDER = "Folder or repository id of"
SEVERAL = "files, folders, patterns or example:NAME"

# Inputs and outputs
Touches = Annotated[list[str], Argument(help=f"Touch images, or videos: {SEVERAL}.")]
Output = Annotated[Path, Option("--output", "-o", help="A folder, or a .png, .jpg or .webp for one picture.")]
Overwrite = Annotated[bool, Option("--overwrite", metavar="", help="Replace files that are there.")]
AsJson = Annotated[bool, Option("--json", metavar="", help="Print one JSON object instead of text.")]

# Arguments of calls; what is left out is the checkpoint's own
Prompt = Annotated[str | None, Option(help="What else the picture should be.")]
NegativePrompt = Annotated[str | None, Option(help="What guidance leads the picture away from.")]
Strength = Annotated[float | None, Option(min=0, help="Gain on the embedding that is drawn.")]
NoiseLevel = Annotated[int | None, Option(min=0, max=999, help="Of the noise on it: more noise, more variety.")]
Sensor = Annotated[str | None, Option(help="Sensor that took the touches; found by their looks if left out.")]
Background = Annotated[Path | None, Option(**FILE, help="Picture of the sensor untouched, for one without a name.")]
Steps = Annotated[int | None, Option("--num-inference-steps", "--steps", min=1, max=1000, help="Of the solver.")]
Solver = Annotated[str | None, Option(help="Such as ddim or dpm++2m.")]
Tolerance = Annotated[float | None, Option(min=1e-5, max=1, help="Relative error of the latents, in place of steps.")]
Guidance = Annotated[float | None, Option("--guidance-scale", "--guidance", min=0, help="On above 1.")]
Settings = Annotated[list[str] | None, Option("--set", help="Another argument of the call: width=160, bridge=false.")]
Images = Annotated[int, Option("--num-images-per-prompt", "--images", min=1, max=10_000, help="Of each input.")]
Seed = Annotated[int, Option(min=0, max=MAX_SEED, help="Of the noise; the same one makes the same pictures.")]
BatchSize = Annotated[int, Option(min=1, help="Pictures in work at once; fewer take less memory.")]

# Models and data sets
Model = Annotated[str | None, Option(help=f"{A_FOLDER} a saved pipeline; built-in if left out.")]
Dtype = Annotated[str | None, Option(help="float32, float16, bfloat16 or float64; float32 if left out.")]
Device = Annotated[str, Option(help="cpu, cuda, cuda:1 or such; auto is a GPU where torch finds one.")]
Materials = Annotated[str | None, Option(help="Names of its materials by comma, in the order of their numbers.")]


def call_arguments(context: Context, pipeline: Any) -> dict[str, Any]:
    """Arguments of a pipeline's call: options of their names, and what `--set` says."""
    known = inspect.signature(pipeline.__call__).parameters
    given = {name: value for name, value in context.params.items() if name in known and value not in (None, (), [])}
    for word in context.params["settings"] or ():
        name, _, value = word.partition("=")
        check_choice("--set", name, [settable for settable in SETTABLE if settable in known])
        given[name] = value_of(value)
    return given


def model_options(context: Context) -> dict[str, Any]:
    """What a command was told of the model to load, and of where it runs."""
    return {name: context.params[name] for name in ("model", "dtype", "device")}


def value_of(word: str) -> Any:
    """A number, a list, true or false, as in JSON or Python; any other word is a text."""
    word = {"True": "true", "False": "false", "None": "null"}.get(word, word)
    try:
        return json.loads(word)
    except ValueError:
        return word


def by_comma(words: str | None) -> list[str] | None:
    """The words of an option that takes several with commas between them."""
    return None if words is None else [word.strip() for word in words.split(",")]


def check_output(files: Sequence[Path], overwrite: bool) -> None:
    """Refuses to replace files that are there, if not asked to, and places that cannot be written to."""
    for file in filter(os.path.lexists, () if overwrite else files):
        raise InvalidInputError(f"`--output` would replace {str(file)!r}; name another place, or pass `--overwrite`.")
    check_writable("--output", files[0])


def is_quiet(as_json: bool) -> bool:
    """Whether progress bars would be in the way."""
    return as_json or not sys.stderr.isatty()


def note(*messages: str) -> None:
    """Lines on standard error, as those of warnings and errors."""
    for message in messages:
        print(f"unitouch-gen: {message}", file=sys.stderr)


def print_table(columns: list[str], rows: list[list[str]]) -> None:
    """A table as wide as the terminal."""
    from rich.console import Console
    from rich.table import Table

    table = Table(*columns)
    for row in rows:
        table.add_row(*row)
    width = None if sys.stdout.isatty() else 120
    Console(width=width, markup=False, emoji=False).print(table)  # a file's name may hold [red] or :brick:
