"""`unitouch-gen distill`."""

from pathlib import Path
from typing import Annotated

import typer

from unitouch_gen.cli.loading import load_pipeline
from unitouch_gen.cli.options import is_quiet
from unitouch_gen.cli.work_precision import MODALITIES, Listed, values


def distill(
    pipeline: Annotated[str, typer.Option(help="touch-to-image or x-to-touch.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder for the student, a pipeline like any other.")
    ] = None,
    model: Annotated[str | None, typer.Option(help="Folder of the teacher; the built-in one if left out.")] = None,
    family: Annotated[
        Path | None, typer.Option(help="Folder of a family of weights, which gets a student of its own.")
    ] = None,
    objective: Annotated[
        str, typer.Option(help="trajectory, which keeps a noise's picture; or consistency, an experiment.")
    ] = "trajectory",
    steps: Annotated[
        Listed,
        typer.Option(help="Numbers of steps that it learns, by comma; 1,2,4,8, and 1,2 by consistency, if left out."),
    ] = None,
    guidance: Annotated[
        Listed, typer.Option(help="Lowest and highest guidance scale that it learns; 1,9 if left out.")
    ] = None,
    contacts: Annotated[int, typer.Option(help="Contacts of the world that it is shown.")] = 4096,
    updates: Annotated[int, typer.Option(help="Steps of the training.")] = 1500,
    batch_size: Annotated[int, typer.Option(help="Samples an update.")] = 32,
    learning_rate: Annotated[float, typer.Option(help="Peak of its cosine.")] = 2e-4,
    rank: Annotated[int, typer.Option(help="Of low-rank updates in place of all weights; 0 trains all.")] = 0,
    size: Annotated[int, typer.Option(help="Bytes that low-rank updates may keep; 0 keeps all.")] = 0,
    seed: Annotated[int, typer.Option(help="Of contacts, noise and batches.")] = 0,
    resume: Annotated[bool, typer.Option("--resume", metavar="", help="Go on from the last checkpoint.")] = False,
) -> None:
    """Makes a student that draws in one to eight evaluations, with its guidance embedded.

    Example: unitouch-gen distill --pipeline touch-to-image -o student/
    """
    from unitouch_gen.errors import InvalidInputError, check_choice, check_integer, check_texts
    from unitouch_gen.files import as_path, check_writable
    from unitouch_gen.pipelines.tiny import tiny
    from unitouch_gen.training.distill import DistillConfig
    from unitouch_gen.training.distill import distill as make
    from unitouch_gen.training.recipe import read_section
    from unitouch_gen.weights import FAMILY, STUDENT

    given = {
        "objective": check_choice("objective", objective, ("trajectory", "consistency")),
        "steps": values("steps", steps, int, (1, 2) if objective == "consistency" else DistillConfig().steps),
        "guidance": tuple(values("guidance", guidance, float, DistillConfig().guidance)),
        "contacts": contacts,
        "updates": updates,
        "batch_size": batch_size,
        "learning_rate": learning_rate,
        "rank": rank,
        "size": size,
        "seed": check_integer("seed", seed, 0, 2**32 - 1),
    }
    config = read_section({"distill": given}, "distill", DistillConfig)
    modalities = MODALITIES[check_choice("pipeline", pipeline, ("touch-to-image", "x-to-touch"))]
    if (output is None) == (family is None) or (family is not None and model is not None):
        raise InvalidInputError("Pass `--output`, or `--family` alone: the folder that the student goes to.")
    if family is not None:
        output = family / (pipeline + STUDENT)
    assert output is not None
    check_texts("--output", str(output))  # or all is lost at the end: tokenizers write to names in UTF-8 alone
    if as_path("--output", output).exists():
        raise InvalidInputError(f"`--output`: {str(output)!r} exists; name another folder, or remove it.")
    check_writable("--output", output / "model_index.json")
    pipe = (
        tiny(pipeline, family=family or FAMILY)
        if model is None
        else load_pipeline(pipeline, model, is_quiet(False), modalities)
    )
    pipe.set_progress_bar_config(disable=True)
    make(pipe, modalities, output, config, apart=family is not None, resume=resume, told=typer.echo)
    typer.echo(f"The student is in {output.resolve()}")
