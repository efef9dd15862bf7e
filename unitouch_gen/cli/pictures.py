"""`unitouch-gen touch-to-image`, `stylize` and `x-to-touch`: pictures from files to files.

Mistakes are refused before a network runs and before a folder is made.
"""

import json
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Context, Option, echo

from unitouch_gen.cli import options
from unitouch_gen.cli.loading import files_of, load_pipeline
from unitouch_gen.cli.options import SEVERAL
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.files import replacing

# Commands -------------------------------------------------------------------------------------------------------------


def touch_to_image(
    context: Context,
    touch: options.Touches,
    output: options.Output,
    prompt: options.Prompt = None,
    negative_prompt: options.NegativePrompt = None,
    strength: options.Strength = None,
    noise_level: options.NoiseLevel = None,
    sensor: options.Sensor = None,
    background: options.Background = None,
    num_inference_steps: options.Steps = None,
    solver: options.Solver = None,
    tolerance: options.Tolerance = None,
    guidance_scale: options.Guidance = None,
    settings: options.Settings = None,
    num_images_per_prompt: options.Images = 1,
    seed: options.Seed = 0,
    batch_size: options.BatchSize = 8,
    model: options.Model = None,
    dtype: options.Dtype = None,
    device: options.Device = "auto",
    overwrite: options.Overwrite = False,
    as_json: options.AsJson = False,
) -> None:
    """Makes a picture of what each touch feels like.

    Example: unitouch-gen touch-to-image example:brick example:wood -o pictures/
    """
    touches = files_of("touch", touch, "touch")
    pictures = pictures_of([({"touch": file}, file.stem) for file in touches], context)
    pipe = load_pipeline("touch-to-image", quiet=options.is_quiet(as_json), **options.model_options(context))
    make(context, pipe, pictures)


def stylize(
    context: Context,
    image: Annotated[str, Argument(help="The photo: a file or example:NAME.")],
    touch: options.Touches,
    output: options.Output,
    touch_weight: Annotated[float | None, Option(min=0, max=1, help="Share of the touch, by default 0.7.")] = None,
    layout: Annotated[int, Option(min=2, help="Cells along a side of the grid on which the photo is held.")] = 14,
    keep_colours: Annotated[bool, Option("--keep-colours", metavar="", help="Hold its mean colour, too.")] = False,
    prompt: options.Prompt = None,
    negative_prompt: options.NegativePrompt = None,
    strength: options.Strength = None,
    noise_level: options.NoiseLevel = None,
    sensor: options.Sensor = None,
    background: options.Background = None,
    num_inference_steps: options.Steps = None,
    solver: options.Solver = None,
    tolerance: options.Tolerance = None,
    guidance_scale: options.Guidance = None,
    settings: options.Settings = None,
    num_images_per_prompt: options.Images = 1,
    seed: options.Seed = 0,
    batch_size: options.BatchSize = 8,
    model: options.Model = None,
    dtype: options.Dtype = None,
    device: options.Device = "auto",
    overwrite: options.Overwrite = False,
    as_json: options.AsJson = False,
) -> None:
    """Restyles a photo by each touch.

    Example: unitouch-gen stylize example:wood example:gravel -o restyled.png
    """
    photo, *others = files_of("image", [image], "image")
    if others:
        raise InvalidInputError(f"`image` is {image!r}, {1 + len(others)} files; name one of them.")
    touches = files_of("touch", touch, "touch")
    rows = [({"image": photo, "touch": file}, f"{photo.stem}-{file.stem}") for file in touches]
    pictures = pictures_of(rows, context)
    pipe = load_pipeline("stylization", quiet=options.is_quiet(as_json), **options.model_options(context))
    make(context, pipe, pictures)


