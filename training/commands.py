"""The commands of the stages of training, and of a family."""

from functools import partial
from inspect import signature
from typing import Any

import typer

from unitouch_gen.training.family import STAGES, folders_of, train_family
from unitouch_gen.training.stages import Recipe, Stage, run_stage

HELP = "Training by its stages: `python -m unitouch_gen.training STAGE`."

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, no_args_is_help=True, help=HELP)


def add_command(name: str, description: str) -> None:
    """Adds the command of a stage, with the options that this stage takes."""

    def command(**options: Any) -> None:
        run_stage(name, **options)

    all_options = signature(partial(Stage, name, Recipe))
    other_folders = set[str]().union(*map(folders_of, STAGES)) - folders_of(name)
    parameters = [parameter for option, parameter in all_options.parameters.items() if option not in other_folders]
    command.__signature__ = all_options.replace(parameters=parameters)  # type: ignore[attr-defined]
    app.command(name, help=description)(command)


for stage, entry in STAGES.items():
    add_command(stage, entry.help)
app.command("family")(train_family)
