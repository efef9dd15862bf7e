"""`unitouch-gen touch-to-image`, `stylize` and `x-to-touch`: pictures from files to files.

What can be refused is refused before anything is loaded, and a folder is made when the first picture is saved, so a
mistake leaves nothing behind.
"""

import io
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from PIL import Image

from unitouch_gen.cli import options
from unitouch_gen.cli.loading import load_pipeline
from unitouch_gen.errors import InvalidInputError, check_integer

if TYPE_CHECKING:
    from torch import Tensor

    from unitouch_gen.evaluation.zero_shot import Named
    from unitouch_gen.sampling import RunReport

# Commands -------------------------------------------------------------------------------------------------------------


def touch_to_image(
    touch: options.Touches,
    output: options.Output,
    prompt: options.Prompt = None,
    steps: options.Steps = None,
    solver: options.SolverName = None,
    tolerance: options.Tolerance = None,
    guidance: options.GuidanceScale = None,
    seed: options.Seed = 0,
    sensor: options.Sensor = None,
    background: options.Background = None,
    load_sensor: options.LoadSensor = None,
    model: options.Model = None,
    dtype: options.Dtype = None,
    batch_size: options.BatchSize = 8,
    as_json: options.AsJson = False,
) -> None:
    """Makes a picture of what each touch feels like.

    Example: unitouch-gen touch-to-image samples/inputs/*.png -o pictures/
    """
    from unitouch_gen.evaluation.zero_shot import MaterialNamer, Named

    files = picture_files([path.stem for path in touch], output, touch)
    check_integers(seed=seed, batch_size=batch_size)
    check_pictures("touch", touch)
    arguments = {
        "touch": touch,
        "prompt": prompt,
        "num_inference_steps": steps,
        "solver": solver,
        "tolerance": tolerance,
        "guidance_scale": guidance,
        "sensor": sensor,
        "background": background,
    }
    quiet = options.is_quiet(as_json)
    pipe = load_pipeline("touch-to-image", model, quiet, arguments=arguments, dtype=dtype, sensors=load_sensor)
    report, embeds = make_pictures(pipe, arguments, files, seed, batch_size, quiet=quiet)
    unknown = report.unknown.get("touch") or [None] * len(touch)
    materials = [Named({}, reason) for reason in unknown]
    if pipe.processor.tokenizer is not None:  # one that `from_pipe` made has none
        materials = MaterialNamer(pipe.unitouch, pipe.processor).name(embeds, "touch", unknown=unknown)
    rows = [
        {
            "touch": str(source),
            "picture": str(file),
            "sensor": report.sensors[row],
            "sensor_distance": report.sensor_distances[row],
            "materials": materials[row],
            "unknown": unknown[row],
        }
        for row, (source, file) in enumerate(zip(touch, files, strict=True))
    ]
    print_results("pictures", rows, report, files, as_json, calibrated="touch" in pipe.unitouch.config.temperatures)


