"""Where in a saved model's folder the tensors of a modality are."""

from pathlib import Path

from safetensors import safe_open
from transformers.utils import SAFE_WEIGHTS_INDEX_NAME, SAFE_WEIGHTS_NAME

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.hub import read_json


def weight_map_of(source: Path) -> dict[str, str]:
    """The file of each tensor, by an index of transformers' kind; none where there is no index.

    Raises:
        InvalidInputError: If the index cannot be read, or names a file elsewhere.
    """
    index = source / SAFE_WEIGHTS_INDEX_NAME
    if not index.is_file():
        return {}
    weight_map = read_json("source", index).get("weight_map")
    if not isinstance(weight_map, dict):
        raise InvalidInputError(f"`{index}` holds no `weight_map`; it is no index of weights.")
    for file in weight_map.values():
        if not isinstance(file, str) or Path(file).name != file or file == "..":
            raise InvalidInputError(f"`{index}` names {file!r}, which is not in its folder; do not trust it.")
    return weight_map


def shards(source: Path, prefix: str = "") -> dict[Path, list[str]]:
    """The safetensors files of a folder with the keys in each that start with `prefix`, if it has any.

    Raises:
        InvalidInputError: If the folder holds no weights, or its index names a file elsewhere.
    """
    if (source / SAFE_WEIGHTS_INDEX_NAME).is_file():
        files: dict[Path, list[str]] = {}
        for key, file in weight_map_of(source).items():
            if key.startswith(prefix):
                files.setdefault(source / file, []).append(key)
        return files
    path = source / SAFE_WEIGHTS_NAME
    if not path.is_file():
        raise InvalidInputError(
            f"`{source}` holds no {SAFE_WEIGHTS_NAME}; pass the folder that `save_pretrained` wrote."
        )
    with safe_open(path, framework="pt") as file:
        keys = [key for key in file.keys() if key.startswith(prefix)]  # noqa: SIM118 - not a dict
    return {path: keys} if keys else {}
