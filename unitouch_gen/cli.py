"""`unitouch-gen ...`: a thin layer over the pipelines. Each command imports what it needs when it runs.

A mistake of the user prints one line on standard error and exits with 2.
"""

import io
import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

if TYPE_CHECKING:
    from PIL import Image

    from unitouch_gen.pipelines import TouchToImagePipeline

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Generative pipelines between touch and image.",
)

USAGE_ERROR = 2
WRONG_USAGE: Any = typer.BadParameter.__bases__  # typer's base class of all usage errors has no public name


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
    background: Annotated[
        Path | None, typer.Option(help="What the sensor sees untouched, to re-centre a sensor the model does not know.")
    ] = None,
    model: Annotated[
        str | None, typer.Option(help="Folder or repository id of a saved pipeline; built-in if left out.")
    ] = None,
    batch_size: Annotated[int, typer.Option(help="Touches in work at once; fewer take less memory.")] = 8,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")] = False,
) -> None:
    """Makes a picture of what each touch feels like."""
    import torch

    from unitouch_gen.diffusion import RunReport
    from unitouch_gen.encoders.pixels import load_images
    from unitouch_gen.errors import check_integer
    from unitouch_gen.evaluation.zero_shot import MaterialNamer

    files = picture_files(touch, output)
    check_integer("seed", seed, 0, 2**63 - 1)
    check_integer("batch_size", batch_size, 1)
    for index, path in enumerate(touch):  # or one that cannot be read would end the work of hours
        load_images(f"touch[{index}]", path)
    quiet = as_json or not sys.stderr.isatty()
    pipe = load_pipeline(model, quiet)

    reports, embeds = [], []
    for start in range(0, len(touch), batch_size):
        batch = slice(start, start + batch_size)
        pipe.set_progress_bar_config(disable=quiet, desc=f"{min(start + batch_size, len(touch))} of {len(touch)}")
        result = pipe(
            touch[batch],
            prompt=prompt,
            num_inference_steps=steps,
            guidance_scale=guidance,
            sensor=sensor,
            background=background,
            # A generator each, so a picture depends on its own touch and the seed, not on its neighbours.
            generator=[torch.Generator().manual_seed(seed) for _ in touch[batch]],
        )
        for image, file in zip(result.images, files[batch], strict=True):
            save_picture(image, file)
        reports.append(result.report)
        embeds.append(result.embeds)
    report = RunReport.joined(reports)

    felt: list[dict[str, float]] = [{} for _ in touch]
    if pipe.processor.tokenizer is not None:  # one that `from_pipe` made has none
        felt = MaterialNamer(pipe.unitouch, pipe.processor).name(torch.cat(embeds), "touch")
    rows = [
        {
            "touch": str(source),
            "picture": str(file),
            "sensor": name,
            "sensor_distance": distance,
            "materials": materials,
        }
        for source, file, name, distance, materials in zip(
            touch, files, report.sensors, report.sensor_distances, felt, strict=True
        )
    ]
    if as_json:
        typer.echo(json.dumps({"pictures": rows, "report": report.to_dict()}))
        return
    _print_table(rows)
    typer.echo(f"Pictures are in {files[0].parent.resolve()}")
    typer.echo(f"Run report: {report}")


def picture_files(touch: list[Path], output: Path) -> list[Path]:
    """Where each picture goes: into a folder under the touch's name, or to the one file named.

    Raises:
        InvalidInputError: If several pictures would go to one file, or the output cannot be written.
    """
    from unitouch_gen.errors import InvalidInputError

    named_file = output.suffix != "" and not os.path.isdir(output)
    if named_file:
        if not can_write(output.suffix):
            raise InvalidInputError(f"`--output` is {str(output)!r}, of no known picture format; use .png or .jpg.")
        if len(touch) > 1:
            raise InvalidInputError(
                f"`--output` is the file {str(output)!r} for {len(touch)} touches; name a folder for several pictures."
            )
        files = [output]
    else:
        if os.path.isfile(output):
            raise InvalidInputError(f"`--output` is {str(output)!r}, a file without a picture's suffix; name a folder.")
        files = [output / f"{stem}.png" for stem in unique_stems(touch)]
    sources = {os.path.realpath(path) for path in touch}
    for file in files:
        if os.path.realpath(file) in sources:
            raise InvalidInputError(
                f"`--output` would replace the touch image {str(file)!r}; name another folder or file."
            )
    # The folder is made when the first picture is saved, so that a mistake leaves nothing behind.
    folder = next(path for path in files[0].absolute().parents if os.path.exists(path))
    if not os.path.isdir(folder):
        raise InvalidInputError(f"`--output` is {str(output)!r}, but {str(folder)!r} is a file; name another folder.")
    if not os.access(folder, os.W_OK):
        raise InvalidInputError(f"`--output` is in {str(folder)!r}, which cannot be written to; name another folder.")
    return files


