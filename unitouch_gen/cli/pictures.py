"""`unitouch-gen touch-to-image`, `stylize` and `x-to-touch`: pictures from files to files.

What can be refused is refused before anything is loaded, and a folder is made when the first picture is saved, so a
mistake leaves nothing behind.
"""

import io
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from PIL import Image

from unitouch_gen.cli import options
from unitouch_gen.cli.inputs import STDIN, files_of, stem_of, texts_of
from unitouch_gen.cli.loading import load_pipeline
from unitouch_gen.errors import InvalidInputError

if TYPE_CHECKING:
    from torch import Tensor

    from unitouch_gen.evaluation.zero_shot import Named, ZeroShotTouchClassifier
    from unitouch_gen.sampling import RunReport

# Commands -------------------------------------------------------------------------------------------------------------


@options.with_call
def touch_to_image(
    touch: options.Touches,
    output: options.Output,
    *,
    prompt: options.Prompt = None,
    negative_prompt: options.NegativePrompt = None,
    strength: options.Strength = None,
    noise_level: options.NoiseLevel = None,
    sensor: options.Sensor = None,
    background: options.Background = None,
    bridge: options.Bridge = None,
    call: options.Call,
) -> None:
    """Makes a picture of what each touch feels like.

    Example: unitouch-gen touch-to-image example:brick example:wood -o pictures/
    """
    call.check()
    touches = files_of("touch", touch, "touch")
    items = items_of(touches, call.images)
    files = picture_files([item.stem for item in items], output, touches, call.overwrite)
    check_inputs("touch", touches)
    given = {
        "prompt": prompt,
        "negative_prompt": negative_prompt,
        "strength": strength,
        "noise_level": noise_level,
        "sensor": sensor,
        "background": background,
        "bridge": bridge,
        **call.arguments,
    }
    quiet = options.is_quiet(call.as_json)
    pipe = load_pipeline("touch-to-image", quiet=quiet, arguments={"touch": touches, **given}, **call.loading)
    made = make_pictures(pipe, given, {"touch": touches}, items, files, call)
    options.note(*endings(made.report, files))
    options.note(*unfamiliar(made.report, touches, items))
    materials = felt(pipe, made)
    rows = [
        {
            "touch": shown(touches[item.source]),
            "picture": str(file),
            "sensor": made.report.sensors[row],
            "sensor_distance": made.report.sensor_distances[row],
            "materials": materials[row],
            "unknown": materials[row].unknown,
        }
        for row, (item, file) in enumerate(zip(items, files, strict=True))
    ]
    print_results("pictures", rows, made.report, files, call.as_json, sureness(pipe))


@options.with_call
def stylize(
    photo: Annotated[str, typer.Argument(help="The photo: a file, - for standard input, or example:wood and such.")],
    touch: options.Touches,
    output: options.Output,
    *,
    touch_weight: Annotated[float, typer.Option(help="Share of the touch in the mix; the photo has the rest.")] = 0.3,
    mix: Annotated[str, typer.Option(help="How touch and photo are mixed: linear, slerp or paper.")] = "linear",
    init_strength: Annotated[
        float, typer.Option(help="How much of the photo's layout goes: near 0 it stays, at 1 it starts from noise.")
    ] = 0.65,
    prompt: options.Prompt = None,
    negative_prompt: options.NegativePrompt = None,
    strength: options.Strength = None,
    noise_level: options.NoiseLevel = None,
    sensor: options.Sensor = None,
    background: options.Background = None,
    bridge: options.Bridge = None,
    call: options.Call,
) -> None:
    """Restyles a photo by each touch.

    Example: unitouch-gen stylize example:wood example:gravel -o restyled.png
    """
    if not 0.0 <= touch_weight <= 1.0:
        raise InvalidInputError(f"`--touch-weight` is {touch_weight:g}; pass a share from 0 to 1.")
    call.check()
    photos, touches = files_of("photo", [photo], "image"), files_of("touch", touch, "touch")
    if len(photos) > 1:
        raise InvalidInputError(f"`photo` is {photo!r}, {len(photos)} files; name one of them.")
    items = items_of(touches, call.images, before=f"{stem_of(photos[0])}-")
    files = picture_files([item.stem for item in items], output, [*photos, *touches], call.overwrite)
    check_inputs("photo", photos)
    check_inputs("touch", touches)
    given = {
        "image": photos[0],
        "prompt": prompt,
        "negative_prompt": negative_prompt,
        "touch_weight": touch_weight,
        "mix": mix,
        "init_strength": init_strength,
        "noise_level": noise_level,
        "sensor": sensor,
        "background": background,
        "bridge": bridge,
        **({} if strength is None else {"strength": strength}),
        **call.arguments,
    }
    quiet = options.is_quiet(call.as_json)
    pipe = load_pipeline("stylization", quiet=quiet, arguments={"touch": touches, **given}, **call.loading)
    made = make_pictures(pipe, given, {"touch": touches}, items, files, call)
    options.note(*endings(made.report, files))
    options.note(*unfamiliar(made.report, touches, items))
    rows = [
        {"photo": shown(photos[0]), "touch": shown(touches[item.source]), "picture": str(file), "sensor": name}
        for item, file, name in zip(items, files, made.report.sensors, strict=True)
    ]
    print_results("pictures", rows, made.report, files, call.as_json)


