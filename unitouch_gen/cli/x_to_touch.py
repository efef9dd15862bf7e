"""`unitouch-gen x-to-touch`."""

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from unitouch_gen.cli.batches import note_endings, note_unfamiliar, without_warning
from unitouch_gen.cli.files import picture_files, save_picture
from unitouch_gen.cli.loading import load_for
from unitouch_gen.cli.options import (
    AsJson,
    Dtype,
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
        list[str] | None, typer.Option(help="Of one of several modalities, such as text=0.3; may be repeated.")
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
    dtype: Dtype = None,
    as_json: AsJson = False,
) -> None:
    """Makes touch images of what is seen, read, heard, or felt by another sensor."""
    from unitouch_gen.errors import InvalidInputError, check_integer
    from unitouch_gen.models.images import load_images
    from unitouch_gen.pipelines.x_to_touch import drawn_sensors

    check_common(seed)
    check_integer("candidates", candidates, 1)
    modalities = {"image": image, "text": text, "audio": audio, "touch": touch}
    if all(value is None for value in modalities.values()):
        raise InvalidInputError("Nothing to make a touch of came; pass `--image`, `--text`, `--audio` or `--touch`.")
    weights = None if not weight else dict(modality_weight(item) for item in weight)
    for name in ("image", "touch"):
        if modalities[name] is not None:
            load_images(name, modalities[name])
    quiet = is_quiet(as_json)
    request = {
        **modalities,
        "weights": weights,
        "bridge": bridge,
        "num_candidates": candidates,
        "guidance_scale": guidance,
    }
    pipe = load_for("x-to-touch", request, model, quiet, dtype)
    chosen = None if not sensor else sensor[0] if len(sensor) == 1 else sensor
    drawn = drawn_sensors(pipe.config.sensors, chosen)
    inputs = [path for path in (image, audio, touch) if path is not None]
    files = picture_files(drawn or ["touch"], output, inputs)

    pipe.set_progress_bar_config(disable=quiet)
    result = without_warning(
        pipe,
        **request,
        sensor=chosen,
        num_inference_steps=steps,
        solver=solver,
        tolerance=tolerance,
        generator=generators(seed, len(files), candidates),
    )
    for picture, file in zip(result.images, files, strict=True):
        save_picture(picture, file)
    note_endings(result.report, files)
    if touch is not None and result.report.sensors:
        note_unfamiliar(pipe, result.report, [touch])

    felt = materials(pipe, files, drawn)
    names: list[str | None] = [*drawn] or [None]
    rows: list[dict[str, Any]] = [
        {"touch": str(file), "sensor": name, "materials": shares_of_file}
        for file, name, shares_of_file in zip(files, names, felt, strict=True)
    ]
    if as_json:
        typer.echo(json.dumps({"touches": rows, "report": result.report.to_dict()}))
        return
    cells = [[file.name, row["sensor"] or "-", shares(row["materials"])] for file, row in zip(files, rows, strict=True)]
    print_table(["touch", "sensor", "feels like"], cells)
    typer.echo(f"Touch images are in {files[0].parent.resolve()}")
    typer.echo(f"Run report: {result.report}")


def materials(pipe: Any, files: list[Path], drawn: list[str]) -> list[dict[str, float]]:
    """What each touch feels like, as `MaterialNamer` has it; one line on standard error says of which nothing is known.

    Args:
        pipe: Whose joint space is asked.
        files: Touch images.
        drawn: The sensor of each; none where the model draws one without a name.
    """
    from unitouch_gen.evaluation.zero_shot import MaterialNamer

    felt: list[dict[str, float]] = [{} for _ in files]
    if pipe.processor.tokenizer is None:
        return felt
    known = pipe.unitouch.config.sensors
    strange = [name for name in drawn if name not in known]
    if strange:
        print(
            f"unitouch-gen: what touches of {', '.join(strange)} feel like is left out, as the model's touch encoder "
            f"knows {', '.join(known) or 'no sensor'} only",
            file=sys.stderr,
        )
    rows = [row for row in range(len(files)) if not drawn or drawn[row] in known]
    if rows:
        sensors = [drawn[row] for row in rows] if drawn else None
        named = MaterialNamer(pipe.unitouch, pipe.processor).touch([files[row] for row in rows], sensor=sensors)
        for row, shares_of_row in zip(rows, named, strict=True):
            felt[row] = shares_of_row
    return felt


def modality_weight(item: str) -> tuple[str, float]:
    """ "text=0.3" as a modality and its weight.

    Raises:
        InvalidInputError: If it is not of that form.
    """
    from unitouch_gen.errors import InvalidInputError

    name, _, value = item.partition("=")
    try:
        return name, float(value)
    except ValueError as error:
        raise InvalidInputError(f"`--weight` is {item!r}; write a modality and a number, such as text=0.3.") from error
