"""Published checkpoints as a folder of ours: `unitouch-gen convert unitouch`."""

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from transformers import CLIPTokenizer
from transformers.utils import CONFIG_NAME, SAFE_WEIGHTS_INDEX_NAME

from unitouch_gen.checkpoints import bytes_of, counted, staged, write_tensors
from unitouch_gen.encoders.config import UniTouchConfig
from unitouch_gen.encoders.model import UniTouchModel
from unitouch_gen.encoders.processing import TOKENIZER_FOLDER, UniTouchProcessor
from unitouch_gen.encoders.published import Published, open_published
from unitouch_gen.encoders.senses import MODULES
from unitouch_gen.errors import InvalidInputError

VOCABULARIES = ("tokenizer.json", "vocab.json")
"""One of which a folder of a tokenizer holds."""

SUB_CONFIGS = ("vision_config", "text_config", "touch_config", "audio_config")


def convert_published(
    output: str | os.PathLike,
    *,
    touch: str | os.PathLike | None = None,
    imagebind: str | os.PathLike | None = None,
    tokenizer: str | os.PathLike | None = None,
    config: UniTouchConfig | None = None,
    dtype: torch.dtype | None = None,
    told: Callable[[str], object] = print,
    written: Callable[[int, int], object] = lambda done, size: None,
) -> None:
    """Writes a folder for `UniTouchModel.from_pretrained` and `UniTouchProcessor.from_pretrained`.

    There is one file of safetensors for each sense, written tensor by tensor. A folder that holds other senses of the
    same configuration is added to. The same input makes the same bytes.

    Args:
        output: The folder.
        touch, imagebind, config, dtype: See `UniTouchModel.from_published`.
        tokenizer: Folder of the tokenizer of text: OpenCLIP's, as in Stable Diffusion 2.1 unCLIP.
        told: Gets lines on what was used, ignored and missed.
        written: Told how many bytes of how many are written.

    Raises:
        InvalidInputError: See `UniTouchModel.from_published`; or if the output holds another model or cannot be
            written to, and nothing is changed then.
    """
    output = Path(output)
    config, parts = open_published(config, touch, imagebind, dtype)
    weight_map = add_to(output, config)
    words = None if tokenizer is None else read_tokenizer(tokenizer)
    whole, done = sum(bytes_of(part.promises.values()) for part in parts), 0
    lines = [line for part in parts for line in taken_from(part)]

    def count(size: int) -> None:
        nonlocal done
        done += size
        written(done, whole)

    with staged("output", output, whole) as folder:
        while parts:  # each is let go when it is written, and its file with it
            weight_map |= write_senses(folder, parts.pop(0), count)
        index = {"metadata": {}, "weight_map": dict(sorted(weight_map.items()))}
        (folder / SAFE_WEIGHTS_INDEX_NAME).write_text(json.dumps(index, indent=2) + "\n", encoding="utf-8")
        model = UniTouchModel(config, senses=())
        model.config.save_pretrained(folder)
        UniTouchProcessor(image_size=model.config.touch_config.image_height, tokenizer=words).save_pretrained(folder)
    for line in [*lines, *missed(weight_map, words=(output / TOKENIZER_FOLDER).is_dir())]:
        told(line)


def write_senses(folder: Path, part: Published, count: Callable[[int], None]) -> dict[str, str]:
    """Writes one file of safetensors for each sense that a published file has.

    Args:
        folder: For them.
        part: What the published file has.
        count: Told the bytes of each tensor when it is written.

    Returns:
        The file of each tensor.
    """
    places: dict[str, str] = {}
    for sense in part.senses:
        starts = tuple(f"{name}." for name in MODULES[sense])
        promises = {key: promise for key, promise in part.promises.items() if key.startswith(starts)}
        file = f"model-{sense}.safetensors"
        write_tensors(folder / file, promises, count)
        places |= dict.fromkeys(promises, file)
    return places


def add_to(output: Path, config: UniTouchConfig) -> dict[str, str]:
    """The file of each tensor in a folder that is added to, and none if it is new; its settings go into `config`.

    Raises:
        InvalidInputError: If it holds something else.
    """
    if not (output / CONFIG_NAME).exists():
        return {}
    known, index = UniTouchConfig.from_pretrained(output), output / SAFE_WEIGHTS_INDEX_NAME
    same = all(getattr(known, name).to_dict() == getattr(config, name).to_dict() for name in SUB_CONFIGS)
    if not same or known.sensors or not index.is_file():
        raise InvalidInputError(f"`output` is {str(output)!r}, which holds another model; name another folder.")
    config.logit_scales = {**known.logit_scales, **config.logit_scales}
    config.embedding_norm = known.embedding_norm
    return dict(json.loads(index.read_text(encoding="utf-8"))["weight_map"])


def read_tokenizer(place: str | os.PathLike) -> CLIPTokenizer:
    """A CLIP tokenizer from its folder.

    Raises:
        InvalidInputError: If there is none.
    """
    folder = Path(place)
    if not any((folder / name).is_file() for name in VOCABULARIES):  # without one, transformers makes one that is empty
        raise InvalidInputError(
            f"`tokenizer` is {str(place)!r}, which holds no {' or '.join(VOCABULARIES)}; pass the folder `tokenizer` "
            "of Stable Diffusion 2.1 unCLIP, or leave it out."
        )
    try:
        return CLIPTokenizer.from_pretrained(folder)
    except (OSError, ValueError, TypeError) as error:
        raise InvalidInputError(
            f"`tokenizer` is {str(place)!r}, from which no CLIP tokenizer can be read: {error}"
        ) from error


def taken_from(part: Published) -> list[str]:
    """Which keys of a published file are used and which ignored, in lines."""
    ignored = [f"Ignored: {counted(part.ignored)}"] if part.ignored else []
    return [f"Used: {counted(part.used)}", *ignored]


def missed(weight_map: Mapping[str, str], words: bool) -> list[str]:
    """What a folder lacks, in a line if there is anything.

    Args:
        weight_map: The file of each of its tensors.
        words: Whether it has a tokenizer.
    """
    missing = [sense for sense, modules in MODULES.items() if not any(key.startswith(modules[0]) for key in weight_map)]
    lacks = [f"the {sense} encoder" for sense in missing]
    if "touch" not in missing:
        lacks.append("sensor tokens, which were not published: touches are encoded without")
    if "text" not in missing and not words:
        lacks.append("a tokenizer, which `tokenizer` would bring")
    return [f"Missed: {'; '.join(lacks)}"] if lacks else []