SEVERAL = "files, folders, patterns, - or example:NAME; may be repeated"


@options.with_call
def x_to_touch(
    output: options.Output,
    *,
    image: Annotated[list[str] | None, typer.Option(help=f"A photo to make a touch of: {SEVERAL}.")] = None,
    text: Annotated[
        list[str] | None, typer.Option(help="A description to make a touch of; - for lines; may be repeated.")
    ] = None,
    audio: Annotated[
        list[str] | None, typer.Option(help=f"A sound to make a touch of, wav, flac, ogg or mp3: {SEVERAL}.")
    ] = None,
    touch: Annotated[
        list[str] | None, typer.Option(help=f"A touch image to translate to another sensor: {SEVERAL}.")
    ] = None,
    source_sensor: Annotated[
        str | None, typer.Option(help="Name of the sensor that took --touch; found by its looks if left out.")
    ] = None,
    sensor: Annotated[
        list[str] | None,
        typer.Option(help="Sensor to draw for, the first if left out; may be repeated, and `all` draws for all."),
    ] = None,
    background: Annotated[
        Path | None,
        typer.Option(
            help="Picture of an untouched gel, to draw for a sensor without a name, in place of --sensor.",
            callback=options.check_picture,
        ),
    ] = None,
    weight: Annotated[
        list[str] | None, typer.Option(help="Weight of one of several modalities, such as text=0.3; may be repeated.")
    ] = None,
    bridge: options.Bridge = None,
    candidates: Annotated[int, typer.Option(help="Touch images made for each that is kept, the best.")] = 1,
    call: options.Call,
) -> None:
    """Makes touch images of what is seen, read, heard, or felt by another sensor.

    Several inputs of one option make a touch each, and go in pairs, or all with one, with those of the others. Pictures
    are named after their inputs and sensor.

    Example: unitouch-gen x-to-touch --text "rough brick" --sensor all -o touches/
    """
    from unitouch_gen.files import check_writable

    call.check(candidates=candidates)
    inputs: dict[str, list[Any]] = {
        name: texts_of(words) if name == "text" else files_of(f"--{name}", words, name)
        for name, words in {"image": image, "text": text, "audio": audio, "touch": touch}.items()
        if words
    }
    if not any(inputs.values()):
        raise InvalidInputError("Nothing to make a touch of came; pass `--image`, `--text`, `--audio` or `--touch`.")
    for option, value in {"--source-sensor": source_sensor, "--load-sensor": call.load_sensor}.items():
        if value and not touch:
            raise InvalidInputError(f"`{option}` came without `--touch`, on which it has no effect; leave it out.")
    if sensor and background:
        raise InvalidInputError("`--background` came with `--sensor`, which has its own; leave one of them out.")
    inputs = in_pairs(inputs)
    check_writable("--output", output if is_one_file(output) else output / "touch.png")
    for name, values in inputs.items():
        check_inputs(name, values)
    if background is not None:
        check_inputs("background", [background])
    given: dict[str, Any] = {
        "weights": modality_weights(weight) if weight else None,
        "bridge": bridge,
        "num_candidates": candidates,
        "source_sensor": source_sensor,
        "sensor": None if not sensor else sensor[0] if len(sensor) == 1 else sensor,
        "background": background,
        **call.arguments,
    }
    from unitouch_gen.pipelines.x_to_touch import drawn_sensors  # takes seconds, which a mistake should not

    quiet = options.is_quiet(call.as_json)
    pipe = load_pipeline("x-to-touch", quiet=quiet, arguments={**inputs, **given}, **call.loading)
    asked = given.pop("sensor")
    drawn = [] if background is not None else drawn_sensors(pipe.config.sensors, asked)
    stems = ["-".join(map(stem_of, values)) for values in zip(*inputs.values(), strict=True)]
    items = items_of(stems, call.images, drawn or [None])
    sources = [value for values in inputs.values() for value in values if isinstance(value, Path)]
    files = picture_files([item.stem for item in items], output, sources, call.overwrite)
    made = make_pictures(pipe, given, inputs, items, files, call, candidates)
    options.note(*endings(made.report, files), *unfamiliar(made.report, inputs.get("touch", []), items))
    materials = materials_of(pipe, made.pictures, [item.sensor for item in items])
    rows = [
        {
            "touch": str(file),
            "of": {name: shown(values[item.source]) for name, values in inputs.items()},
            "sensor": item.sensor,
            "materials": named,
            "unknown": named.unknown,
        }
        for item, file, named in zip(items, files, materials, strict=True)
    ]
    print_results("touches", rows, made.report, files, call.as_json, sureness(pipe))


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


