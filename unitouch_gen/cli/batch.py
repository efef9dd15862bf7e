"""`unitouch-gen batch`: the pictures of a manifest, which may be many."""

import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from unitouch_gen.cli import options
from unitouch_gen.cli.loading import load_pipeline
from unitouch_gen.errors import MOST_NAMES, InvalidInputError, describe, first_of
from unitouch_gen.files import check_file

SOME_FAILED = 1
"""Exit code."""


def batch(
    manifest: Annotated[
        Path,
        typer.Argument(help="Table of what to make, .csv, .tsv or .jsonl; or a folder of inputs.", metavar="MANIFEST"),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="A folder: of another run, it is gone on with.")],
    pipeline: Annotated[
        str,
        typer.Option(help="touch-to-image, stylization or x-to-touch, of items without."),
    ] = "touch-to-image",
    kind: Annotated[
        str | None, typer.Option(help="What the pictures of a folder are: touch or image; by the pipeline if left out.")
    ] = None,
    prompt: options.Prompt = None,
    steps: options.Steps = None,
    solver: options.SolverName = None,
    tolerance: options.Tolerance = None,
    guidance: options.GuidanceScale = None,
    seed: options.Seed = 0,
    setting: Annotated[
        list[str] | None,
        typer.Option("--set", help="What any column says where an item does not, as sensor=digit; may be repeated."),
    ] = None,
    load_sensor: options.LoadSensor = None,
    model: options.Model = None,
    dtype: options.Dtype = None,
    device: options.Device = "auto",
    batch_size: options.BatchSize = 8,
    shard_size: Annotated[
        int | None, typer.Option(help="Write WebDataset shards of so many items in place of pictures.")
    ] = None,
    as_json: options.AsJson = False,
) -> None:
    """Makes the pictures of a table or folder, and goes on where it was ended; exits with 1 if some fail.

    Example: unitouch-gen batch touches/ -o pictures/
    """
    if not manifest.is_dir():
        check_file("manifest", manifest, "a table, or a folder")  # before anything large is imported
    from unitouch_gen.pipelines.batch import check_batch, run_batch
    from unitouch_gen.pipelines.manifest import COLUMNS, FILES, read_manifest

    given = {"prompt": prompt, "steps": steps, "solver": solver, "tolerance": tolerance, "guidance": guidance}
    defaults: dict[str, Any] = {column: value for column, value in given.items() if value is not None} | {"seed": seed}
    for word in setting or ():
        column, _, value = word.partition("=")
        if not value or column not in COLUMNS or column in ("name", "pipeline"):
            columns = ", ".join(column for column in COLUMNS if column not in ("name", "pipeline"))
            raise InvalidInputError(f"`--set` is {describe(word)}; write a column and what it says, of {columns}.")
        defaults[column] = os.path.abspath(value) if column in FILES and value else value
    found = read_manifest(manifest, pipeline, defaults=defaults, kind=kind)
    if manifest.is_dir() and output.resolve().is_relative_to(manifest.resolve()):
        raise InvalidInputError(f"`--output` is {str(output)!r}, which is in the folder of inputs; name one beside it.")
    if model is not None and len(found.plans) > 1:
        raise InvalidInputError(f"`--model` came for {' and '.join(found.plans)}; run their items one after the other.")
    settings: dict[str, Any] = {
        "batch_size": batch_size,
        "shard_size": shard_size,
        "settings": {
            "model": model,
            "dtype": dtype or "float32",
            "load_sensor": [str(file) for file in load_sensor or ()],
        },
    }
    check_batch(found, output, **settings)

    number, count = (int(os.environ.get(name, default)) for name, default in (("RANK", 0), ("WORLD_SIZE", 1)))
    quiet = options.is_quiet(as_json) or number > 0
    if count > 1 and options.device_of(device).type == "cuda":  # each process of a machine has one of its own
        device = f"cuda:{os.environ.get('LOCAL_RANK', 0)}"
    pipes = {
        name: load_pipeline(name, model, quiet, plan=plan, dtype=dtype, device=device, sensors=load_sensor)
        for name, plan in found.plans.items()
    }
    for pipe in pipes.values():
        pipe.set_progress_bar_config(disable=True)
    with options.progress(total=0, unit="picture", disable=quiet) as progress:
        result = run_batch(pipes, found, output, process=(number, count), progress=progress, **settings)
    if result is None:
        return
    for name, why in list(result.failed.items())[:MOST_NAMES]:
        options.note(f"{name} failed: {options.as_options(why)}")
    if len(result.failed) > MOST_NAMES:
        options.note(f"and {len(result.failed) - MOST_NAMES} more failed; see the ledger")
    if result.unknown:
        whys = (f"{name} ({', '.join(map(': '.join, why.items()))})" for name, why in result.unknown.items())
        options.note(f"Unknown to the model, so a guess: {first_of(list(whys))}")
    if as_json:
        typer.echo(json.dumps({**asdict(result), "ledger": str(result.ledger)}))
    else:
        failed = f"; {len(result.failed)} failed, and are tried again by the same command" if result.failed else ""
        typer.echo(f"{result.made} pictures are in {output.resolve()}{failed}")
        typer.echo(f"What came of each is in {result.ledger.resolve()}")
    if result.failed:
        raise typer.Exit(SOME_FAILED)
