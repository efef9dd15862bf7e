"""Touch-LLM's release at small width, transcribed: a LLaMA of Meta's with adapters, and its files."""

from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor
from transformers import LlamaConfig, LlamaForCausalLM

DIM, HEADS, LAYERS, HIDDEN, WIDTH, RANK = 32, 4, 2, 48, 16, 3
SHAPES = {
    "attention.wq": (DIM, DIM),
    "attention.wk": (DIM, DIM),
    "attention.wv": (DIM, DIM),
    "attention.wo": (DIM, DIM),
    "feed_forward.w1": (HIDDEN, DIM),
    "feed_forward.w2": (DIM, HIDDEN),
    "feed_forward.w3": (HIDDEN, DIM),
}
BIASED = ("wq", "wo", "w1", "w2", "w3")
NAMES = {
    "tok_embeddings": "model.embed_tokens",
    "output": "lm_head",
    "layers": "model.layers",
    "norm": "model.norm",
    "attention_norm": "input_layernorm",
    "ffn_norm": "post_attention_layernorm",
    "attention": "self_attn",
    "feed_forward": "mlp",
    "w1": "gate_proj",
    "w2": "down_proj",
    "w3": "up_proj",
    **{f"w{one}": f"{one}_proj" for one in "qkvo"},
}


