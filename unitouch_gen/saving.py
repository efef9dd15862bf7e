"""Folders of models that are filled and lose nothing: each file takes its place by a rename when all are written."""

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

from unitouch_gen.errors import InvalidInputError, check_arguments
from unitouch_gen.files import (
    UNFINISHED,
    as_path,
    check_replaceable,
    files_below,
    finish_save,
    locked,
    share_as_usual,
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
"""Options of `save_pretrained` and `push_to_hub` of diffusers and transformers, which ignore others."""

SHARD_NUMBER = re.compile(r"-\d+-of-\d+(?=\.safetensors$)")


@contextmanager
def filling(name: str, folder: Path) -> Iterator[Path]:
    """An empty folder to write to, whose files take their places in `folder` when the block ends without an error.

    Everything else in `folder` stays as it is, but for older weights of the components that were written (another
    number of shards). Files take their places one by one, weights first and configs last. If that is cut off, whoever
    reads the folder next, by `reading`, finishes it.

    Raises:
        InvalidInputError: If `folder` cannot be written to; what was there stays.
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
                with suppress(OSError):  # of a folder that somebody else has filled meanwhile
                    target.rmdir()
            raise
    try:
        with locked(target):
            finish_save(target)
    except OSError as error:
        why = f"{error.strerror}. The files are there under hidden names, and take their places when it is read."
        raise InvalidInputError(f"`{name}` was written in part to {str(target)!r}: {why}") from error
    shutil.rmtree(staging, ignore_errors=True)


def _decide(staging: Path, target: Path) -> None:
    """Moves staged files beside their destinations, under hidden names, and writes down where they go.

    Only a move within one folder is sure to be a rename: folders inside `target` may be mounts or links.
    """
    moves: dict[Path, Path] = {}
    new_folders: list[Path] = []
    try:
        for staged in files_below(staging):
            destination = target / staged.relative_to(staging)
            check_replaceable(destination)
            _make_folders(destination.parent, new_folders)
            beside = destination.with_name(f".{destination.name}{staging.name}")
            if os.path.lexists(beside):
                why = f"{destination.parent.name} is a link to another component's folder"
                raise FileExistsError(errno.EEXIST, why)
            moves[beside] = destination
            share_as_usual(staged, destination)
            shutil.move(staged, beside)
        _write_plan(moves, target)
    except BaseException:
        for beside in moves:
            beside.unlink(missing_ok=True)
        for folder in reversed(new_folders):
            with suppress(OSError):  # of a folder that another save has filled meanwhile
                folder.rmdir()
        raise


def _make_folders(folder: Path, made: list[Path]) -> None:
    """Makes a folder and those above it that are not there, and adds them to `made`."""
    missing = [one for one in (folder, *folder.parents) if not os.path.lexists(one)]
    for one in reversed(missing):
        one.mkdir()
        made.append(one)
    folder.mkdir(exist_ok=True)  # raises if a file is there


def _write_plan(moves: dict[Path, Path], target: Path) -> None:
    """Writes down which files take which places, and which older weights go; from then on the save is decided."""
    ordered = sorted(moves.items(), key=lambda move: _order(move[1]))
    plan = {
        "moves": [[str(path.relative_to(target)) for path in move] for move in ordered],
        "removed": sorted(str(file.relative_to(target)) for file in _earlier_weights([*moves.values()])),
    }
    write_file("save_directory", target / UNFINISHED, json.dumps(plan))


def _order(destination: Path) -> tuple[bool, int, Path]:
    """A key to sort files by: weights before what describes them, and what lies deeper before what names it."""
    return destination.suffix == ".json", -len(destination.parts), destination


def _earlier_weights(written: Sequence[Path]) -> set[Path]:
    """Weights of the same components and variants under other names: a single file, or an index and its shards."""
    earlier = set[Path]()
    for file in written:
        if file.suffix != ".safetensors":
            continue
        single = SHARD_NUMBER.sub("", file.name)  # model.fp16-00001-of-00002.safetensors: model.fp16.safetensors
        component, *variant = single.removesuffix(".safetensors").split(".", 1)
        index = file.with_name(".".join([component, "safetensors", "index", *variant, "json"]))
        shards = [shard for shard in _shards_in(index) if SHARD_NUMBER.sub("", shard) == single]
        earlier |= {index, *(file.with_name(name) for name in (single, *shards))}
    return earlier - {*written}


def _shards_in(index: Path) -> set[str]:
    """Names of the files that an index of sharded weights lists; none where there is no such index."""
    try:
        return set(json.loads(index.read_text(encoding="utf-8"))["weight_map"].values())
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return set()


def saved_whole(save: Callable[..., Any]) -> Callable[..., None]:
    """A `save_pretrained` whose files take their places when all of them are written; uploads come after that."""

    @functools.wraps(save)  # with the signature, by which diffusers knows what it may pass
    def save_pretrained(self: Any, save_directory: Any, *args: Any, push_to_hub: bool = False, **kwargs: Any) -> None:
        folder = as_path("save_directory", save_directory)
        check_arguments("`save_pretrained`", kwargs, SAVING_OPTIONS)
        repo_id = kwargs.pop("repo_id", None)
        with filling("save_directory", folder) as place:
            save(self, place, *args, **kwargs)
        if push_to_hub:
            given = {name: kwargs[name] for name in kwargs.keys() & inspect.signature(self.push_to_hub).parameters}
            self.push_to_hub(repo_id or folder.resolve().name, **given)

    return save_pretrained
