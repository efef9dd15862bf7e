"""`unitouch-gen distill`: a pipeline in four evaluations."""

from pathlib import Path
from typing import Annotated

from typer import Option, echo

from unitouch_gen.cli.loading import folder_of


def distill(
    model: Annotated[str, Option(help="Folder or repository id of a saved pipeline.")],
    output: Annotated[Path, Option("--output", "-o", help="Folder for the LoRA weights and checkpoints.")],
    recipe: Annotated[str, Option(help="A YAML file, or the name of a recipe of the package.")] = "distill",
    overrides: Annotated[list[str] | None, Option("--set", metavar="SECTION.KEY=VALUE", help="Of the recipe.")] = None,
    cache: Annotated[Path, Option(help="Folder for rendered or decoded training data.")] = Path("runs/cache"),
    resume: Annotated[bool, Option("--resume", metavar="", help="Go on from the last checkpoint.")] = False,
) -> None:
    """Learns LoRA weights by which a pipeline draws in four evaluations without guidance (LCM-LoRA).

    Example: unitouch-gen distill --model my-pipeline -o runs/turbo
    """
    folder = folder_of(model)

    from unitouch_gen.training.distill import DistillRecipe, main
    from unitouch_gen.training.stages import run_stage

    options = {"recipe": recipe, "overrides": overrides, "cache": cache, "resume": resume}
    run_stage("distill", DistillRecipe, main, model=folder, output=output, **options)
    echo(f"The weights are in {(output / 'model').resolve()}; pipe.load_lora_weights(...) reads them, for LCMScheduler")