def files_of(folder: Path, vocabulary: int, legacy: bool) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Writes a LLaMA in transformers' layout and a checkpoint; returns the weights of both in their authors'."""
    generator = torch.Generator().manual_seed(0)

    def random(*shape: int, scale: float = 0.3) -> Tensor:
        return scale * torch.randn(shape, generator=generator)

    llama = {
        "tok_embeddings.weight": random(vocabulary, DIM, scale=1.0),
        "output.weight": random(vocabulary, DIM),
        "norm.weight": 1 + random(DIM),
    }
    bridge = {
        "image_bind_proj.weight": random(DIM, WIDTH),
        "image_bind_proj.bias": random(DIM),
        "prefix_query.weight": random(LAYERS, DIM),
        "llama.norm.weight": 1 + random(DIM),
    }
    for k in (1, 2, 3):
        bridge[f"image_bind_norm_{k}.weight"] = 1 + random(DIM)
        for name, shape in {"f1": (HIDDEN, DIM), "f2": (DIM, HIDDEN), "f3": (HIDDEN, DIM)}.items():
            bridge[f"image_bind_{name}_{k}.weight"] = random(*shape)
            if legacy:
                bridge[f"image_bind_{name}_{k}.bias"] = random(shape[0])
        if legacy:
            bridge[f"image_bind_norm_{k}.bias"] = random(DIM)
    for layer in range(LAYERS):
        for name, shape in SHAPES.items():
            llama[f"layers.{layer}.{name}.weight"] = random(*shape)
            part, short = name.split(".")
            place = f"llama.layers.{layer}.{part}"
            bridge[f"{place}.lora_{short}_l1.weight"] = random(RANK, shape[1])
            bridge[f"{place}.lora_{short}_l2.weight"] = random(shape[0], RANK)
            if short in BIASED:
                bridge[f"{place}.{short}.bias"] = random(shape[0])
        for name in ("attention_norm", "ffn_norm"):
            llama[f"layers.{layer}.{name}.weight"] = 1 + random(DIM)
            bridge[f"llama.layers.{layer}.{name}.weight"] = 1 + random(DIM)
        bridge[f"llama.layers.{layer}.attention.gate"] = random(1, HEADS, 1, 1, scale=1.0)
    write_llama(folder, vocabulary, llama)
    torch.save({"model": bridge, "config": {"w_lora": True}}, folder.with_suffix(".pth"))
    return llama, bridge


def write_llama(folder: Path, vocabulary: int, llama: dict[str, Tensor]) -> None:
    """Permuted as transformers' own script does."""
    sizes = {"hidden_size": DIM, "intermediate_size": HIDDEN, "num_hidden_layers": LAYERS, "num_attention_heads": HEADS}
    model = LlamaForCausalLM(LlamaConfig(**sizes, vocab_size=vocabulary, rms_norm_eps=1e-5))
    state = {".".join(NAMES.get(part, part) for part in key.split(".")): value for key, value in llama.items()}
    for key in [key for key in state if "q_proj" in key or "k_proj" in key]:
        state[key] = state[key].view(HEADS, DIM // HEADS // 2, 2, DIM).transpose(1, 2).reshape(DIM, DIM)
    model.load_state_dict(state)
    model.save_pretrained(folder)


def rms(x: Tensor, weight: Tensor, eps: float) -> Tensor:
    return weight * x * (x.square().mean(-1, keepdim=True) + eps).rsqrt()


def visual(w: dict[str, Tensor], embeds: Tensor) -> Tensor:
    """F' (B, 1, DIM) of embeddings (B, WIDTH)."""
    x = F.linear(F.normalize(embeds, dim=-1)[:, None], w["image_bind_proj.weight"], w["image_bind_proj.bias"])
    for k in (1, 2, 3):
        norm = w[f"image_bind_norm_{k}.weight"]
        bias = w.get(f"image_bind_norm_{k}.bias")
        n = rms(x, norm, 1e-6) if bias is None else F.layer_norm(x, (DIM,), norm, bias)
        f1, f2, f3 = ((w[f"image_bind_f{i}_{k}.weight"], w.get(f"image_bind_f{i}_{k}.bias")) for i in (1, 2, 3))
        x = x + F.linear(F.silu(F.linear(n, *f1)) * F.linear(n, *f3), *f2)
    return x


def turned(x: Tensor) -> Tensor:
    """Rotary positions of (B, T, HEADS, d), pairs in neighbouring places, as complex numbers."""
    d = x.shape[-1]
    angles = torch.outer(torch.arange(x.shape[1]).float(), 10000.0 ** (-torch.arange(0, d, 2).float() / d))
    pairs = torch.view_as_complex(x.unflatten(-1, (-1, 2)).contiguous())
    return torch.view_as_real(pairs * torch.polar(torch.ones_like(angles), angles)[:, None]).flatten(-2)


def logits_of(llama: dict[str, Tensor], bridge: dict[str, Tensor], embeds: Tensor, ids: Tensor) -> Tensor:
    """Logits (B, T, V) of token ids (B, T)."""
    w = {f"llama.{key}": value for key, value in llama.items()} | bridge
    features, (batch, size) = visual(w, embeds), ids.shape
    mask = torch.full((size, size), -torch.inf).triu(1)

    def linear(x: Tensor, layer: int, name: str) -> Tensor:
        part, short = name.split(".")
        place = f"llama.layers.{layer}.{part}"
        low = F.linear(F.linear(x, w[f"{place}.lora_{short}_l1.weight"]), w[f"{place}.lora_{short}_l2.weight"])
        return F.linear(x, w[f"{place}.{short}.weight"], w.get(f"{place}.{short}.bias")) + low

    h = w["llama.tok_embeddings.weight"][ids]
    for layer in range(LAYERS):
        place = f"llama.layers.{layer}"
        x = rms(h, w[f"{place}.attention_norm.weight"], 1e-5)
        q, k, v = (linear(x, layer, f"attention.w{one}").view(batch, size, HEADS, -1) for one in "qkv")
        q, k, v = (one.transpose(1, 2) for one in (turned(q), turned(k), v))
        out = (q @ k.transpose(2, 3) / q.shape[-1] ** 0.5 + mask).softmax(dim=-1) @ v
        adapter = F.linear(features + w["prefix_query.weight"][layer], w[f"{place}.attention.wv.weight"])
        out = out + w[f"{place}.attention.gate"].tanh() * adapter.view(batch, 1, HEADS, -1).transpose(1, 2)
        h = h + linear(out.transpose(1, 2).flatten(2), layer, "attention.wo")
        x = rms(h, w[f"{place}.ffn_norm.weight"], 1e-5)
        gated = F.silu(linear(x, layer, "feed_forward.w1")) * linear(x, layer, "feed_forward.w3")
        h = h + linear(gated, layer, "feed_forward.w2")
    return F.linear(rms(h, w["llama.norm.weight"], 1e-5), w["llama.output.weight"])
