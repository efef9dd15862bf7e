"""`unitouch-gen touch-to-image`."""

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
    shares,
)


def touch_to_image(
    touch: Annotated[list[Path], typer.Argument(help="Touch images; one picture is made for each.")],
    output: Output,
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
    """Makes a picture of what each touch feels like."""
    from unitouch_gen.evaluation.zero_shot import MaterialNamer

    files = picture_files([path.stem for path in touch], output, touch)
    check_common(seed, batch_size)
    check_pictures("touch", touch)
    quiet = is_quiet(as_json)
    pipe = load_for("touch-to-image", {"touch": touch, "guidance_scale": guidance}, model, quiet, dtype)
    call = partial(
        pipe,
        prompt=prompt,
        num_inference_steps=steps,
        solver=solver,
        tolerance=tolerance,
        guidance_scale=guidance,
        sensor=sensor,
        background=background,
    )
    report, embeds = make_pictures(pipe, call, touch, files, seed=seed, batch_size=batch_size, quiet=quiet)
    note_endings(report, files)
    if background is None:
        note_unfamiliar(pipe, report, touch)

    felt: list[dict[str, float]] = [{} for _ in touch]
    if pipe.processor.tokenizer is not None:  # one that `from_pipe` made has none
        felt = MaterialNamer(pipe.unitouch, pipe.processor).name(embeds, "touch")
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
    cells = [
        [source.name, file.name, name or "-", shares(materials)]
        for source, file, name, materials in zip(touch, files, report.sensors, felt, strict=True)
    ]
    print_table(["touch", "picture", "sensor", "feels like"], cells)
    typer.echo(f"Pictures are in {files[0].parent.resolve()}")
    typer.echo(f"Run report: {report}")
