"""Training by its stages: `python -m unitouch_gen.training STAGE`."""

import sys
from functools import partial
from inspect import signature
from typing import Any

import typer

from unitouch_gen.errors import run_commands
from unitouch_gen.training.stages import FOLDERS, Recipe, Stage, folders_of, run_stage

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, no_args_is_help=True, help=__doc__)


def add(name: str, sentence: str) -> None:
    """Adds the command of a stage."""

    def command(**options: Any) -> None:
        run_stage(name, **options)

    options = signature(partial(Stage, name, Recipe))
    unused = {*FOLDERS} - folders_of(name)
    taken = [parameter for option, parameter in options.parameters.items() if option not in unused]
    command.__signature__ = options.replace(parameters=taken)  # type: ignore[attr-defined]
    app.command(name, help=sentence)(command)


add("image_text", "Binds pictures and captions to each other: the joint space.")
add("touch", "Binds touches to pictures.")
add("texture", "Adds to pictures and touches what a network trained on photos says of their texture.")
add("audio", "Binds sounds to pictures.")
add("image_vae", "Learns the autoencoder of pictures.")
add("unclip", "Learns to draw pictures from embeddings of pictures.")
add("touch_vae", "Learns the autoencoder of touches.")
add("touch_ldm", "Learns to draw touches from embeddings of pictures.")
add("language_model", "Learns a small language model of questions about contacts.")
add("touch_llm", "Learns a bridge from embeddings of pictures into a language model.")
add("distill", "Learns LoRA weights by which a saved pipeline draws in four evaluations.")

if __name__ == "__main__":
    sys.exit(run_commands(app, "unitouch_gen.training", prog_name="python -m unitouch_gen.training"))
