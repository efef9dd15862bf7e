"""`TouchToTextPipeline`: what it asks and answers, and folders."""

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from diffusers import DiffusionPipeline
from torch.testing import assert_close
from transformers import TextIteratorStreamer

from tests.helpers.calls import seeded
from tests.helpers.components import D, make_language_parts
from unitouch_gen.pipelines import TouchToTextPipeline

EMBEDS = torch.randn(3, D, generator=seeded(3))
QUESTION = "How does it feel?"
SHORT = {"max_new_tokens": 6, "min_new_tokens": 6}


@pytest.fixture
def ask(components):
    joint = {name: components[name] for name in ("unitouch", "processor")}
    return TouchToTextPipeline(**make_language_parts(), **joint)


def test_answers_are_those_of_the_language_model_with_the_touch_attached(ask, touch):
    """Of each alone, without padding; and `embeds` bring them again."""
    questions = [QUESTION, "Where is it?"]
    output = ask(touch, questions, **SHORT)
    embeds = ask.encode_touch(touch)
    assert torch.equal(output.embeds, embeds)
    for row, question in enumerate(questions):
        ids = torch.tensor([ask.tokenizer(question)["input_ids"]])
        with ask.language_bridge.attach(ask.language_model, embeds[row : row + 1]):
            made = ask.language_model.generate(ids, attention_mask=torch.ones_like(ids), **SHORT)[0, ids.shape[1] :]
        assert output.texts[row] == ask.tokenizer.decode(made, skip_special_tokens=True).strip()
        assert output.report.prompt_tokens[row] == ids.shape[1]
    assert output.report.tokens == [6, 6]
    assert set(output.report.seconds) == {"touch", "answer"}
    texts, report = ask(touch_embeds=embeds, question=questions, return_dict=False, **SHORT)
    assert texts == output.texts
    assert "12 tokens" in str(report)


def test_one_input_has_several_questions_or_answers(ask, photo):
    several = ask(touch_embeds=EMBEDS[:1], question=[QUESTION, "Where?"], num_beams=2, num_return_sequences=2, **SHORT)
    assert len(several.texts) == 4
    assert several.embeds.shape == (1, D)
    assert (
        several.texts[:2]
        == ask(touch_embeds=EMBEDS[:1], question=QUESTION, num_beams=2, num_return_sequences=2, **SHORT).texts
    )
    seen = ask(image=photo, question=QUESTION, **SHORT)
    assert_close(seen.embeds.norm(dim=1), torch.full((2,), 3.0))


def test_a_seed_fixes_the_answer_whatever_threads_do_and_leaves_the_global_one_alone(ask):
    def call(seed: int) -> list[str]:
        options = {"do_sample": True, "generator": seeded(seed), **SHORT}
        return ask(touch_embeds=EMBEDS[seed % 3][None], question=QUESTION, **options).texts

    before = torch.random.get_rng_state()
    expected = [call(seed) for seed in range(6)]
    assert len({*map(tuple, expected)}) > 1
    assert torch.equal(torch.random.get_rng_state(), before)
    with ThreadPoolExecutor(3) as pool:
        assert list(pool.map(call, range(6))) == expected


def test_prompts_are_put_as_the_language_model_was_trained_and_streamed(ask):
    sizes = []
    chat_template = "[{{ messages[0].content }}]"
    for template, chat in (("{question}", None), ("Q: {question} A:", None), ("{question}", chat_template)):
        ask.register_to_config(prompt_template=template)
        ask.tokenizer.chat_template = chat
        streamer = TextIteratorStreamer(ask.tokenizer, timeout=60)
        given = {"touch_embeds": EMBEDS[:1], **SHORT}
        with ThreadPoolExecutor(1) as pool:
            answer = pool.submit(ask, question="Where?", streamer=streamer, **given)
            printed = "".join(streamer)
            output = answer.result()
        wanted = "[Where?]" if chat else "<s>" + template.replace("{question}", "Where?")
        assert printed.startswith(wanted)
        assert printed.strip().endswith(output.texts[0])
        sizes += output.report.prompt_tokens
    assert len({*sizes}) > 1


def test_a_saved_pipeline_answers_the_same_also_by_diffusers(ask, touch, tmp_path):
    output = ask(touch, QUESTION, **SHORT)
    ask.save_pretrained(tmp_path / "ask")
    assert "print(output.texts[0])" in (tmp_path / "ask" / "README.md").read_text()
    loaded = DiffusionPipeline.from_pretrained(tmp_path / "ask", trust_remote_code=True)
    for pipe in (loaded, TouchToTextPipeline.from_pretrained(tmp_path / "ask", dtype=torch.float32)):
        assert pipe(touch, QUESTION, **SHORT).texts == output.texts
    assert ask.to(torch.bfloat16)(touch, QUESTION, **SHORT).report.tokens == [6, 6]
