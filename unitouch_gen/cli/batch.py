"""`unitouch-gen batch`: a picture of every line of a list, or every file of a folder, over accelerate's processes.

A picture that is there is not made again: the same command goes on where one was killed, and tries anew what failed.
"""

import inspect
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, Context, Exit, Option, echo

from unitouch_gen import errors
from unitouch_gen.cli import options
from unitouch_gen.cli.loading import CLASSES, files_in, load_pipeline, suffixes_of
from unitouch_gen.cli.pictures import Picture, described, draw, save, stem_of, unique
from unitouch_gen.errors import InvalidInputError, check_choice, check_integer, check_kind, first_line

if TYPE_CHECKING:
    from PIL import Image

FILES = ("touch", "image", "audio", "background")
OWN = (*FILES, "text", "prompt", "negative_prompt", "sensor", "source_sensor")
"""Arguments in which the pictures of one call may differ; in `options.SETTABLE` they are alike."""


def batch(
    context: Context,
    source: Annotated[Path, Argument(help="A .csv or .jsonl with a line for each picture, or a folder.")],
    output: Annotated[Path, Option("--output", "-o", help="A folder; pictures that are there stay.")],
    pipeline: Annotated[str, Option(help=f"{', '.join(CLASSES)}.")] = "touch-to-image",
    num_inference_steps: options.Steps = None,
    settings: Annotated[list[str] | None, Option("--set", help="A column of lines without: sensor=digit.")] = None,
    seed: options.Seed = 0, batch_size: options.BatchSize = 8, model: options.Model = None,
    load_sensor: options.LoadSensor = None, dtype: options.Dtype = None, device: options.Device = "auto",
) -> None:  # fmt: skip
    """Makes the pictures of a list or a folder that are not there yet; exits with 1 if some fail.

    Processes that torchrun or accelerate launch starts share the work.

    Example: unitouch-gen batch touches/ -o pictures/
    """
    check_choice("--pipeline", pipeline, CLASSES)
    rows = in_folder(source, pipeline, output) if source.is_dir() else in_list(source)
    import torch
    from accelerate import PartialState
    from accelerate.utils import gather_object
    from tqdm import tqdm

    from unitouch_gen import pipelines

    known = inspect.signature(getattr(pipelines, CLASSES[pipeline]).__call__).parameters
    columns = ["name", "seed", *(column for column in (*OWN, *options.SETTABLE) if column in known)]
    shared = {"seed": seed, **checked(dict(word.partition("=")[::2] for word in settings or ()), columns, Path())}
    if num_inference_steps is not None:
        shared["num_inference_steps"] = num_inference_steps
    folder = source if source.is_dir() else source.parent
    pictures = pictures_of([shared | checked(row, columns, folder) for row in rows], output)
    manifest = output / "manifest.jsonl"
    options.check_output([manifest], overwrite=True)
    if manifest.exists() and not (lines := manifest.read_bytes()).endswith(b"\n"):  # of a disk that was full
        manifest.write_bytes(lines[: lines.rfind(b"\n") + 1])

    state, failed = PartialState(cpu=not torch.cuda.is_available()), list[str]()
    calls = calls_of([picture for picture in pictures if not picture.file.exists()], batch_size)
    state.wait_for_everyone()  # or the last process would not miss what the first has made
    if device == "auto" and state.num_processes > 1:
        context.params["device"] = str(state.device)
    pipe = load_pipeline(pipeline, quiet=options.is_quiet(False), **context.params) if calls else None
    output.mkdir(parents=True, exist_ok=True)
    with state.split_between_processes(calls) as mine:
        for call in tqdm(mine, unit="call", disable=None if state.is_main_process else True):
            made = make(pipe, call)
            with manifest.open("a", encoding="utf-8") as stream:
                stream.write("".join(f"{json.dumps(line)}\n" for _, line in made))
            for (image, line), picture in zip(made, call, strict=True):
                if image is None:
                    failed.append(f"{picture.file} failed: {line['error']}")
                else:
                    save(image, picture.file)
    failed = gather_object(failed)
    if state.is_main_process:
        options.note(*failed)
        echo(f"{len(pictures) - len(failed)} of {len(pictures)} pictures are in {output.resolve()}")
    if failed:
        raise Exit(1)


