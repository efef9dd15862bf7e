"""`unitouch-gen touch-to-image`."""

import json
from pathlib import Path
from typing import Annotated

import typer

from unitouch_gen.cli.files import picture_files, save_picture
from unitouch_gen.cli.loading import load_pipeline
from unitouch_gen.cli.options import (
    AsJson,
    Background,
    BatchSize,
    GuidanceScale,
    Model,
    Output,
    Prompt,
    Seed,
    Steps,
    check_common,
    generators,
    is_quiet,
    print_table,
    shares,
)


def touch_to_image(
    touch: Annotated[list[Path], typer.Argument(help="Touch images; one picture is made for each.")],
    output: Output,
    prompt: Prompt = None,
    steps: Steps = None,
    guidance: GuidanceScale = None,
    seed: Seed = 0,
    sensor: Annotated[str | None, typer.Option(help="Which sensor took the touches; retrieved when left out.")] = None,
    background: Background = None,
    model: Model = None,
    batch_size: BatchSize = 8,
    as_json: AsJson = False,
) -> None:
    """Makes a picture of what each touch feels like."""
    import torch

    from unitouch_gen.diffusion import RunReport
    from unitouch_gen.encoders.pixels import load_images
    from unitouch_gen.evaluation.zero_shot import MaterialNamer

    files = picture_files([path.stem for path in touch], output, touch)
    check_common(seed, batch_size)
    for index, path in enumerate(touch):  # or one that cannot be read would end the work of hours
        load_images(f"touch[{index}]", path)
    quiet = is_quiet(as_json)
    pipe = load_pipeline("touch-to-image", ["touch"], model, quiet)

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
            generator=generators(seed, len(touch[batch])),
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
    cells = [
        [source.name, file.name, name or "-", shares(materials)]
        for source, file, name, materials in zip(touch, files, report.sensors, felt, strict=True)
    ]
    print_table(["touch", "picture", "sensor", "feels like"], cells)
    typer.echo(f"Pictures are in {files[0].parent.resolve()}")
    typer.echo(f"Run report: {report}")
