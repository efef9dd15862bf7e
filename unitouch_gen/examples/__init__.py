"""Touches, photos and sounds of objects that the built-in models never saw, and a height map, to try calls with.

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
"""Where the files of each modality are, and their suffix."""


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
    """An input to try a call with.

    Args:
        name: What it is of, such as "brick"; a touch also goes by its file's name, "gelsight_brick".
        modality: "touch", "image", "audio" or "height", a map to press.

    Returns:
        The path of a file.

    Raises:
        InvalidInputError: If there is none of that name; the message lists those there are.

    Example:
        >>> example("brick").name
        'gelsight_brick.png'
    """
    known = examples(modality)
    check_kind("name", name, str)
    known = {**{stem.rpartition("_")[2]: file for stem, file in known.items() if modality == "touch"}, **known}
    return known[check_choice("name", name, known)]
