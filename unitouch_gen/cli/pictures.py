"""`unitouch-gen touch-to-image`, `stylize` and `x-to-touch`: from files to pictures in files.

Inputs are checked before a network runs and before a folder is made.
"""

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Context, Option, echo

from unitouch_gen.cli import options
from unitouch_gen.cli.loading import files_of, load_pipeline
from unitouch_gen.cli.options import SEVERAL
from unitouch_gen.errors import InvalidInputError, check_count, check_passed
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
    """Generates a picture from each touch.

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
    touch_weight: Annotated[
        float | None, Option(min=0, max=1, help="Weight of the touch in the mix, by default 0.7.")
    ] = None,
    layout: Annotated[int, options.sampling_option("layout")] = 14,
    keep_colours: Annotated[bool, Option("--keep-colours", metavar="", help="Keep its mean colour, too.")] = False,
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
    image: Annotated[list[str] | None, Option(help=f"Photo as input: {SEVERAL}; repeatable.")] = None,
    text: Annotated[list[str] | None, Option(help="Description as input; repeatable.")] = None,
    audio: Annotated[list[str] | None, Option(help=f"Sound as input: {SEVERAL}; repeatable.")] = None,
    touch: Annotated[list[str] | None, Option(help=f"Touch by another sensor as input: {SEVERAL}; repeatable.")] = None,
    source_sensor: Annotated[str | None, Option(help="Sensor that took --touch; retrieved if left out.")] = None,
    sensor: Annotated[
        list[str] | None, Option(help="Sensor to draw for, or all; the first if left out; repeatable.")
    ] = None,
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
    """Generates touch images from photos, descriptions, sounds, or touches by another sensor.

    Each input of one option makes a touch. Inputs of several options are mixed in pairs; a single input of an option is
    mixed with each of the others. Pictures are named after their inputs and sensor.

    Example: unitouch-gen x-to-touch --text "rough brick" --sensor all -o touches/
    """
    words_by_option = {"--image": image, "--text": text, "--audio": audio, "--touch": touch}
    passed = check_passed({option: words or None for option, words in words_by_option.items()})
    inputs: dict[str, list[Any]] = {}
    for option, words in passed.items():
        name = option.removeprefix("--")
        inputs[name] = words if name == "text" else files_of(option, words, name)
    most = max(map(len, inputs.values()))
    for name, values in inputs.items():
        check_count(f"--{name}", len(values), most)
    pipe = load_pipeline("x-to-touch", quiet=options.is_quiet(as_json), **options.model_options(context))
    sensors = sensor or ([] if background else pipe.config.sensors[:1])
    if "all" in sensors:
        sensors = list(pipe.config.sensors)
    rows = list[tuple[dict[str, Any], str]]()
    for row in range(most):
        own_inputs = {name: values[row % len(values)] for name, values in inputs.items()}
        stem = "-".join(map(stem_of, own_inputs.values()))
        if not sensors:
            rows.append((own_inputs, stem))
        for name in sensors:
            rows.append(({**own_inputs, "sensor": name}, f"{stem}-{name}"))
    make(context, pipe, pictures_of(rows, context))


# Shared by the commands -----------------------------------------------------------------------------------------------


@dataclass
class Picture:
    """A picture to make."""

    inputs: dict[str, Any]  #: its own arguments of the pipeline's call
    file: Path  #: where it is saved
    seed: int  #: of its noise


def stem_of(value: Path | str) -> str:
    """A name for the picture of an input: the stem of a file, or the first words of a description."""
    if isinstance(value, Path):
        return value.stem
    return re.sub(r"\W+", "-", value.lower())[:60].strip("-") or "text"


def pictures_of(rows: Sequence[tuple[dict[str, Any], str]], context: Context) -> list[Picture]:
    """The pictures of rows of inputs and names of their files; raises if a file cannot be written."""
    params = context.params
    output = Path(params["output"])
    images = params["num_images_per_prompt"]
    all_inputs = list[dict[str, Any]]()
    seeds = list[int]()
    stems = list[str]()
    for inputs, stem in rows:
        for number in range(images):
            all_inputs.append(inputs)
            seeds.append(params["seed"] + number)
            stems.append(f"{stem}-{number + 1}" if images > 1 else stem)
    files = options.targets_of(output, unique(stems))
    input_files = [value for inputs in all_inputs for value in inputs.values() if is_file(value)]
    options.check_output(files, params["overwrite"], inputs=input_files)
    return [Picture(inputs, file, seed) for inputs, file, seed in zip(all_inputs, files, seeds, strict=True)]


def is_file(value: Any) -> bool:
    """Whether an input is a file, not a text or the name of a sensor."""
    return isinstance(value, Path)


def unique(names: Sequence[str]) -> list[str]:
    """Names, repeated ones with a number, so that no file replaces another, not even if case is ignored."""
    used: dict[str, str] = {}
    for name in names:
        candidate = name
        count = 1
        while candidate.casefold() in used:
            count += 1
            candidate = f"{name}-{count}"
        used[candidate.casefold()] = candidate
    return list(used.values())


def draw(pipe: Any, pictures: Sequence[Picture], settings: dict[str, Any]) -> Any:
    """Output of one call for some pictures, each from its own seed, so that it is the same alone and in a batch."""
    import torch

    generators = [torch.Generator().manual_seed(picture.seed) for picture in pictures]
    inputs = {name: [picture.inputs[name] for picture in pictures] for name in pictures[0].inputs}
    return pipe(**{**settings, **inputs}, generator=generators)


def save(image: Any, file: Path) -> None:
    """Writes a PIL image completely, or leaves the file as it was."""
    with replacing("--output", file) as partial:
        image.save(partial)


def described(picture: Picture, report: Any, place: int) -> dict[str, Any]:
    """The JSON row of the picture at a place of its call: file, inputs, and sensor of the touch."""
    row: dict[str, Any] = {"picture": str(picture.file)}
    row |= {name: str(value) for name, value in picture.inputs.items()}
    if report.sensors:
        row |= {"touch_sensor": report.sensors[place], "sensor_distance": report.sensor_distances[place]}
    if report.unknown:
        row["unknown"] = report.unknown["touch"][place]
    return row


def make(context: Context, pipe: Any, pictures: Sequence[Picture]) -> None:
    """Generates pictures by a command's options, saves those of each call, and prints a table and the report."""
    params = context.params
    rows = list[dict[str, Any]]()
    reports = list[Any]()
    settings = {**options.call_arguments(context, type(pipe)), "num_images_per_prompt": 1}
    quiet = options.is_quiet(params["as_json"])
    check_inputs(pipe.processor, pictures)
    for start in range(0, len(pictures), params["batch_size"]):
        call = pictures[start : start + params["batch_size"]]
        pipe.set_progress_bar_config(disable=quiet, desc=f"{start + len(call)} of {len(pictures)}")
        output = draw(pipe, call, settings)
        for place, (picture, image) in enumerate(zip(call, output.images, strict=True)):
            save(image, picture.file)
            rows.append(described(picture, output.report, place))
        reports.append(output.report)
    codes = dict.fromkeys(code for report in reports for code in report.codes if code != "success")
    options.note(*(f"a picture is {code.value}: {code.message}" for code in codes))
    if params["as_json"]:
        echo(json.dumps({"pictures": rows, "reports": [report.to_dict() for report in reports]}))
        return
    columns = list(dict.fromkeys(name for row in rows for name in row if name != "sensor_distance"))
    options.print_table(columns, [[Path(row.get(name) or "-").name for name in columns] for row in rows])
    echo(f"Pictures are in {pictures[0].file.resolve().parent}")
    total = ""
    if len(reports) > 1:
        seconds = sum(sum(report.seconds.values()) for report in reports)
        total = f"; {len(reports)} such calls, {seconds:.1f} s"
    echo(f"Run report: {reports[-1]}{total}")


def check_inputs(processor: Any, pictures: Sequence[Picture]) -> None:
    """Reads all inputs once, so that one that cannot be read does not end the work of hours."""
    from unitouch_gen.models import MODALITIES

    for picture in pictures:
        for modality in {*MODALITIES} & picture.inputs.keys():
            value = picture.inputs[modality]
            name = f"{modality} {value.name}" if is_file(value) else modality
            processor.inputs(modality, value, name=name)
