"""Conversion of the published checkpoints of ImageBind and UniTouch to the four encoders of a joint space.

Both have the same layout (Girdhar et al., 2023, "ImageBind"; the paper's release), with M one of vision, text, audio
and touch: `modality_preprocessors.M` are stem and positions, `modality_trunks.M` the blocks, `modality_heads.M` norm
and projection. UniTouch's file has "model." before every key. Its text head has no projection, so image, text and audio
are read from ImageBind's file, and touch from UniTouch's. The scales of their logits are left out.
"""

import copy
import os
import pickle
import re
import zipfile
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor

from unitouch_gen.errors import (
    InvalidInputError,
    check_dtype,
    check_file,
    check_finite,
    check_kind,
    check_passed,
    check_unused,
    first_line,
)
from unitouch_gen.files import as_path, check_writable
from unitouch_gen.models.config import UniTouchConfig
from unitouch_gen.models.joint import MODALITIES, MODULES, UniTouchModel, make_modules
from unitouch_gen.models.processing import UniTouchProcessor, read_tokenizer
from unitouch_gen.models.sensor_bank import SensorBank
from unitouch_gen.saving import filling

FILES = {"imagebind": ("image", "text", "audio"), "touch": ("touch",)}
"""Encoders that are read from each file."""

# The layout -----------------------------------------------------------------------------------------------------------

Rule = Callable[[Tensor], Tensor]
"""Converts a published tensor to one of this package."""

SAME: Rule = torch.as_tensor
WITHOUT_BATCH: Rule = partial(torch.squeeze, dim=0)
STILL: Rule = partial(torch.sum, dim=2)
"""The published stem takes two frames, and a still picture is two equal ones, so its kernel is the sum over time."""


def third(number: int) -> Rule:
    """Query, key or value (0, 1, 2) of the three stacked."""
    return lambda stacked: stacked.chunk(3)[number]


_END = r"\.(weight|bias)"
_BLOCK = r"blocks\.(\d+)"
_LAYER = r"encoder\.layers\.(\d+)"

Renaming = tuple[str, str, Rule]
"""Pattern of a key of this package, template of the published key, and the rule."""

VIT: tuple[Renaming, ...] = (
    (r"class_token", r"modality_preprocessors.M.cls_token", SAME),
    (r"position", r"modality_preprocessors.M.pos_embedding_helper.pos_embed", SAME),
    (rf"stem_norm{_END}", r"modality_preprocessors.M.rgbt_stem.norm_layer.\1", SAME),
    (rf"{_BLOCK}\.(norm_[12]){_END}", r"modality_trunks.M.blocks.\1.\2.\3", SAME),
    (rf"{_BLOCK}\.attention\.(.+)", r"modality_trunks.M.blocks.\1.attn.\2", SAME),
    (rf"{_BLOCK}\.mlp\.0{_END}", r"modality_trunks.M.blocks.\1.mlp.fc1.\2", SAME),
    (rf"{_BLOCK}\.mlp\.2{_END}", r"modality_trunks.M.blocks.\1.mlp.fc2.\2", SAME),
    (rf"norm{_END}", r"modality_heads.M.0.\1", SAME),
    (r"projection\.weight", r"modality_heads.M.2.weight", SAME),
)

CLIP_LAYERS: tuple[Renaming, ...] = (
    (rf"{_LAYER}\.self_attn\.q_proj{_END}", r"modality_trunks.M.blocks.\1.attn.in_proj_\2", third(0)),
    (rf"{_LAYER}\.self_attn\.k_proj{_END}", r"modality_trunks.M.blocks.\1.attn.in_proj_\2", third(1)),
    (rf"{_LAYER}\.self_attn\.v_proj{_END}", r"modality_trunks.M.blocks.\1.attn.in_proj_\2", third(2)),
    (rf"{_LAYER}\.self_attn\.out_proj{_END}", r"modality_trunks.M.blocks.\1.attn.out_proj.\2", SAME),
    (rf"{_LAYER}\.layer_norm([12]){_END}", r"modality_trunks.M.blocks.\1.norm_\2.\3", SAME),
    (rf"{_LAYER}\.mlp\.(fc[12]){_END}", r"modality_trunks.M.blocks.\1.mlp.\2.\3", SAME),
)

_POSITIONS = r"embeddings\.position_embedding\.weight"