def stylize(
    photo: Annotated[Path, typer.Argument(help="The photo.")],
    touch: options.Touches,
    output: options.Output,
    touch_weight: Annotated[float, typer.Option(help="Share of the touch in the mix; the photo has the rest.")] = 0.3,
    mix: Annotated[str, typer.Option(help="How touch and photo are mixed: linear, slerp or paper.")] = "linear",
    init_strength: Annotated[
        float | None,
        typer.Option(
            help="Start from the photo to keep its layout: near 0 it stays, at 1 it goes; from noise if left out."
        ),
    ] = None,
    prompt: options.Prompt = None,
    steps: options.Steps = None,
    solver: options.SolverName = None,
    tolerance: options.Tolerance = None,
    guidance: options.GuidanceScale = None,
    seed: options.Seed = 0,
    sensor: options.Sensor = None,
    background: options.Background = None,
    load_sensor: options.LoadSensor = None,
    model: options.Model = None,
    dtype: options.Dtype = None,
    batch_size: options.BatchSize = 8,
    as_json: options.AsJson = False,
) -> None:
    """Restyles a photo by each touch.

    Example: unitouch-gen stylize samples/inputs/photos/wood.png samples/inputs/gelsight_gravel.png -o restyled.png
    """
    from unitouch_gen.models.images import load_images

    if not 0.0 <= touch_weight <= 1.0:
        raise InvalidInputError(f"`--touch-weight` is {touch_weight:g}; pass a share from 0 to 1.")
    files = picture_files([f"{photo.stem}-{path.stem}" for path in touch], output, [photo, *touch])
    check_integers(seed=seed, batch_size=batch_size)
    load_images("photo", photo)
    check_pictures("touch", touch)
    arguments = {
        "image": photo,
        "touch": touch,
        "prompt": prompt,
        "touch_weight": touch_weight,
        "mix": mix,
        "init_strength": init_strength,
        "num_inference_steps": steps,
        "solver": solver,
        "tolerance": tolerance,
        "guidance_scale": guidance,
        "sensor": sensor,
        "background": background,
    }
    quiet = options.is_quiet(as_json)
    pipe = load_pipeline("stylization", model, quiet, arguments=arguments, dtype=dtype, sensors=load_sensor)
    report, _ = make_pictures(pipe, arguments, files, seed, batch_size, quiet=quiet)
    rows = [
        {"photo": str(photo), "touch": str(source), "picture": str(file), "sensor": name}
        for source, file, name in zip(touch, files, report.sensors, strict=True)
    ]
    print_results("pictures", rows, report, files, as_json)


def x_to_touch(
    output: options.Output,
    image: Annotated[Path | None, typer.Option(help="A photo to make a touch of.")] = None,
    text: Annotated[str | None, typer.Option(help="A description to make a touch of.")] = None,
    audio: Annotated[Path | None, typer.Option(help="A sound to make a touch of: wav, flac, ogg or mp3.")] = None,
    touch: Annotated[Path | None, typer.Option(help="A touch image to translate to another sensor.")] = None,
    source_sensor: Annotated[
        str | None, typer.Option(help="Name of the sensor that took --touch; found by its looks if left out.")
    ] = None,
    sensor: Annotated[
        list[str] | None,
        typer.Option(help="Sensor to draw for, the first if left out; may be repeated, and `all` draws for all."),
    ] = None,
    background: Annotated[
        Path | None,
        typer.Option(help="Picture of another sensor untouched, to draw for that one, of models that can."),
    ] = None,
    weight: Annotated[
        list[str] | None, typer.Option(help="Weight of one of several modalities, such as text=0.3; may be repeated.")
    ] = None,
    bridge: Annotated[
        bool,
        typer.Option("--bridge", metavar="", help="Move what is no photo towards the images the model was trained on."),
    ] = False,
    candidates: Annotated[int, typer.Option(help="Touch images made for each that is kept, the best.")] = 1,
    steps: options.Steps = None,
    solver: options.SolverName = None,
    tolerance: options.Tolerance = None,
    guidance: options.GuidanceScale = None,
    seed: options.Seed = 0,
    load_sensor: options.LoadSensor = None,
    model: options.Model = None,
    dtype: options.Dtype = None,
    batch_size: options.BatchSize = 8,
    as_json: options.AsJson = False,
) -> None:
    """Makes touch images of what is seen, read, heard, or felt by another sensor.

    Example: unitouch-gen x-to-touch --text "rough brick" --sensor all --bridge -o touches/
    """
    from unitouch_gen.files import check_writable
    from unitouch_gen.models.images import load_images
    from unitouch_gen.pipelines.x_to_touch import drawn_sensors
    from unitouch_gen.sampling import RunReport

    check_integers(seed=seed, candidates=candidates, batch_size=batch_size)
    modalities = {"image": image, "text": text, "audio": audio, "touch": touch}
    if all(value is None for value in modalities.values()):
        raise InvalidInputError("Nothing to make a touch of came; pass `--image`, `--text`, `--audio` or `--touch`.")
    for option, given in {"--source-sensor": source_sensor, "--load-sensor": load_sensor}.items():
        if given and touch is None:
            raise InvalidInputError(f"`{option}` came without `--touch`, on which it has no effect; leave it out.")
    if sensor and background:
        raise InvalidInputError("`--sensor` and `--background` both came, and each says whom to draw for; pass one.")
    check_writable("--output", output if is_one_file(output) else output / "touch.png")
    weights = modality_weights(weight) if weight else None
    for name, picture in (("image", image), ("touch", touch), ("background", background)):
        if picture is not None:
            load_images(name, picture)
    arguments: dict[str, Any] = {
        **modalities,
        "weights": weights,
        "bridge": bridge,
        "num_candidates": candidates,
        "source_sensor": source_sensor,
        "sensor": None if not sensor else sensor[0] if len(sensor) == 1 else sensor,
        "background": background,
        "num_inference_steps": steps,
        "solver": solver,
        "tolerance": tolerance,
        "guidance_scale": guidance,
    }
    quiet = options.is_quiet(as_json)
    pipe = load_pipeline("x-to-touch", model, quiet, arguments=arguments, dtype=dtype, sensors=load_sensor)
    drawn = drawn_sensors([] if background else pipe.config.sensors, arguments["sensor"])
    given = [path for path in (image, audio, touch, background) if path is not None]
    files = picture_files(drawn or ["touch"], output, given)

    pipe.set_progress_bar_config(disable=quiet)
    pictures, reports = list[Image.Image](), list[RunReport]()
    for start in range(0, len(files), batch_size):
        batch = files[start : start + batch_size]
        arguments["sensor"] = drawn[start : start + batch_size] or None
        result = pipe(**arguments, generator=generators(seed, len(batch), candidates))
        for picture, file in zip(result.images, batch, strict=True):
            save_picture(picture, file)
        pictures, reports = [*pictures, *result.images], [*reports, result.report]
    report = RunReport.joined(reports)
    first = reports[0]  # of the one input
    report.sensors, report.sensor_distances, report.unknown = first.sensors, first.sensor_distances, first.unknown
    note_endings(report, files)
    inputs = {name: [getattr(value, "name", repr(value))] for name, value in modalities.items() if value is not None}
    note_unfamiliar(pipe, report, inputs, source_sensor)
    names: list[str | None] = [*drawn] or [None]
    rows = [
        {"touch": str(file), "sensor": name, "materials": materials, "unknown": materials.unknown}
        for file, name, materials in zip(files, names, materials_of(pipe, pictures, names), strict=True)
    ]
    print_results("touches", rows, report, files, as_json, calibrated="touch" in pipe.unitouch.config.temperatures)


