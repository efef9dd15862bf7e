"""What all stages share: their options, the models and data they read, and the folder they write."""

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
from unitouch_gen.files import check_writable, files_below, is_hidden
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.models.features import image_embeddings
from unitouch_gen.saving import filling
from unitouch_gen.training.batches import ArrayDataset, SamplerSettings, in_batch_indices, shuffled_indices
from unitouch_gen.training.checkpoints import checkpoints_in, read_progress
from unitouch_gen.training.data import Contacts, DataConfig, DrawnContacts, columns_of, computed_once
from unitouch_gen.training.family import STAGES, folders_of
from unitouch_gen.training.recipe import Arguments, Settings, build, overridden, read, read_recipe
from unitouch_gen.training.trainer import Trainer, TrainerConfig

Indices = Callable[[int], Sequence[int]]  # sample indices of a batch, by the number of its step


class Recipe(Settings):
    """The sections that all stages have."""

    data: DataConfig
    trainer: TrainerConfig


class Stage:
    """One call of a stage's command, with its options as arguments.

    `recipe` is read as settings of a `kind`; `recipe_values` is the same as plain values, for checkpoints and the
    record. `folders` are the models that were named, by option, and `inputs` are hashes of their weights.
    """

    def __init__(
        self,
        name: str,
        kind: type[Recipe],
        *,
        recipe: Annotated[str | None, Option(help="A YAML file, or a name in training/recipes.")] = None,
        overrides: Annotated[
            list[str] | None,
            Option("--set", metavar="SECTION.KEY=VALUE", help="A value of the recipe to replace; may be repeated."),
        ] = None,
        output: Annotated[Path | None, Option(help="Folder to write to, and to resume from; else runs/STAGE.")] = None,
        cache: Annotated[Path, Option(help="Folder for rendered contacts and embeddings.")] = Path("runs/cache"),
        resume: Annotated[bool, Option("--resume", metavar="", help="Go on from the last checkpoint.")] = False,
        joint: Annotated[Path | None, Option(exists=True, help="Folder of the joint space to build on.")] = None,
        vae: Annotated[Path | None, Option(exists=True, help="Folder of the autoencoder to build on.")] = None,
        llama: Annotated[Path | None, Option(exists=True, help="Folder of the language model to build on.")] = None,
        init: Annotated[Path | None, Option(exists=True, help="Folder of weights to start from.")] = None,
        model: Annotated[Path | None, Option(exists=True, help="Folder of a saved pipeline to distil.")] = None,
    ):
        on_cpu = parse_flag_from_env("ACCELERATE_USE_CPU")  # accelerate reads this only after it has looked for GPUs
        # The other processes wait for the main one, which renders, decodes and embeds.
        self.processes = PartialState(cpu=on_cpu, timeout=timedelta(days=2))
        self.name = name
        self.output = output or Path("runs") / name
        self.cache = cache
        self.resume = resume
        changes = overrides or ()
        progress = read_progress(self.output) if resume else {}
        if resume:
            if recipe is not None:
                raise InvalidInputError(
                    "`recipe` cannot be passed with `--resume`, which reads the checkpoint's; leave it out, and change "
                    "values by `--set`."
                )
            self.recipe_values = overridden(progress["recipe"], changes)
        else:
            check_no_checkpoints(self.output)
            self.recipe_values = read_recipe(recipe or name, changes)
        self.recipe: Any = read(kind, self.recipe_values)
        self.trainer = self.recipe.trainer
        self.data = self.recipe.data
        self.batch_options: dict[str, Any] = {"batch_size": self.trainer.batch_size, "seed": self.trainer.seed}
        self.folders = named_folders(name, joint=joint, vae=vae, llama=llama, init=init, model=model)
        self.inputs = {option: hash_weights(folder) for option, folder in self.folders.items()}
        if resume:
            self._check_inputs(progress["inputs"])
        self.sources = self.data.sources()
        self.sets = [source.summary for source in self.sources]
        self.earlier_sets = self._earlier_sets(progress, changes)
        check_writable("output", self.output / "record.json")
        check_writable("output", self.output / "model" / "config.json")
        check_writable("output", self.output / "checkpoints" / "step" / "progress.json")
        check_writable("cache", self.cache / "array.npy")
        if not self.processes.is_main_process:
            self.processes.wait_for_everyone()  # until the main process has filled the cache; see `fit`

    def _check_inputs(self, inputs: dict[str, str]) -> None:
        """Raises if the hashes of a checkpoint's `inputs` are not those of the folders that are named now."""
        if inputs != self.inputs:
            options = ", ".join(f"--{option}" for option in inputs)
            raise InvalidInputError(
                f"`resume` finds a run in {str(self.output)!r} that was built on other weights than {options} name "
                "now; name those, or begin anew."
            )

    def _earlier_sets(self, progress: dict[str, Any], changes: Sequence[str]) -> list[Any]:
        """Summaries of the data that a resumed run was trained on before its data was changed."""
        earlier_sets = progress.get("earlier_sets", [])
        before = progress.get("sets", self.sets)
        if before == self.sets:
            return earlier_sets
        if not any(change.startswith("data.") for change in changes):
            raise InvalidInputError(
                f"`resume` finds a run in {str(self.output)!r} on other data than there is now: "
                f"{_difference(before, self.sets)}. Put the data back, or begin anew in another `output`."
            )
        return [*earlier_sets, before]

    @cached_property
    def processor(self) -> UniTouchProcessor:
        """The processor of the pipeline, the joint space, or the weights to start from; else by the recipe."""
        if "model" in self.folders:
            return UniTouchProcessor.from_pretrained(self.folders["model"] / "processor")
        init = self.folders.get("init")
        if init is not None and not (init / "preprocessor_config.json").is_file():
            init = None  # an autoencoder or a UNet
        folder = self.folders.get("joint", init)
        if folder is not None:
            return UniTouchProcessor.from_pretrained(folder)
        return UniTouchProcessor(image_size=self.data.image_size, audio=self.data.audio)  # type: ignore[arg-type]

    def joint_space(self, *modalities: str) -> UniTouchModel:
        """The joint space of `--joint`, or of the pipeline of `--model`."""
        folder = self.folders["model"] / "unitouch" if "model" in self.folders else self.folders["joint"]
        return UniTouchModel.from_pretrained(folder, modalities=modalities)

    def unet(self, model: Arguments, **conditions: Any) -> UNet2DConditionModel:
        """The UNet of `--init`; else a random one, by the recipe's section `model` and `conditions`."""
        if "init" not in self.folders:
            return build("model", UNet2DConditionModel, model, **conditions)
        init = self.folders["init"]
        return UNet2DConditionModel.from_pretrained(init, torch_dtype=torch.float32, use_safetensors=True)

    def splits(self, *needs: str) -> list[Contacts]:
        """The training split of each source, with the columns that are needed; see `columns_of`."""
        return columns_of(self.sources, self.cache, self.data, self.processor, needs)

    def computed_once(self, name: str, option: str, splits: list[Contacts], compute: Callable[[], Tensor]) -> Tensor:
        """What a model computes of `splits`, cached by the weights of the folder that `option` names.

        If that option names no folder, the model is random or changed, and nothing is cached.
        """
        weights = self.inputs.get("model", self.inputs.get(option))
        if weights is None:
            return compute()
        fingerprints = "".join(split.fingerprint for split in splits)
        splits_hash = hashlib.sha256(fingerprints.encode()).hexdigest()
        data_names = [Path(data_set.path).name for data_set in self.data.sets]
        if self.data.drawn:
            data_names.append("drawn")
        file = "-".join([name, *data_names, "train", splits_hash[:16], weights[:16]])
        return computed_once(self.cache / f"{file}.safetensors", compute)

    def image_embeddings(self, model: UniTouchModel, splits: list[Contacts]) -> Tensor:
        """Embeddings (N, D) of all pictures, un-normalised."""

        def compute() -> Tensor:
            return torch.cat([image_embeddings(model.eval(), "image", split.image) for split in splits])

        return self.computed_once("image-embeddings", "joint", splits, compute)

    def sampler(self, settings: SamplerSettings, splits: list[Contacts], embeds: Tensor) -> Indices:
        """Sample indices of batches, in groups whose embeddings (N, D) are alike."""
        sizes = [len(split) for split in splits]
        near = F.normalize(embeds.float(), dim=1).numpy()
        return partial(in_batch_indices, sizes=sizes, settings=settings, near=near, **self.batch_options)

    def check_drawn(self, *weights: str) -> None:
        """Raises if there are data sets, and losses with `weights` above 0 need what only drawn contacts have."""
        if weights and not all(isinstance(source, DrawnContacts) for source in self.sources):
            names = ", ".join(f"`objective.{name}`" for name in weights)
            raise InvalidInputError(f"{names} need `data.drawn` alone; set these to 0, or leave out `data.sets`.")

    def fit(self, objective: nn.Module, dataset: ArrayDataset, indices_of: Indices | None = None) -> None:
        """Trains an objective to its last step, with `--resume` from the last checkpoint.

        Batches are of shuffled epochs, if `indices_of` is left out.
        """
        if self.processes.is_main_process:
            self.processes.wait_for_everyone()  # the cache is filled; the other processes go on and read it
        indices_of = indices_of or partial(shuffled_indices, size=len(dataset), **self.batch_options)
        progress = {
            "inputs": self.inputs,
            "recipe": self.recipe_values,
            "sets": self.sets,
            "earlier_sets": self.earlier_sets,
        }
        trainer = Trainer(objective, dataset, indices_of, config=self.trainer, output=self.output, progress=progress)
        if self.resume:
            trainer.resume()
        trainer.fit()
        self.seconds = trainer.seconds

    @contextmanager
    def saving(self, **figures: Any) -> Iterator[Path]:
        """The folder to write the stage's model to. `record.json` beside it has seed, recipe, inputs and times."""
        record: dict[str, Any] = {
            "stage": self.name,
            "seed": self.trainer.seed,
            "seconds": round(self.seconds, 1),
            "version": __version__,
            "inputs": self.inputs,
            "trainer": self.trainer.model_dump(),
            "recipe": {key: value for key, value in self.recipe_values.items() if key != "trainer"},
            "sets": self.sets,
        }
        if self.earlier_sets:
            record["earlier_sets"] = self.earlier_sets
        record.update(figures)
        if "init" in self.folders:
            # The record of a run lies beside its `model`, and `init` may name that folder or a part of it.
            for folder in self.folders["init"].resolve().parents[:2]:
                if (folder / "record.json").is_file():
                    record["started_from"] = json.loads((folder / "record.json").read_text())
        main = self.processes.is_main_process  # what the other processes write is discarded
        with filling("output", self.output) if main else TemporaryDirectory() as output:
            model = Path(output) / "model"
            model.mkdir()
            yield model
            (model.parent / "record.json").write_text(json.dumps(record, indent=2) + "\n")