def x_to_touch(
    context: Context,
    output: options.Output,
    image: Annotated[list[str] | None, Option(help=f"A photo to make a touch of: {SEVERAL}; repeatable.")] = None,
    text: Annotated[list[str] | None, Option(help="A description to make a touch of; repeatable.")] = None,
    audio: Annotated[list[str] | None, Option(help=f"A sound to make a touch of: {SEVERAL}; repeatable.")] = None,
    touch: Annotated[list[str] | None, Option(help=f"A touch to translate: {SEVERAL}; repeatable.")] = None,
    source_sensor: Annotated[str | None, Option(help="Sensor that took --touch; by its looks if left out.")] = None,
    sensor: Annotated[list[str] | None, Option(help="Sensor to draw for, the first, or all; repeatable.")] = None,
    background: options.Background = None,
    num_inference_steps: options.Steps = None,
    solver: options.Solver = None,
    tolerance: options.Tolerance = None,
    guidance_scale: options.Guidance = None,
    settings: options.Settings = None,
    num_images_per_prompt: options.Images = 1,
    seed: options.Seed = 0,
    batch_size: options.BatchSize = 8,
    model: options.Model = None,
    dtype: options.Dtype = None,
    device: options.Device = "auto",
    overwrite: options.Overwrite = False,
    as_json: options.AsJson = False,
) -> None:
    """Makes touch images of what is seen, read, heard, or felt by another sensor.

    Several inputs of one option make a touch each, and go in pairs, or all with one, with those of the others. Pictures
    are named after their inputs and sensor.

    Example: unitouch-gen x-to-touch --text "rough brick" --sensor all -o touches/
    """
    words = {"image": image, "text": text, "audio": audio, "touch": touch}
    inputs: dict[str, list[Any]] = {
        name: some if name == "text" else files_of(f"--{name}", some, name) for name, some in words.items() if some
    }
    if not inputs:
        raise InvalidInputError("No input was given; pass `--image`, `--text`, `--audio` or `--touch`.")
    most = max(map(len, inputs.values()))
    for name, values in inputs.items():
        if len(values) not in (1, most):
            raise InvalidInputError(f"`--{name}` was given {len(values)} times, another {most}; pass one, or as many.")
    pipe = load_pipeline("x-to-touch", quiet=options.is_quiet(as_json), **options.model_options(context))
    known = list(pipe.config.sensors)
    drawn = known if sensor and "all" in sensor else sensor or ([] if background else known[:1])
    rows = list[tuple[dict[str, Any], str]]()
    for row in range(most):
        own = {name: values[row % len(values)] for name, values in inputs.items()}
        stem = "-".join(map(stem_of, own.values()))
        rows += [({**own, "sensor": name}, f"{stem}-{name}") for name in drawn] or [(own, stem)]
    make(context, pipe, pictures_of(rows, context))


# What they share ------------------------------------------------------------------------------------------------------


@dataclass
class Picture:
    """A picture to make."""

    inputs: dict[str, Any]  #: its own arguments of the pipeline's call
    file: Path  #: where it goes
    seed: int  #: of its noise


def stem_of(value: Path | str) -> str:
    """A name for what is made of an input: that of its file, or the first words of a description."""
    if isinstance(value, Path):
        return value.stem
    return re.sub(r"\W+", "-", value.lower())[:60].strip("-") or "text"


def pictures_of(rows: Sequence[tuple[dict[str, Any], str]], context: Context) -> list[Picture]:
    """The pictures of rows of inputs and the names of their files; refuses what cannot be written."""
    given = context.params
    output = Path(given["output"])
    images = given["num_images_per_prompt"]
    each = [(inputs, stem, number) for inputs, stem in rows for number in range(images)]
    stems = unique([f"{stem}-{number + 1}" if images > 1 else stem for _, stem, number in each])
    files = [output / f"{stem}.png" for stem in stems]
    if output.suffix and not os.path.isdir(output):
        if output.suffix.lower() not in (".png", ".jpg", ".jpeg", ".webp") or len(files) > 1:
            wanted = "name a folder, or for one a .png, .jpg or .webp."
            raise InvalidInputError(f"`--output` is {str(output)!r} for {len(files)} pictures; {wanted}")
        files = [output]
    read = {os.path.realpath(value) for inputs, _ in rows for value in inputs.values() if isinstance(value, Path)}
    if read & {os.path.realpath(file) for file in files}:
        raise InvalidInputError(f"`--output` is {str(output)!r}, where an input would be replaced; name another place.")
    options.check_output(files, given["overwrite"])
    seeds = [given["seed"] + number for _, _, number in each]
    return [Picture(inputs, *place) for (inputs, _, _), *place in zip(each, files, seeds, strict=True)]