def can_write(suffix: str) -> bool:
    """Whether Pillow writes RGB pictures of this suffix; some formats it only reads, some have no colour."""
    from PIL import Image

    try:
        Image.new("RGB", (16, 16)).save(io.BytesIO(), format=Image.registered_extensions()[suffix.lower()])
    except (KeyError, ValueError, OSError):
        return False
    return True


def unique_stems(paths: list[Path]) -> list[str]:
    """File names without suffix; repeated ones get a number, so no picture replaces another."""
    stems: list[str] = []
    for path in paths:
        stem, count = path.stem, 1
        while stem.casefold() in {taken.casefold() for taken in stems}:  # some file systems ignore case
            count += 1
            stem = f"{path.stem}-{count}"
        stems.append(stem)
    return stems


def save_picture(image: "Image.Image", file: Path) -> None:
    """Writes under a temporary name and renames, so no half a picture is ever left.

    Raises:
        InvalidInputError: If it cannot be written.
    """
    from unitouch_gen.errors import InvalidInputError

    partial = file.with_name(f".{os.getpid()}.partial{file.suffix}")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        try:
            image.save(partial)
            partial.replace(file)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        raise InvalidInputError(f"`--output` cannot be written to {str(file)!r}: {error.strerror or error}.") from error


def load_pipeline(model: str | None, quiet: bool) -> "TouchToImagePipeline":
    """The pipeline saved in a folder or repository, or the built-in one; `quiet` shows no bars while it loads.

    Raises:
        InvalidInputError: If it cannot be loaded.
    """
    import diffusers.utils.logging
    import transformers.utils.logging

    from unitouch_gen.errors import InvalidInputError
    from unitouch_gen.pipelines import TouchToImagePipeline
    from unitouch_gen.pipelines.tiny import tiny

    if quiet:
        diffusers.utils.logging.disable_progress_bar()
        transformers.utils.logging.disable_progress_bar()
    if model is None:
        return tiny("touch-to-image")
    folder = local_folder(model)
    try:
        pipe = TouchToImagePipeline.from_pretrained(folder)
        if pipe.unitouch is not None:
            pipe.unitouch.load("touch")
    except Exception as error:  # a broken folder makes its many readers raise as many kinds of errors
        reason = str(error).strip().partition("\n")[0] or type(error).__name__
        raise InvalidInputError(f"`--model` is {model!r}, which cannot be loaded: {reason}") from error
    return pipe


def local_folder(model: str) -> str:
    """The folder of a saved pipeline; a repository id is fetched first.

    Raises:
        InvalidInputError: If it is neither.
    """
    from unitouch_gen.errors import InvalidInputError

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
        code = app(standalone_mode=False)
    except WRONG_USAGE as error:  # type: ignore[misc]
        complain(error.format_message())
    except (ValueError, TypeError, ArithmeticError) as error:
        from unitouch_gen.errors import InvalidInputError, InvalidTypeError, NonFiniteError  # late, as it brings torch

        if not isinstance(error, InvalidInputError | InvalidTypeError | NonFiniteError):
            raise
        complain(str(error))
    else:
        sys.exit(code)


def complain(message: str) -> NoReturn:
    """One line on standard error, and exit code 2; no line where the help has been shown instead."""
    if message:
        print(f"unitouch-gen: {' '.join(message.split())}", file=sys.stderr)
    sys.exit(USAGE_ERROR)
