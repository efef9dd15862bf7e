"""Results that took long, kept on disk under a hash of everything they depend on.

A result is a file of tensors and a JSON file beside it with figures and the hash of the first. Both are written whole,
the JSON last, so a result whose writer was killed is none. What does not fit its hash is taken for none as well.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load, save
from torch import Tensor, nn

from unitouch_gen.errors import InvalidInputError, InvalidTypeError, describe
from unitouch_gen.files import write_file


def fingerprint(*parts: Any) -> str:
    """SHA-256 of the contents of values, 64 hexadecimal digits.

    Args:
        parts: Plain values, dtypes, tensors, modules (class, configuration, mode and weights), dataclasses, and
            mappings and sequences of them.

    Raises:
        InvalidTypeError: If a value is of another kind.
        InvalidInputError: If a module holds no tensors, so that nothing tells it from others of its class.

    Example:
        >>> fingerprint(torch.zeros(2)) == fingerprint(torch.zeros(2))
        True
    """
    digest = hashlib.sha256()
    for part in parts:
        _add(digest, part)
    return digest.hexdigest()


def _add(digest: Any, value: Any) -> None:
    """Adds a value, its kind and its length, so that no two values run into one another."""
    kind: str
    inner: list[Any]
    match value:
        case None | bool() | int() | float() | str() | bytes() | torch.dtype():
            kind, inner = type(value).__name__, [value if isinstance(value, bytes) else repr(value).encode()]
        case Tensor():
            data = value.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy()
            kind, inner = f"tensor {value.dtype} {tuple(value.shape)}", [data.tobytes()]
        case nn.Module():
            kind, inner = f"module {type(value).__qualname__} {value.training}", [_config(value), _weights(value)]
        case Mapping():
            kind, inner = "mapping", [entry for key in sorted(value) for entry in (key, value[key])]
        case list() | tuple():
            kind, inner = "sequence", list(value)
        case _ if is_dataclass(value) and not isinstance(value, type):
            kind = f"dataclass {type(value).__qualname__}"
            inner = [{field.name: getattr(value, field.name) for field in fields(value)}]
        case _:
            raise InvalidTypeError(
                f"`parts` holds {describe(value)}; pass plain values, tensors, modules and dataclasses of them."
            )
    digest.update(f"{kind} {len(inner)}:".encode())
    for entry in inner:
        if isinstance(entry, bytes):
            digest.update(f"{len(entry)}:".encode() + entry)
        else:
            _add(digest, entry)


def _config(module: nn.Module) -> str:
    """What a diffusers model was made with, but not where from and by which version, as JSON, as it is saved."""
    config = getattr(module, "config", None)
    if not isinstance(config, Mapping):
        return ""
    made_with = {key: config[key] for key in config if not key.startswith("_")}
    return json.dumps(made_with, sort_keys=True, default=repr)


def _weights(module: nn.Module) -> dict[str, Tensor]:
    weights = {name: value for name, value in module.state_dict().items() if isinstance(value, Tensor)}
    if not weights:
        raise InvalidInputError(
            f"`parts` holds a {type(module).__name__} without tensors, which nothing tells from others of its class; "
            "pass what it was made of."
        )
    return weights


def keep(folder: Path, key: str, tensors: dict[str, Tensor], record: dict[str, Any]) -> None:
    """Writes a result.

    Args:
        folder: Made if it is not there.
        key: Of the result, see `fingerprint`.
        tensors: Its tensors.
        record: Plain values beside them.
    """
    data = save({name: value.contiguous() for name, value in tensors.items()})
    text = json.dumps({**record, "sha256": hashlib.sha256(data).hexdigest()}, indent=1)
    write_file(folder / f"{key}.safetensors", data)
    write_file(folder / f"{key}.json", text)


def find(folder: Path, key: str) -> tuple[dict[str, Tensor], dict[str, Any]] | None:
    """Tensors and record of a result, or `None` if there is none or it is damaged."""
    try:
        record = json.loads((folder / f"{key}.json").read_text(encoding="utf-8"))
        data = (folder / f"{key}.safetensors").read_bytes()
    except (FileNotFoundError, ValueError):  # ValueError: no JSON, or no text
        return None
    if not isinstance(record, dict) or record.pop("sha256", None) != hashlib.sha256(data).hexdigest():
        return None
    return load(data), record