def modality_weights(items: list[str]) -> dict[str, float]:
    """ "text=0.3" and the like as weights by modality."""
    weights: dict[str, float] = {}
    for item in items:
        name, _, value = item.partition("=")
        if name in weights:
            raise InvalidInputError(f"`--weight` names {name!r} twice; give each modality one weight.")
        try:
            weights[name] = float(value)
        except ValueError as error:
            raise InvalidInputError(
                f"`--weight` is {item!r}; write a modality and a number, such as text=0.3."
            ) from error
    return weights


# Checks and files -----------------------------------------------------------------------------------------------------


MOST = 100_000
"""Candidates, or inputs at once: each has a random generator, of kilobytes, before memory is looked at."""


def check_integers(seed: int, **counts: int) -> None:
    """Refuses seeds and counts that cannot be used."""
    check_integer("seed", seed, 0, 2**63 - 1)
    for name, count in counts.items():
        check_integer(name, count, 1, MOST)


def check_pictures(name: str, files: list[Path]) -> None:
    """Reads every picture before any work is done, or one that cannot be read would end the work of hours."""
    from unitouch_gen.models.images import load_images

    for index, path in enumerate(files):
        load_images(f"{name}[{index}]", path)


def picture_files(stems: list[str], output: Path, inputs: list[Path]) -> list[Path]:
    """Where each picture goes: into a folder under its name, or to the one file named.

    Args:
        stems: Names of the pictures, without suffix; repeated ones get a number.
        output: A folder, or a file name for a single picture.
        inputs: Files that must not be replaced.

    Raises:
        InvalidInputError: If several pictures would go to one file, or the output cannot be written.
    """
    from unitouch_gen.files import check_writable

    if is_one_file(output):
        if output.suffix and not can_write(output.suffix):
            raise InvalidInputError(f"`--output` is {str(output)!r}, of no known picture format; use .png or .jpg.")
        if len(stems) > 1:
            raise InvalidInputError(
                f"`--output` is the file {str(output)!r} for {len(stems)} pictures; name a folder for several."
            )
        files = [output]
    else:
        if os.path.isfile(output):
            raise InvalidInputError(f"`--output` is {str(output)!r}, a file without a picture's suffix; name a folder.")
        files = [output / f"{stem}.png" for stem in unique(stems)]
    places = {os.path.realpath(path) for path in inputs}
    for file in files:
        if os.path.realpath(file) in places:
            raise InvalidInputError(f"`--output` would replace the input {str(file)!r}; name another folder or file.")
    check_writable("--output", files[0])
    return files


