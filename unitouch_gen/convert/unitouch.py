"""The checkpoints that ImageBind's and UniTouch's authors published, as the four encoders of a joint space: into memory
(`UniTouchModel.from_published`), or into a folder (`unitouch-gen convert unitouch`).

Both use one layout (Girdhar et al., 2023, "ImageBind"; the paper's release): `modality_preprocessors.M` hold stem and
positions, `modality_trunks.M` the blocks, `modality_heads.M` norm and projection, `modality_postprocessors.M` the scale
of the logits, M one of vision, text, audio and touch. UniTouch's file has "model." before every key. Its text head has
no projection, so that image, text and audio are ImageBind's, and touch is UniTouch's.
"""

import copy
import json
import math
import os
import re
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor
from transformers import PreTrainedConfig
from transformers.utils import CONFIG_NAME, SAFE_WEIGHTS_INDEX_NAME

from unitouch_gen.convert.checkpoints import (
    DTYPES,
    LazyTensor,
    counted,
    open_checkpoint,
    page_out,
    size_of,
    write_tensors,
)
from unitouch_gen.errors import (
    InvalidInputError,
    check_dtype,
    check_finite,
    check_kind,
    check_number,
    first_line,
    first_of,
)
from unitouch_gen.files import as_path, read_json, weight_map_of, writing_folder
from unitouch_gen.models.config import UniTouchConfig
from unitouch_gen.models.joint import MODALITIES, UniTouchModel, make_encoder, modalities_of
from unitouch_gen.models.processing import UniTouchProcessor, read_tokenizer, tokenizer_in
from unitouch_gen.models.sensors import SensorBank

FILES = {"imagebind": ("image", "text", "audio"), "touch": ("touch",)}
"""Whose encoders are read from which file."""

LOGIT_SCALES = {"audio": 20.0, "touch": 5.0}
"""Scales of the modalities whose scale is fixed."""

MAX_LOGIT_SCALE = 100.0

WEIGHTS = (torch.float32, torch.float64, torch.float16, torch.bfloat16)
"""What published weights may be."""

OF_PIPELINES = ("model_index.json", "unet", "vae")
"""What folders of diffusers' pipelines hold."""

SUB_CONFIGS = ("vision_config", "text_config", "touch_config", "audio_config")


# Layout ---------------------------------------------------------------------------------------------------------------

PUBLISHED_NAMES = {"image": "vision", "text": "text", "audio": "audio", "touch": "touch"}
"""What the published files call the modalities."""

Shape = tuple[int, ...]


class Rule(NamedTuple):
    """How a published tensor becomes one of ours."""

    shape: Callable[[Shape], Shape]  # that of the published tensor from that of ours
    make: Callable[[Tensor], Tensor]  # ours from the published one


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


def published_name(modality: str, key: str) -> tuple[str, Rule]:
    """The published key of one of ours, and what makes ours of it.

    Args:
        modality: "image", "text", "audio" or "touch".
        key: As `UniTouchModel` has it.

    Raises:
        KeyError: If the published encoders have nothing like it.
    """
    short = key.removeprefix(OURS[modality]).removeprefix(OURS[modality])
    for pattern, template, rule in RENAMINGS[modality]:
        match = re.fullmatch(pattern, short)
        if match:
            return match.expand(template.replace("M", PUBLISHED_NAMES[modality], 1)), rule
    raise KeyError(key)


# Reading --------------------------------------------------------------------------------------------------------------


