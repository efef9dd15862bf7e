"""`unitouch-gen x-to-touch`."""

import json
from pathlib import Path
from typing import Annotated

import typer

from unitouch_gen.cli.batches import note_unfamiliar, without_warning
from unitouch_gen.cli.files import picture_files, save_picture
from unitouch_gen.cli.loading import load_pipeline
from unitouch_gen.cli.options import (
    AsJson,
    GuidanceScale,
    Model,
    Output,
    Seed,
    SolverName,
    Steps,
    Tolerance,
    check_common,
    generators,
    is_quiet,
    print_table,
    shares,
)


def x_to_touch(
    output: Output,
    image: Annotated[Path | None, typer.Option(help="A photo to make a touch of.")] = None,
    text: Annotated[str | None, typer.Option(help="A description to make a touch of.")] = None,
    audio: Annotated[Path | None, typer.Option(help="A sound to make a touch of: wav, flac, ogg or mp3.")] = None,
    touch: Annotated[Path | None, typer.Option(help="A touch image to translate to another sensor.")] = None,
    sensor: Annotated[
        list[str] | None, typer.Option(help="Whose image to draw; may be repeated, and `all` draws all there are.")
    ] = None,
    weight: Annotated[
        list[str] | None, typer.Option(help="Of one of several senses, such as text=0.3; may be repeated.")
    ] = None,
    bridge: Annotated[
        bool, typer.Option("--bridge", help="Move what is no photo towards the images the model was trained on.")
    ] = False,
    candidates: Annotated[int, typer.Option(help="Made for each touch image; the best one is kept.")] = 1,
    steps: Steps = None,
    solver: SolverName = None,
    tolerance: Tolerance = None,
    guidance: GuidanceScale = None,
    seed: Seed = 0,
    model: Model = None,
    as_json: AsJson = False,
) -> None:
    """Makes touch images of what is seen, read, heard, or felt by another sensor."""
    from unitouch_gen.encoders.pixels import load_images
    from unitouch_gen.errors import InvalidInputError, check_integer
    from unitouch_gen.evaluation.zero_shot import MaterialNamer

    check_common(seed)
    check_integer("candidates", candidates, 1)
    senses = {"image": image, "text": text, "audio": audio, "touch": touch}
    if all(value is None for value in senses.values()):
        raise InvalidInputError("Nothing to make a touch of came; pass `--image`, `--text`, `--audio` or `--touch`.")
    weights = None if not weight else dict(sense_weight(item) for item in weight)
    for name in ("image", "touch"):
        if senses[name] is not None:
            load_images(name, senses[name])
    quiet = is_quiet(as_json)
    pipe = load_pipeline("x-to-touch", [name for name, value in senses.items() if value is not None], model, quiet)
    known = list(pipe.config.sensors)
    drawn = known if sensor == ["all"] else list(sensor or known[:1])
    inputs = [path for path in (image, audio, touch) if path is not None]
    files = picture_files(drawn or ["touch"], output, inputs)

    pipe.set_progress_bar_config(disable=quiet)
    result = without_warning(
        pipe,
        **senses,
        weights=weights,
        bridge="nearest" if bridge else None,
        sensor=drawn or None,
        num_candidates=candidates,
        num_inference_steps=steps,
        solver=solver,
        tolerance=tolerance,
        guidance_scale=guidance,
        generator=generators(seed, len(files), candidates),
    )
    for picture, file in zip(result.images, files, strict=True):
        save_picture(picture, file)
    if touch is not None:
        note_unfamiliar(pipe, result.report, [touch])

    felt: list[dict[str, float]] = [{} for _ in files]
    if pipe.processor.tokenizer is not None:
        felt = MaterialNamer(pipe.unitouch, pipe.processor).touch(files, sensor=drawn or None)
    rows = [
        {"touch": str(file), "sensor": name, "materials": materials}
        for file, name, materials in zip(files, drawn or [None], felt, strict=True)
    ]
    if as_json:
        typer.echo(json.dumps({"touches": rows, "report": result.report.to_dict()}))
        return
    cells = [[file.name, row["sensor"] or "-", shares(row["materials"])] for file, row in zip(files, rows, strict=True)]
    print_table(["touch", "sensor", "feels like"], cells)
    typer.echo(f"Touch images are in {files[0].parent.resolve()}")
    typer.echo(f"Run report: {result.report}")


def sense_weight(item: str) -> tuple[str, float]:
    """ "text=0.3" as a sense and its weight.

    Raises:
        InvalidInputError: If it is not of that form.
    """
    from unitouch_gen.errors import InvalidInputError

    name, _, value = item.partition("=")
    try:
        return name, float(value)
    except ValueError as error:
        raise InvalidInputError(f"`--weight` is {item!r}; write a sense and a number, such as text=0.3.") from error
