"""The stages of training, what each takes from which, and the runs that make a family of weights."""

import os
import shlex
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from typer import Option, echo

from unitouch_gen.commands import interrupt_on_termination
from unitouch_gen.training.checkpoints import checkpoints_in


@dataclass(frozen=True)
class StageEntry:
    """A stage: its command and the folders of models that it takes."""

    help: str
    takes: dict[str, str] = field(default_factory=dict)  # needed options for folders, and whose output they expect
    init: bool = False  # whether it may start from weights in place of random ones, by `--init`
    module: str = ""  # the module of its `main`; that of its own name if empty


STAGES = {
    "image_text": StageEntry("Trains the joint space: image and text encoders.", init=True),
    "touch": StageEntry("Trains the touch encoder on frozen image embeddings.", {"joint": "image_text"}, init=True),
    "texture": StageEntry(
        "Adds texture heads, on a network trained on photos, to the image and touch encoders.", {"joint": "touch"}
    ),
    "audio": StageEntry("Trains the audio encoder on frozen image embeddings.", {"joint": "texture"}, module="binding"),
    "image_vae": StageEntry("Trains the autoencoder of pictures.", init=True),
    "unclip": StageEntry(
        "Trains the diffusion of pictures from image embeddings.",
        {"joint": "texture", "vae": "image_vae"},
        init=True,
    ),
    "touch_vae": StageEntry("Trains the autoencoder of touches.", {"joint": "touch"}, init=True, module="image_vae"),
    "touch_ldm": StageEntry(
        "Trains the diffusion of touches from image embeddings.",
        {"joint": "texture", "vae": "touch_vae"},
        init=True,
    ),
    "language_model": StageEntry(
        "Trains a small language model on questions about contacts.", {"joint": "texture"}, module="touch_llm"
    ),
    "touch_llm": StageEntry(
        "Trains a bridge from image embeddings into a language model.",
        {"joint": "texture", "llama": "language_model"},
    ),
    "distill": StageEntry(
        "Trains LoRA weights with which a saved pipeline draws in four evaluations.",
        {"model": "my-pipeline"},
        init=True,
    ),
}
"""All stages by name. `distill` is no part of a family."""


@dataclass(frozen=True)
class Run:
    """One run of a stage in the training of a family, with a folder of its own name."""

    name: str
    stage: str = ""  # that of its name if empty
    recipe: str | None = None  # the stage's own if `None`
    init: str | None = None  # the run whose weights it starts from
    place: str | None = None  # the folder of the family for its model; `None` if another run's model contains it

    @property
    def takes(self) -> dict[str, str]:
        """Options for folders of models, and the runs that leave these models."""
        start = {} if self.init is None else {"init": self.init}
        return {**STAGES[self.stage or self.name].takes, **start}

    def command(self, runs: Path) -> list[str]:
        """The words of its command, with all outputs below one folder; it resumes if there is a checkpoint."""
        output = runs / self.name
        words = [self.stage or self.name]
        is_resumed = bool(checkpoints_in(output))
        if self.recipe is not None and not is_resumed:  # else it goes on with the recipe of the checkpoint
            words += ["--recipe", self.recipe]
        for option, before in self.takes.items():
            words += [f"--{option}", str(runs / before / "model")]
        words += ["--output", str(output), "--cache", str(runs / "cache")]
        return [*words, "--resume"] if is_resumed else words


RUNS = (
    Run("captions", "image_text"),
    Run("image_text", recipe="image_text_lamps", init="captions"),
    Run("touch_pairs", "touch", recipe="touch_pairs"),
    Run("touch", init="touch_pairs"),
    Run("texture"),
    Run("audio", place="joint"),
    Run("image_vae", place="image-vae"),
    Run("unclip", place="touch-to-image"),
    Run("touch_vae", place="touch-vae"),
    Run("touch_ldm", place="x-to-touch"),
    Run("language_model"),
    Run("touch_llm", place="touch-to-text"),
)
"""The runs of a family, each after those that it takes models from."""

FINAL_RUNS = tuple(run for run in RUNS if not run.stage)
"""The last run of each stage. The others are only started from."""

ALLOCATOR = {"MALLOC_MMAP_THRESHOLD_": "4000000000", "MALLOC_TRIM_THRESHOLD_": "4000000000"}
"""Makes glibc keep the memory that a process frees, with which a step takes two thirds of the time."""


def folders_of(stage: str) -> set[str]:
    """The options of a stage that name folders of models; all but `init` are needed."""
    entry = STAGES[stage]
    return {*entry.takes, "init"} if entry.init else {*entry.takes}


def train_family(
    runs: Annotated[Path, Option(help="Folder for the outputs of all stages and their cache.")] = Path("runs"),
    dry_run: Annotated[bool, Option("--dry-run", metavar="", help="Print the remaining commands only.")] = False,
) -> None:
    """Trains all stages of a family, one after another, and goes on where it was stopped.

    A stage that left its record is done. To train one anew, remove its folder, and those of the stages that take its
    model.
    """
    if not dry_run:
        interrupt_on_termination()  # an interrupt ends the running stage, too
    for run in RUNS:
        if (runs / run.name / "record.json").is_file():
            continue
        words = ["-m", "unitouch_gen.training", *run.command(runs)]
        echo(shlex.join(["python", *words]))
        if not dry_run:
            done = subprocess.run([sys.executable, *words], env={**ALLOCATOR, **os.environ}, check=False)
            if done.returncode:
                sys.exit(done.returncode)
