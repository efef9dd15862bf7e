"""Folders of models: on disk, or fetched from a repository whose id the user named."""

import json
import os
from pathlib import Path
from typing import Any

from unitouch_gen.errors import InvalidInputError, describe, first_line

OPTIONS = ("cache_dir", "revision", "token", "local_files_only", "allow_patterns", "ignore_patterns")
"""Of a fetch, as huggingface_hub calls them."""

NEVER_READ = ["*.bin", "*.ckpt", "*.pt", "*.pth", "*.h5", "*.msgpack", "*.onnx", "*.onnx_data"]
"""Of repositories: pickles, and weights for other frameworks."""


def local_folder(name: str, place: str | os.PathLike, **options: Any) -> Path:
    """A folder as it is, or the copy of a repository.

    Args:
        name: Of the argument that the place came in, for the messages.
        place: Path or repository id.
        options: Of the fetch; others than `OPTIONS`, and those that are `None`, are left out. Where no
            `ignore_patterns` come, files that are `NEVER_READ` stay where they are.

    Raises:
        InvalidInputError: If it is neither a folder nor the id of a repository that can be fetched.
    """
    folder = Path(place)
    if folder.is_dir():
        return folder
    if folder.is_file():
        raise InvalidInputError(
            f"`{name}` is {str(place)!r}, which is a file; pass a folder, such as `unitouch-gen convert` makes of a "
            "checkpoint."
        )
    from huggingface_hub import snapshot_download
    from huggingface_hub.utils import validate_repo_id

    try:
        if str(place).startswith((".", "/", "~")):
            raise ValueError(place)
        validate_repo_id(str(place))
    except ValueError as error:
        raise InvalidInputError(
            f"`{name}` is {str(place)!r}, which is no folder and no repository id; pass one of them."
        ) from error
    known = {key: value for key, value in options.items() if key in OPTIONS and value is not None}
    known.setdefault("ignore_patterns", NEVER_READ)
    try:
        return Path(snapshot_download(str(place), **known))
    except OSError as error:
        raise InvalidInputError(
            f"`{name}` is {str(place)!r}, which is no folder here, and no repository of that id could be fetched: "
            f"{first_line(error)}"
        ) from error


def read_json(name: str, file: Path) -> dict[str, Any]:
    """The settings in a JSON file of such a folder.

    Args:
        name: Of the argument that the file or its folder came in, for the message.
        file: To read.

    Raises:
        InvalidInputError: If it cannot be read, or holds something else.
    """
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InvalidInputError(
            f"`{name}` names {str(file)!r}, which cannot be read as JSON: {first_line(error)}."
        ) from error
    if not isinstance(found, dict):
        raise InvalidInputError(f"`{name}` names {str(file)!r}, which holds {describe(found)} and no settings.")
    return found
