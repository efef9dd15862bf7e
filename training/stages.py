"""What the stages have in common: their command line, what they are given, and the folder they leave behind."""

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from functools import cached_property, partial
from importlib import import_module
from itertools import zip_longest
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import torch
import torch.nn.functional as F
from accelerate import PartialState
from accelerate.utils import parse_flag_from_env
from diffusers import UNet2DConditionModel
from torch import Tensor, nn
from typer import Option

from unitouch_gen import __version__
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.evaluation.contacts import image_embeddings
from unitouch_gen.files import check_writable, files_below, is_hidden
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.saving import filling
from unitouch_gen.training.batches import ArrayDataset, SamplerSettings, in_batch_indices, shuffled_indices
from unitouch_gen.training.checkpoints import checkpoints_in, read_progress
from unitouch_gen.training.data import Contacts, DataConfig, DrawnContacts, columns_of, computed_once
from unitouch_gen.training.recipe import Arguments, Settings, build, overridden, read, read_recipe
from unitouch_gen.training.trainer import Trainer, TrainerConfig

STAGES: dict[str, dict[str, str]] = {
    "image_text": {},
    "touch": {"joint": "image_text"},
    "texture": {"joint": "touch"},
    "audio": {"joint": "texture"},
    "image_vae": {},
    "unclip": {"joint": "texture", "vae": "image_vae"},
    "touch_vae": {"joint": "touch"},
    "touch_ldm": {"joint": "texture", "vae": "touch_vae"},
    "language_model": {"joint": "texture"},
    "touch_llm": {"joint": "texture", "llama": "language_model"},
}
"""All stages in order. Each names the options that take an earlier stage's output, and that stage."""

STARTING_FROM_WEIGHTS = ("image_text", "touch", "image_vae", "unclip", "touch_vae", "touch_ldm", "distill")
"""Stages that may start from weights in place of random ones, by `--init`."""

NEEDS = {**STAGES, "distill": {"model": "my-pipeline"}}  # which is no part of a family

FOLDERS = ("joint", "vae", "llama", "init", "model")
"""Options that name folders of models."""

MODULES = {"touch_vae": "image_vae", "language_model": "touch_llm"}
"""Modules of stages that have none of their own."""

Indices = Callable[[int], Sequence[int]]  # those of a batch by the number of its step


class Recipe(Settings):
    """The sections that all stages have."""

    data: DataConfig
    trainer: TrainerConfig


