"""`unitouch-gen ...`: a thin layer over the pipelines. Each command imports what it needs when it runs.

A mistake of the user prints one line on standard error and exits with 2.
"""

import json
import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from unitouch_gen.errors import InvalidInputError, InvalidTypeError, NonFiniteError

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Generative pipelines between touch and image.",
)

USAGE_ERROR = 2


@app.callback()
def _commands() -> None:
    """Keeps `touch-to-image` a sub-command while it is the only one."""


@app.command("touch-to-image")
def touch_to_image(
    touch: Annotated[list[Path], typer.Argument(help="Touch images; one picture is made for each.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="A folder, or a file name for a single picture.")],
    prompt: Annotated[str | None, typer.Option(help="What else the picture should be.")] = None,
    steps: Annotated[int | None, typer.Option(help="Solver steps.")] = None,
    guidance: Annotated[float | None, typer.Option(help="Scale of classifier-free guidance; on above 1.")] = None,
    seed: Annotated[int, typer.Option(help="Of the noise; the same seed makes the same pictures.")] = 0,
    sensor: Annotated[str | None, typer.Option(help="Which sensor took the touches; retrieved when left out.")] = None,
    model: Annotated[
        str | None, typer.Option(help="Folder or repository id of a saved pipeline; built-in if left out.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")] = False,
) -> None:
    """Makes a picture of what each touch feels like."""
    import torch

    from unitouch_gen.errors import check_integer
    from unitouch_gen.evaluation.zero_shot import MaterialNamer
    from unitouch_gen.pipelines import TouchToImagePipeline
    from unitouch_gen.pipelines.tiny import tiny

    files = picture_files(touch, output)
    check_integer("seed", seed, 0, 2**63 - 1)
    pipe = TouchToImagePipeline.from_pretrained(local_folder(model)) if model else tiny("touch-to-image")
    pipe.set_progress_bar_config(disable=as_json or not sys.stderr.isatty())
    # A generator each, so a picture depends on its own touch and the seed, not on its neighbours.
    generators = [torch.Generator().manual_seed(seed) for _ in touch]
    result = pipe(
        list(touch),
        prompt=prompt,
        num_inference_steps=steps,
        guidance_scale=guidance,
        sensor=sensor,
        generator=generators,
    )
    felt = MaterialNamer(pipe.unitouch, pipe.processor).touch(list(touch), sensor=sensor)
    for image, file in zip(result.images, files, strict=True):
        save_picture(image, file)

    rows = [
        {
            "touch": str(source),
            "picture": str(file),
            "sensor": name,
            "sensor_distance": distance,
            "materials": materials,
        }
        for source, file, name, distance, materials in zip(
            touch, files, result.report.sensors, result.report.sensor_distances, felt, strict=True
        )
    ]
    if as_json:
        typer.echo(json.dumps({"pictures": rows, "report": result.report.to_dict()}))
        return
    _print_table(rows)
    typer.echo(f"Pictures are in {files[0].parent.resolve()}")
    typer.echo(f"Run report: {result.report}")


def picture_files(touch: list[Path], output: Path) -> list[Path]:
    """Where each picture goes: into a folder under the touch's name, or to the one file named.

    Raises:
        InvalidInputError: If several pictures would go to one file, or the output cannot be written.
    """
    from PIL import Image

    named_file = output.suffix != "" and not output.is_dir()
    if named_file:
        if output.suffix.lower() not in Image.registered_extensions():
            raise InvalidInputError(f"`--output` is {str(output)!r}, of no known picture format; use .png or .jpg.")
        if len(touch) > 1:
            raise InvalidInputError(
                f"`--output` is the file {str(output)!r} for {len(touch)} touches; name a folder for several pictures."
            )
        files = [output]
    else:
        if output.exists() and not output.is_dir():
            raise InvalidInputError(f"`--output` is {str(output)!r}, a file without a picture's suffix; name a folder.")
        files = [output / f"{stem}.png" for stem in unique_stems(touch)]
    folder = files[0].parent
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInputError(f"`--output` is {str(output)!r}, which cannot be made: {error.strerror}.") from error
    if not os.access(folder, os.W_OK):
        raise InvalidInputError(f"`--output` is in {str(folder)!r}, which cannot be written to; name another folder.")
    return files


def unique_stems(paths: list[Path]) -> list[str]:
    """File names without suffix; repeated ones get a number, so no picture replaces another."""
    seen: dict[str, int] = {}
    stems = []
    for path in paths:
        count = seen[path.stem] = seen.get(path.stem, 0) + 1
        stems.append(path.stem if count == 1 else f"{path.stem}-{count}")
    return stems


def save_picture(image, file: Path) -> None:
    """Writes under a temporary name and renames, so no half a picture is ever left."""
    partial = file.with_name(f".{file.stem}.partial{file.suffix}")
    try:
        image.save(partial)
        partial.replace(file)
    except OSError as error:
        raise InvalidInputError(f"`--output` cannot be written to {str(file)!r}: {error.strerror or error}.") from error
    finally:
        partial.unlink(missing_ok=True)


def local_folder(model: str) -> str:
    """The folder of a saved pipeline; a repository id is fetched first.

    Raises:
        InvalidInputError: If it is neither.
    """
    if Path(model).is_dir():
        if not (Path(model) / "model_index.json").is_file():
            raise InvalidInputError(f"`--model` is {model!r}, which holds no model_index.json; name a saved pipeline.")
        return model
    if model.count("/") != 1 or model.startswith((".", "/", "~")):
        raise InvalidInputError(f"`--model` is {model!r}, which is no folder; name a folder or a repository id.")
    from huggingface_hub import snapshot_download

    try:
        return snapshot_download(model)
    except (OSError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise InvalidInputError(
            f"`--model` is {model!r}, which is no folder and could not be fetched: {reason}"
        ) from error


def _print_table(rows: list[dict]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("touch", "picture", "sensor", "feels like")
    for row in rows:
        feels = ", ".join(f"{name} {share:.0%}" for name, share in row["materials"].items())
        table.add_row(Path(row["touch"]).name, Path(row["picture"]).name, row["sensor"] or "-", feels)
    Console(width=None if sys.stdout.isatty() else 120).print(table)


def main() -> None:
    """Entry point: turns users' mistakes into one line and exit code 2."""
    try:
        app()
    except (InvalidInputError, InvalidTypeError, NonFiniteError) as error:
        message = " ".join(str(error).split())
        print(f"unitouch-gen: {message}", file=sys.stderr)
        sys.exit(USAGE_ERROR)
