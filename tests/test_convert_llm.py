"""Touch-LLM's published checkpoint: what is made of it computes what a plain transcription of the release does."""

import re
from pathlib import Path

import pytest
import torch
from torch.testing import assert_close
from transformers import LlamaConfig, LlamaForCausalLM

from tests.helpers.language import make_language_parts
from tests.helpers.touch_llm import DIM, HEADS, HIDDEN, LAYERS, WIDTH, files_of, logits_of
from unitouch_gen.convert_llm import read_touch_llm
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.pipelines import TouchToTextPipeline

TOKENIZER = make_language_parts()["tokenizer"]
EMBEDS = torch.randn(2, WIDTH, generator=torch.Generator().manual_seed(1))


def published(folder: Path, legacy: bool = False):
    """The folder of a LLaMA, its checkpoint, and the weights of both."""
    folder.mkdir()
    TOKENIZER.save_pretrained(folder)
    return folder, folder.with_suffix(".pth"), *files_of(folder, len(TOKENIZER), legacy)


def in_transformers_layout(folder: Path, llama: dict, place: Path) -> Path:
    """The LLaMA alone, permuted as transformers' own script does."""
    sizes = {"hidden_size": DIM, "intermediate_size": HIDDEN, "num_hidden_layers": LAYERS, "num_attention_heads": HEADS}
    model = LlamaForCausalLM(LlamaConfig(**sizes, vocab_size=len(TOKENIZER), rms_norm_eps=1e-5))
    mlp = {"gate_proj": "feed_forward.w1", "down_proj": "feed_forward.w2", "up_proj": "feed_forward.w3"}
    names = {"self_attn": {f"{one}_proj": f"attention.w{one}" for one in "qkvo"}, "mlp": mlp}
    state = {"model.embed_tokens.weight": llama["tok_embeddings.weight"], "lm_head.weight": llama["output.weight"],
             "model.norm.weight": llama["norm.weight"]}  # fmt: skip
    for layer in range(LAYERS):
        ours, theirs = f"model.layers.{layer}", f"layers.{layer}"
        for part, linears in names.items():
            for name, published_name in linears.items():
                weight = llama[f"{theirs}.{published_name}.weight"]
                if name in ("q_proj", "k_proj"):
                    weight = weight.view(HEADS, DIM // HEADS // 2, 2, DIM).transpose(1, 2).reshape(DIM, DIM)
                state[f"{ours}.{part}.{name}.weight"] = weight
        state[f"{ours}.input_layernorm.weight"] = llama[f"{theirs}.attention_norm.weight"]
        state[f"{ours}.post_attention_layernorm.weight"] = llama[f"{theirs}.ffn_norm.weight"]
    model.load_state_dict(state)
    model.save_pretrained(place)
    TOKENIZER.save_pretrained(place)
    return place


@pytest.mark.parametrize(("legacy", "layout"), [(False, "original"), (True, "original"), (False, "transformers")])
@torch.no_grad()
def test_logits_and_greedy_text_are_those_of_the_release(tmp_path, legacy, layout):
    folder, bridge, llama, weights = published(tmp_path / "llama", legacy)
    if layout == "transformers":
        folder = in_transformers_layout(folder, llama, tmp_path / "hf")
    pipe = TouchToTextPipeline.from_published(bridge, folder)
    ids = torch.randint(3, len(TOKENIZER), (2, 9), generator=torch.Generator().manual_seed(2))
    with pipe.language_bridge.attach(pipe.language_model, EMBEDS):
        found = pipe.language_model(ids).logits
    wanted = logits_of(llama, weights, EMBEDS, ids)
    assert_close(found, wanted, atol=1e-5 * float(wanted.abs().max()), rtol=0)
    assert pipe.language_model.generation_config.temperature == 0.1

    pipe.register_to_config(prompt_template="{question}")
    made = pipe(touch_embeds=EMBEDS, question="How?", max_new_tokens=6, do_sample=False).texts
    tokens = torch.tensor(TOKENIZER(["How?"] * 2)["input_ids"])
    start = tokens.shape[1]
    for _ in range(6):
        following = logits_of(llama, weights, EMBEDS, tokens)[:, -1].argmax(dim=-1)
        tokens = torch.cat([tokens, following[:, None]], dim=1)
    ends = [row.index(2) if 2 in row else 6 for row in tokens[:, start:].tolist()]
    texts = [TOKENIZER.decode(row[start : start + end]) for row, end in zip(tokens, ends, strict=True)]
    assert made == [TOKENIZER.decode(TOKENIZER(text)["input_ids"], skip_special_tokens=True).strip() for text in texts]


class Code:
    def __reduce__(self):
        return Path.touch, (Path("ran"),)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda w: w.pop("image_bind_proj.bias"), "'image_bind_proj.bias' is missing"),
        (lambda w: w.pop("llama.layers.1.attention.gate"), "'llama.layers.1.attention.gate' is missing"),
        (lambda w: w.update({"prefix_query.weight": torch.zeros(3, DIM)}), "size mismatch for queries"),
        (lambda w: w.update({"llama.norm.weight": torch.zeros(DIM + 1)}), "does not fit this LLaMA"),
        (lambda w: w.update(code=Code()), "holds more than weights: .* of which nothing was run"),
    ],
)
def test_another_checkpoint_is_refused_and_no_pickle_is_run(tmp_path, monkeypatch, change, words):
    folder, bridge, _, weights = published(tmp_path / "llama")
    monkeypatch.chdir(tmp_path)
    change(weights)
    torch.save({"model": weights}, bridge)
    with pytest.raises(InvalidInputError, match=f"`bridge` .*{words}"):
        read_touch_llm(bridge, folder)
    assert not Path("ran").exists()


def test_a_folder_without_one_llama_is_refused(tmp_path):
    folder, bridge, *_ = published(tmp_path / "llama")
    torch.save({}, folder / "consolidated.01.pth")
    for place in (folder, tmp_path):
        with pytest.raises(InvalidInputError, match=f"`llama` is '{re.escape(str(place))}'"):
            read_touch_llm(bridge, place)