def is_one_file(output: Path) -> bool:
    """Whether an output is the name of a picture, or a device or pipe, rather than a folder."""
    from unitouch_gen.files import as_path

    output = as_path("--output", output)
    return not output.is_dir() and (output.suffix != "" or (output.exists() and not output.is_file()))


def can_write(suffix: str) -> bool:
    """Whether Pillow writes RGB pictures of this suffix; some formats it only reads, some have no colour."""
    try:
        Image.new("RGB", (16, 16)).save(io.BytesIO(), format=Image.registered_extensions()[suffix.lower()])
    except (KeyError, ValueError, OSError):
        return False
    return True


def unique(names: list[str]) -> list[str]:
    """Names of which repeated ones get a number, so no picture replaces another."""
    found: list[str] = []
    for name in names:
        free, count = name, 1
        while free.casefold() in {taken.casefold() for taken in found}:  # some file systems ignore case
            count += 1
            free = f"{name}-{count}"
        found.append(free)
    return found


def save_picture(image: Image.Image, file: Path) -> None:
    """Writes a picture whole, or leaves what was there."""
    from unitouch_gen.files import replacing

    with replacing("--output", file) as partial:
        image.save(partial, format=None if file.suffix else "PNG")  # devices have no suffix


# Calls ----------------------------------------------------------------------------------------------------------------


def make_pictures(
    pipe: Any, arguments: dict[str, Any], files: list[Path], seed: int, batch_size: int, *, quiet: bool
) -> "tuple[RunReport, Tensor]":
    """A picture for each touch of a call's arguments, saved as soon as its batch is made.

    Returns:
        The joined report, and the embeddings of all batches (N, D).
    """
    import torch

    from unitouch_gen.sampling import RunReport

    touch, results = arguments["touch"], []
    for start in range(0, len(touch), batch_size):
        batch = touch[start : start + batch_size]
        pipe.set_progress_bar_config(disable=quiet, desc=f"{start + len(batch)} of {len(touch)}")
        result = pipe(**{**arguments, "touch": batch}, generator=generators(seed, len(batch)))
        for picture, file in zip(result.images, files[start : start + batch_size], strict=True):
            save_picture(picture, file)
        results.append((result.report, result.embeds))
    report = RunReport.joined([report for report, _ in results])
    note_endings(report, files)
    given = {"touch": [path.name for path in touch], "image": [Path(arguments.get("image") or "").name]}
    report.unknown |= {name: report.unknown[name][:1] for name in ("image",) if name in report.unknown}  # of one photo
    note_unfamiliar(pipe, report, given, arguments["sensor"], compared=arguments["background"] is None)
    return report, torch.cat([embeds for _, embeds in results])


def generators(seed: int, count: int, candidates: int = 1) -> list[Any]:
    """One for each candidate of each picture, which depends on its own input and the seed, not on its neighbours."""
    import torch

    return [torch.Generator().manual_seed(seed + number) for _ in range(count) for number in range(candidates)]


