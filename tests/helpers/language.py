"""A LLaMA of a few thousand parameters, with a tokenizer and a bridge into it whose gates are open."""

import torch
from transformers import LlamaConfig, LlamaForCausalLM

from tests.helpers.components import D
from unitouch_gen.models.language import LanguageBridge
from unitouch_gen.training.language_model import train_language_tokenizer

SIZES = {"hidden_size": 32, "intermediate_size": 48, "num_hidden_layers": 2, "num_attention_heads": 4,
         "max_position_embeddings": 64, "tie_word_embeddings": True}  # fmt: skip


def make_language_parts(**sizes: object) -> dict:
    """Those of a `TouchToTextPipeline`; answers differ with the embedding."""
    torch.manual_seed(0)
    tokenizer = train_language_tokenizer(["How does it feel?\nit feels rough", "Where is it?"], 280)
    special = {"vocab_size": len(tokenizer), "pad_token_id": 0, "bos_token_id": 1, "eos_token_id": 2}
    model = LlamaForCausalLM(LlamaConfig(**{**SIZES, **special, "initializer_range": 0.3, **sizes})).eval()
    bridge = LanguageBridge.for_model(model, D, num_blocks=2, intermediate_size=24).eval()
    torch.nn.init.normal_(bridge.gates, std=2.0)
    return {"language_bridge": bridge, "language_model": model, "tokenizer": tokenizer}