def check_inputs(name: str, values: list[Any]) -> None:
    """Reads every input before any work is done, or one that cannot be read would end the work of hours."""
    from unitouch_gen.models.images import load_images
    from unitouch_gen.models.sounds import check_audible, load_sounds
    from unitouch_gen.models.videos import still
    from unitouch_gen.pipelines.x_to_touch import check_not_blank

    if name == "text":
        check_not_blank(values if len(values) > 1 else values[0])
        return
    for index, value in enumerate(values):
        numbered = f"{name}[{index}]" if len(values) > 1 else name
        if name == "audio":
            check_audible(numbered, load_sounds(numbered, value))
        else:
            load_images(numbered, still(numbered, value) if name == "touch" else value)


def in_pairs(inputs: dict[str, list[Any]]) -> dict[str, list[Any]]:
    """Inputs by modality, as many of each: one goes with all of another."""
    most = max(map(len, inputs.values()))
    for name, values in inputs.items():
        if len(values) not in (1, most):
            raise InvalidInputError(
                f"`--{name}` came {len(values)} times, where another came {most} times; pass one, or as many."
            )
    return {name: values * (most if len(values) == 1 else 1) for name, values in inputs.items()}


def shown(source: Path | str) -> str:
    """An input as it was named."""
    return STDIN if isinstance(source, Path) and source.name == "stdin" else str(source)


