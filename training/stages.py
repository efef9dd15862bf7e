"""What the stages have in common: their command line, what they are given, and the folder they leave behind."""

import hashlib
import json
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from datetime import timedelta
from functools import cached_property
from inspect import Parameter, Signature, signature
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, TypeVar

import torch
import typer
from accelerate import PartialState
from accelerate.utils import parse_flag_from_env
from diffusers import UNet2DConditionModel
from safetensors.torch import save_file
from torch import nn
from typer import Option

from unitouch_gen.errors import INTERRUPTED, InvalidInputError, first_of, run_commands
from unitouch_gen.files import as_path, check_writable, complete_folder, writing_folder
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.models.joint import MODULES
from unitouch_gen.training.batches import ArrayDataset, ShuffledSampler
from unitouch_gen.training.data import DataConfig, DrawnContacts, RecordSet, Rendered, Source, columns_of
from unitouch_gen.training.recipe import Section, Settings, flat, read_recipe, read_section, section_of
from unitouch_gen.training.trainer import Trainer, TrainerConfig, checkpoints_in, read_progress
from unitouch_gen.training.watching import Watch

SettingsKind = TypeVar("SettingsKind", bound=Settings)

STAGES: dict[str, dict[str, str]] = {
    "image_text": {},
    "audio": {"joint": "image_text"},
    "touch": {"joint": "image_text"},
    "image_vae": {},
    "unclip": {"joint": "image_text", "vae": "image_vae"},
    "picture_classifier": {},
    "touch_vae": {},
    "touch_ldm": {"joint": "image_text", "vae": "touch_vae"},
    "touch_classifier": {},
}
"""All stages in order. Each names the options that take an earlier stage's output, and that stage."""

STARTING_FROM_WEIGHTS = ("image_text", "touch", "unclip", "touch_ldm")
"""Stages that may start from weights in place of random ones."""

FREE = tuple(f"trainer.{key}" for key in ("save_every", "keep_checkpoints", "watch_every", "trackers", "workers"))
"""Keys of recipes that may change on the way without being asked, as no weight depends on them."""

LOOKED_AT = 64
"""Held-out samples that are watched."""

RENDERING = timedelta(days=2)
"""How long processes wait for the main one, which renders, decodes and embeds."""


