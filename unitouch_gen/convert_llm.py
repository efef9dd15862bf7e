"""Conversion of Touch-LLM's published checkpoint: a language bridge, and fine-tuned weights of a LLaMA.

The checkpoint is in the layout of LLaMA's authors, with rotary pairs in neighbouring rows, biases and low-rank updates.
They are merged into a LLaMA in transformers' layout.
"""

import os
import re
from typing import Any

import torch
from torch import Tensor
from transformers import AutoTokenizer, LlamaConfig, LlamaForCausalLM

from unitouch_gen.convert import open_checkpoint
from unitouch_gen.errors import InvalidInputError, check_dtype, check_file
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
"""Modules of transformers' LLaMA, and of each of its layers, with their published names."""

PROMPT = (
    "Below is an instruction that describes a task. Write a response that appropriately completes the request.\n\n"
    "### Instruction:\n{question}\n\n### Response:"
)
SAMPLING = {"do_sample": True, "temperature": 0.1, "top_p": 0.75, "max_new_tokens": 256}
POSITIONS = 512  # length of the texts in fine-tuning, tokens


@torch.no_grad()
def read_touch_llm(
    bridge: str | os.PathLike, llama: str | os.PathLike, *, dtype: torch.dtype = torch.float32
) -> dict[str, Any]:
    """Components of a `TouchToTextPipeline` from Touch-LLM's checkpoint and the LLaMA that it was trained on.

    `llama` is a folder or repository in transformers' layout, with its tokenizer.

    Raises:
        InvalidInputError: If a file cannot be read, or the two do not fit.
    """
    dtype = check_dtype("dtype", dtype)
    folder = local_folder("llama", llama)
    check_file("llama", folder / "config.json", "a folder in transformers' layout")
    tokenizer = read_tokenizer("llama", folder, AutoTokenizer)
    tensors = open_checkpoint("bridge", bridge)
    model: Any
    loading_info: Any
    with reading("llama", folder):
        config = LlamaConfig.from_pretrained(folder, attention_bias=True, mlp_bias=True)  # for the fine-tuned biases
        loaded: Any = LlamaForCausalLM.from_pretrained(
            folder, config=config, dtype=dtype, use_safetensors=True, output_loading_info=True
        )
        model, loading_info = loaded
        missing = sorted(key for key in loading_info["missing_keys"] if not key.endswith(".bias"))
        if missing:
            raise InvalidInputError(f"it lacks {len(missing)} tensors, such as {missing[0]}; fetch it again.")
    try:
        language_bridge = bridge_of(tensors, model.config.num_hidden_layers)
        merge_weights(model, tensors)
    except (KeyError, RuntimeError) as error:
        why = f"{error} is missing" if isinstance(error, KeyError) else str(error).splitlines()[-1].strip(" .")
        raise InvalidInputError(f"`bridge` is {str(bridge)!r}, which does not fit this LLaMA: {why}.") from error
    model.config.max_position_embeddings = min(POSITIONS, model.config.max_position_embeddings)
    model.generation_config.update(**SAMPLING)
    return {
        "language_bridge": language_bridge.to(dtype).eval(),
        "language_model": model.to(dtype=dtype).eval(),
        "tokenizer": tokenizer,
        "prompt_template": PROMPT,
    }


def bridge_of(tensors: dict[str, Tensor], layers: int) -> LanguageBridge:
    """The bridge in a checkpoint.

    Raises:
        KeyError, RuntimeError: If there is none, or it is of another number of layers.
    """
    state = {
        "projection.weight": tensors["image_bind_proj.weight"],
        "projection.bias": tensors["image_bind_proj.bias"],
    }
    for key, tensor in tensors.items():
        match = re.fullmatch(r"image_bind_(norm|f)(\d?)_(\d+)\.(weight|bias)", key)
        if match:
            part = "norm" if match[1] == "norm" else f"w{match[2]}"
            state[f"blocks.{int(match[3]) - 1}.{part}.{match[4]}"] = tensor
    state["queries"] = tensors["prefix_query.weight"]
    attentions = [f"llama.layers.{layer}.attention" for layer in range(layers)]
    state["gates"] = torch.stack([tensors[f"{attention}.gate"].flatten() for attention in attentions])
    rank = len(tensors.get(f"{attentions[0]}.lora_wv_l1.weight", ()))
    if rank:
        state["value_down"] = torch.stack([tensors[f"{attention}.lora_wv_l1.weight"] for attention in attentions])
        state["value_up"] = torch.stack([tensors[f"{attention}.lora_wv_l2.weight"] for attention in attentions])
    hidden_size, embedding_dim = state["projection.weight"].shape
    intermediate_size, _ = state["blocks.0.w1.weight"].shape
    bridge = LanguageBridge(
        embedding_dim,
        hidden_size,
        num_layers=layers,
        num_heads=state["gates"].shape[1],
        num_blocks=sum(key.endswith("w1.weight") for key in state),
        intermediate_size=intermediate_size,
        legacy="blocks.0.w1.bias" in state,
        value_rank=rank,
    )
    bridge.load_state_dict(state)
    return bridge


def merge_weights(model: Any, tensors: dict[str, Tensor]) -> None:
    """Replaces weights, biases and norms of a LLaMA by those of a checkpoint, and adds its low-rank updates."""
    published_names = {name: f"llama.{published}" for name, published in OUTER.items()}
    for layer in range(model.config.num_hidden_layers):
        for name, published in INNER.items():
            published_names[f"model.layers.{layer}.{name}"] = f"llama.layers.{layer}.{published}"
    for name, published in published_names.items():
        module: Any = model.get_submodule(name)
        rows: Any = slice(None)
        if name.endswith(("q_proj", "k_proj")):  # transformers has the rows of a rotary pair half a head apart
            order = torch.arange(len(module.weight))
            rows = order.view(-1, model.config.head_dim // 2, 2).transpose(1, 2).flatten()
        if f"{published}.weight" in tensors:
            module.weight.copy_(tensors[f"{published}.weight"][rows])
        parent, _, part = published.rpartition(".")
        if f"{parent}.lora_{part}_l1.weight" in tensors:
            down = tensors[f"{parent}.lora_{part}_l1.weight"].float()
            up = tensors[f"{parent}.lora_{part}_l2.weight"].float()
            module.weight += (up @ down)[rows]
        if f"{published}.bias" in tensors:
            module.bias.copy_(tensors[f"{published}.bias"][rows])
