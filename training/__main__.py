"""Training by its stages: `python -m unitouch_gen.training STAGE`."""

import sys
from functools import partial
from inspect import signature
from typing import Any

import typer

from unitouch_gen.errors import run_commands
from unitouch_gen.training.stages import FOLDERS, Recipe, Stage, folders_of, run_stage

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, no_args_is_help=True, help=__doc__)


def add_command(name: str, description: str) -> None:
    """Adds the command of a stage, with the options that this stage takes."""

    def command(**options: Any) -> None:
        run_stage(name, **options)

    all_options = signature(partial(Stage, name, Recipe))
    other_folders = {*FOLDERS} - folders_of(name)
    parameters = [parameter for option, parameter in all_options.parameters.items() if option not in other_folders]
    command.__signature__ = all_options.replace(parameters=parameters)  # type: ignore[attr-defined]
    app.command(name, help=description)(command)


add_command("image_text", "Trains the joint space: image and text encoders.")
add_command("touch", "Trains the touch encoder on frozen image embeddings.")
add_command("texture", "Adds texture heads, on a network trained on photos, to the image and touch encoders.")
add_command("audio", "Trains the audio encoder on frozen image embeddings.")
add_command("image_vae", "Trains the autoencoder of pictures.")
add_command("unclip", "Trains the diffusion of pictures from image embeddings.")
add_command("touch_vae", "Trains the autoencoder of touches.")
add_command("touch_ldm", "Trains the diffusion of touches from image embeddings.")
add_command("language_model", "Trains a small language model on questions about contacts.")
add_command("touch_llm", "Trains a bridge from image embeddings into a language model.")
add_command("distill", "Trains LoRA weights with which a saved pipeline draws in four evaluations.")

if __name__ == "__main__":
    sys.exit(run_commands(app, "unitouch_gen.training", prog_name="python -m unitouch_gen.training"))
