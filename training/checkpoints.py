"""Checkpoints of a training run: which are complete, which to resume from, and removing older ones.

runs/touch/checkpoints/step-00000250/     what accelerate's `save_state` wrote
                                          progress.json, written last: without it a checkpoint is unfinished
"""

import json
import os
import re
import warnings
import zipfile
import zlib
from contextlib import suppress
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.files import read_settings

CHECKPOINT_FILE = re.compile(
    r"model(-\d+-of-\d+)?\.safetensors|model(_\d+)?\.safetensors|model\.safetensors\.index\.json|scaler\.pt"
    r"|(optimizer|scheduler|sampler)(_\d+)?\.bin|(random_states|custom_checkpoint)_\d+\.pkl"
)
"""Names that accelerate gives to files of a checkpoint."""


def checkpoint_folders(output: Path) -> list[Path]:
    """Folders of finished and unfinished checkpoints, by step. Copies under other names are left out."""
    folders = (output / "checkpoints").glob("step-*")
    return sorted(folder for folder in folders if re.fullmatch(r"step-\d{8}", folder.name))


def files_of_checkpoint(folder: Path) -> list[Path]:
    """The files that accelerate wrote into the folder of a checkpoint."""
    return sorted(file for file in folder.iterdir() if CHECKPOINT_FILE.fullmatch(file.name) and file.is_file())


def checkpoints_in(output: Path) -> list[Path]:
    """The finished checkpoints of a run, by step."""
    return [folder for folder in checkpoint_folders(output) if (folder / "progress.json").is_file()]


def last_checkpoint(output: Path) -> Path:
    """The last checkpoint of a run whose files are undamaged.

    Raises:
        InvalidInputError: If there is none.

    Warns:
        UserWarning: If a later one is damaged.
    """
    damaged: Path | None = None  # a damaged file of the latest checkpoint that has one
    for folder in reversed(checkpoints_in(output)):
        damaged_here = _damaged_file(folder)
        if damaged_here is None:
            if damaged is not None:
                message = f"{str(damaged)!r} is missing or damaged; the run goes on from {folder.name}, before it."
                warnings.warn(message, stacklevel=2)
            return folder
        damaged = damaged or damaged_here
    if damaged is not None:
        raise InvalidInputError(
            f"`resume` finds {str(damaged)!r} missing or damaged, and no whole checkpoint before it; begin anew "
            "in another `output`."
        )
    raise InvalidInputError(f"`resume` finds no checkpoint in {str(output)!r}; leave it out, or name its output.")


def read_progress(output: Path) -> dict[str, Any]:
    """The progress of a run's last undamaged checkpoint: `step`, `seconds`, and the `progress` given to `Trainer`."""
    return read_settings("resume", last_checkpoint(output) / "progress.json")


def _damaged_file(checkpoint: Path) -> Path | None:
    """The first file of a checkpoint that is missing or damaged; else `None`."""
    try:
        progress = json.loads((checkpoint / "progress.json").read_text())
        # Checkpoints of earlier versions list no files.
        names = progress.get("files") or [file.name for file in files_of_checkpoint(checkpoint)]
        files = [checkpoint / Path(name).name for name in names]
    except (ValueError, TypeError, AttributeError):
        return checkpoint / "progress.json"
    for file in files:
        if not os.path.isfile(file) or _is_damaged(file):
            return file
    return None


def _is_damaged(file: Path) -> bool:
    """Whether a safetensors file is cut off, or a zip (what `torch.save` writes) fails its checksums."""
    try:
        if file.suffix == ".safetensors":
            with safe_open(file, framework="pt"):  # compares the file's length with its header
                return False
        if file.suffix in (".bin", ".pkl", ".pt"):
            with zipfile.ZipFile(file) as archive:
                return archive.testzip() is not None
    except (OSError, SafetensorError, zipfile.BadZipFile, zlib.error, EOFError, ValueError, NotImplementedError):
        return True
    return False


def remove_checkpoint(folder: Path) -> None:
    """Removes the files of a checkpoint, `progress.json` first, and its folder if nothing else is in it."""
    (folder / "progress.json").unlink(missing_ok=True)
    for file in files_of_checkpoint(folder):
        file.unlink()
    with suppress(OSError):  # the folder may hold other files
        folder.rmdir()


def flush(file: Path) -> None:
    """Waits until a file is on the disk."""
    descriptor = os.open(file, os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
