"""`unitouch-gen batch`: a picture of every line of a table, or every file of a folder, over accelerate's processes."""

import inspect
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Context, Exit, Option, echo

from unitouch_gen import errors
from unitouch_gen.cli import options
from unitouch_gen.cli.loading import DRAWING, IMAGES, files_in, load_pipeline, suffixes_of
from unitouch_gen.cli.pictures import Picture, described, draw, save, stem_of, unique
from unitouch_gen.errors import InvalidInputError, check_choice, check_file, check_integer, first_line
from unitouch_gen.files import files_below, find_file, read_table, write_file

FILES = ("touch", "image", "audio", "background")
COLUMNS = (*FILES, "text", "prompt", "negative_prompt", "sensor", "source_sensor")
"""Arguments of a call in which its pictures may differ."""


def batch(
    context: Context,
    source: Annotated[Path, Argument(help="A .csv with a line for each picture, or a folder.")],
    output: Annotated[Path, Option("--output", "-o", help="A folder; pictures that are there stay.")],
    pipeline: Annotated[str, Option(help=f"{', '.join(DRAWING)}.")] = "touch-to-image",
    sensor: options.Sensor = None,
    num_inference_steps: options.Steps = None,
    settings: options.Settings = None,
    seed: options.Seed = 0,
    batch_size: options.BatchSize = 8,
    model: options.Model = None,
    dtype: options.Dtype = None,
    device: options.Device = "auto",
) -> None:
    """Makes the pictures of a table or a folder that are not there yet; exits with 1 if some fail.

    Processes that torchrun or accelerate launch starts share the work.

    Example: unitouch-gen batch touches/ -o pictures/
    """
    check_choice("--pipeline", pipeline, DRAWING)
    if not source.is_dir():
        check_file("source", source, "a .csv file")
    if source.suffix.lower() in IMAGES:
        raise InvalidInputError(f"`source` is {str(source)!r}, an image; pass its folder, or use `touch-to-image`.")
    rows = in_folder(source, pipeline, output) if source.is_dir() else read_table(source)
    import torch
    from accelerate import PartialState
    from accelerate.utils import gather_object
    from tqdm import tqdm

    from unitouch_gen.pipelines.tiny import PIPELINES

    kind = PIPELINES[pipeline]
    shared = options.call_arguments(context, kind)
    known = inspect.signature(kind.__call__).parameters
    columns = ["name", "seed", *(column for column in COLUMNS if column in known)]
    folder = source if source.is_dir() else source.parent
    rows = [{"seed": str(seed), **{column: cell for column, cell in row.items() if cell}} for row in rows]
    pictures = pictures_of(rows, columns, folder, output)
    manifest = output / "manifest.jsonl"
    options.check_output([manifest], overwrite=True)
    end_last_line(manifest)

    state = PartialState(cpu=not torch.cuda.is_available())
    failed = list[str]()
    most = 1 if "tolerance" in shared else batch_size  # the samples of a call choose its steps together
    alike: dict[tuple[str, ...], list[Picture]] = {}  # of the same kinds of inputs
    for one in (picture for picture in pictures if not picture.file.exists()):
        alike.setdefault(tuple(one.inputs), []).append(one)
    calls = [group[start : start + most] for group in alike.values() for start in range(0, len(group), most)]
    state.wait_for_everyone()  # or the last process would not miss what the first has made
    if device == "auto" and state.num_processes > 1:
        context.params["device"] = str(state.device)
    loading = options.model_options(context)
    pipe = load_pipeline(pipeline, quiet=options.is_quiet(False), **loading) if calls else None
    output.mkdir(parents=True, exist_ok=True)
    with state.split_between_processes(calls) as mine:
        for call in tqdm(mine, unit="call", disable=None if state.is_main_process else True):
            made = make(pipe, call, shared)
            with manifest.open("a", encoding="utf-8") as stream:
                stream.write("".join(f"{json.dumps(line)}\n" for _, line in made))
            for (image, line), picture in zip(made, call, strict=True):
                if image is None:
                    failed.append(f"{picture.file} failed: {line['error']}")
                else:
                    save(image, picture.file)
    failed = gather_object(failed)
    state.destroy_process_group()  # or now and then a process aborts as it ends
    if state.is_main_process:
        options.note(*failed)
        echo(f"{len(pictures) - len(failed)} of {len(pictures)} pictures are in {output.resolve()}")
    raise Exit(1 if failed else 0)


