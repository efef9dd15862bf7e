"""`unitouch-gen batch`: pictures of the lines of a table or the files of a folder, over accelerate's processes."""

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
from unitouch_gen.files import files_below, find_file, path_inside, read_table, write_file

FILES = ("touch", "image", "audio", "background")
COLUMNS = (*FILES, "text", "prompt", "negative_prompt", "sensor", "source_sensor")
"""Arguments of a call that may be different for each of its pictures."""


def batch(
    context: Context,
    source: Annotated[Path, Argument(help="A .csv with a line for each picture, or a folder of inputs.")],
    output: Annotated[Path, Option("--output", "-o", help="Folder for the pictures; those that are there are kept.")],
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

    shared = options.call_arguments(context, PIPELINES[pipeline])
    pictures = pictures_of(rows, PIPELINES[pipeline], source, output, seed)
    manifest = output / "manifest.jsonl"
    options.check_output([manifest], overwrite=True)
    end_last_line(manifest)

    state = PartialState(cpu=not torch.cuda.is_available())
    # The samples of a call choose its adaptive steps together.
    calls = calls_of(pictures, 1 if "tolerance" in shared else batch_size)
    state.wait_for_everyone()  # so that the first process does not write pictures before the last has looked for them
    if device == "auto" and state.num_processes > 1:
        context.params["device"] = str(state.device)
    loading = options.model_options(context)
    pipe = load_pipeline(pipeline, quiet=options.is_quiet(False), **loading) if calls else None
    output.mkdir(parents=True, exist_ok=True)
    failed = list[str]()
    with state.split_between_processes(calls) as own_calls:
        for call in tqdm(own_calls, unit="call", disable=None if state.is_main_process else True):
            results = make(pipe, call, shared)
            with manifest.open("a", encoding="utf-8") as stream:
                stream.write("".join(f"{json.dumps(line)}\n" for _, line in results))
            failed += save_images(results, call)
    failed = gather_object(failed)
    state.destroy_process_group()  # without this, the process sometimes aborts at its end
    if state.is_main_process:
        options.note(*failed)
        echo(f"{len(pictures) - len(failed)} of {len(pictures)} pictures are in {output.resolve()}")
    raise Exit(1 if failed else 0)


def calls_of(pictures: Sequence[Picture], size: int) -> list[list[Picture]]:
    """The pictures that are not there yet, in calls of at most `size` with the same kinds of inputs."""
    groups: dict[tuple[str, ...], list[Picture]] = {}
    for picture in pictures:
        if not picture.file.exists():
            groups.setdefault(tuple(picture.inputs), []).append(picture)
    calls = list[list[Picture]]()
    for group in groups.values():
        for start in range(0, len(group), size):
            calls.append(group[start : start + size])
    return calls


def save_images(results: Sequence[tuple[Any, dict[str, Any]]], call: Sequence[Picture]) -> list[str]:
    """Saves the images of a call, and returns a line for each picture that failed."""
    failed = list[str]()
    for (image, line), picture in zip(results, call, strict=True):
        if image is None:
            failed.append(f"{picture.file} failed: {line['error']}")
        else:
            save(image, picture.file)
    return failed


def end_last_line(manifest: Path) -> None:
    """Completes the last line of a manifest that was cut off by a full disk, or removes it if it is no whole JSON."""
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
    """A row for every input below a folder, without those in the output; pictures are named after their paths."""
    modalities = ("image", "audio") if pipeline == "x-to-touch" else ("touch",)
    columns = {suffix: modality for modality in modalities for suffix in suffixes_of(modality)}
    if os.path.realpath(output) == os.path.realpath(folder):
        raise InvalidInputError(f"`--output` is {str(output)!r}, the folder of the inputs; name another one.")
    paths = [file for file in files_below(folder) if output.resolve() not in file.resolve().parents]
    rows = list[dict[str, str]]()
    for file in files_in("source", str(folder), folder, paths, columns):
        path = file.relative_to(folder)
        rows.append({columns[file.suffix.lower()]: str(path), "name": str(path.with_suffix(""))})
    return rows


def pictures_of(rows: Sequence[dict[str, str]], kind: Any, source: Path, output: Path, seed: int) -> list[Picture]:
    """The picture of each row: its inputs, its file and its seed.

    Files in rows are relative to the folder of the table. A picture is named by its row, or after its first input.

    Args:
        rows: Cells by column.
        kind: Class of the pipeline, whose arguments are the columns.
        source: A folder, or a table in it.
        output: Folder of the pictures.
        seed: For rows without one.
    """
    parameters = inspect.signature(kind.__call__).parameters
    columns = ["name", "seed", *(column for column in COLUMNS if column in parameters)]
    folder = (source if source.is_dir() else source.parent).absolute()
    rows = [{column: cell for column, cell in row.items() if cell} for row in rows]
    names = list[str]()
    for row in rows:
        for column in row:
            check_choice("column", column, columns)
        names.append(name_of(row))
    pictures = list[Picture]()
    for name, row in zip(unique(names), rows, strict=True):
        inputs = {column: row[column] for column in COLUMNS if column in row}
        for column in FILES:
            if column in inputs:
                inputs[column] = str(find_file(folder, inputs[column]))
        pictures.append(
            Picture(inputs, path_inside("name", output, f"{name}.png"), seed_of(row.get("seed", str(seed))))
        )
    return pictures


def name_of(row: dict[str, str]) -> str:
    """The name of a row's picture, or the stem of its first file, or the first words of its text."""
    stems = [stem_of(Path(row[column])) for column in FILES if column in row]
    return row.get("name") or (stems[0] if stems else stem_of(row.get("text", "")))


def seed_of(cell: str) -> int:
    """The seed in a cell; 1.0 is 1, since pandas makes floats of a column of integers and blanks."""
    value = options.value_of(cell)
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return check_integer("seed", value, 0, options.MAX_SEED)


def make(pipe: Any, call: list[Picture], settings: dict[str, Any]) -> list[tuple[Any, dict[str, Any]]]:
    """PIL images of a call and lines of the manifest; if the call fails, each picture is tried alone.

    The image of a picture that fails is `None`, and its line has the error.
    """
    try:
        output = draw(pipe, call, settings)
    except (InvalidInputError, errors.InvalidTypeError, errors.NonFiniteError, errors.NotConvergedError) as error:
        if len(call) > 1:
            results = list[tuple[Any, dict[str, Any]]]()
            for picture in call:
                results += make(pipe, [picture], settings)
            return results
        picture = call[0]
        return [(None, {"picture": str(picture.file), **picture.inputs, "error": first_line(error)})]
    lines = list[dict[str, Any]]()
    for row, picture in enumerate(call):
        lines.append({**settings, **described(picture, output.report, row), "seed": picture.seed})
    return list(zip(output.images, lines, strict=True))
