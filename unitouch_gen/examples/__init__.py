"""Example inputs: touches, photos and sounds of objects that the built-in models were not trained on, and a height map.

Those of rock, metal, concrete and sand are of scanned surfaces.

`samples/inputs` is a link to this folder, which `samples/render_inputs.py` renders.
"""

from pathlib import Path

from unitouch_gen.errors import check_choice, check_kind

FOLDERS = {
    "touch": ("", ".png"),
    "image": ("photos", ".png"),
    "audio": ("sounds", ".wav"),
    "height": ("heights", ".png"),
}
"""Folder and suffix of the files of each modality."""


def examples(modality: str = "touch") -> dict[str, Path]:
    """The files of a modality by their names, such as "gelsight_brick".

    Args:
        modality: "touch", "image", "audio" or "height", a map to press.

    Raises:
        InvalidInputError: If there is no such modality.
    """
    folder, suffix = FOLDERS[check_choice("modality", modality, FOLDERS)]
    return {file.stem: file for file in sorted((Path(__file__).parent / folder).glob(f"*{suffix}"))}


def example(name: str, modality: str = "touch") -> Path:
    """An example input.

    Args:
        name: Of the object, such as "brick"; for a touch also of the file, "gelsight_brick".
        modality: "touch", "image", "audio" or "height", a map to press.

    Returns:
        The path of a file.

    Raises:
        InvalidInputError: If there is none of that name; the message lists all names.

    Example:
        >>> example("brick").name
        'gelsight_brick.png'
    """
    by_stem = examples(modality)
    check_kind("name", name, str)
    by_object: dict[str, Path] = {}
    if modality == "touch":
        by_object = {stem.rpartition("_")[2]: file for stem, file in by_stem.items()}
    by_name = by_object | by_stem
    return by_name[check_choice("name", name, by_name)]