def picture_files(stems: list[str], output: Path, inputs: list[Path], overwrite: bool = False) -> list[Path]:
    """Where each picture goes: into a folder under its name, or to the one file named.

    Args:
        stems: Names of the pictures, without suffix; repeated ones get a number.
        output: A folder, or a file name for a single picture.
        inputs: Files that must not be replaced.
        overwrite: Whether other files may be.
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
    if not overwrite:
        options.check_new(files)
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
    found: dict[str, str] = {}  # by what they are where case is ignored
    for name in names:
        free, count = name, 1
        while free.casefold() in found:
            count += 1
            free = f"{name}-{count}"
        found[free.casefold()] = free
    return list(found.values())


def save_picture(image: Image.Image, file: Path) -> None:
    """Writes a picture whole, or leaves what was there."""
    from unitouch_gen.files import replacing

    with replacing("--output", file) as partial:
        image.save(partial, format=None if file.suffix else "PNG")  # devices have no suffix


# Calls ----------------------------------------------------------------------------------------------------------------


@dataclass
class Item:
    """One picture that is to be made.

    Attributes:
        source: Row of its inputs.
        stem: Its name, without suffix.
        number: Among the pictures of these inputs, from 0.
        sensor: That it is drawn for, if it is a touch image.
    """

    source: int
    stem: str
    number: int
    sensor: str | None


def items_of(
    sources: Sequence[Path | str], images: int, sensors: Sequence[str | None] = (None,), before: str = ""
) -> list[Item]:
    """The pictures of some inputs, in their order: `images` of each, for each of some sensors.

    Args:
        sources: Inputs, or their stems.
        images: Pictures of each; they get numbers from 1 where there are several.
        sensors: Sensors; `None` is one without a name.
        before: What names begin with.
    """
    return [
        Item(
            row,
            before
            + "-".join(
                [
                    source if isinstance(source, str) else stem_of(source),
                    *([sensor] if sensor else []),
                    *([str(number + 1)] if images > 1 else []),
                ]
            ),
            number,
            sensor,
        )
        for row, source in enumerate(sources)
        for sensor in sensors
        for number in range(images)
    ]


@dataclass
class Made:
    """What has become of some items: the joined report, embeddings (N, D), and pictures where they are of touches."""

    report: "RunReport"
    embeds: "Tensor"
    pictures: list[Image.Image]


def make_pictures(
    pipe: Any,
    arguments: dict[str, Any],
    inputs: dict[str, list[Any]],
    items: list[Item],
    files: list[Path],
    call: options.Call,
    candidates: int | None = None,
) -> Made:
    """A picture for each item, saved as soon as its batch is made.

    Args:
        pipe: That makes them.
        arguments: Of its calls, beside the inputs.
        inputs: Rows of them by the argument that they go to.
        items: What to make.
        files: Where each goes.
        call: Options.
        candidates: Of each touch image; `None` for pictures.
    """
    import torch

    from unitouch_gen.sampling import RunReport

    quiet, kept = options.is_quiet(call.as_json), list[Image.Image]()
    reports, embeds = list[RunReport](), list[torch.Tensor]()
    for start in range(0, len(items), call.batch_size):
        batch = items[start : start + call.batch_size]
        pipe.set_progress_bar_config(disable=quiet, desc=f"{start + len(batch)} of {len(items)}")
        own: dict[str, Any] = {name: [values[item.source] for item in batch] for name, values in inputs.items()}
        if len(batch) == 1:  # by which messages go without a number
            own = {name: values[0] for name, values in own.items()}
        sensors = [item.sensor for item in batch]
        if candidates is not None:
            own["sensor"] = sensors if any(sensors) else None
        seeds = generators(call.seed, [item.number for item in batch], candidates or 1)
        result = pipe(**arguments, **own, generator=seeds)
        for picture, file in zip(result.images, files[start : start + call.batch_size], strict=True):
            save_picture(picture, file)
        kept += result.images if candidates is not None else []
        reports.append(result.report)
        embeds.append(result.embeds if result.encoded is None else result.encoded)
    return Made(RunReport.joined(reports), torch.cat(embeds), kept)


def generators(seed: int, numbers: Sequence[int], candidates: int = 1) -> list[Any]:
    """One for each candidate of each picture, which depends on its own input, its number and the seed alone."""
    import torch

    return [
        torch.Generator().manual_seed(seed + number * candidates + candidate)
        for number in numbers
        for candidate in range(candidates)
    ]


def classifier_of(pipe: Any) -> "ZeroShotTouchClassifier | None":
    """What names touches by a pipeline's joint space; `None` where it reads no words, as one that `from_pipe` made."""
    from unitouch_gen.evaluation.zero_shot import ZeroShotTouchClassifier

    if pipe.processor.tokenizer is None:
        return None
    return ZeroShotTouchClassifier(pipe.unitouch, pipe.processor, pipe.read_bank())


