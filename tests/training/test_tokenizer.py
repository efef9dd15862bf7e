"""The tokenizer: CLIP's form, and no text that it cannot hold."""

import unicodedata
from pathlib import Path

import pytest
from transformers import CLIPTokenizer

from unitouch_gen.training.tokenizer import PROMPTS, train_tokenizer

TEXTS = ("a photo of rough red brick, a flat face", "slick glass", "touch of soft grass", "brick that feels rough")


@pytest.fixture(scope="module")
def tokenizer() -> CLIPTokenizer:
    return train_tokenizer(TEXTS, 600, 12)


def test_a_text_stands_between_start_and_end_and_is_padded_or_cut(tokenizer: CLIPTokenizer) -> None:
    start, end = len(tokenizer) - 2, len(tokenizer) - 1
    assert (tokenizer.bos_token_id, tokenizer.eos_token_id, tokenizer.pad_token_id) == (start, end, end)
    ids = tokenizer("rough brick", padding="max_length").input_ids
    assert len(ids) == 12 and ids[0] == start and {*ids[ids.index(end) :]} == {end}
    cut = tokenizer("brick " * 50, truncation=True).input_ids
    assert len(cut) == 12 and cut[-1] == end
    whole = train_tokenizer(list(TEXTS) * 5, 1024, 24)
    assert all(len(whole(word).input_ids) == 3 for word in ("brick", "Rough", "GLASS"))
    assert all(len(whole(prompt).input_ids) <= len(prompt.replace(",", " ,").split()) + 2 for prompt in PROMPTS)


def letters(text: str) -> str:
    """What CLIP's normaliser keeps, without the spaces that decoding may move."""
    return "".join(unicodedata.normalize("NFC", text).lower().split())


@pytest.mark.parametrize("text", ["粗いレンガ", "العربية", "naïve café", "🧱 brick", "e\u0301", "a\tb\n c"])
def test_no_text_is_lost(tokenizer: CLIPTokenizer, text: str) -> None:
    assert letters(tokenizer.decode(tokenizer(text).input_ids, skip_special_tokens=True)) == letters(text)


def test_ids_are_the_same_when_trained_again_or_read(tokenizer: CLIPTokenizer, tmp_path: Path) -> None:
    tokenizer.save_pretrained(tmp_path)
    for again in (CLIPTokenizer.from_pretrained(tmp_path), train_tokenizer(TEXTS, 600, 12)):
        assert again.get_vocab() == tokenizer.get_vocab()
        assert again(TEXTS).input_ids == tokenizer(TEXTS).input_ids
