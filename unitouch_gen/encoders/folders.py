"""Where in a saved model's folder the tensors of a sense are."""

import json
from pathlib import Path

from safetensors import safe_open
from transformers.utils import SAFE_WEIGHTS_INDEX_NAME, SAFE_WEIGHTS_NAME

from unitouch_gen.errors import InvalidInputError


def shards(source: Path, prefix: str = "") -> dict[Path, list[str]]:
    """The safetensors files of a folder with the keys in each that start with `prefix`, if it has any.

    Raises:
        InvalidInputError: If the folder holds no weights, or its index names a file elsewhere.
    """
    index = source / SAFE_WEIGHTS_INDEX_NAME
    if index.is_file():
        weight_map = json.loads(index.read_text())["weight_map"]
        files: dict[Path, list[str]] = {}
        for key, file in weight_map.items():
            if key.startswith(prefix):
                if Path(file).name != file:
                    raise InvalidInputError(f"`{index}` names {file!r}, which is not in its folder; do not trust it.")
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
