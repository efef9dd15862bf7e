"""Folders of models that are filled and lose nothing: each file takes its place by a rename when all are written."""

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
from unitouch_gen.files import UNFINISHED, as_path, check_replaceable, files_below, share_as_usual, writing_to

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

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
    number of shards). Files take their places one by one, weights first and configs last. While they do, and if that is
    cut off, `UNFINISHED` lies in `folder`, and `reading` refuses it.

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
            moves = _move_beside(staging, target)
        except BaseException:
            shutil.rmtree(staging, ignore_errors=True)
            if is_new:
                with suppress(OSError):  # of a folder that somebody else has filled meanwhile
                    target.rmdir()
            raise
    try:
        with _locked(target):
            _put_in_place(moves, target)
    except OSError as error:
        why = f"{error.strerror}. Files that are not in place yet lie beside it, as {staging.name}. Save again."
        raise InvalidInputError(f"`{name}` was written in part to {str(target)!r}: {why}") from error
    shutil.rmtree(staging, ignore_errors=True)


def _move_beside(staging: Path, target: Path) -> dict[Path, Path]:
    """Moves staged files beside their destinations, under hidden names; returns destinations by those.

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
            moves[beside] = destination
            shutil.move(staged, beside)
    except BaseException:
        for beside in moves:
            beside.unlink(missing_ok=True)
        for folder in reversed(new_folders):
            folder.rmdir()
        raise
    share_as_usual(moves, staging)
    return moves


def _make_folders(folder: Path, made: list[Path]) -> None:
    """Makes a folder and those above it that are not there, and adds them to `made`."""
    missing = [one for one in (folder, *folder.parents) if not os.path.lexists(one)]
    for one in reversed(missing):
        one.mkdir()
        made.append(one)
    folder.mkdir(exist_ok=True)  # raises if a file is there


def _put_in_place(moves: dict[Path, Path], target: Path) -> None:
    """Renames files to their destinations, then removes what earlier saves left of the same weights."""
    earlier = _earlier_weights([*moves.values()])
    folders = sorted({target, *(destination.parent for destination in moves.values())})
    for folder in folders:
        (folder / UNFINISHED).touch()
    for beside, destination in sorted(moves.items(), key=lambda move: _order(move[1])):
        os.replace(beside, destination)
    for file in earlier:
        file.unlink(missing_ok=True)
    for folder in reversed(folders):
        (folder / UNFINISHED).unlink(missing_ok=True)


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


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Holds a lock on a folder, so that the files of two saves do not mix; without one where the system has none."""
    if fcntl is None:
        yield
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):  # of file systems without locks
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


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