def open_published(
    config: UniTouchConfig | None = None,
    touch: str | os.PathLike | None = None,
    imagebind: str | os.PathLike | None = None,
    dtype: torch.dtype | None = None,
) -> tuple[UniTouchConfig, dict[str, dict[str, LazyTensor]], list[str]]:
    """What the published files hold, of which nothing but names and shapes has been read.

    Args:
        config, touch, imagebind, dtype: See `UniTouchModel.from_published`.

    Returns:
        The configuration with the files' logit scales; the tensors of each modality, by their keys in `UniTouchModel`;
        and lines on which keys of the files are used and which ignored.

    Raises:
        InvalidInputError: See `UniTouchModel.from_published`.
    """
    config = UniTouchConfig() if config is None else copy.deepcopy(check_kind("config", config, UniTouchConfig))
    if touch is None and imagebind is None:
        raise InvalidInputError("Pass `touch`, `imagebind` or both: the published files that are to be read.")
    if config.sensors:
        raise InvalidInputError(
            f"`config` names the sensors {config.sensors}, and the published files have no sensor tokens; leave "
            "`sensors` empty."
        )
    if dtype is not None and (dtype := check_dtype("dtype", dtype)) not in DTYPES:
        raise InvalidInputError(f"`dtype` is {dtype}; pass torch.float32, torch.float16 or torch.bfloat16.")
    tensors: dict[str, dict[str, LazyTensor]] = {}
    lines: list[str] = []
    for name, path in (("imagebind", imagebind), ("touch", touch)):
        if path is not None:
            found, scales, used = _read_file(name, as_path(name, path), config, dtype)
            tensors |= found
            lines += used
            config.logit_scales = {**config.logit_scales, **scales}
    if touch is not None:  # and a bank of no sensors
        width = config.touch_config.hidden_size  # type: ignore[union-attr]
        bank = SensorBank((), config.sensor_tokens, width, config.prototype_size)
        bank.to(next(iter(tensors["touch"].values())).dtype)
        tensors["touch"] |= {f"sensor_bank.{key}": LazyTensor.of(tensor) for key, tensor in bank.state_dict().items()}
    return config, tensors, lines


def _read_file(
    name: str, path: Path, config: UniTouchConfig, dtype: torch.dtype | None
) -> tuple[dict[str, dict[str, LazyTensor]], dict[str, float], list[str]]:
    """What one published file holds.

    Returns:
        The tensors of each modality, the scales of logits, and lines on which keys are used and which ignored.
    """
    keys = {key.removeprefix("model."): tensor for key, tensor in open_checkpoint(name, path).items()}
    tensors: dict[str, dict[str, LazyTensor]] = {modality: {} for modality in FILES[name]}
    scales: dict[str, float] = {}
    used: set[str] = set()
    missing: list[str] = []
    misshapen: list[str] = []
    for modality, found in tensors.items():
        for key, shape in shapes_of(config, modality).items():
            source, rule = published_name(modality, key)
            used.add(source)
            if source not in keys:
                missing.append(source)
                continue
            tensor = keys[source]
            if tuple(tensor.shape) != rule.shape(shape) or tensor.dtype not in WEIGHTS:
                kind = str(tensor.dtype).removeprefix("torch.")
                misshapen.append(f"{source} of {tuple(tensor.shape)}, {kind}, for {rule.shape(shape)}")
                continue
            found[key] = _lazily(f"{name}: {source}", tensor, shape, rule, dtype or tensor.dtype)
        scale = f"modality_postprocessors.{PUBLISHED_NAMES[modality]}.1.log_logit_scale"
        if scale in keys and keys[scale].numel() == 1:
            used.add(scale)
            learned = check_number(f"{name}: {scale}", float(keys[scale]))
            scales[modality] = min(math.exp(min(learned, math.log(MAX_LOGIT_SCALE))), MAX_LOGIT_SCALE)
        elif modality in LOGIT_SCALES:
            scales[modality] = LOGIT_SCALES[modality]
    if missing or misshapen:
        lacks = [
            f"{verb} {first_of(list(dict.fromkeys(names)))}"
            for verb, names in (("misses", missing), ("has misshapen", misshapen))
            if names
        ]
        raise InvalidInputError(
            f"`{name}` names {str(path)!r}, which is not laid out as the published {' and '.join(FILES[name])} "
            f"encoder{'s are' if len(FILES[name]) > 1 else ' is'}: it {' and it '.join(lacks)}. It holds "
            f"{counted(keys)}. {_hint(name, keys)}"
        )
    ignored = [key for key in keys if key not in used]
    lines = [f"Used of {path.name}: {counted(used.intersection(keys))}"]
    if ignored:
        lines.append(f"Ignored of {path.name}: {counted(ignored)}")
    return tensors, scales, lines