class Stage:
    """One call of a stage's command, with its options as arguments; `folders` are the models that were given.

    `recipe` is read as settings of a `kind`; `given` is what was read, for checkpoints and the record.
    """

    def __init__(
        self,
        name: str,
        kind: type[Recipe],
        *,
        recipe: Annotated[str | None, Option(help="A YAML file, or a name in training/recipes.")] = None,
        overrides: Annotated[list[str] | None, Option("--set", metavar="SECTION.KEY=VALUE")] = None,
        output: Annotated[Path | None, Option(help="Where the stage writes, and resumes; else runs/STAGE.")] = None,
        cache: Annotated[Path, Option(help="What was rendered, and what models say of it.")] = Path("runs/cache"),
        resume: Annotated[bool, Option("--resume", metavar="", help="Go on from the last checkpoint.")] = False,
        joint: Annotated[Path | None, Option(exists=True, help="Folder of the joint space to build on.")] = None,
        vae: Annotated[Path | None, Option(exists=True, help="Folder of the autoencoder to build on.")] = None,
        llama: Annotated[Path | None, Option(exists=True, help="Folder of the language model to build on.")] = None,
        init: Annotated[Path | None, Option(exists=True, help="Folder of weights to start from.")] = None,
        model: Annotated[Path | None, Option(exists=True, help="Folder of a saved pipeline to distil.")] = None,
    ):
        on_cpu = parse_flag_from_env("ACCELERATE_USE_CPU")  # which accelerate reads only after it has looked for GPUs
        # The other processes wait for the main one, which renders, decodes and embeds.
        self.processes = PartialState(cpu=on_cpu, timeout=timedelta(days=2))
        self.name = name
        self.output = output or Path("runs") / name
        self.cache = cache
        self.resume = resume
        before = read_progress(self.output) if resume else {}
        if (found := checkpoints_in(self.output)) and not resume:
            raise InvalidInputError(
                f"`output` is {str(self.output)!r}, which holds {found[-1].name} of a run that would be lost; pass "
                "`--resume` to go on with it, remove it, or name another output."
            )
        if resume and recipe is not None:
            raise InvalidInputError("`recipe` is the checkpoint's with `--resume`; leave it out. `--set` changes it.")
        changes = overrides or ()
        self.given = overridden(before["recipe"], changes) if resume else read_recipe(recipe or name, changes)
        self.recipe: Any = read(kind, self.given)
        self.trainer = self.recipe.trainer
        self.data = self.recipe.data
        self.batches: dict[str, Any] = {"batch_size": self.trainer.batch_size, "seed": self.trainer.seed}
        folders = {"joint": joint, "vae": vae, "llama": llama, "init": init, "model": model}
        self.folders = {option: folder for option, folder in folders.items() if folder is not None}
        if not {*NEEDS[name]} <= {*self.folders} <= folders_of(name):
            given = ", ".join(f"--{option}" for option in self.folders) or "none"
            wanted = ", ".join(f"--{option} of {before}" for option, before in NEEDS[name].items()) or "none"
            raise InvalidInputError(f"{name} needs folders of models: {wanted}; it got {given}.")
        self.inputs = {option: weights_of(folder) for option, folder in self.folders.items()}
        if resume and before["inputs"] != self.inputs:
            options = ", ".join(f"--{option}" for option in before["inputs"])
            raise InvalidInputError(
                f"`resume` finds a run in {str(self.output)!r} that was built on other weights than {options} name "
                "now; name those, or begin anew."
            )
        self.sources = self.data.sources()
        self.sets = [source.summary for source in self.sources]
        self.earlier_sets = before.get("earlier_sets", [])  # of a run whose data was changed on the way
        if before.get("sets", self.sets) != self.sets:
            if not any(change.startswith("data.") for change in changes):
                raise InvalidInputError(
                    f"`resume` finds a run in {str(self.output)!r} on other data than there is now: "
                    f"{_difference(before['sets'], self.sets)}. Put the data back, or begin anew in another `output`."
                )
            self.earlier_sets = [*self.earlier_sets, before["sets"]]
        check_writable("output", self.output / "record.json")
        check_writable("output", self.output / "model" / "config.json")
        check_writable("output", self.output / "checkpoints" / "step" / "progress.json")
        check_writable("cache", self.cache / "array.npy")
        if not self.processes.is_main_process:
            self.processes.wait_for_everyone()  # until the main one has prepared what all find in the cache; see `fit`

    @cached_property
    def processor(self) -> UniTouchProcessor:
        """That of the pipeline, the joint space, or the weights to start from; else what the recipe says."""
        if "model" in self.folders:
            return UniTouchProcessor.from_pretrained(self.folders["model"] / "processor")
        init = self.folders.get("init")
        if init is not None and not (init / "preprocessor_config.json").is_file():
            init = None  # an autoencoder or a UNet
        if folder := self.folders.get("joint", init):
            return UniTouchProcessor.from_pretrained(folder)
        return UniTouchProcessor(image_size=self.data.image_size, audio=self.data.audio)  # type: ignore[arg-type]

    def joint_space(self, *modalities: str) -> UniTouchModel:
        folder = self.folders["model"] / "unitouch" if "model" in self.folders else self.folders["joint"]
        return UniTouchModel.from_pretrained(folder, modalities=modalities)

    def unet(self, model: Arguments, **conditions: Any) -> UNet2DConditionModel:
        """The network: random by the recipe and `conditions`, or the weights that were named to start from."""
        if "init" not in self.folders:
            return build("model", UNet2DConditionModel, model, **conditions)
        init = self.folders["init"]
        return UNet2DConditionModel.from_pretrained(init, torch_dtype=torch.float32, use_safetensors=True)

    def splits(self, *needs: str) -> list[Contacts]:
        """The training split of each source, with the columns that are needed; see `columns_of`."""
        return columns_of(self.sources, self.cache, self.data, self.processor, needs)

    def computed_once(self, name: str, option: str, splits: list[Contacts], compute: Callable[[], Tensor]) -> Tensor:
        """What a model makes of `splits`: once for the weights that an option named, at each call if none did."""
        weights = self.inputs.get("model", self.inputs.get(option))
        if weights is None:
            return compute()
        shown = hashlib.sha256("".join(split.fingerprint for split in splits).encode()).hexdigest()
        names = [*(Path(one.path).name for one in self.data.sets), *(["drawn"] if self.data.drawn else [])]
        file = "-".join([name, *names, "train", shown[:16], weights[:16]])
        return computed_once(self.cache / f"{file}.safetensors", compute)

    def image_embeddings(self, model: UniTouchModel, splits: list[Contacts]) -> Tensor:
        """Embeddings (N, D) of all pictures, un-normalised."""
        parts = (image_embeddings(model.eval(), "image", split.image) for split in splits)  # computed when asked for
        return self.computed_once("image-embeddings", "joint", splits, lambda: torch.cat([*parts]))

    def sampler(self, settings: SamplerSettings, splits: list[Contacts], embeds: Tensor) -> Indices:
        """Batches in groups whose embeddings (N, D) are alike."""
        sizes = [len(split) for split in splits]
        near = F.normalize(embeds.float(), dim=1).numpy()
        return partial(in_batch_indices, sizes=sizes, settings=settings, near=near, **self.batches)

    def check_drawn(self, *weights: str) -> None:
        """Refuses data sets where the objective weighs what only drawn contacts have."""
        if weights and not all(isinstance(source, DrawnContacts) for source in self.sources):
            names = ", ".join(f"`objective.{name}`" for name in weights)
            raise InvalidInputError(f"{names} need `data.drawn` alone; set these to 0, or leave out `data.sets`.")

    def fit(self, objective: nn.Module, dataset: ArrayDataset, indices_of: Indices | None = None) -> None:
        """Runs an objective to its last step, from the last checkpoint if that was asked for; by shuffled epochs."""
        if self.processes.is_main_process:
            self.processes.wait_for_everyone()  # the others may now prepare what they find in the cache
        indices_of = indices_of or partial(shuffled_indices, size=len(dataset), **self.batches)
        begun = {"inputs": self.inputs, "recipe": self.given, "sets": self.sets, "earlier_sets": self.earlier_sets}
        trainer = Trainer(objective, dataset, indices_of, self.trainer, self.output, begun)
        if self.resume:
            trainer.resume()
        trainer.fit()
        self.seconds = trainer.seconds

    @contextmanager
    def saving(self, **figures: Any) -> Iterator[Path]:
        """The folder to write the stage's model to; `record.json` beside it has seed, recipe, inputs and times."""
        record: dict[str, Any] = {
            "stage": self.name,
            "seed": self.trainer.seed,
            "seconds": round(self.seconds, 1),
            "version": __version__,
            "inputs": self.inputs,
            "trainer": self.trainer.model_dump(),
            "recipe": {key: value for key, value in self.given.items() if key != "trainer"},
            "sets": self.sets,
            **({"earlier_sets": self.earlier_sets} if self.earlier_sets else {}),
            **figures,
        }
        for beside in self.folders["init"].resolve().parents[:2] if "init" in self.folders else ():
            if (beside / "record.json").is_file():  # beside a run's `model`, or a part of that
                record["started_from"] = json.loads((beside / "record.json").read_text())
        main = self.processes.is_main_process  # what the others write is discarded
        with filling("output", self.output) if main else TemporaryDirectory() as place:
            model = Path(place) / "model"
            model.mkdir()
            yield model
            (model.parent / "record.json").write_text(json.dumps(record, indent=2) + "\n")


