"""The layout of ImageBind's and UniTouch's published checkpoints, and how it maps onto the four encoders.

Both use one layout (Girdhar et al., 2023, "ImageBind"; the paper's release): `modality_preprocessors.M` hold stem and
positions, `modality_trunks.M` the blocks, `modality_heads.M` norm and projection, `modality_postprocessors.M` the scale
of the logits, M one of vision, text, audio and touch. UniTouch's file has "model." before every key. Its text head has
no projection, so that image, text and audio are ImageBind's, and touch is UniTouch's.
"""

import copy
import math
import os
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor
from transformers import PreTrainedConfig

from unitouch_gen.convert.checkpoints import DTYPES, Checkpoint, Promise, counted, open_checkpoint, page_out, promised
from unitouch_gen.errors import InvalidInputError, check_finite, check_number, first_of
from unitouch_gen.models.config import UniTouchConfig
from unitouch_gen.models.joint import MODALITIES, MODULES, make_encoder
from unitouch_gen.models.sensors import SensorBank

FILES = {"imagebind": ("image", "text", "audio"), "touch": ("touch",)}
"""Whose encoders are read from which file."""

PUBLISHED_NAMES = {"image": "vision", "text": "text", "audio": "audio", "touch": "touch"}
"""What the published files call the modalities."""

LOGIT_SCALES = {"audio": 20.0, "touch": 5.0}
"""Of modalities whose scale is fixed."""

MAX_LOGIT_SCALE = 100.0

Shape = tuple[int, ...]


@dataclass(frozen=True)
class Rule:
    """How a published tensor becomes one of ours.

    Attributes:
        shape: Of the published tensor, from the shape of ours.
        make: Of ours from the published one.
    """

    shape: Callable[[Shape], Shape]
    make: Callable[[Tensor], Tensor]


def third(number: int) -> Rule:
    """One of query, key and value, which lie above each other."""
    return Rule(lambda shape: (3 * shape[0], *shape[1:]), lambda stacked: stacked.chunk(3)[number])


SAME = Rule(lambda shape: shape, lambda tensor: tensor)
WITHOUT_BATCH = Rule(lambda shape: (1, *shape), lambda tensor: tensor[0])
WITHOUT_BATCH_AND_LENGTH = Rule(lambda shape: (1, 1, *shape), lambda tensor: tensor[0, 0])
STILL = Rule(lambda shape: (*shape[:2], 2, *shape[2:]), lambda kernel: kernel.sum(dim=2))
"""A still picture is two equal frames to a stem over two, so that its kernel is the sum over time."""

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
    (rf"{_BLOCK}\.attention\.qkv{_END}", r"modality_trunks.M.blocks.\1.attn.in_proj_\2", SAME),
    (rf"{_BLOCK}\.attention\.out{_END}", r"modality_trunks.M.blocks.\1.attn.out_proj.\2", SAME),
    (rf"{_BLOCK}\.attention\.(bias_[kv])", r"modality_trunks.M.blocks.\1.attn.\2", SAME),
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

RENAMINGS: dict[str, tuple[Renaming, ...]] = {
    "image": (
        (r"embeddings\.class_embedding", r"modality_preprocessors.M.cls_token", WITHOUT_BATCH_AND_LENGTH),
        (r"embeddings\.patch_embedding\.weight", r"modality_preprocessors.M.rgbt_stem.proj.1.weight", STILL),
        (
            r"embeddings\.position_embedding\.weight",
            r"modality_preprocessors.M.pos_embedding_helper.pos_embed",
            WITHOUT_BATCH,
        ),
        (rf"pre_layrnorm{_END}", r"modality_trunks.M.pre_transformer_layer.0.\1", SAME),
        *CLIP_LAYERS,
        (rf"post_layernorm{_END}", r"modality_heads.M.0.\1", SAME),
        (r"visual_projection\.weight", r"modality_heads.M.2.weight", SAME),
    ),
    "text": (
        (r"embeddings\.token_embedding\.weight", r"modality_preprocessors.M.token_embedding.weight", SAME),
        (r"embeddings\.position_embedding\.weight", r"modality_preprocessors.M.pos_embed", WITHOUT_BATCH),
        *CLIP_LAYERS,
        (rf"final_layer_norm{_END}", r"modality_heads.M.proj.0.\1", SAME),
        (r"text_projection\.weight", r"modality_heads.M.proj.1.weight", SAME),
    ),
    "audio": ((r"stem\.weight", r"modality_preprocessors.M.rgbt_stem.proj.weight", SAME), *VIT),
    "touch": ((r"stem\.weight", r"modality_preprocessors.M.rgbt_stem.proj.1.weight", STILL), *VIT),
}