RENAMINGS: dict[str, tuple[Renaming, ...]] = {
    "image": (
        (r"embeddings\.class_embedding", r"modality_preprocessors.M.cls_token", torch.Tensor.flatten),
        (r"embeddings\.patch_embedding\.weight", r"modality_preprocessors.M.rgbt_stem.proj.1.weight", STILL),
        (_POSITIONS, r"modality_preprocessors.M.pos_embedding_helper.pos_embed", WITHOUT_BATCH),
        (rf"pre_layrnorm{_END}", r"modality_trunks.M.pre_transformer_layer.0.\1", SAME),
        *CLIP_LAYERS,
        (rf"post_layernorm{_END}", r"modality_heads.M.0.\1", SAME),
        (r"visual_projection\.weight", r"modality_heads.M.2.weight", SAME),
    ),
    "text": (
        (r"embeddings\.token_embedding\.weight", r"modality_preprocessors.M.token_embedding.weight", SAME),
        (_POSITIONS, r"modality_preprocessors.M.pos_embed", WITHOUT_BATCH),
        *CLIP_LAYERS,
        (rf"final_layer_norm{_END}", r"modality_heads.M.proj.0.\1", SAME),
        (r"text_projection\.weight", r"modality_heads.M.proj.1.weight", SAME),
    ),
    "audio": ((r"stem\.weight", r"modality_preprocessors.M.rgbt_stem.proj.weight", SAME), *VIT),
    "touch": ((r"stem\.weight", r"modality_preprocessors.M.rgbt_stem.proj.1.weight", STILL), *VIT),
}


def published_name(modality: str, key: str) -> tuple[str, Rule]:
    """The published key of a key of `UniTouchModel`, and the rule; raises `KeyError` if there is none."""
    prefix = f"{MODULES[modality][0]}."
    short = key.removeprefix(prefix).removeprefix(prefix)  # transformers repeats the prefix of image and text
    published_modality = "vision" if modality == "image" else modality
    for pattern, template, rule in RENAMINGS[modality]:
        match = re.fullmatch(pattern, short)
        if match:
            return match.expand(template.replace("M", published_modality, 1)), rule
    raise KeyError(key)


# Reading --------------------------------------------------------------------------------------------------------------


def _read_published(
    files: Mapping[str, str | os.PathLike], config: UniTouchConfig, dtype: torch.dtype | None
) -> UniTouchModel:
    """A joint space from the published `FILES`, by the names of arguments of `convert_published`."""
    model: Any = UniTouchModel(config, modalities=()).eval()
    for name, file in files.items():
        model.source = as_path(name, file)
        checkpoint = open_checkpoint(name, model.source)
        published = {key.removeprefix("model."): tensor for key, tensor in checkpoint.items()}
        for modality in FILES[name]:
            tensors = _encoder_in(f"`{name}` names {str(file)!r}, which", published, config, modality)
            if not model.known_modalities:
                model.to(dtype or next(iter(tensors.values())).dtype)
            model.load_tensors(modality, tensors)
    return model


def _encoder_in(
    subject: str, published: Mapping[str, Tensor], config: UniTouchConfig, modality: str
) -> dict[str, Tensor]:
    """The tensors of a modality, by keys of `UniTouchModel`, from published ones; `subject` begins messages."""
    tensors = {}
    prefix = MODULES[modality][0]
    with torch.device("meta"):
        encoder = make_modules(config, modality)[prefix]
    for key in encoder.state_dict():
        source, rule = published_name(modality, key)
        try:
            tensors[f"{prefix}.{key}"] = rule(check_finite(source, published[source]))
        except (KeyError, IndexError, RuntimeError) as error:  # the last two if there are too few dimensions
            wrong = f"of the shape {tuple(published[source].shape)}" if source in published else "missing"
            raise InvalidInputError(
                f"{subject} is not laid out as the published {modality} encoder: {source} is {wrong}. `touch` is for "
                "UniTouch's last_new.ckpt, `imagebind` for ImageBind's imagebind_huge.pth."
            ) from error
    if modality == "touch":
        width = config.touch_config.hidden_size  # type: ignore[union-attr]
        bank = SensorBank((), config.sensor_tokens, width, config.prototype_size)  # without sensors
        tensors |= {f"sensor_bank.{key}": tensor for key, tensor in bank.state_dict().items()}
    return tensors


class Inert:
    """Replaces objects that trainers leave beside the weights, and does nothing."""

    def __new__(cls, *args: Any) -> "Inert":
        return super().__new__(cls)

    def __setstate__(self, state: Any) -> None:
        pass


LEFT_BY_TRAINERS: list[Any] = [
    (Inert, name)
    for name in (
        "pytorch_lightning.callbacks.early_stopping.EarlyStopping",
        "pytorch_lightning.callbacks.model_checkpoint.ModelCheckpoint",
        "numpy.core.multiarray.scalar",
        "numpy._core.multiarray.scalar",
        "numpy.dtype",
    )
]
"""Names in pickles of Lightning 1, whose callbacks store their states by class, and scores as numpy scalars."""


