"""Folders that are replaced whole: whoever looks finds the old one or the new one, also after a kill."""

import shutil
from collections.abc import Callable
from pathlib import Path


def write_folder(output: Path, write: Callable[[Path], None]) -> None:
    """Writes a folder under a temporary name and renames it."""
    restore_folder(output)
    partial = output.with_name(output.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    write(partial)
    replace_folder(partial, output)


def replace_folder(partial: Path, final: Path) -> None:
    """Renames a finished folder into place.

    At no time is there neither the old nor the new one: between the two renames the old one is `final` + ".old", and
    `restore_folder` puts it back if that was the last moment of the process.
    """
    old = final.with_name(final.name + ".old")
    if final.exists():
        shutil.rmtree(old, ignore_errors=True)
        final.rename(old)
    partial.rename(final)
    shutil.rmtree(old, ignore_errors=True)


def restore_folder(final: Path) -> None:
    """Undoes a `replace_folder` that was killed between its two renames."""
    old = final.with_name(final.name + ".old")
    if old.exists() and not final.exists():
        old.rename(final)