OURS = {"image": "vision_model.", "text": "text_model.", "audio": "audio_model.", "touch": "touch_model."}
"""What our keys of a modality start with; transformers repeats the first two."""


@dataclass(frozen=True, eq=False)
class Published:
    """What one file has for some modalities.

    Attributes:
        path: Of the file.
        modalities: That were read.
        promises: Our tensors, by their keys in `UniTouchModel`.
        logit_scales: Of the modalities that have one.
        used, ignored: Keys of the file.
    """

    path: Path
    modalities: tuple[str, ...]
    promises: Mapping[str, Promise]
    logit_scales: Mapping[str, float]
    used: frozenset[str]
    ignored: frozenset[str]


def published_name(modality: str, key: str) -> tuple[str, Rule]:
    """The published key of one of ours, and what makes ours of it.

    Args:
        modality: "image", "text", "audio" or "touch".
        key: Of `UniTouchModel`.

    Raises:
        KeyError: If the published encoders have nothing like it.
    """
    short = key.removeprefix(OURS[modality]).removeprefix(OURS[modality])
    for pattern, template, rule in RENAMINGS[modality]:
        match = re.fullmatch(pattern, short)
        if match:
            return match.expand(template.replace("M", PUBLISHED_NAMES[modality], 1)), rule
    raise KeyError(key)


def open_published(
    config: UniTouchConfig | None = None,
    touch: str | os.PathLike | None = None,
    imagebind: str | os.PathLike | None = None,
    dtype: torch.dtype | None = None,
) -> tuple[UniTouchConfig, list[Published]]:
    """What the published files hold, of which nothing but names and shapes has been read.

    Args:
        config, touch, imagebind, dtype: See `UniTouchModel.from_published`.

    Returns:
        The configuration with the files' logit scales, and what each file has.

    Raises:
        InvalidInputError: See `UniTouchModel.from_published`.
    """
    config = UniTouchConfig() if config is None else copy.deepcopy(config)
    if touch is None and imagebind is None:
        raise InvalidInputError("Pass `touch`, `imagebind` or both: the published files that are to be read.")
    if config.sensors:
        raise InvalidInputError(
            f"`config` names the sensors {config.sensors}, and the published files have no sensor tokens; leave "
            "`sensors` empty."
        )
    if dtype is not None and dtype not in (torch.float32, torch.float16, torch.bfloat16):
        raise InvalidInputError(f"`dtype` is {dtype}; pass torch.float32, torch.float16 or torch.bfloat16.")
    parts = []
    for name, path in (("imagebind", imagebind), ("touch", touch)):
        if path is not None:
            shapes = {modality: shapes_of(config, modality) for modality in FILES[name]}
            parts.append(read_published(name, open_checkpoint(name, path), shapes, dtype))
    if touch is not None:
        some = next(iter(parts[-1].promises.values())).dtype
        parts[-1] = replace(parts[-1], promises={**parts[-1].promises, **no_sensors(config, some)})
    for part in parts:
        config.logit_scales = {**config.logit_scales, **part.logit_scales}
    return config, parts


def shapes_of(config: PreTrainedConfig, modality: str) -> dict[str, Shape]:
    """Of the tensors of a modality's encoder, by their keys in `UniTouchModel`."""
    with torch.device("meta"):
        encoder = make_encoder(config, modality)
    return {f"{OURS[modality]}{key}": tuple(tensor.shape) for key, tensor in encoder.state_dict().items()}


def no_sensors(config: PreTrainedConfig, dtype: torch.dtype) -> dict[str, Promise]:
    """The tensors of a bank of zero sensors."""
    bank = SensorBank((), config.sensor_tokens, config.touch_config.hidden_size, config.prototype_size).to(dtype)
    return {f"sensor_bank.{key}": promised(tensor) for key, tensor in bank.state_dict().items()}