def open_checkpoint(name: str, path: str | os.PathLike) -> dict[str, Tensor]:
    """The weights in a checkpoint, whose path was passed as the argument `name`.

    Checkpoints are safetensors, or pickles of `torch.save` of a state dict, or of a dict with one as "state_dict" or
    "model". A pickle is read by torch's unpickler of tensors and plain containers, so no code in it is run. Tensors of
    the format since torch 1.6 are read from the file when they are used.

    Raises:
        InvalidInputError: If there is no such file, it is cut off, or has other objects than tensors and plain
            containers.
    """
    check_file(name, path, "a checkpoint")
    subject = f"`{name}` names {str(path)!r}, which"
    try:
        if Path(path).suffix == ".safetensors":
            content: Any = load_file(path)
        else:
            with torch.serialization.safe_globals(LEFT_BY_TRAINERS):
                content = torch.load(path, map_location="cpu", weights_only=True, mmap=zipfile.is_zipfile(path))
    except Exception as error:  # readers of broken files raise many kinds of errors
        unsafe = re.search(r"GLOBAL:? (\S+)", str(error), re.IGNORECASE)
        if isinstance(error, pickle.UnpicklingError) and unsafe:
            why = f"holds more than weights: {unsafe[1]}, of which nothing was run. Pass a file of weights alone"
        else:
            why = f"cannot be read as a checkpoint ({first_line(error)}): it is cut off, or something else"
        raise InvalidInputError(f"{subject} {why}.") from error
    state: Any = {}
    if isinstance(content, Mapping):
        state = content.get("state_dict", content.get("model", content))
    tensors = {key: value for key, value in state.items() if is_weight(value)}
    if not tensors:
        raise InvalidInputError(f"{subject} holds no weights; pass a state dict.")
    return tensors


def is_weight(value: Any) -> bool:
    """Whether an object is a dense tensor of floating-point numbers."""
    if not isinstance(value, Tensor) or not value.is_floating_point():
        return False
    return value.layout == torch.strided and not value.is_meta


# Writing --------------------------------------------------------------------------------------------------------------


def convert_published(
    output: str | os.PathLike,
    *,
    touch: str | os.PathLike | None = None,
    imagebind: str | os.PathLike | None = None,
    tokenizer: str | os.PathLike | None = None,
    config: UniTouchConfig | None = None,
    dtype: torch.dtype | None = None,
    max_shard_size: str = "2GB",
) -> list[str]:
    """Writes a folder for `UniTouchModel.from_pretrained` and `UniTouchProcessor.from_pretrained`.

    Args:
        output: The folder.
        touch: UniTouch's file (`last_new.ckpt`), for the touch encoder. It has no sensor tokens.
        imagebind: ImageBind's file (`imagebind_huge.pth`), for image, text and audio.
        tokenizer: Folder of the tokenizer of text: OpenCLIP's, as in Stable Diffusion 2.1 unCLIP.
        config: Sizes of encoders other than the published ones, without sensors.
        dtype: Precision of the weights; the file's own if left out.
        max_shard_size: Size of the largest file of weights, which is also the memory that is used.

    Returns:
        What the folder lacks, in words.

    Raises:
        InvalidInputError: If neither file is given; if a file is no such checkpoint, lacks tensors, or has values that
            are not finite; or if the output holds a model or cannot be written to. Nothing is changed then.
    """
    output = as_path("output", output)
    config = check_kind("config", UniTouchConfig() if config is None else copy.deepcopy(config), UniTouchConfig)
    files = check_passed({"imagebind": imagebind, "touch": touch})
    check_unused("on published files, which hold no sensor tokens", **{"config.sensors": config.sensors or None})
    weights_dtype = None if dtype is None else check_dtype("dtype", dtype)
    text_tokenizer = None if tokenizer is None else read_tokenizer("tokenizer", as_path("tokenizer", tokenizer))
    if any((output / file).exists() for file in ("model_index.json", "config.json")):
        raise InvalidInputError(f"`output` is {str(output)!r}, which holds a model; name another folder.")
    check_writable("output", output / "config.json")
    model = _read_published(files, config, weights_dtype)
    missing = [f"the {modality} encoder" for modality in MODALITIES if modality not in model.known_modalities]
    if "touch" in model.known_modalities:
        missing.append("sensor tokens, which were not published")
    if not text_tokenizer:
        missing.append("a tokenizer, which `tokenizer` would bring")
    with filling("output", output) as folder:
        model.save_pretrained(folder, max_shard_size=max_shard_size)
        UniTouchProcessor.for_config(model.config, text_tokenizer).save_pretrained(folder)
    return missing
