"""Where pictures go, decided before anything is made, and how they get there whole."""

import io
import os
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from PIL import Image


def picture_files(stems: list[str], output: Path, sources: list[Path]) -> list[Path]:
    """Where each picture goes: into a folder under its name, or to the one file named.

    Args:
        stems: Names of the pictures, without suffix; repeated ones get a number.
        output: A folder, or a file name for a single picture.
        sources: Files that must not be replaced.

    Raises:
        InvalidInputError: If several pictures would go to one file, or the output cannot be written.
    """
    from unitouch_gen.errors import InvalidInputError

    named_file = output.suffix != "" and not os.path.isdir(output)
    if named_file:
        if not can_write(output.suffix):
            raise InvalidInputError(f"`--output` is {str(output)!r}, of no known picture format; use .png or .jpg.")
        if len(stems) > 1:
            raise InvalidInputError(
                f"`--output` is the file {str(output)!r} for {len(stems)} pictures; name a folder for several."
            )
        files = [output]
    else:
        if os.path.isfile(output):
            raise InvalidInputError(f"`--output` is {str(output)!r}, a file without a picture's suffix; name a folder.")
        files = [output / f"{stem}.png" for stem in unique(stems)]
    inputs = {os.path.realpath(path) for path in sources}
    for file in files:
        if os.path.realpath(file) in inputs:
            raise InvalidInputError(f"`--output` would replace the input {str(file)!r}; name another folder or file.")
    # The folder is made when the first picture is saved, so that a mistake leaves nothing behind.
    folder = next(path for path in files[0].absolute().parents if os.path.exists(path))
    if not os.path.isdir(folder):
        raise InvalidInputError(f"`--output` is {str(output)!r}, but {str(folder)!r} is a file; name another folder.")
    if not os.access(folder, os.W_OK):
        raise InvalidInputError(f"`--output` is in {str(folder)!r}, which cannot be written to; name another folder.")
    return files


def can_write(suffix: str) -> bool:
    """Whether Pillow writes RGB pictures of this suffix; some formats it only reads, some have no colour."""
    from PIL import Image

    try:
        Image.new("RGB", (16, 16)).save(io.BytesIO(), format=Image.registered_extensions()[suffix.lower()])
    except (KeyError, ValueError, OSError):
        return False
    return True


def unique(names: list[str]) -> list[str]:
    """Names of which repeated ones get a number, so no picture replaces another."""
    found: list[str] = []
    for name in names:
        free, count = name, 1
        while free.casefold() in {taken.casefold() for taken in found}:  # some file systems ignore case
            count += 1
            free = f"{name}-{count}"
        found.append(free)
    return found


def save_picture(image: "Image.Image", file: Path) -> None:
    """Writes a picture whole, or leaves what was there.

    Raises:
        InvalidInputError: If it cannot be written.
    """
    from unitouch_gen.errors import InvalidInputError
    from unitouch_gen.files import replacing

    try:
        with replacing(file) as partial:
            image.save(partial)
    except OSError as error:
        raise InvalidInputError(f"`--output` cannot be written to {str(file)!r}: {error.strerror or error}.") from error