class Stage:
    """One call of a stage's command.

    Args:
        name: One of `STAGES`; the other arguments are the command's options.
        folders: Models of the stages before, by the name of the option: "joint", "vae".

    Attributes:
        trainer, data: Sections of the recipe.
        commit: That of the code it started with.
        inputs: Hashes of the weights in `folders`, and of those to start from.

    Raises:
        InvalidInputError, InvalidTypeError: If the stage cannot be run as asked for.
    """

    def __init__(
        self,
        name: str,
        *,
        recipe: Annotated[str | None, Option(help="A YAML file, or a name in training/recipes.")] = None,
        overrides: Annotated[
            list[str] | None, Option("--set", metavar="SECTION.KEY=VALUE", help="Override the recipe.")
        ] = None,
        output: Annotated[Path | None, Option(help="Where the stage writes, and resumes; else runs/STAGE.")] = None,
        textures: Annotated[
            Path | None, Option(help="Folder of scanned materials for `data.drawn`, as CC0 libraries give them.")
        ] = None,
        cache: Annotated[Path, Option(help="What was rendered, and what models say of them.")] = Path("runs/cache"),
        resume: Annotated[bool, Option("--resume", metavar="", help="Go on from the last checkpoint.")] = False,
        override: Annotated[
            bool, Option("--override", metavar="", help="Go on although the recipe has changed.")
        ] = False,
        init: Annotated[Path | None, Option(help="Folder of weights to start from in place of random ones.")] = None,
        **folders: Path,
    ):
        on_cpu = parse_flag_from_env("ACCELERATE_USE_CPU")  # which accelerate reads only after it has looked for GPUs
        self.processes = PartialState(cpu=on_cpu, timeout=RENDERING)
        self.name, self.output, self.cache, self.resume = name, output or Path("runs") / name, cache, resume
        self.recipe = read_recipe(name if recipe is None else recipe, overrides or ())
        if textures is not None:
            set_textures(self.recipe, textures)
        self.trainer, self.data = self.section("trainer", TrainerConfig), self.section("data", DataConfig)
        self.data.check_named()
        for option, folder in {"output": self.output, "cache": self.cache}.items():
            check_writable(option, folder / "record.json")
        if not resume and (found := checkpoints_in(self.output)):
            raise InvalidInputError(
                f"`output` is {str(self.output)!r}, which holds {found[-1].name} of a run that would be lost; pass "
                "`--resume` to go on with it, remove it, or name another output."
            )
        progress = read_progress(self.output, self.trainer.steps) if resume else {}
        self._check_recipe(progress.get("recipe", self.recipe), override)
        self.folders = {option: _model_folder(option, folder) for option, folder in folders.items()}
        self.init = None if init is None else _model_folder("init", init)
        given, before = self.folders | ({} if self.init is None else {"init": self.init}), progress.get("inputs", {})
        if "init" in before and self.init is None:
            raise InvalidInputError(
                f"`resume` finds a checkpoint in {str(self.output)!r} of a run that started from weights; pass the "
                "same `--init` again."
            )
        for option in changed(before, given):
            raise InvalidInputError(
                f"`resume` finds a checkpoint in {str(self.output)!r} that was built on other weights than `{option}` "
                f"({str(given[option])!r}) holds now; remove {str(self.output)!r} and begin anew, or name another "
                "output."
            )
        self.inputs = {option: weights_of(folder) for option, folder in given.items()}
        self.commit, self.seconds = commit(), 0.0
        if not self.processes.is_main_process:
            self.processes.wait_for_everyone()  # until the main one has prepared what all find in the cache; see `fit`

    def _check_recipe(self, before: Mapping[str, Any], override: bool) -> None:
        """Tells how the recipe has changed since the checkpoint."""
        old, new = flat(before), flat(self.recipe)
        keys = sorted(key for key in {*old, *new} if old.get(key) != new.get(key) and key not in FREE)
        if not keys:
            return
        changes = first_of([f"{key} from {old.get(key)} to {new.get(key)}" for key in keys], ", ")
        if not override:
            raise InvalidInputError(
                f"`resume` finds a checkpoint in {str(self.output)!r} that began with another recipe: {changes}. Pass "
                "`--override` to go on with this one, or name another output."
            )
        if self.processes.is_main_process:
            print(f"The recipe has changed: {changes}.", file=sys.stderr)

    def section(self, name: str, kind: Callable[..., Section], **given: Any) -> Section:
        """A section of the recipe; see `read_section`."""
        return read_section(self.recipe, name, kind, **given)

    def settings(self, name: str, kind: type[SettingsKind]) -> SettingsKind:
        """A section of settings that a recipe may leave out: all of them have defaults."""
        return self.section(name, kind) if name in self.recipe else kind()

    def processor(self) -> UniTouchProcessor:
        """That of the joint space; what the recipe says where the stage takes none."""
        if "joint" in self.folders:
            return UniTouchProcessor.from_pretrained(self.folders["joint"])
        return UniTouchProcessor(image_size=self.data.image_size, audio=self.data.audio)  # type: ignore[arg-type]

    def unet(self, **conditions: Any) -> UNet2DConditionModel:
        """The network: random by the recipe and `conditions`, or the weights that were named to start from."""
        if self.init is None:
            return self.section("model", UNet2DConditionModel, **conditions)
        return UNet2DConditionModel.from_pretrained(self.init, torch_dtype=torch.float32, use_safetensors=True)

    @cached_property
    def sources(self) -> list[Source]:
        """The recipe's contacts and data sets: all that a stage is trained on, yet to be rendered or decoded."""
        sources = self.data.sources()
        if self.processes.is_main_process:
            for data in (source for source in sources if isinstance(source, RecordSet)):
                print("; ".join([f"{data}: {len(data)} touches of {data.sensor}", *data.notes]), file=sys.stderr)
        return sources

    def splits(self, processor: UniTouchProcessor, *needs: str) -> list[Rendered]:
        """The training split of each source, with the columns that are needed; see `columns_of`."""
        untextured = any(isinstance(source, DrawnContacts) and source.textures is None for source in self.sources)
        if untextured and self.processes.is_main_process:
            print("Trained on the world alone; --textures FOLDER adds scanned materials.", file=sys.stderr)
        return columns_of(self.sources, self.cache, self.data, processor, needs)

    def watching(
        self, watch: Callable[[list[Rendered]], Watch], processor: UniTouchProcessor, *needs: str
    ) -> Watch | None:
        """`watch` of about `LOOKED_AT` samples that nothing is trained on, with the columns that are needed.

        `None` where nothing is watched or held out, and in processes other than the main one.
        """
        every, steps = self.trainer.watch_every, self.trainer.steps
        if not every or (steps is not None and steps < every) or not self.processes.is_main_process:
            return None
        known = {source.sensor for source in self.sources}
        sources = [source for source in self.data.held_out(LOOKED_AT) if source.sensor in known]
        splits = columns_of(sources, self.cache, self.data, processor, needs, "val")
        return watch([split.thinned(-(-LOOKED_AT // len(splits))) for split in splits]) if splits else None

    def key(self, splits: list[Rendered]) -> str:
        """Names the pictures of `splits`, for caches of what is computed from them."""
        shown = hashlib.sha256("".join(split.fingerprint for split in splits).encode()).hexdigest()[:16]
        sets = [Path(one.path).name for one in self.data.sets]
        sets += [] if self.data.drawn is None else ["drawn"]
        return "-".join([*sets, "train", shown])

    def fit(
        self,
        objective: nn.Module,
        dataset: ArrayDataset,
        indices_of: Callable[[int], list[int]] | None = None,
        watch: Watch | None = None,
    ) -> None:
        """Runs an objective to its last step, from the last checkpoint if that was asked for; by shuffled epochs.

        Args:
            objective, dataset, indices_of, watch: See `Trainer`.

        Raises:
            SystemExit: If a SIGTERM stopped it, or with 130 an interrupt; its checkpoint is there.
        """
        if self.processes.is_main_process:
            self.processes.wait_for_everyone()  # the others may now prepare what they find in the cache
        indices_of = indices_of or ShuffledSampler(len(dataset), self.trainer.batch_size, self.trainer.seed)
        progress = {"inputs": self.inputs, "recipe": self.recipe}
        trainer = Trainer(objective, dataset, indices_of, self.trainer, self.output, progress, watch)
        if self.resume:
            trainer.resume()
        finished = trainer.fit()
        self.seconds = trainer.seconds
        if not finished:
            if self.processes.is_main_process:
                print(f"Stopped after step {trainer.step}, which is saved; go on with `--resume`.", file=sys.stderr)
            sys.exit(INTERRUPTED if trainer.interrupted else 0)

    @contextmanager
    def saving(self, **figures: Any) -> Iterator[Path]:
        """The folder to write the stage's model to; `record.json` beside it says how the weights came about."""
        if not self.processes.is_main_process:
            with TemporaryDirectory() as discarded:
                yield Path(discarded)
            return
        with writing_folder("output", self.output, replace=True) as place:
            (place / "model").mkdir()
            yield place / "model"
            (place / "record.json").write_text(json.dumps(self._record(**figures), indent=2) + "\n")

    def _record(self, **figures: Any) -> dict[str, Any]:
        """How the weights came about."""
        sets = [source.summary for source in self.sources]
        drawn = [source for source in self.sources if isinstance(source, DrawnContacts)]
        scans = {name: files for source in drawn for name, files in source.scans.items()}
        record = {
            "stage": self.name,
            "seed": self.trainer.seed,
            "seconds": round(self.seconds, 1),
            "threads": torch.get_num_threads(),
            "commit": self.commit,
            "inputs": self.inputs,
            "trainer": self.trainer.model_dump(),
            "recipe": {key: value for key, value in self.recipe.items() if key != "trainer"},
            **({"sets": sets} if sets else {}),
            **({"textures": scans} if scans else {}),
            **figures,
        }
        before = None if self.init is None else record_beside(self.init)
        return record if before is None else {**record, "started_from": before}


def record_beside(folder: Path) -> dict[str, Any] | None:
    """The record of the run that left some weights, where they are its model or a part of that."""
    found = (place / "record.json" for place in folder.resolve().parents[:2])
    return next((json.loads(file.read_text()) for file in found if file.is_file()), None)


# Commands -------------------------------------------------------------------------------------------------------------


def run(name: str, main: Callable[[Stage], None], words: Sequence[str] | None = None) -> None:
    """Runs a stage by its command line.

    Args:
        name: One of `STAGES`.
        main: The stage.
        words: In place of those that the process was started with.
    """

    def command(**options: Any) -> None:
        stage = Stage(name, **options)
        torch.manual_seed(stage.trainer.seed)
        main(stage)

    hidden = {"name", "folders", *(() if name in STARTING_FROM_WEIGHTS else ("init",))}
    shared = [option for key, option in signature(Stage).parameters.items() if key not in hidden]
    before = [
        Parameter(key, Parameter.KEYWORD_ONLY, annotation=Annotated[Path, Option(help=f"The {stage} stage's model.")])
        for key, stage in STAGES[name].items()
    ]
    command.__signature__ = Signature([*before, *shared])  # type: ignore[attr-defined]
    run_command(name, command, words)


def run_command(name: str, function: Callable[..., None], words: Sequence[str] | None = None) -> None:
    """Runs a function by a command line of its arguments.

    Users' mistakes, and losses that are not finite, end it with one line and exit code 2, an interrupt with 130.
    """
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command(help=(function.__doc__ or "").partition("\n")[0])(function)
    prog_name = f"python -m unitouch_gen.training.{name}"
    code = run_commands(app, "unitouch_gen.training", words, prog_name=prog_name)
    if code:  # of an interrupt
        sys.exit(code)


def command_of(name: str, runs: Path) -> str:
    """What runs a stage, with all outputs in one folder."""
    needs = [f"--{option} {runs / before / 'model'}" for option, before in STAGES[name].items()]
    return " ".join([f"python -m unitouch_gen.training.{name}", *needs, f"--output {runs / name}"])


# What stages were built on --------------------------------------------------------------------------------------------


def set_textures(recipe: Mapping[str, Any], folder: Path) -> None:
    """Has a recipe's drawn contacts made of scanned materials as well.

    Raises:
        InvalidInputError: If it draws none, or there is no such folder.
    """
    drawn = section_of(recipe, "data").get("drawn")
    if not isinstance(drawn, dict):
        raise InvalidInputError(
            f"`textures` is {str(folder)!r}, but the recipe draws no contacts that could be made of them; give it a "
            "`data.drawn`."
        )
    if not as_path("textures", folder).is_dir():
        raise InvalidInputError(f"`textures` is {str(folder)!r}, which is no folder.")
    drawn["textures"] = str(folder)


def _model_folder(option: str, folder: Path) -> Path:
    complete_folder(as_path(option, folder))
    if not (folder / "config.json").is_file():
        raise InvalidInputError(
            f"`{option}` is {str(folder)!r}, which holds no model; name a folder with a config.json."
        )
    return folder


def weights_of(folder: Path) -> str:
    """SHA-256 of all the safetensors below a folder: of their names and bytes."""
    digest = hashlib.sha256()
    for file in sorted(folder.rglob("*.safetensors")):
        digest.update(f"{file.relative_to(folder).as_posix()}\n".encode())
        with file.open("rb") as stream:
            digest.update(hashlib.file_digest(stream, "sha256").digest())
    return digest.hexdigest()


def changed(recorded: Mapping[str, str], folders: Mapping[str, Path]) -> list[str]:
    """Options whose folders hold other weights than were recorded; older records hold none, and pass."""
    return [name for name, folder in folders.items() if name in recorded and recorded[name] != weights_of(folder)]


def commit(file: Path = Path(__file__)) -> str | None:
    """The commit of the checkout that tracks a file, "-dirty" if tracked files differ; `None` outside of one."""
    file = file.resolve()
    if _git(file.parent, "ls-files", "--error-unmatch", file.name) is None:  # such as what is installed in a checkout
        return None
    return _git(file.parent, "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*")


def _git(folder: Path, *words: str) -> str | None:
    """What git says; `None` if it fails, or there is none."""
    try:
        done = subprocess.run(["git", "-C", str(folder), *words], capture_output=True, text=True, check=False)
    except OSError:
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def save_modalities(
    model: UniTouchModel, modalities: Sequence[str], processor: UniTouchProcessor, folder: Path
) -> None:
    """Writes some modalities of a model to a folder that `UniTouchModel.from_pretrained` reads.

    What weights that it started from do not know, and how sure they were, is left behind.
    """
    config = deepcopy(model.config)
    for name in ("ood_thresholds", "temperatures", "temperature_exponents", "sensor_reaches"):
        setattr(config, name, {})
    config.save_pretrained(folder)
    processor.save_pretrained(folder)
    names = [name for modality in modalities for name in MODULES[modality]]
    state = {
        f"{name}.{key}": tensor.detach().contiguous().clone()
        for name in names
        for key, tensor in getattr(model, name).state_dict().items()
    }
    save_file(state, folder / "model.safetensors", metadata={"format": "pt"})
