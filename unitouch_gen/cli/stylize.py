"""`unitouch-gen stylize`."""

import json
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from unitouch_gen.cli.batches import check_pictures, make_pictures, note_endings, note_unfamiliar
from unitouch_gen.cli.files import picture_files
from unitouch_gen.cli.loading import load_for
from unitouch_gen.cli.options import (
    AsJson,
    Background,
    BatchSize,
    Dtype,
    GuidanceScale,
    Model,
    Output,
    Prompt,
    Seed,
    Sensor,
    SolverName,
    Steps,
    Tolerance,
    check_common,
    is_quiet,
    print_table,
)


def stylize(
    photo: Annotated[Path, typer.Argument(help="The photo.")],
    touch: Annotated[list[Path], typer.Argument(help="Touch images; one picture is made for each.")],
    output: Output,
    touch_weight: Annotated[float, typer.Option(help="Share of the touch in the mix; the photo has the rest.")] = 0.3,
    mix: Annotated[str, typer.Option(help="linear or slerp.")] = "linear",
    init_strength: Annotated[
        float | None, typer.Option(help="Start from the photo itself to keep its layout: near 0 the photo, at most 1.")
    ] = None,
    prompt: Prompt = None,
    steps: Steps = None,
    solver: SolverName = None,
    tolerance: Tolerance = None,
    guidance: GuidanceScale = None,
    seed: Seed = 0,
    sensor: Sensor = None,
    background: Background = None,
    model: Model = None,
    dtype: Dtype = None,
    batch_size: BatchSize = 8,
    as_json: AsJson = False,
) -> None:
    """Restyles a photo by each touch."""
    from unitouch_gen.errors import InvalidInputError
    from unitouch_gen.models.images import load_images

    if not 0.0 <= touch_weight <= 1.0:
        raise InvalidInputError(f"`--touch-weight` is {touch_weight:g}; pass a share from 0 to 1.")
    files = picture_files([f"{photo.stem}-{path.stem}" for path in touch], output, [photo, *touch])
    check_common(seed, batch_size)
    load_images("photo", photo)
    check_pictures("touch", touch)
    quiet = is_quiet(as_json)
    request = {"image": photo, "touch_weight": touch_weight, "init_strength": init_strength}
    pipe = load_for("stylization", {**request, "touch": touch, "guidance_scale": guidance}, model, quiet, dtype)
    call = partial(
        pipe,
        photo,
        prompt=prompt,
        touch_weight=touch_weight,
        mix=mix,
        init_strength=init_strength,
        num_inference_steps=steps,
        solver=solver,
        tolerance=tolerance,
        guidance_scale=guidance,
        sensor=sensor,
        background=background,
    )
    report, _ = make_pictures(pipe, call, touch, files, seed=seed, batch_size=batch_size, quiet=quiet)
    note_endings(report, files)
    if background is None:
        note_unfamiliar(pipe, report, touch)
    rows = [
        {"photo": str(photo), "touch": str(source), "picture": str(file), "sensor": name}
        for source, file, name in zip(touch, files, report.sensors, strict=True)
    ]
    if as_json:
        typer.echo(json.dumps({"pictures": rows, "report": report.to_dict()}))
        return
    cells = [
        [source.name, file.name, row["sensor"] or "-"] for source, file, row in zip(touch, files, rows, strict=True)
    ]
    print_table(["touch", "picture", "sensor"], cells)
    typer.echo(f"Pictures are in {files[0].parent.resolve()}")
    typer.echo(f"Run report: {report}")
