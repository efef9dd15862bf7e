"""The tokenizer: CLIP's form, and no text that it cannot hold."""

import unicodedata

import pytest
from transformers import CLIPTokenizer

from unitouch_gen.training.tokenizer import PROMPTS, train_tokenizer

TEXTS = ("a photo of rough red brick, a flat face", "slick glass", "touch of soft grass", "brick that feels rough")


@pytest.fixture(scope="module")
def tokenizer() -> CLIPTokenizer:
    return train_tokenizer(TEXTS, 600, 12)


def test_tokens_are_whole_words_between_start_and_end(tokenizer: CLIPTokenizer) -> None:
    start, end = len(tokenizer) - 2, len(tokenizer) - 1
    assert (tokenizer.bos_token_id, tokenizer.eos_token_id, tokenizer.pad_token_id) == (start, end, end)
    whole = train_tokenizer(list(TEXTS) * 5, 1024, 24)
    assert all(len(whole(word).input_ids) == 3 for word in ("brick", "Rough", "GLASS"))
    assert all(len(whole(prompt).input_ids) <= len(prompt.replace(",", " ,").split()) + 2 for prompt in PROMPTS)


def letters(text: str) -> str:
    """What CLIP's normaliser keeps, without the spaces that decoding may move."""
    return "".join(unicodedata.normalize("NFC", text).lower().split())


@pytest.mark.parametrize("text", ["粗いレンガ", "العربية", "naïve café", "🧱 brick", "e\u0301", "a\tb\n c"])
def test_no_text_is_lost(tokenizer: CLIPTokenizer, text: str) -> None:
    assert letters(tokenizer.decode(tokenizer(text).input_ids, skip_special_tokens=True)) == letters(text)


def test_ids_are_the_same_when_trained_again(tokenizer: CLIPTokenizer) -> None:
    again = train_tokenizer(TEXTS, 600, 12)
    assert again.get_vocab() == tokenizer.get_vocab() and again(TEXTS).input_ids == tokenizer(TEXTS).input_ids
