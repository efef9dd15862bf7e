"""What every stage's command has in common: arguments, the training data, and the folder a stage leaves behind."""

import argparse
import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import wraps
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from tqdm.auto import tqdm

from unitouch_gen.errors import InvalidInputError, InvalidTypeError, NonFiniteError
from unitouch_gen.files import replacing, replacing_folder, restore_folder, write_file
from unitouch_gen.models import UniTouchConfig, UniTouchModel, UniTouchProcessor
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.models.joint import MODULES
from unitouch_gen.training.core import Trainer, check_one_process, read_progress
from unitouch_gen.training.data import ArrayDataset, Rendered, rendered
from unitouch_gen.training.inputs import check_resumed, weights_of
from unitouch_gen.training.recipe import (
    DataConfig,
    TrainerConfig,
    read_recipe,
    read_section,
    trainer_config,
)
from unitouch_gen.world import TRAINING_COLLECTIONS

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


def command_of(name: str, runs: Path) -> str:
    """What runs a stage, with all outputs in one folder."""
    needs = [f"--{option} {runs / before / 'model'}" for option, before in STAGES[name].items()]
    return " ".join([f"python -m unitouch_gen.training.{name}", *needs, f"--output {runs / name}"])


@dataclass
class Stage:
    """One call of a stage's command.

    Attributes:
        name: Of the stage.
        recipe: The YAML as read, overrides laid over it.
        trainer: Its `trainer` section.
        data: Its `data` section.
        output: Where the stage writes.
        cache: Where rendered collections are kept.
        resume: Whether to go on from the last checkpoint.
        folders: Outputs of the stages before, by the name of the option: "joint", "vae".
        init: Folder of weights to start from in place of random ones, where the stage takes one.
        commit: Of the code it started with.
        inputs: Hashes of the weights in `folders`, by the name of the option.
    """

    name: str
    recipe: dict[str, Any]
    trainer: TrainerConfig
    data: DataConfig
    output: Path
    cache: Path
    resume: bool
    folders: dict[str, Path]
    init: Path | None = None
    commit: str | None = None
    inputs: dict[str, str] = field(default_factory=dict)


def command(main: Callable[..., None]) -> Callable[..., None]:
    """A `main` that ends on users' mistakes, and on losses that are not finite, with one line and exit code 2."""

    @wraps(main)
    def run(*arguments: Any) -> None:
        try:
            main(*arguments)
        except (InvalidInputError, InvalidTypeError, NonFiniteError) as error:
            print(f"unitouch_gen.training: {' '.join(str(error).split())}", file=sys.stderr)
            sys.exit(2)

    return run


def parse(name: str, takes_init: bool = False) -> Stage:
    """Reads a stage's command line.

    Raises:
        InvalidInputError, InvalidTypeError: If the stage cannot be run as asked for.
    """
    parser = argparse.ArgumentParser(prog=f"python -m unitouch_gen.training.{name}")
    parser.add_argument("--recipe", default=name, help="a YAML file, or a name in training/recipes")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="override the recipe")
    parser.add_argument("--output", type=Path, default=Path("runs") / name)
    parser.add_argument("--cache", type=Path, default=Path("runs/cache"), help="rendered collections")
    parser.add_argument("--resume", action="store_true", help="go on from the last checkpoint")
    for option, before in STAGES[name].items():
        parser.add_argument(f"--{option}", type=Path, required=True, help=f"the {before} stage's model")
    if takes_init:
        parser.add_argument("--init", type=Path, help="folder of weights to start from in place of random ones")
    arguments = parser.parse_args()

    check_one_process(int(os.environ.get("WORLD_SIZE", "1")))  # set by what starts several
    recipe = read_recipe(arguments.recipe, arguments.set)
    trainer, data = trainer_config(recipe), read_section(recipe, "data", DataConfig)
    for option in ("output", "cache"):
        if (folder := getattr(arguments, option)).exists() and not folder.is_dir():
            raise InvalidInputError(f"`{option}` is {str(folder)!r}, which is a file; name a folder.")
    progress = read_progress(arguments.output, trainer.steps) if arguments.resume else {}
    folders = {option: _model_folder(option, getattr(arguments, option)) for option in STAGES[name]}
    check_resumed(progress.get("inputs", {}), folders, arguments.output)
    init = _model_folder("init", arguments.init) if takes_init and arguments.init is not None else None
    return Stage(
        name=name,
        recipe=recipe,
        trainer=trainer,
        data=data,
        output=arguments.output,
        cache=arguments.cache,
        resume=arguments.resume,
        folders=folders,
        init=init,
        commit=commit(),
        inputs={option: weights_of(folder) for option, folder in folders.items()},
    )


def _model_folder(option: str, folder: Path) -> Path:
    restore_folder(folder)
    if not (folder / "config.json").is_file():
        raise InvalidInputError(
            f"`{option}` is {str(folder)!r}, which holds no model; name a folder with a config.json."
        )
    return folder


