"""Touch-LLM's published checkpoint: a language bridge, and what was fine-tuned of a LLaMA beside it.

It is in the layout of LLaMA's authors, rotary pairs in neighbouring rows, with biases and low-rank updates, which are
merged into a LLaMA in transformers' layout here.
"""

import os
import re
from typing import Any

import torch
from torch import Tensor
from transformers import AutoTokenizer, LlamaConfig, LlamaForCausalLM

from unitouch_gen.convert import open_checkpoint
from unitouch_gen.errors import InvalidInputError, check_dtype
from unitouch_gen.files import local_folder, reading
from unitouch_gen.models.language import LanguageBridge
from unitouch_gen.models.processing import read_tokenizer

OUTER = {"model.embed_tokens": "tok_embeddings", "model.norm": "norm", "lm_head": "output"}
INNER = {
    "input_layernorm": "attention_norm",
    "post_attention_layernorm": "ffn_norm",
    "self_attn.q_proj": "attention.wq",
    "self_attn.k_proj": "attention.wk",
    "self_attn.v_proj": "attention.wv",
    "self_attn.o_proj": "attention.wo",
    "mlp.gate_proj": "feed_forward.w1",
    "mlp.down_proj": "feed_forward.w2",
    "mlp.up_proj": "feed_forward.w3",
}
"""Modules of transformers' LLaMA, and of each of its layers, as the published files call them."""

PROMPT = (
    "Below is an instruction that describes a task. Write a response that appropriately completes the request.\n\n"
    "### Instruction:\n{question}\n\n### Response:"
)
SAMPLING = {"do_sample": True, "temperature": 0.1, "top_p": 0.75, "max_new_tokens": 256}
POSITIONS = 512  # that it was fine-tuned on


@torch.no_grad()
def read_touch_llm(
    bridge: str | os.PathLike, llama: str | os.PathLike, *, dtype: torch.dtype = torch.float32
) -> dict[str, Any]:
    """Arguments for a `TouchToTextPipeline`: Touch-LLM's checkpoint over the LLaMA that it was trained on.

    `llama` is a folder or repository in transformers' layout, with its tokenizer. Raises `InvalidInputError` if a file
    cannot be read, or they do not fit.
    """
    dtype = check_dtype("dtype", dtype)
    folder = local_folder("llama", llama)
    if not (folder / "config.json").is_file():
        raise InvalidInputError(f"`llama` is {str(folder)!r}, which has no config.json; pass transformers' layout.")
    tokenizer = read_tokenizer("llama", folder, AutoTokenizer)
    tensors = open_checkpoint("bridge", bridge)
    model: Any
    loaded: Any
    with reading("llama", folder):
        config = LlamaConfig.from_pretrained(folder, attention_bias=True, mlp_bias=True)  # which a LLaMA has not
        read: Any = LlamaForCausalLM.from_pretrained(
            folder, config=config, dtype=dtype, use_safetensors=True, output_loading_info=True
        )
        model, loaded = read
        lacking = sorted(key for key in loaded["missing_keys"] if not key.endswith(".bias"))
        if lacking:
            raise InvalidInputError(f"it lacks {len(lacking)} tensors, such as {lacking[0]}; fetch it again.")
    try:
        made = bridge_of(tensors, model.config.num_hidden_layers)
        lay_over(model, tensors)
    except (KeyError, RuntimeError) as error:
        why = f"{error} is missing" if isinstance(error, KeyError) else str(error).splitlines()[-1].strip(" .")
        raise InvalidInputError(f"`bridge` is {str(bridge)!r}, which does not fit this LLaMA: {why}.") from error
    model.config.max_position_embeddings = min(POSITIONS, model.config.max_position_embeddings)
    model.generation_config.update(**SAMPLING)
    parts = {"language_bridge": made.to(dtype).eval(), "language_model": model.to(dtype=dtype).eval()}
    return {**parts, "tokenizer": tokenizer, "prompt_template": PROMPT}


def bridge_of(tensors: dict[str, Tensor], layers: int) -> LanguageBridge:
    """The bridge in a checkpoint; raises `KeyError` or `RuntimeError` if it is none, or of other layers."""
    state = {f"projection.{end}": tensors[f"image_bind_proj.{end}"] for end in ("weight", "bias")}
    for key, tensor in tensors.items():
        if match := re.fullmatch(r"image_bind_(norm|f)(\d?)_(\d+)\.(weight|bias)", key):
            part = "norm" if match[1] == "norm" else f"w{match[2]}"
            state[f"blocks.{int(match[3]) - 1}.{part}.{match[4]}"] = tensor
    state["queries"] = tensors["prefix_query.weight"]
    attention = [f"llama.layers.{layer}.attention" for layer in range(layers)]
    state["gates"] = torch.stack([tensors[f"{place}.gate"].flatten() for place in attention])
    rank = len(tensors.get(f"{attention[0]}.lora_wv_l1.weight", ()))
    for name, end in {"value_down": "l1", "value_up": "l2"}.items() if rank else ():
        state[name] = torch.stack([tensors[f"{place}.lora_wv_{end}.weight"] for place in attention])
    width, dim = state["projection.weight"].shape
    hidden, _ = state["blocks.0.w1.weight"].shape
    blocks = sum(key.endswith("w1.weight") for key in state)
    legacy = "blocks.0.w1.bias" in state
    made = LanguageBridge(
        dim,
        width,
        layers,
        state["gates"].shape[1],
        num_blocks=blocks,
        intermediate_size=hidden,
        legacy=legacy,
        value_rank=rank,
    )
    made.load_state_dict(state)
    return made


def lay_over(model: Any, tensors: dict[str, Tensor]) -> None:
    """Writes a checkpoint's weights, low-rank updates, biases and norms over those of a LLaMA."""
    names = {ours: f"llama.{theirs}" for ours, theirs in OUTER.items()}
    for layer in range(model.config.num_hidden_layers):
        names |= {f"model.layers.{layer}.{ours}": f"llama.layers.{layer}.{theirs}" for ours, theirs in INNER.items()}
    for ours, theirs in names.items():
        module: Any = model.get_submodule(ours)
        rows: Any
        rows = slice(None)
        place, _, name = theirs.rpartition(".")
        if ours.endswith(("q_proj", "k_proj")):  # both rows of a rotary pair, then half a head apart
            order = torch.arange(len(module.weight))
            rows = order.view(-1, model.config.head_dim // 2, 2).transpose(1, 2).flatten()
        if f"{theirs}.weight" in tensors:
            module.weight.copy_(tensors[f"{theirs}.weight"][rows])
        if f"{place}.lora_{name}_l1.weight" in tensors:
            down, up = (tensors[f"{place}.lora_{name}_{end}.weight"].float() for end in ("l1", "l2"))
            module.weight += (up @ down)[rows]
        if f"{theirs}.bias" in tensors:
            module.bias.copy_(tensors[f"{theirs}.bias"][rows])
