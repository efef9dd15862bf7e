"""What a stage was built on: hashes of the weights it took, which tell when those have been trained anew since.

They stand in a stage's record and in its checkpoints. Older ones hold none, and pass.
"""

import hashlib
from collections.abc import Mapping
from pathlib import Path

from unitouch_gen.errors import InvalidInputError


def weights_of(folder: Path) -> str:
    """SHA-256 of all the safetensors below a folder: of their names and bytes."""
    digest = hashlib.sha256()
    for file in sorted(folder.rglob("*.safetensors")):
        digest.update(f"{file.relative_to(folder).as_posix()}\n".encode())
        with file.open("rb") as stream:
            digest.update(hashlib.file_digest(stream, "sha256").digest())
    return digest.hexdigest()


def changed(recorded: Mapping[str, str], folders: Mapping[str, Path]) -> list[str]:
    """Options whose folders hold other weights than were recorded."""
    return [name for name, folder in folders.items() if name in recorded and recorded[name] != weights_of(folder)]


def check_resumed(recorded: Mapping[str, str], folders: Mapping[str, Path], output: Path) -> None:
    """Checks that a run goes on with the weights it began with.

    Raises:
        InvalidInputError: If it would not; the message names the folders.
    """
    for name in changed(recorded, folders):
        raise InvalidInputError(
            f"`resume` finds a checkpoint in {str(output)!r} that was built on other weights than `{name}` "
            f"({str(folders[name])!r}) holds now; remove {str(output)!r} and begin anew, or name another output."
        )