def materials_of(pipe: Any, pictures: list[Image.Image], sensors: list[str | None]) -> "list[Named]":
    """What touch images that were drawn feel like, as `MaterialNamer` has it; empty where the model cannot tell.

    Args:
        pipe: Whose joint space is asked.
        pictures: The touch images.
        sensors: Sensor of each, `None` where the model draws one without a name.
    """
    from unitouch_gen.evaluation.zero_shot import MaterialNamer, Named

    if pipe.processor.tokenizer is None:  # one that `from_pipe` made has none
        return [Named({}) for _ in pictures]
    known = pipe.unitouch.sensors
    unknown = [name for name in sensors if name is not None and name not in known]
    if unknown:
        options.note(
            f"what touches of {', '.join(unknown)} feel like is left out, as the model's touch encoder "
            f"knows {', '.join(known) or 'no sensor'} only"
        )
    asked = [row for row, name in enumerate(sensors) if name not in unknown]
    materials = {}
    if asked:
        namer = MaterialNamer(pipe.unitouch, pipe.processor)
        named = namer.touch([pictures[row] for row in asked], sensor=[sensors[row] for row in asked])
        materials = dict(zip(asked, named, strict=True))
    return [materials.get(row) or Named({}) for row in range(len(pictures))]


# What is printed ------------------------------------------------------------------------------------------------------


def note_endings(report: "RunReport", files: list[Path]) -> None:
    """A line for each picture that was made, but not as it should be: diverged, say."""
    from unitouch_gen.sampling import ReturnCode

    for sample, file in zip(report.chosen or range(len(files)), files, strict=True):
        code = report.codes[sample]
        if code is not ReturnCode.SUCCESS:
            options.note(f"{file.name} is {code.value}: {options.as_options(code.message)}")


def note_unfamiliar(
    pipe: Any,
    report: "RunReport",
    names: dict[str, list[str]],
    sensor: str | list[str] | None,
    compared: bool = True,
) -> None:
    """A line on those inputs of a run that are unlike any the model knows, by their names.

    Args:
        pipe: That ran.
        report: Of it.
        names: Of the inputs, by modality.
        sensor: As it was asked for.
        compared: Whether `report.sensor_distances` are of the touches, and not of a background.
    """
    from unitouch_gen.models import SensorMatch
    from unitouch_gen.pipelines.common import unfamiliar_touches, unknown_inputs

    matches = list(map(SensorMatch, report.sensors, report.sensor_distances)) if compared else []
    far = unfamiliar_touches(pipe.unitouch, matches, sensor, names.get("touch", []))
    for message in (far, unknown_inputs(report.unknown, names)):
        if message:
            options.note(message)


COLUMNS = {"touch": "touch", "picture": "picture", "sensor": "sensor", "materials": "feels like"}
"""Headings of tables, by the keys of rows."""


def print_results(
    kind: str,
    rows: list[dict[str, Any]],
    report: "RunReport",
    files: list[Path],
    as_json: bool,
    calibrated: bool = False,
) -> None:
    """A row for each file of a kind, "pictures" or "touches", and the report: as one JSON object, or for people.

    `calibrated` says whether the probabilities of materials are.
    """
    if as_json:
        typer.echo(json.dumps({kind: rows, "report": report.to_dict()}))
        return
    keys = [key for key in COLUMNS if key in rows[0]]
    options.print_table([COLUMNS[key] for key in keys], [[cell(key, row[key]) for key in keys] for row in rows])
    if "materials" in keys:
        kept = "how often it is right on touches like those of training" if calibrated else "not calibrated"
        typer.echo(
            f"A percentage is how sure the model is of a material ({kept}); the solver's error is no part of it."
        )
    what = "Pictures" if kind == "pictures" else "Touch images"
    typer.echo(f"{what} are in {files[0].parent.resolve()}")
    typer.echo(f"Run report: {report}")


def cell(key: str, value: Any) -> str:
    """A value of a row in a table: the name of a file, "-" for no sensor, or "brick 80%, tile 12%"."""
    if key == "materials":
        return str(value)
    return value or "-" if key == "sensor" else Path(value).name
