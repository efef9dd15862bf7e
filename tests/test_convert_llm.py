"""Touch-LLM's published checkpoint: what is made of it computes what a plain transcription of the release does."""

from pathlib import Path

import pytest
import torch
from torch.testing import assert_close

from tests.helpers.components import make_language_parts
from tests.helpers.touch_llm import DIM, WIDTH, files_of, logits_of
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


@pytest.mark.parametrize("legacy", [False, True])
@torch.no_grad()
def test_logits_and_greedy_text_are_those_of_the_release(tmp_path, legacy):
    folder, bridge, llama, weights = published(tmp_path / "llama", legacy)
    pipe = TouchToTextPipeline(**read_touch_llm(bridge, folder))
    ids = torch.tensor(TOKENIZER(["How?"] * 2)["input_ids"])
    options = {"max_new_tokens": 6, "min_new_tokens": 6, "do_sample": False}
    with pipe.language_bridge.attach(pipe.language_model, EMBEDS):
        made = pipe.language_model.generate(ids, attention_mask=torch.ones_like(ids), **options)
        found = pipe.language_model(made).logits
    wanted = logits_of(llama, weights, EMBEDS, made)
    assert_close(found, wanted, atol=1e-5 * float(wanted.abs().max()), rtol=0)
    wanted[..., 2] = -torch.inf  # </s>
    assert torch.equal(made[:, ids.shape[1] :], wanted[:, ids.shape[1] - 1 : -1].argmax(dim=-1))
    assert pipe.language_model.generation_config.temperature == 0.1
    assert "### Response:" in pipe.config.prompt_template
    pipe.register_to_config(prompt_template="{question}")
    texts = pipe(touch_embeds=EMBEDS, question="How?", **options).texts
    assert texts == [TOKENIZER.decode(row[ids.shape[1] :], skip_special_tokens=True).strip() for row in made]


class Code:
    def __reduce__(self):
        return Path.touch, (Path("ran"),)


def test_another_checkpoint_is_refused_and_no_pickle_is_run(tmp_path, monkeypatch):
    folder, bridge, _, weights = published(tmp_path / "llama")
    monkeypatch.chdir(tmp_path)
    for key, value, words in (
        ("image_bind_proj.bias", None, "'image_bind_proj.bias' is missing"),
        ("llama.layers.1.attention.gate", None, "'llama.layers.1.attention.gate' is missing"),
        ("prefix_query.weight", torch.zeros(3, DIM), "size mismatch for queries"),
        ("llama.norm.weight", torch.zeros(DIM + 1), "does not fit this LLaMA"),
        ("code", Code(), "holds more than weights: .* of which nothing was run"),
    ):
        changed = {name: one for name, one in {**weights, key: value}.items() if one is not None}
        torch.save({"model": changed}, bridge)
        with pytest.raises(InvalidInputError, match=f"`bridge` .*{words}"):
            read_touch_llm(bridge, folder)
    assert not Path("ran").exists()