def shapes_of(config: PreTrainedConfig, modality: str) -> dict[str, Shape]:
    """Shapes of the tensors of a modality's encoder, by their keys in `UniTouchModel`."""
    with torch.device("meta"):
        encoder = make_encoder(config, modality)
    return {f"{OURS[modality]}{key}": tuple(tensor.shape) for key, tensor in encoder.state_dict().items()}


def _hint(name: str, keys: Mapping[str, Tensor]) -> str:
    """What to do about a file that is another one."""
    trunks = {key.split(".")[1] for key in keys if key.startswith("modality_trunks.")}
    for other, modalities in FILES.items():
        if other != name and trunks.issuperset(PUBLISHED_NAMES[modality] for modality in modalities):
            return f"It may be the one to pass as `{other}`."
    return "Pass the file as its authors published it."


def _lazily(name: str, tensor: Tensor, shape: Shape, rule: Rule, dtype: torch.dtype) -> LazyTensor:
    """One of our tensors, of a published one."""
    dtype = torch.float32 if dtype == torch.float64 else dtype

    def make() -> Tensor:
        made = rule.make(check_finite(name, tensor))
        cast = made.to(dtype)
        if dtype.itemsize < made.dtype.itemsize and not bool(torch.isfinite(cast).all()):
            raise InvalidInputError(f"`dtype` is {dtype}, in which {name} overflows; use torch.bfloat16.")
        if cast.untyped_storage().data_ptr() != tensor.untyped_storage().data_ptr():
            page_out(tensor)
        return cast

    return LazyTensor(shape, dtype, make)


def missed(modalities: Collection[str], words: bool = True) -> list[str]:
    """What a joint space lacks, in a line if there is anything.

    Args:
        modalities: Those it has.
        words: Whether it has a tokenizer, or needs none.
    """
    lacks = [f"the {modality} encoder" for modality in MODALITIES if modality not in modalities]
    if "touch" in modalities:
        lacks.append("sensor tokens, which were not published: touches are encoded without")
    if "text" in modalities and not words:
        lacks.append("a tokenizer, which `tokenizer` would bring")
    return [f"Missed: {'; '.join(lacks)}"] if lacks else []


# Writing --------------------------------------------------------------------------------------------------------------


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
    output = as_path("output", output)
    config, tensors, lines = open_published(config, touch, imagebind, dtype)
    weight_map = add_to(output, config)
    words = None if tokenizer is None else read_tokenizer("tokenizer", as_path("tokenizer", tokenizer))
    files = {f"model-{modality}.safetensors": found for modality, found in tensors.items()}
    weight_map |= {key: file for file, found in files.items() for key in found}
    del tensors  # each file's are let go when it is written
    with writing_folder("output", output, size_of(files)) as folder:
        write_tensors(folder, files, written)
        index = {"metadata": {}, "weight_map": dict(sorted(weight_map.items()))}
        (folder / SAFE_WEIGHTS_INDEX_NAME).write_text(json.dumps(index, indent=2) + "\n", encoding="utf-8")
        model = UniTouchModel(config, modalities=())
        model.config.save_pretrained(folder)
        UniTouchProcessor.for_config(model.config, words).save_pretrained(folder)
    for line in [*lines, *missed(modalities_of(weight_map), words=tokenizer_in(output) is not None)]:
        told(line)


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
    weight_map = weight_map_of(output / SAFE_WEIGHTS_INDEX_NAME)
    if not same or known.sensors or not weight_map:
        raise InvalidInputError(f"`output` is {str(output)!r}, which holds another model; name another folder.")
    config.logit_scales = {**known.logit_scales, **config.logit_scales}
    config.embedding_norm = known.embedding_norm
    return weight_map


def read_config(name: str, file: Path) -> UniTouchConfig:
    """Sizes of a joint space, from its config.json, which came in the argument `name`.

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
