"""Options that several commands share."""

import functools
import inspect
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any

import typer

from unitouch_gen.errors import InvalidInputError, check_device, check_integer
from unitouch_gen.files import check_file


def check_picture(parameter: typer.CallbackParam, file: Path | None) -> Path | None:
    """Refuses an option that names no file, before a command imports what takes seconds."""
    if file is not None:
        check_file(parameter.opts[0], file, "an image file")
    return file


Touches = Annotated[
    list[str],
    typer.Argument(help="Touch images: files, folders, patterns, - for standard input, or example:brick and such."),
]
Output = Annotated[Path, typer.Option("--output", "-o", help="A folder, or a file name for a single picture.")]
Prompt = Annotated[str | None, typer.Option(help="What else the picture should be.")]
NegativePrompt = Annotated[str | None, typer.Option(help="What guidance leads the picture away from.")]
Strength = Annotated[
    float | None, typer.Option(help="Gain on the embedding that is drawn; the checkpoint's own if left out.")
]
NoiseLevel = Annotated[
    int | None,
    typer.Option(help="Of the noise on that embedding, from 0 to 999: more noise, more variety."),
]
Steps = Annotated[int | None, typer.Option(help="Number of solver steps; the checkpoint's own if left out.")]
Timesteps = Annotated[
    str | None, typer.Option(help="The steps themselves, such as 900,500,100, in place of --steps, for some solvers.")
]
Sigmas = Annotated[
    str | None, typer.Option(help="The same as noise levels, such as 9,2,0.5,0: they fall, and end in 0.")
]
SolverName = Annotated[
    str | None,
    typer.Option("--solver", help="Name of the solver, such as ddim or dpm++2m; the checkpoint's own if left out."),
]
Tolerance = Annotated[
    float | None, typer.Option(help="Relative error of the latents to keep to, in place of --steps and --solver.")
]
MaxEvaluations = Annotated[
    int | None, typer.Option(help="Of the network, at most, to a --tolerance; 1,000 if left out.")
]
GuidanceInterval = Annotated[
    tuple[float, float] | None,
    typer.Option(help="Where guidance is on, from 0 (the least noise) to 1 (noise alone); everywhere if left out."),
]
Eta = Annotated[float, typer.Option(help="Of DDIM, from 0 to 1; other solvers ignore it.")]
Height = Annotated[int | None, typer.Option(help="Of the pictures, pixels; as the model was trained if left out.")]
Width = Annotated[int | None, typer.Option(help="Of the pictures, pixels; as the model was trained if left out.")]
Images = Annotated[int, typer.Option(help="Pictures of each input.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", metavar="", help="Replace files that are there.")]
GuidanceScale = Annotated[
    float | None, typer.Option(help="Scale of classifier-free guidance, on above 1; the checkpoint's own if left out.")
]
Seed = Annotated[int, typer.Option(help="Seed of the noise; the same one makes the same pictures.")]
Sensor = Annotated[
    str | None, typer.Option(help="Name of the sensor that took the touches; found by their looks if left out.")
]
Background = Annotated[
    Path | None,
    typer.Option(
        help="Picture of the sensor untouched, to re-centre one that the model does not know.", callback=check_picture
    ),
]
Bridge = Annotated[
    bool | None,
    typer.Option(
        "--bridge/--no-bridge",
        metavar="",
        help="Move what is no picture towards pictures the model knows; done where it has some, if left out.",
    ),
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
    "`num_images_per_prompt`": "`--images`",
    "`max_evaluations`": "`--max-evaluations`",
    "`guidance_interval`": "`--guidance-interval`",
    "`source_sensor`": "`--source-sensor`",
    "`file`": "`--load-sensor`",
    **{f"`{name}`": f"`--{name}`" for name in ("imagebind", "tokenizer", "config")},
}
"""Options of the arguments that pipelines know under other names."""


MOST = 100_000
"""Candidates, or pictures at once: each has a random generator, of kilobytes."""


