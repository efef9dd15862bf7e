"""Loading of the files and models of commands."""

import glob
import logging
import os
import re
from collections.abc import Collection, Iterable, Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from unitouch_gen.cli.options import note
from unitouch_gen.errors import InvalidInputError, check_arguments, check_dtype, check_file, explain_errors
from unitouch_gen.examples import example
from unitouch_gen.files import (
    class_name,
    files_below,
    find_file,
    is_hidden,
    local_folder,
    natural,
    read_settings,
    reading,
)
from unitouch_gen.weights import JOINT

IMAGES = frozenset({".png", ".jpg", ".jpeg", ".jfif", ".bmp", ".gif", ".tif", ".tiff", ".webp", ".avif", ".npy"})
SOUNDS = frozenset({".wav", ".flac", ".ogg", ".mp3"})

WANTED = {"audio": "a sound file", "height": "a height map"}  # for messages, by modality; else an image file

DRAWING = {"touch-to-image": ("touch",), "x-to-touch": ("image",), "stylization": ("image", "touch")}
"""The built-in pipelines that generate images, and their inputs when they are measured."""

# Files ----------------------------------------------------------------------------------------------------------------


def suffixes_of(modality: str) -> frozenset[str]:
    """Suffixes of files of a modality; those of images if it has no others."""
    from unitouch_gen.models.videos import VIDEOS

    return {"audio": SOUNDS, "touch": IMAGES.union(VIDEOS)}.get(modality, IMAGES)


def files_of(name: str, words: Sequence[str], modality: str) -> list[Path]:
    """The files of a modality that words of a command line name, in their order.

    A word is the path of a file or of a folder, a pattern such as "touches/**/*.png", or "example:brick". Hidden files,
    and files with other suffixes, are left out of folders and patterns. `name` is the argument, for the messages.
    """
    all_files = list[Path]()
    for word in words:
        if word.startswith("example:"):
            files = [example(word.removeprefix("example:"), modality)]
        elif os.path.isdir(word):
            files = files_in(name, word, Path(word), Path(word).iterdir(), suffixes_of(modality))
        elif not os.path.lexists(word) and re.search(r"[*?[]", word):
            # The brackets of an existing folder are part of its name.
            folder = next(parent for parent in Path(word).parents if os.path.isdir(parent))
            files = files_in(name, word, folder, files_like(folder, word), suffixes_of(modality))
        else:
            file = find_file(Path(), word)
            check_file(name, file, WANTED.get(modality, "an image file"))
            files = [file]
        all_files += sorted(files, key=natural)
    return all_files


def files_like(folder: Path, pattern: str) -> list[Path]:
    """The files below a folder that match a pattern, each once; `glob` would follow a loop of links forty times."""
    pattern_parts = Path(pattern).relative_to(folder).parts
    if "**" in pattern_parts:
        paths = files_below(folder)
    else:
        paths = [folder / path for path in glob.glob(str(Path(*pattern_parts)), root_dir=folder)]
    return [path for path in paths if is_like(path.relative_to(folder).parts, pattern_parts)]


def is_like(parts: Sequence[str], pattern: Sequence[str]) -> bool:
    """Whether the parts of a path match those of a pattern; "**" matches any number of folders."""
    if not pattern:
        return not parts
    if pattern[0] == "**":
        return is_like(parts, pattern[1:]) or (len(parts) > 0 and is_like(parts[1:], pattern))
    return len(parts) > 0 and fnmatch(parts[0], pattern[0]) and is_like(parts[1:], pattern[1:])


def files_in(name: str, place: str, folder: Path, paths: Iterable[Path], suffixes: Collection[str]) -> list[Path]:
    """The files with some suffixes among `paths` in a folder, at least one; notes how many are left out.

    `place` is the folder or pattern as the user typed it, for the message.
    """
    files = [path for path in paths if os.path.isfile(path)]
    kept = [file for file in files if file.suffix.lower() in suffixes and not is_hidden(file.relative_to(folder))]
    if not kept:
        what = "inputs"
        if SOUNDS.isdisjoint(suffixes):
            what = "images"
        elif {*suffixes} <= SOUNDS:
            what = "sounds"
        raise InvalidInputError(f"`{name}` is {place!r}, where there are no {what}; name another folder or pattern.")
    if len(kept) < len(files):
        note(f"{len(files) - len(kept)} other files in {folder} are left out.")
    return kept


# Models ---------------------------------------------------------------------------------------------------------------


def load_pipeline(
    name: str, *, model: str | None, dtype: str | None = None, device: str = "cpu", quiet: bool = True, **unknown: Any
) -> Any:
    """The pipeline of a folder or repository, or the built-in one, by a command's options."""
    check_arguments("`load_pipeline`", unknown, ("model", "dtype", "device", "quiet"))
    weights_dtype = check_dtype("--dtype", dtype or "float32")
    place = device_of(device)
    import diffusers.utils.logging
    import transformers.utils.logging

    from unitouch_gen.pipelines.tiny import PIPELINES, TURBO, tiny

    diffusers.utils.logging.set_verbosity(logging.CRITICAL)  # diffusers raises whatever it logs as an error
    if quiet:
        diffusers.utils.logging.disable_progress_bar()
        transformers.utils.logging.disable_progress_bar()
    if model is None or TURBO.get(model) == name:
        pipe: Any = tiny(model or name, dtype=weights_dtype)
    else:
        folder = folder_of(model)
        with reading("--model", model):
            pipe = PIPELINES[name].from_pretrained(folder, dtype=weights_dtype)
    pipe.set_progress_bar_config(disable=quiet)
    return pipe.to(place)


def load_joint_space(model: str | None, device: str) -> tuple[Any, Any]:
    """`UniTouchModel` and `UniTouchProcessor` of a folder, repository or saved pipeline, or the built-in ones."""
    place = device_of(device)
    import transformers.utils.logging

    from unitouch_gen.models import UniTouchModel, UniTouchProcessor

    transformers.utils.logging.disable_progress_bar()
    folder = JOINT if model is None else folder_of(model)
    joint = folder
    processor = folder
    if (folder / "model_index.json").is_file():  # a saved pipeline
        joint = folder / "unitouch"
        processor = folder / "processor"
    with reading("--model", folder):
        return UniTouchModel.from_pretrained(joint).to(place), UniTouchProcessor.from_pretrained(processor)


def folder_of(model: str) -> Path:
    """The folder of a model; a repository is fetched first."""
    return local_folder("--model", model)


def kind_of(model: str, kinds: Iterable[str] = DRAWING) -> str:
    """The built-in name of a saved pipeline; raises if it is none of `kinds`."""
    from unitouch_gen.pipelines.tiny import PIPELINES

    name = class_name(read_settings("--model", folder_of(model) / "model_index.json"))
    kind_by_class = {PIPELINES[kind].__name__: kind for kind in kinds}
    if name not in kind_by_class:
        classes = ", ".join(kind_by_class)
        raise InvalidInputError(f"`--model` is {model!r}, which holds a {name}; name a saved {classes}.")
    return kind_by_class[name]


def device_of(name: str) -> Any:
    """The torch.device of a name; "auto" is a GPU if there is one, else the CPU."""
    import torch

    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    kinds = (RuntimeError, AssertionError, NotImplementedError)
    with explain_errors(f"`--device` is {name!r}, which cannot be used here", "pass cpu or cuda", *kinds):
        torch.empty(1, device=name).cpu()  # raises for meta, a device without data
    return torch.device(name)