def unique(names: Sequence[str]) -> list[str]:
    """Names, repeated ones with a number, so that no file replaces another, not even where case is ignored."""
    found: dict[str, str] = {}
    for name in names:
        free = name
        count = 1
        while free.casefold() in found:
            count += 1
            free = f"{name}-{count}"
        found[free.casefold()] = free
    return list(found.values())


def draw(pipe: Any, pictures: Sequence[Picture], settings: dict[str, Any]) -> Any:
    """Output of one call that makes pictures, each from its own seed: a picture is the same alone and among others."""
    import torch

    generator = [torch.Generator().manual_seed(one.seed) for one in pictures]
    inputs = {name: [one.inputs[name] for one in pictures] for name in pictures[0].inputs}
    return pipe(**{**settings, **inputs}, generator=generator)


def save(image: Any, file: Path) -> None:
    """Writes a PIL image whole, or leaves what was there."""
    with replacing("--output", file) as partial:
        image.save(partial)


def described(picture: Picture, report: Any, place: int) -> dict[str, Any]:
    """The row of JSON for the picture at a place of its call: file, inputs, and what the report says of the touch."""
    row: dict[str, Any] = {"picture": str(picture.file), **{name: str(value) for name, value in picture.inputs.items()}}
    if report.sensors:
        row |= {"touch_sensor": report.sensors[place], "sensor_distance": report.sensor_distances[place]}
    if report.unknown:
        row["unknown"] = report.unknown["touch"][place]
    return row


def make(context: Context, pipe: Any, pictures: Sequence[Picture]) -> None:
    """Makes pictures by a command's options, saves those of each call, and prints a table of them and the report."""
    given = context.params
    rows = list[dict[str, Any]]()
    reports = list[Any]()
    settings = {**options.call_arguments(context, type(pipe)), "num_images_per_prompt": 1}
    processor = pipe.processor
    quiet = options.is_quiet(given["as_json"])
    read = {"touch": processor.touch, "image": processor.images, "audio": processor.sounds, "text": processor.text}
    for picture in pictures:  # an input that cannot be read should not end the work of hours
        for name in read.keys() & picture.inputs.keys():
            read[name](one := picture.inputs[name], name=f"{name} {one.name}" if isinstance(one, Path) else name)
    for start in range(0, len(pictures), given["batch_size"]):
        call = pictures[start : start + given["batch_size"]]
        pipe.set_progress_bar_config(disable=quiet, desc=f"{start + len(call)} of {len(pictures)}")
        output = draw(pipe, call, settings)
        for place, (picture, image) in enumerate(zip(call, output.images, strict=True)):
            save(image, picture.file)
            rows.append(described(picture, output.report, place))
        reports.append(output.report)
    codes = dict.fromkeys(code for report in reports for code in report.codes if code != "success")
    options.note(*(f"a picture is {code.value}: {code.message}" for code in codes))
    if given["as_json"]:
        echo(json.dumps({"pictures": rows, "reports": [report.to_dict() for report in reports]}))
        return
    columns = list(dict.fromkeys(name for row in rows for name in row if name != "sensor_distance"))
    options.print_table(columns, [[Path(row.get(name) or "-").name for name in columns] for row in rows])
    echo(f"Pictures are in {pictures[0].file.resolve().parent}")
    seconds = sum(sum(report.seconds.values()) for report in reports)
    echo(f"Run report: {reports[-1]}" + (f"; {len(reports)} such calls, {seconds:.1f} s" if len(reports) > 1 else ""))