# The list -------------------------------------------------------------------------------------------------------------


def in_folder(folder: Path, pipeline: str, output: Path) -> list[dict[str, str]]:
    """The columns of every file of a folder and those below, but for the output; places are the pictures' names."""
    from unitouch_gen.files import files_below

    modalities = ("image", "audio") if pipeline == "x-to-touch" else ("touch",)
    columns = {suffix: modality for modality in modalities for suffix in suffixes_of(modality)}
    paths = [file for file in files_below(folder) if output.resolve() not in file.resolve().parents]
    files = files_in(folder, paths, columns)
    places = [(columns[file.suffix.lower()], file.relative_to(folder)) for file in files]
    return [{column: str(place), "name": str(place.with_suffix(""))} for column, place in places]


def in_list(file: Path) -> list[dict[str, Any]]:
    """The columns of every line of a table with a header, or of a .jsonl; blank cells are left out."""
    from unitouch_gen.files import check_file, read_table, read_text

    check_file("source", file, "a .csv or .jsonl file")
    try:
        rows: list[Any]
        if file.suffix.lower() in (".csv", ".tsv"):
            rows = read_table(file)
        else:
            rows = [dict(json.loads(line)) for line in read_text(file).split("\n") if line.strip()]
    except (OSError, ValueError, TypeError, RecursionError) as error:
        message = f"`source` is {str(file)!r}, which is no .csv or .jsonl: {first_line(error)}"
        raise InvalidInputError(message) from error
    return [{column: value for column, value in row.items() if value not in (None, "")} for row in rows]


def checked(row: Mapping[str, Any], columns: Sequence[str], folder: Path) -> dict[str, Any]:
    """Columns as arguments of a call; names of files start from a folder."""
    found: dict[str, Any] = {}
    for column, value in row.items():
        if check_choice("column", column, columns) in ("name", *OWN):
            check_kind(column, value, str)
        elif isinstance(value, str):
            value = options.value_of(value)
        found[column] = str(folder.absolute() / value) if column in FILES else value
    return found


def pictures_of(rows: Sequence[dict[str, Any]], output: Path) -> list[Picture]:
    """What is made of each row, and where it goes: by its name, or that of what it is made of."""
    names = []
    for row in rows:
        stems = (stem_of(Path(row[name])) for name in FILES if name in row)
        names.append(row.get("name") or next(stems, stem_of(row.get("text", ""))))
        if Path(names[-1]).is_absolute() or ".." in Path(names[-1]).parts:
            raise InvalidInputError(f"`name` is {names[-1]!r}, a place elsewhere; name one in the output.")
    pictures = []
    for name, row in zip(unique(names), rows, strict=True):
        inputs = {column: row[column] for column in OWN if column in row}
        settings = {column: row[column] for column in options.SETTABLE if column in row}
        pictures.append(Picture(inputs, output / f"{name}.png", check_integer("seed", row["seed"], 0, 2**32), settings))
    return pictures


# Making it ------------------------------------------------------------------------------------------------------------


def calls_of(pictures: Sequence[Picture], size: int) -> list[list[Picture]]:
    """Pictures that one call makes: of the same settings, and of the same kinds of inputs."""
    alike: dict[str, list[Picture]] = {}
    for one in pictures:
        alike.setdefault(json.dumps([sorted(one.inputs), one.settings]), []).append(one)
    calls = []
    for group in alike.values():
        most = 1 if "tolerance" in group[0].settings else size  # the samples of a call choose its steps together
        calls += [group[start : start + most] for start in range(0, len(group), most)]
    return calls


def make(pipe: Any, call: list[Picture]) -> "list[tuple[Image.Image | None, dict[str, Any]]]":
    """The pictures of a call, each with its line of the manifest; where the call fails, each is tried alone."""
    try:
        output = draw(pipe, call)
    except (InvalidInputError, errors.InvalidTypeError, errors.NonFiniteError, errors.NotConvergedError) as error:
        if len(call) > 1:
            return [made for one in call for made in make(pipe, [one])]
        return [(None, {"picture": str(call[0].file), **call[0].inputs, "error": first_line(error)})]
    lines = [{**described(one, output.report, row), "seed": one.seed, **one.settings} for row, one in enumerate(call)]
    return list(zip(output.images, lines, strict=True))