def _difference(before: Sequence[dict[str, Any]], now: Sequence[dict[str, Any]]) -> str:
    """The first data set that is not what it was, in words."""
    one, other = next(pair for pair in zip_longest(before, now) if pair[0] != pair[1])
    return f"{json.dumps(one) if one else 'nothing'} then, {json.dumps(other) if other else 'nothing'} now"


def folders_of(name: str) -> set[str]:
    """The options of a stage that name folders of models; all but `init` are needed."""
    return {*NEEDS[name], *(["init"] if name in STARTING_FROM_WEIGHTS else [])}


def weights_of(folder: Path) -> str:
    """SHA-256 of all the safetensors below a folder, also behind links: of their names and bytes."""
    digest = hashlib.sha256()
    files = [file for file in files_below(folder) if not is_hidden(file.relative_to(folder))]  # as of a save cut off
    for file in sorted(file for file in files if file.suffix == ".safetensors"):
        digest.update(f"{file.relative_to(folder).as_posix()}\n".encode())
        with file.open("rb") as stream:
            digest.update(hashlib.file_digest(stream, "sha256").digest())
    return digest.hexdigest()


def run_stage(name: str, **options: Any) -> None:
    """Runs a stage by its options, from its seed; `recipe` of its `main` says what it is read as."""
    main = import_module(f"unitouch_gen.training.{MODULES.get(name, name)}").main
    stage = Stage(name, main.__annotations__["recipe"], **options)
    torch.manual_seed(stage.trainer.seed)
    main(stage, stage.recipe)
