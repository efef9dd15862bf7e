"""`unitouch-gen watch`: a touch sensor, or a video of one, while it is touched."""

import json
import os
import sys
from collections.abc import Iterator
from itertools import chain, count, islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from unitouch_gen.cli import options
from unitouch_gen.cli.loading import load_pipeline
from unitouch_gen.cli.pictures import classifier_of, endings, generators, is_one_file, save_picture
from unitouch_gen.errors import InvalidInputError, check_integer

if TYPE_CHECKING:
    import numpy as np

    from unitouch_gen.models.videos import Contact, ContactTracker

CAMERAS = {"linux": ("v4l2", "/dev/video{}"), "darwin": ("avfoundation", "{}")}
"""PyAV's format of cameras, and what it calls the one of an index, by system."""

WIDEST = 30
"""Characters of the bar of contact."""

FIRMEST = 0.1
"""Share of full scale by which the whole image differs from the gel at rest where the bar is full."""


@options.with_call
def watch(
    source: Annotated[str, typer.Argument(help="Index of a camera, such as 0; or a video file.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="A folder for touches and pictures.")],
    *,
    prompt: options.Prompt = None,
    sensor: options.Sensor = None,
    background: Annotated[
        Path | None,
        typer.Option(
            help="Picture of the sensor untouched; seen in the first quiet frames if left out.",
            callback=options.check_picture,
        ),
    ] = None,
    recentre: Annotated[
        bool, typer.Option("--recentre", metavar="", help="Re-centre touches on it, for a sensor not known.")
    ] = False,
    bgr: Annotated[bool, typer.Option("--bgr", metavar="", help="Frames have blue in the place of red.")] = False,
    loop: Annotated[bool, typer.Option("--loop", metavar="", help="Begin a video anew where it ends.")] = False,
    touches: Annotated[int | None, typer.Option(help="Stop after so many; goes on until Ctrl-C if left out.")] = None,
    call: options.Call,
) -> None:
    """Shows contact, sensor and material while a sensor is touched, and makes a picture of every new touch.

    Leave the sensor alone for the first moment. Needs PyAV, of the extra `train`.

    Example: unitouch-gen watch 0 -o touches/
    """
    from unitouch_gen.files import check_file, check_writable

    if not source.isdecimal():
        check_file("source", source, "a video")  # before anything large is imported
    from unitouch_gen.models.videos import ContactTracker

    call.check()
    if touches is not None:
        check_integer("--touches", touches, 1, options.MOST)
    if is_one_file(output) or os.path.isfile(output):
        raise InvalidInputError(f"`--output` is {str(output)!r}; name a folder.")
    check_writable("--output", output / "1-picture.png")
    tracker = ContactTracker("bgr" if bgr else "rgb", background, name="source")
    frames = frames_of(source, loop)
    first = list(islice(frames, 1))  # what cannot be read is told before a model is loaded
    given = {"prompt": prompt, "sensor": sensor, **call.arguments, "num_images_per_prompt": call.images}
    pipe = load_pipeline("touch-to-image", quiet=True, arguments={"touch": source, **given}, **call.loading)
    pipe.set_progress_bar_config(disable=True)
    classifier = classifier_of(pipe)
    numbers = (number for number in count(1) if not any(output.glob(f"{number}-*.png")))
    live, made, last = sys.stderr.isatty() and not call.as_json, 0, ""
    try:
        for frame in chain(first, frames):
            tracker.update(frame)
            if live:
                show(tracker, last)
            if tracker.settled and tracker.contact is not None:
                row = picture_of(pipe, classifier, tracker.contact, recentre, given, output, next(numbers), call)
                made, last = made + 1, f"{row['sensor'] or '-'}  {row['feels']}"
                tell(made, row, call.as_json, live)
                if made == touches:
                    break
    except KeyboardInterrupt:
        pass
    if live:
        print(file=sys.stderr)
    if tracker.background is None:
        options.note("no quiet frames came that would show the gel at rest; leave the sensor alone at first")
    if not call.as_json:
        where = f"; they are in {output.resolve()}" if made else ""
        typer.echo(f"{tracker.count} frames, {made} touch{'es' * (made != 1)}{where}")


def frames_of(source: str, loop: bool) -> "Iterator[np.ndarray]":
    """Frames of a camera or a video file."""
    from unitouch_gen.models.videos import read_video

    if not source.isdecimal():
        return (frame for _ in (count() if loop else range(1)) for frame in read_video("source", source))
    if sys.platform not in CAMERAS:
        raise InvalidInputError(f"`source` is {source!r}; cameras are known by index on Linux and macOS alone.")
    if loop:
        raise InvalidInputError("`--loop` came, on which a camera has no end; leave it out.")
    form, place = CAMERAS[sys.platform]
    return read_video("source", place.format(int(source)), form=form)


def picture_of(
    pipe: Any,
    classifier: Any,
    contact: "Contact",
    recentre: bool,
    given: dict[str, Any],
    output: Path,
    number: int,
    call: options.Call,
) -> dict[str, Any]:
    """Saves a contact's frame and its pictures, and says what was felt."""
    from PIL import Image

    from unitouch_gen.models.images import load_images

    behind = contact.background if recentre else None
    seeds = generators(call.seed, range(call.images))
    result = pipe(touch=contact.frame, background=behind, **given, generator=seeds)
    touch = output / f"{number}-touch.png"
    pixels = load_images("source", contact.frame)[0]
    bytes_of = pixels if not pixels.is_floating_point() else (pixels * 255).round().byte()
    save_picture(Image.fromarray(bytes_of.permute(1, 2, 0).numpy()), touch)
    numbers = [""] if call.images == 1 else [f"-{row + 1}" for row in range(call.images)]
    files = [output / f"{number}-picture{of_one}.png" for of_one in numbers]
    for picture, file in zip(result.images, files, strict=True):
        save_picture(picture, file)
    options.note(*endings(result.report, files))
    unknown = result.report.unknown.get("touch") or [None]
    materials = classifier.name(result.encoded[:1], "touch", unknown=unknown) if classifier else [{}]
    return {
        "frame": contact.index,
        "firmness": contact.firmness,
        "touch": str(touch),
        "pictures": list(map(str, files)),
        "sensor": result.report.sensors[0],
        "materials": materials[0],
        "unknown": unknown[0],
        "feels": str(materials[0]) if classifier else "",
    }


# What is shown --------------------------------------------------------------------------------------------------------


def tell(number: int, row: dict[str, Any], as_json: bool, live: bool) -> None:
    """A line on a touch."""
    if as_json:
        typer.echo(json.dumps({name: value for name, value in row.items() if name != "feels"}))
        return
    if live:
        print("\r\x1b[K", end="", file=sys.stderr, flush=True)
    typer.echo(f"Touch {number}: {row['sensor'] or '-'}, {row['feels'] or 'no names'}: {', '.join(row['pictures'])}")


def show(tracker: "ContactTracker", last: str) -> None:
    """The state of things on the last line of a terminal."""
    filled = min(round(tracker.firmness / FIRMEST * WIDEST), WIDEST) if tracker.touched else 0
    state = "waiting for a quiet moment" if tracker.background is None else "contact" if tracker.touched else "at rest"
    bar = "█" * filled + "·" * (WIDEST - filled)
    print(f"\r\x1b[K{tracker.count - 1:6d} {bar} {state}  {last}"[:160], end="", file=sys.stderr, flush=True)