@dataclass(frozen=True)
class Call:
    """The options that all commands have which make pictures: of the calls, and of what becomes of the pictures."""

    steps: Steps = None
    timesteps: Timesteps = None
    sigmas: Sigmas = None
    solver: SolverName = None
    tolerance: Tolerance = None
    max_evaluations: MaxEvaluations = None
    guidance: GuidanceScale = None
    guidance_interval: GuidanceInterval = None
    eta: Eta = 0.0
    height: Height = None
    width: Width = None
    images: Images = 1
    seed: Seed = 0
    load_sensor: LoadSensor = None
    model: Model = None
    dtype: Dtype = None
    device: Device = "auto"
    batch_size: BatchSize = 8
    overwrite: Overwrite = False
    as_json: AsJson = False

    def check(self, **counts: int) -> None:
        """Refuses seeds and counts that cannot be used, with more counts of the command's own."""
        check_integer("seed", self.seed, 0, 2**63 - 1)
        for name, count in {"images": self.images, "batch_size": self.batch_size, **counts}.items():
            check_integer(name, count, 1, MOST)

    @property
    def arguments(self) -> dict[str, Any]:
        """Arguments of a pipeline's call."""
        return {
            "num_inference_steps": self.steps,
            "timesteps": numbers_of("--timesteps", self.timesteps, int),
            "sigmas": numbers_of("--sigmas", self.sigmas, float),
            "solver": self.solver,
            "tolerance": self.tolerance,
            "max_evaluations": self.max_evaluations,
            "guidance_scale": self.guidance,
            "guidance_interval": self.guidance_interval,
            "eta": self.eta,
            "height": self.height,
            "width": self.width,
        }

    @property
    def loading(self) -> dict[str, Any]:
        """Arguments of `load_pipeline`."""
        return {"model": self.model, "dtype": self.dtype, "device": self.device, "sensors": self.load_sensor}


def with_call(command: Callable[..., None]) -> Callable[..., None]:
    """A command whose argument `call` is a `Call`, as one that has all of its options, which is what typer looks at."""
    own = [one for name, one in inspect.signature(command).parameters.items() if name != "call"]
    ours = [
        inspect.Parameter(one.name, inspect.Parameter.KEYWORD_ONLY, default=one.default, annotation=one.type)
        for one in fields(Call)
    ]

    @functools.wraps(command)
    def run(**given: Any) -> None:
        call = Call(**{one.name: given.pop(one.name) for one in fields(Call)})
        command(**given, call=call)

    run.__signature__ = inspect.Signature([*own, *ours])  # type: ignore[attr-defined]
    return run


def numbers_of(option: str, words: str | None, kind: type[int] | type[float]) -> list[float] | None:
    """ "900,500,100" as numbers, and nothing as nothing."""
    try:
        return None if words is None else [kind(word) for word in words.split(",")]
    except ValueError as error:
        what = "whole numbers" if kind is int else "numbers"
        raise InvalidInputError(f"`{option}` is {words!r}; write {what} with commas between them.") from error


def check_new(files: Sequence[Path]) -> None:
    """Refuses to replace files that are there."""
    there = [file for file in files if os.path.isfile(file)]
    if there:
        more = f" and {len(there) - 1} more" if there[1:] else ""
        raise InvalidInputError(
            f"`--output` would replace {str(there[0])!r}{more}; name another place, or pass `--overwrite`."
        )


def device_of(name: str) -> Any:
    """The torch.device of a name, or what there is for "auto"."""
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


def note(*messages: str) -> None:
    """Lines on standard error, as those of warnings and errors."""
    for message in messages:
        print(f"unitouch-gen: {message}", file=sys.stderr)


@contextmanager
def progress(**settings: Any) -> Iterator[Callable[[int, int], None]]:
    """A bar, by settings of tqdm, as what to tell how much of how much is done."""
    from tqdm import tqdm

    with tqdm(**settings) as bar:

        def told(done: int, whole: int) -> None:
            bar.total = whole
            bar.update(done - bar.n)

        yield told


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