def end_last_line(manifest: Path) -> None:
    """Ends the last line of a manifest that a full disk cut; one that is not a whole line of JSON is left out."""
    content = manifest.read_bytes() if manifest.exists() else b""
    if not content or content.endswith(b"\n"):
        return
    whole_lines, newline, last = content.rpartition(b"\n")
    try:
        json.loads(last)
    except ValueError:
        write_file("--output", manifest, whole_lines + newline)
    else:
        write_file("--output", manifest, content + b"\n")


def in_folder(folder: Path, pipeline: str, output: Path) -> list[dict[str, str]]:
    """The columns of every file of a folder and those below, but for the output; places are the pictures' names."""
    modalities = ("image", "audio") if pipeline == "x-to-touch" else ("touch",)
    columns = {suffix: modality for modality in modalities for suffix in suffixes_of(modality)}
    if os.path.realpath(output) == os.path.realpath(folder):
        raise InvalidInputError(f"`--output` is {str(output)!r}, the folder of the inputs; name another one.")
    paths = [file for file in files_below(folder) if output.resolve() not in file.resolve().parents]
    files = files_in("source", str(folder), folder, paths, columns)
    places = [(columns[file.suffix.lower()], file.relative_to(folder)) for file in files]
    return [{column: str(place), "name": str(place.with_suffix(""))} for column, place in places]


def pictures_of(rows: Sequence[dict[str, str]], columns: Sequence[str], folder: Path, output: Path) -> list[Picture]:
    """What is made of each row, and where it goes: by its name, or that of what it is made of.

    Names of files in the rows start from a folder.
    """
    names = list[str]()
    pictures = list[Picture]()
    for row in rows:
        for column in row:
            check_choice("column", column, columns)
        stems = (stem_of(Path(row[name])) for name in FILES if name in row)
        names.append(row.get("name") or next(stems, stem_of(row.get("text", ""))))
        if Path(names[-1]).is_absolute() or ".." in Path(names[-1]).parts:
            raise InvalidInputError(f"`name` is {names[-1]!r}, a place elsewhere; name one in the output.")
    for name, row in zip(unique(names), rows, strict=True):
        own = {column: row[column] for column in COLUMNS if column in row}
        place = folder.absolute()
        inputs = {column: str(find_file(place, cell)) if column in FILES else cell for column, cell in own.items()}
        pictures.append(Picture(inputs, output / f"{name}.png", seed_of(row["seed"])))
    return pictures


def seed_of(cell: str) -> int:
    """The seed in a cell, also written as 1.0: pandas makes floats of a column of integers and blanks."""
    value = options.value_of(cell)
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return check_integer("seed", value, 0, options.MAX_SEED)


def make(pipe: Any, call: list[Picture], settings: dict[str, Any]) -> list[tuple[Any, dict[str, Any]]]:
    """A call's PIL images, `None` for those that fail, and lines of the manifest; if it fails, each is tried alone."""
    try:
        output = draw(pipe, call, settings)
    except (InvalidInputError, errors.InvalidTypeError, errors.NonFiniteError, errors.NotConvergedError) as error:
        if len(call) > 1:
            return [made for one in call for made in make(pipe, [one], settings)]
        return [(None, {"picture": str(call[0].file), **call[0].inputs, "error": first_line(error)})]
    lines = [{**settings, **described(one, output.report, row), "seed": one.seed} for row, one in enumerate(call)]
    return list(zip(output.images, lines, strict=True))