def _difference(before: Sequence[dict[str, Any]], now: Sequence[dict[str, Any]]) -> str:
    """The first data set that differs between two runs, in words."""

    def in_words(summary: dict[str, Any] | None) -> str:
        return json.dumps(summary) if summary else "nothing"

    pairs = zip_longest(before, now)
    summary_before, summary_now = next(pair for pair in pairs if pair[0] != pair[1])
    return f"{in_words(summary_before)} then, {in_words(summary_now)} now"


def check_no_checkpoints(output: Path) -> None:
    """Raises if a folder holds checkpoints, which a new run would remove."""
    checkpoints = checkpoints_in(output)
    if checkpoints:
        raise InvalidInputError(
            f"`output` is {str(output)!r}, which holds {checkpoints[-1].name} of a run that would be lost; pass "
            "`--resume` to go on with it, remove it, or name another output."
        )


def named_folders(name: str, **folders: Path | None) -> dict[str, Path]:
    """The folders of models that were named, by option; raises if a stage needs others, or does not take one."""
    named = {option: folder for option, folder in folders.items() if folder is not None}
    takes = STAGES[name].takes
    if not {*takes} <= {*named} <= folders_of(name):
        needed = ", ".join(f"--{option} of {stage}" for option, stage in takes.items()) or "none"
        given = ", ".join(f"--{option}" for option in named) or "none"
        raise InvalidInputError(f"{name} needs folders of models: {needed}; it got {given}.")
    return named


def hash_weights(folder: Path) -> str:
    """SHA-256 of the names and bytes of all safetensors below a folder, also behind links."""
    digest = hashlib.sha256()
    # A save that was cut off leaves hidden files.
    files = [file for file in files_below(folder) if not is_hidden(file.relative_to(folder))]
    for file in sorted(file for file in files if file.suffix == ".safetensors"):
        digest.update(f"{file.relative_to(folder).as_posix()}\n".encode())
        with file.open("rb") as stream:
            digest.update(hashlib.file_digest(stream, "sha256").digest())
    return digest.hexdigest()


def run_stage(name: str, **options: Any) -> None:
    """Runs a stage with its options. The annotation of `recipe` in its `main` is what the recipe is read as."""
    main = import_module(f"unitouch_gen.training.{STAGES[name].module or name}").main
    stage = Stage(name, main.__annotations__["recipe"], **options)
    torch.manual_seed(stage.trainer.seed)
    main(stage, stage.recipe)