def felt(pipe: Any, made: Made) -> "list[Named]":
    """What touches feel like that pictures were made of, as `materials_of` says of those that were drawn."""
    from unitouch_gen.evaluation.zero_shot import Named

    unknown, classifier = made.report.unknown.get("touch") or [None] * len(made.embeds), classifier_of(pipe)
    if classifier is None:
        return [Named({}, reason) for reason in unknown]
    return classifier.name(made.embeds, "touch", unknown=unknown)


def materials_of(pipe: Any, pictures: list[Image.Image], sensors: list[str | None]) -> "list[Named]":
    """What touch images that were drawn feel like, by a `ZeroShotTouchClassifier`; empty where the model cannot tell.

    Args:
        pipe: Whose joint space is asked.
        pictures: The touch images.
        sensors: Sensor of each, `None` where the model draws one without a name.
    """
    from unitouch_gen.evaluation.zero_shot import Named

    classifier = classifier_of(pipe)
    if classifier is None:
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
        shown = [pictures[row] for row in asked]
        named = classifier(shown, sensor=[sensors[row] for row in asked], top=3)
        materials = dict(zip(asked, named, strict=True))
    return [materials.get(row) or Named({}) for row in range(len(pictures))]


# What is told ---------------------------------------------------------------------------------------------------------


def endings(report: "RunReport", files: list[Path]) -> list[str]:
    """A line for each picture that was made, but not as it should be: diverged, say."""
    codes = [report.codes[sample] for sample in report.chosen or range(len(files))]
    return [
        f"{file.name} is {code.value}: {options.as_options(code.message)}"
        for file, code in zip(files, codes, strict=True)
        if code != "success"
    ]


def unfamiliar(report: "RunReport", touches: list[Any], items: list[Item]) -> list[str]:
    """A line on those touches of a run that the model does not know, by their names.

    Args:
        report: Of the run, with a row for each item.
        touches: What the items were made of.
        items: What was made of them.
    """
    from unitouch_gen.models.out_of_distribution import describe_unknown

    reasons = report.unknown.get("touch", [])
    sources = [item.source for item in items]
    rows = [row for row, source in enumerate(sources) if row == 0 or source != sources[row - 1]]  # the first of each
    reasons = reasons[:1] if len(touches) == 1 else [reasons[row] for row in rows if reasons]
    names = [getattr(touch, "name", repr(touch)) for touch in touches]
    return [line for line in [describe_unknown(reasons, names)] if reasons and line]


def sureness(pipe: Any) -> str:
    """What the percentages of materials are."""
    classifier = classifier_of(pipe)
    calibrated = classifier is not None and classifier.calibrated
    kept = "calibrated on touches like those it was trained on" if calibrated else "not calibrated"
    return f"A percentage is how sure the model is of a material ({kept}); the solver's error is no part of it."


COLUMNS = {"touch": "touch", "picture": "picture", "sensor": "sensor", "materials": "feels like"}
"""Headings of tables, by the keys of rows."""


def print_results(
    kind: str,
    rows: list[dict[str, Any]],
    report: "RunReport",
    files: list[Path],
    as_json: bool,
    percentages: str = "",
) -> None:
    """A row for each file of a kind, "pictures" or "touches", and the report: as one JSON object, or for people.

    `percentages` says what those of materials are, where there are such.
    """
    if as_json:
        typer.echo(json.dumps({kind: rows, "report": report.to_dict()}))
        return
    keys = [key for key in COLUMNS if key in rows[0]]
    options.print_table([COLUMNS[key] for key in keys], [[cell(key, row[key]) for key in keys] for row in rows])
    if percentages and any("%" in cell("materials", row.get("materials")) for row in rows):
        typer.echo(percentages)
    what = "Pictures" if kind == "pictures" else "Touch images"
    typer.echo(f"{what} are in {files[0].parent.resolve()}")
    typer.echo(f"Run report: {report}")


def cell(key: str, value: Any) -> str:
    """A value of a row in a table: the name of a file, "-" for no sensor, or "brick 80%, tile 12%"."""
    if key == "materials":
        return str(value)
    return value or "-" if key == "sensor" else Path(value).name