def read_published(
    name: str,
    checkpoint: Checkpoint,
    shapes: Mapping[str, Mapping[str, Shape]],
    dtype: torch.dtype | None = None,
) -> Published:
    """The encoders of some modalities in a published file.

    Args:
        name: Of the argument that the file came in, for the messages.
        checkpoint: The file.
        shapes: For each modality the shapes of our tensors, by key.
        dtype: Of our tensors; the file's own when left out.

    Raises:
        InvalidInputError: If keys are missing or misshapen, or tensors of a dtype that no weight has; all are listed.
    """
    keys = _without_prefix(checkpoint.tensors)
    promises: dict[str, Promise] = {}
    scales: dict[str, float] = {}
    used: set[str] = set()
    missing: list[str] = []
    misshapen: list[str] = []
    for modality, wanted in shapes.items():
        for key, shape in wanted.items():
            source, rule = published_name(modality, key)
            used.add(source)
            if source not in keys:
                missing.append(source)
                continue
            tensor = keys[source]
            if tuple(tensor.shape) != rule.shape(shape) or not _is_weight(tensor):
                kind = str(tensor.dtype).removeprefix("torch.")
                misshapen.append(f"{source} of {tuple(tensor.shape)}, {kind}, for {rule.shape(shape)}")
                continue
            promises[key] = _promise(name, source, tensor, shape, rule, dtype or tensor.dtype)
        scale = f"modality_postprocessors.{PUBLISHED_NAMES[modality]}.1.log_logit_scale"
        if scale in keys and keys[scale].numel() == 1:
            used.add(scale)
            learned = check_number(f"{name}: {scale}", float(keys[scale]))
            scales[modality] = min(math.exp(min(learned, math.log(MAX_LOGIT_SCALE))), MAX_LOGIT_SCALE)
        elif modality in LOGIT_SCALES:
            scales[modality] = LOGIT_SCALES[modality]
    if missing or misshapen:
        lacks = [
            f"{verb} {first_of(list(dict.fromkeys(keys)))}"
            for verb, keys in (("misses", missing), ("has misshapen", misshapen))
            if keys
        ]
        raise InvalidInputError(
            f"`{name}` names {str(checkpoint.path)!r}, which is not laid out as the published {' and '.join(shapes)} "
            f"encoder{'s are' if len(shapes) > 1 else ' is'}: it {' and it '.join(lacks)}. It holds {counted(keys)}. "
            f"{_hint(name, keys)}"
        )
    return Published(
        checkpoint.path, tuple(shapes), promises, scales, frozenset(used & set(keys)), frozenset(set(keys) - used)
    )


def _hint(name: str, keys: Mapping[str, Tensor]) -> str:
    """What to do about a file that is another one."""
    trunks = {key.split(".")[1] for key in keys if key.startswith("modality_trunks.")}
    for other, modalities in FILES.items():
        if other != name and trunks.issuperset(PUBLISHED_NAMES[modality] for modality in modalities):
            return f"It may be the one to pass as `{other}`."
    return "Pass the file as its authors published it."


def _without_prefix(tensors: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
    """By keys without the prefix that a trainer's module gave to all."""
    prefix = "model."
    return {key.removeprefix(prefix): tensor for key, tensor in tensors.items()}


def _is_weight(tensor: Tensor) -> bool:
    return tensor.is_floating_point() and tensor.dtype in {*DTYPES, torch.float64}


def _promise(name: str, source: str, tensor: Tensor, shape: Shape, rule: Rule, dtype: torch.dtype) -> Promise:
    dtype = torch.float32 if dtype == torch.float64 else dtype

    def make() -> Tensor:
        made = rule.make(check_finite(f"{name}: {source}", tensor))
        cast = made.to(dtype)
        if dtype.itemsize < made.dtype.itemsize and not bool(torch.isfinite(cast).all()):
            raise InvalidInputError(f"`dtype` is {dtype}, in which {name}: {source} overflows; use torch.bfloat16.")
        if cast.untyped_storage().data_ptr() != tensor.untyped_storage().data_ptr():
            page_out(tensor)
        return cast

    return Promise(tuple(shape), dtype, make)


def of_modality(modality: str, part: Published) -> dict[str, Promise]:
    """The tensors of one modality."""
    starts = tuple(f"{name}." for name in MODULES[modality])
    return {key: promise for key, promise in part.promises.items() if key.startswith(starts)}


# Account --------------------------------------------------------------------------------------------------------------


def taken_from(part: Published) -> list[str]:
    """Which keys of a published file are used and which ignored, in lines."""
    ignored = [f"Ignored of {part.path.name}: {counted(part.ignored)}"] if part.ignored else []
    return [f"Used of {part.path.name}: {counted(part.used)}", *ignored]


def missed(modalities: Collection[str], words: bool = True) -> list[str]:
    """What a joint space lacks, in a line if there is anything.

    Args:
        modalities: That it has.
        words: Whether it has a tokenizer, or needs none.
    """
    lacks = [f"the {modality} encoder" for modality in MODALITIES if modality not in modalities]
    if "touch" in modalities:
        lacks.append("sensor tokens, which were not published: touches are encoded without")
    if "text" in modalities and not words:
        lacks.append("a tokenizer, which `tokenizer` would bring")
    return [f"Missed: {'; '.join(lacks)}"] if lacks else []
