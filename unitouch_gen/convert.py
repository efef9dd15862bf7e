"""The checkpoints that ImageBind's and UniTouch's authors published, as the four encoders of a joint space.

Both use one layout (Girdhar et al., 2023, "ImageBind"; the paper's release): `modality_preprocessors.M` hold stem and
positions, `modality_trunks.M` the blocks, `modality_heads.M` norm and projection, M one of vision, text, audio and
touch. UniTouch's file has "model." before every key. Its text head has no projection, so image, text and audio are read
from ImageBind's file and touch from UniTouch's. The scales of their logits are left out.
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

from unitouch_gen.errors import InvalidInputError, check_dtype, check_file, check_finite, check_kind, first_line
from unitouch_gen.files import as_path, check_writable
from unitouch_gen.models.config import UniTouchConfig
from unitouch_gen.models.joint import MODALITIES, MODULES, UniTouchModel, make_modules
from unitouch_gen.models.processing import UniTouchProcessor, read_tokenizer
from unitouch_gen.models.sensors import SensorBank
from unitouch_gen.saving import filling

FILES = {"imagebind": ("image", "text", "audio"), "touch": ("touch",)}
"""Which encoders are read from which file."""

# The layout -----------------------------------------------------------------------------------------------------------

Rule = Callable[[Tensor], Tensor]
"""Makes one of our tensors of a published one."""

SAME: Rule = torch.as_tensor
WITHOUT_BATCH: Rule = partial(torch.squeeze, dim=0)
STILL: Rule = partial(torch.sum, dim=2)
"""A still picture is two equal frames to a stem over two, so that its kernel is the sum over time."""


def third(number: int) -> Rule:
    """One of query, key and value, which are stacked."""
    return lambda stacked: stacked.chunk(3)[number]


_END = r"\.(weight|bias)"
_BLOCK = r"blocks\.(\d+)"
_LAYER = r"encoder\.layers\.(\d+)"

Renaming = tuple[str, str, Rule]
"""Pattern of our key, template of the published one, and the rule."""

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
    """The published key of one of `UniTouchModel`'s, and what makes ours of it; raises `KeyError` if there is none."""
    prefix = f"{MODULES[modality][0]}."
    short = key.removeprefix(prefix).removeprefix(prefix)  # transformers repeats that of image and text
    for pattern, template, rule in RENAMINGS[modality]:
        if match := re.fullmatch(pattern, short):
            return match.expand(template.replace("M", "vision" if modality == "image" else modality, 1)), rule
    raise KeyError(key)


# Reading --------------------------------------------------------------------------------------------------------------


def _read_published(
    files: Mapping[str, str | os.PathLike | None], config: UniTouchConfig, dtype: torch.dtype | None
) -> UniTouchModel:
    """A joint space of the published `FILES`, which are named by the arguments of `convert_published`."""
    model: Any = UniTouchModel(config, modalities=()).eval()
    for name, file in files.items():
        if file is None:
            continue
        model.source = as_path(name, file)
        keys = {key.removeprefix("model."): tensor for key, tensor in open_checkpoint(name, model.source).items()}
        for modality in FILES[name]:
            tensors = _encoder_in(f"`{name}` names {str(file)!r}, which", keys, config, modality)
            if not model.known_modalities:
                model.to(dtype or next(iter(tensors.values())).dtype)
            model.load_tensors(modality, tensors)
    return model


def _encoder_in(subject: str, keys: Mapping[str, Tensor], config: UniTouchConfig, modality: str) -> dict[str, Tensor]:
    """The tensors of a modality in a published file of tensors `keys`, by our keys; `subject` begins messages."""
    found = {}
    prefix = MODULES[modality][0]
    with torch.device("meta"):
        encoder = make_modules(config, modality)[prefix]
    for key in encoder.state_dict():
        source, rule = published_name(modality, key)
        try:
            found[f"{prefix}.{key}"] = rule(check_finite(source, keys[source]))
        except (KeyError, IndexError, RuntimeError) as error:  # the last two of too few dimensions
            wrong = f"of the shape {tuple(keys[source].shape)}" if source in keys else "missing"
            raise InvalidInputError(
                f"{subject} is not laid out as the published {modality} encoder: {source} is {wrong}. `touch` is for "
                "UniTouch's last_new.ckpt, `imagebind` for ImageBind's imagebind_huge.pth."
            ) from error
    if modality == "touch":  # and a bank of no sensors
        bank = SensorBank((), config.sensor_tokens, config.touch_config.hidden_size, config.prototype_size)  # type: ignore[union-attr]
        found |= {f"sensor_bank.{key}": tensor for key, tensor in bank.state_dict().items()}
    return found


