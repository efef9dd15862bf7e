"""Saving of models into folders without loss: each file takes its place by a rename after all are written."""

import errno
import functools
import inspect
import json
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from unitouch_gen.errors import check_arguments, explain_errors
from unitouch_gen.files import (
    UNFINISHED,
    as_path,
    check_replaceable,
    files_below,
    finish_save,
    locked,
    set_permissions,
    write_file,
    writing_to,
)

SAVING_OPTIONS = (
    "commit_description",
    "commit_message",
    "create_pr",
    "distributed_checkpoint",
    "is_main_process",
    "max_shard_size",
    "private",
    "push_to_hub",
    "repo_id",
    "revision",
    "safe_serialization",
    "save_function",
    "save_original_format",
    "save_peft_format",
    "state_dict",
    "tags",
    "token",
    "use_flashpack",
    "variant",
)
"""Options of `save_pretrained` and `push_to_hub` of diffusers and transformers, which ignore unknown ones."""

SHARD_NUMBER = re.compile(r"-\d+-of-\d+(?=\.safetensors$)")


@contextmanager
def filling(name: str, folder: Path) -> Iterator[Path]:
    """An empty folder to write to, whose files take their places in `folder` when the block ends without an error.

    Other files in `folder` are unchanged, except for older weights of the same components (another number of shards),
    which are removed. Files take their places one by one, weights first and configs last. If that is cut off, the next
    reader of the folder finishes it, see `reading`.

    Raises:
        InvalidInputError: If `folder` cannot be written to. It is then unchanged.
    """
    target = Path(os.path.realpath(folder))
    with writing_to(name, target):
        is_new = not os.path.exists(target)
        target.mkdir(parents=True, exist_ok=True)
        staging = Path(tempfile.mkdtemp(prefix=".", suffix=".partial", dir=target))
        try:
            yield staging
            with locked(target):
                finish_save(target)
                _decide(staging, target)
        except BaseException:
            shutil.rmtree(staging, ignore_errors=True)
            if is_new:
                with suppress(OSError):  # raised if another process has filled the folder
                    target.rmdir()
            raise
    problem = f"`{name}` was written in part to {str(target)!r}"
    wanted = "the files are there under hidden names, and take their places when it is read"
    with explain_errors(problem, wanted, OSError), locked(target):
        finish_save(target)
    shutil.rmtree(staging, ignore_errors=True)


def _decide(staging: Path, target: Path) -> None:
    """Moves staged files beside their destinations, under hidden names, and writes the plan of their moves.

    Only a move within one folder is certainly a rename, since folders inside of `target` may be mounts or links.
    """
    moves: dict[Path, Path] = {}
    new_folders: list[Path] = []
    try:
        for staged in files_below(staging):
            destination = target / staged.relative_to(staging)
            check_replaceable(destination)
            _make_folders(destination.parent, new_folders)
            hidden = destination.with_name(f".{destination.name}{staging.name}")
            if os.path.lexists(hidden):
                why = f"{destination.parent.name} is a link to another component's folder"
                raise FileExistsError(errno.EEXIST, why)
            moves[hidden] = destination
            set_permissions(staged, destination)
            shutil.move(staged, hidden)
        _write_plan(moves, target)
    except BaseException:
        for hidden in moves:
            hidden.unlink(missing_ok=True)
        for folder in reversed(new_folders):
            with suppress(OSError):  # raised if another save has filled the folder
                folder.rmdir()
        raise


def _make_folders(folder: Path, new_folders: list[Path]) -> None:
    """Makes a folder and its missing parents, and adds them to `new_folders`."""
    missing = [path for path in (folder, *folder.parents) if not os.path.lexists(path)]
    for path in reversed(missing):
        path.mkdir()
        new_folders.append(path)
    folder.mkdir(exist_ok=True)  # raises if a file is there


def _write_plan(moves: dict[Path, Path], target: Path) -> None:
    """Writes the plan: the moves, and older weights to remove. From then on, the save will be finished."""
    ordered = sorted(moves.items(), key=lambda move: _order(move[1]))
    plan = {
        "moves": [[str(path.relative_to(target)) for path in move] for move in ordered],
        "removed": sorted(str(file.relative_to(target)) for file in _earlier_weights([*moves.values()])),
    }
    write_file("save_directory", target / UNFINISHED, json.dumps(plan))


def _order(destination: Path) -> tuple[bool, int, Path]:
    """A key to sort files by: weights before JSON files, and deeper files before those above them."""
    return destination.suffix == ".json", -len(destination.parts), destination


def _earlier_weights(written: Sequence[Path]) -> set[Path]:
    """Older weights of the same components and variants: a single file, or an index and its shards."""
    earlier = set[Path]()
    for file in written:
        if file.suffix != ".safetensors":
            continue
        single = SHARD_NUMBER.sub("", file.name)  # model.fp16-00001-of-00002.safetensors -> model.fp16.safetensors
        component, *variant = single.removesuffix(".safetensors").split(".", 1)
        index = file.with_name(".".join([component, "safetensors", "index", *variant, "json"]))
        shards = [shard for shard in _shards_in(index) if SHARD_NUMBER.sub("", shard) == single]
        earlier |= {index, *(file.with_name(name) for name in (single, *shards))}
    return earlier - {*written}


def _shards_in(index: Path) -> set[str]:
    """Names of the files in an index of sharded weights; none if there is no such index."""
    try:
        return set(json.loads(index.read_text(encoding="utf-8"))["weight_map"].values())
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return set()


def saved_whole(save: Callable[..., Any]) -> Callable[..., None]:
    """A `save_pretrained` whose files take their places after all of them are written; uploads follow."""

    @functools.wraps(save)  # diffusers reads the signature
    def save_pretrained(self: Any, save_directory: Any, *args: Any, push_to_hub: bool = False, **kwargs: Any) -> None:
        folder = as_path("save_directory", save_directory)
        check_arguments("`save_pretrained`", kwargs, SAVING_OPTIONS)
        repo_id = kwargs.pop("repo_id", None)
        with filling("save_directory", folder) as staging:
            save(self, staging, *args, **kwargs)
        if push_to_hub:
            parameters = inspect.signature(self.push_to_hub).parameters
            upload_options = {name: value for name, value in kwargs.items() if name in parameters}
            self.push_to_hub(repo_id or folder.resolve().name, **upload_options)

    return save_pretrained