def train(stage: Stage, objective: nn.Module, dataset: ArrayDataset, indices_of: Callable[[int], list[int]]) -> Trainer:
    """Runs a stage's objective to its last step, from the last checkpoint if that was asked for."""
    trainer = Trainer(objective, dataset, indices_of, stage.trainer, stage.output, stage.inputs)
    if stage.resume:
        trainer.resume()
    trainer.fit()
    return trainer


def own_processor(stage: Stage) -> UniTouchProcessor:
    """The processor of a stage that starts without a joint space: what its recipe says."""
    return UniTouchProcessor(image_size=stage.data.image_size, audio=stage.data.audio)  # type: ignore[arg-type]


def training_splits(stage: Stage, processor: UniTouchProcessor) -> list[Rendered]:
    """The training split of each of the recipe's collections."""
    data = stage.data
    return [
        rendered(stage.cache, name, "train", data.contacts_per_object, processor, data.world_seed, data.touch_size)
        for name in data.collections
    ]


def data_key(stage: Stage, splits: list[Rendered]) -> str:
    """Names the pictures of `training_splits`, for caches of what is computed from them."""
    world = hashlib.sha256("".join(split.fingerprint for split in splits).encode()).hexdigest()[:16]
    few = [] if stage.data.collections == TRAINING_COLLECTIONS else stage.data.collections
    return "-".join([*few, f"train{stage.data.contacts_per_object}", world])


@torch.no_grad()
def image_embeddings(
    model: UniTouchModel, images: list[np.ndarray], key: str, cache: Path, batch_size: int = 256
) -> Tensor:
    """Frozen image embeddings (N, D) of uint8 pictures, computed once for each state of the encoder.

    Args:
        model: With its image encoder.
        images: Arrays (n, 3, S, S), concatenated.
        key: Names the pictures; the encoder's own weights are hashed beside it.
        cache: Folder to keep them in.
    """
    model.load("image")
    model.eval()

    def embed(pixels: Tensor) -> Tensor:
        return model.get_image_features(normalise_pixels(pixels.float() / 255).to(model.device)).cpu()

    file = Path(cache) / f"image-embeddings-{key}-{weights_hash(model.vision_model)}.safetensors"
    return computed_once(file, embed, images, batch_size)


def computed_once(file: Path, compute: Callable[[Tensor], Tensor], images: list[np.ndarray], batch_size: int) -> Tensor:
    """What `compute` makes of uint8 pictures, batch by batch; read from the file if it is there, else written to it."""
    if file.is_file():
        return load_file(file)["values"]
    rows = []
    for array in images:
        for start in tqdm(range(0, len(array), batch_size), desc=file.stem, mininterval=5.0, leave=False):
            rows.append(compute(torch.from_numpy(np.ascontiguousarray(array[start : start + batch_size]))))
    values = torch.cat(rows)
    with replacing(file) as partial:
        save_file({"values": values.contiguous()}, partial)
    return values


def weights_hash(module: nn.Module) -> str:
    """Sixteen hexadecimal digits that change whenever a weight does."""
    digest = hashlib.sha256()
    for name, tensor in sorted(module.state_dict().items()):
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().contiguous().float().numpy().tobytes())
    return digest.hexdigest()[:16]


def joint_of(recipe: dict[str, Any]) -> UniTouchConfig:
    """The joint space's configuration from a recipe's `model` section."""
    return read_section(recipe, "model", UniTouchConfig)


def save_modalities(
    model: UniTouchModel, modalities: tuple[str, ...], processor: UniTouchProcessor, output: Path
) -> None:
    """Writes some modalities of a model as a folder that `UniTouchModel.from_pretrained` reads."""
    names = [name for modality in modalities for name in MODULES[modality]]
    state = {
        f"{name}.{key}": tensor.detach().contiguous().clone()
        for name in names
        for key, tensor in getattr(model, name).state_dict().items()
    }
    with replacing_folder(output) as folder:
        save_file(state, folder / "model.safetensors", metadata={"format": "pt"})
        model.config.save_pretrained(folder)
        processor.save_pretrained(folder)


def write_record(stage: Stage, seconds: float, **figures: Any) -> None:
    """`record.json` beside a stage's weights: recipe, seed, time, commit, what it was built on, and figures."""
    record = {
        "stage": stage.name,
        "seed": stage.trainer.seed,
        "seconds": round(seconds, 1),
        "threads": torch.get_num_threads(),
        "commit": stage.commit,
        "inputs": stage.inputs,
        "trainer": asdict(stage.trainer),
        "recipe": {key: value for key, value in stage.recipe.items() if key != "trainer"},
        **figures,
    }
    before = None if stage.init is None else stage.init.resolve().parents[1] / "record.json"
    if before is not None and before.is_file():
        record["started_from"] = json.loads(before.read_text())
    write_file(stage.output / "record.json", json.dumps(record, indent=2) + "\n")


def commit(file: Path = Path(__file__)) -> str | None:
    """Of the checkout that tracks a file, with "-dirty" if tracked files differ from it; `None` outside of one."""
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