class Inert:
    """Stands for what trainers leave beside the weights, of which nothing is made."""

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
"""Names in pickles of Lightning 1: its callbacks' states go by their classes, and their scores are numpy's."""


def open_checkpoint(name: str, path: str | os.PathLike) -> dict[str, Tensor]:
    """The weights in a checkpoint, whose path was passed as the argument `name`.

    It is a pickle of `torch.save`, also of a dict with the weights as "state_dict" or "model", or safetensors. A pickle
    is read by torch's unpickler of tensors and plain containers, so nothing that it holds is run. Tensors of the format
    since torch 1.6 stay in the file until they are used.

    Raises:
        InvalidInputError: If there is no such file, it is cut off, or holds anything but tensors and plain containers.
    """
    check_file(name, path, "a checkpoint")
    subject = f"`{name}` names {str(path)!r}, which"
    try:
        if Path(path).suffix == ".safetensors":
            found: Any = load_file(path)
        else:
            with torch.serialization.safe_globals(LEFT_BY_TRAINERS):
                found = torch.load(path, map_location="cpu", weights_only=True, mmap=zipfile.is_zipfile(path))
    except Exception as error:  # a broken file makes its readers raise errors of many kinds
        unsafe = re.search(r"GLOBAL:? (\S+)", str(error), re.IGNORECASE)
        if isinstance(error, pickle.UnpicklingError) and unsafe:
            why = f"holds more than weights: {unsafe[1]}, of which nothing was run. Pass a file of weights alone"
        else:
            why = f"cannot be read as a checkpoint ({first_line(error)}): it is cut off, or something else"
        raise InvalidInputError(f"{subject} {why}.") from error
    found = found.get("state_dict", found.get("model", found)) if isinstance(found, Mapping) else {}
    tensors = {key: value for key, value in found.items() if isinstance(value, Tensor) and value.is_floating_point()}
    tensors = {key: value for key, value in tensors.items() if value.layout == torch.strided and not value.is_meta}
    if not tensors:
        raise InvalidInputError(f"{subject} holds no weights; pass a state dict.")
    return tensors


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
        touch: UniTouch's file (`last_new.ckpt`), of which the touch encoder is read. It has no sensor tokens.
        imagebind: ImageBind's (`imagebind_huge.pth`), of which image, text and audio are read.
        tokenizer: Folder of the tokenizer of text: OpenCLIP's, as in Stable Diffusion 2.1 unCLIP.
        config: Sizes of encoders other than the published ones, without sensors.
        dtype: Precision of the weights; the file's own when left out.
        max_shard_size: Size of the largest file of weights, which is also what is held in memory at a time.

    Returns:
        What the folder lacks, in words.

    Raises:
        InvalidInputError: If neither file is given, or one is none of these, lacks tensors, or holds some that are
            not finite; or if the output holds something else or cannot be written to. Nothing is changed then.
    """
    output = as_path("output", output)
    config = check_kind("config", UniTouchConfig() if config is None else copy.deepcopy(config), UniTouchConfig)
    if touch is None and imagebind is None:
        raise InvalidInputError("Pass `touch`, `imagebind` or both: the published files that are to be read.")
    if config.sensors:
        raise InvalidInputError("`config` names sensors, but published files hold no sensor tokens; leave them out.")
    wanted = None if dtype is None else check_dtype("dtype", dtype)
    words = None if tokenizer is None else read_tokenizer("tokenizer", as_path("tokenizer", tokenizer))
    if any((output / file).exists() for file in ("model_index.json", "config.json")):
        raise InvalidInputError(f"`output` is {str(output)!r}, which holds a model; name another folder.")
    check_writable("output", output / "config.json")
    model = _read_published({"imagebind": imagebind, "touch": touch}, config, wanted)
    lacks = [f"the {modality} encoder" for modality in MODALITIES if modality not in model.known_modalities]
    lacks += ["sensor tokens, which were not published"] if "touch" in model.known_modalities else []
    if not words:
        lacks.append("a tokenizer, which `tokenizer` would bring")
    with filling("output", output) as folder:
        model.save_pretrained(folder, max_shard_size=max_shard_size)
        UniTouchProcessor.for_config(model.config, words).save_pretrained(folder)
    return lacks
