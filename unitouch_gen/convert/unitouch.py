"""Published checkpoints as a folder of ours: `unitouch-gen convert unitouch`."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import torch
from transformers import CLIPTokenizer
from transformers.utils import CONFIG_NAME, SAFE_WEIGHTS_INDEX_NAME

from unitouch_gen.convert.checkpoints import bytes_of, counting, write_tensors
from unitouch_gen.convert.published import Published, missed, of_modality, open_published, taken_from
from unitouch_gen.errors import InvalidInputError, first_line
from unitouch_gen.files import adding_to_folder, read_json, weight_map_of
from unitouch_gen.models.config import UniTouchConfig
from unitouch_gen.models.joint import UniTouchModel, modalities_of
from unitouch_gen.models.processing import TOKENIZER_FOLDER, UniTouchProcessor

VOCABULARIES = ("tokenizer.json", "vocab.json")
"""One of which a folder of a tokenizer holds."""

OF_PIPELINES = ("model_index.json", "unet", "vae")
"""What folders of diffusers' pipelines hold."""

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

    There is one file of safetensors for each modality, written tensor by tensor. A folder that holds others of
    the same configuration is added to. The same input makes the same bytes.

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
    whole = sum(bytes_of(part.promises.values()) for part in parts)
    count = counting(whole, written)
    lines = [line for part in parts for line in taken_from(part)]

    with adding_to_folder("output", output, whole) as folder:
        while parts:  # each is let go when it is written, and its file with it
            weight_map |= write_modalities(folder, parts.pop(0), count)
        index = {"metadata": {}, "weight_map": dict(sorted(weight_map.items()))}
        (folder / SAFE_WEIGHTS_INDEX_NAME).write_text(json.dumps(index, indent=2) + "\n", encoding="utf-8")
        model = UniTouchModel(config, modalities=())
        model.config.save_pretrained(folder)
        UniTouchProcessor.for_config(model.config, words).save_pretrained(folder)
    for line in [*lines, *missed(modalities_of(weight_map), words=(output / TOKENIZER_FOLDER).is_dir())]:
        told(line)


def write_modalities(folder: Path, part: Published, count: Callable[[int], None]) -> dict[str, str]:
    """Writes one file of safetensors for each modality that a published file has.

    Args:
        folder: For them.
        part: What the published file has.
        count: Told the bytes of each tensor when it is written.

    Returns:
        The file of each tensor.
    """
    places: dict[str, str] = {}
    for modality in part.modalities:
        promises = of_modality(modality, part)
        file = f"model-{modality}.safetensors"
        write_tensors(folder / file, promises, count)
        places |= dict.fromkeys(promises, file)
    return places


def add_to(output: Path, config: UniTouchConfig) -> dict[str, str]:
    """The file of each tensor in a folder that is added to, and none if it is new; its settings go into `config`.

    Raises:
        InvalidInputError: If it holds something else.
    """
    if not (output / CONFIG_NAME).exists():
        if others := [name for name in OF_PIPELINES if (output / name).exists()]:
            raise InvalidInputError(
                f"`output` is {str(output)!r}, which holds a pipeline ({', '.join(others)}); name another folder."
            )
        return {}
    known = read_config("output", output / CONFIG_NAME)
    same = all(getattr(known, name).to_dict() == getattr(config, name).to_dict() for name in SUB_CONFIGS)
    weight_map = weight_map_of(output)
    if not same or known.sensors or not weight_map:
        raise InvalidInputError(f"`output` is {str(output)!r}, which holds another model; name another folder.")
    config.logit_scales = {**known.logit_scales, **config.logit_scales}
    config.embedding_norm = known.embedding_norm
    return weight_map


def read_config(name: str, file: Path) -> UniTouchConfig:
    """Sizes of a joint space, from its config.json.

    Args:
        name: Of the argument that the file came in, for the message.
        file: To read.

    Raises:
        InvalidInputError: If it holds none.
    """
    settings = read_json(name, file)
    if settings.get("model_type") != UniTouchConfig.model_type:
        raise InvalidInputError(
            f"`{name}` names {str(file)!r}, whose `model_type` is {settings.get('model_type')!r}; that of a joint "
            f"space is {UniTouchConfig.model_type!r}."
        )
    try:
        return UniTouchConfig.from_dict(settings)
    except Exception as error:  # of many kinds, from the checks of four configurations
        raise InvalidInputError(
            f"`{name}` names {str(file)!r}, which describes no joint space: {first_line(error)}"
        ) from error


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
