"""The tokenizer: CLIP's form, and no text that it cannot hold."""

import unicodedata
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from transformers import CLIPTokenizer

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.training.tokenizer import END, PROMPTS, START, train_tokenizer

TEXTS = ("a photo of rough red brick, a flat face", "slick glass", "touch of soft grass", "brick that feels rough")
STRANGE = ("мягкая трава", "粗いレンガ", "العربية", "naïve café", "🧱 brick 🤖", "e\u0301", "\u200d", "%$#", "a\tb\n c")


@pytest.fixture(scope="module")
def tokenizer() -> CLIPTokenizer:
    return train_tokenizer(TEXTS, 600, 12)


def test_a_text_stands_between_start_and_end_and_is_padded_or_cut(tokenizer: CLIPTokenizer) -> None:
    size = len(tokenizer)
    assert tokenizer.convert_tokens_to_ids([START, END]) == [size - 2, size - 1]
    assert (tokenizer.bos_token_id, tokenizer.eos_token_id, tokenizer.pad_token_id) == (size - 2, size - 1, size - 1)
    ids = tokenizer("rough brick", padding="max_length").input_ids
    end = ids.index(size - 1)
    assert len(ids) == 12 and ids[0] == size - 2 and {*ids[end:]} == {size - 1} and max(ids[1:end]) < size - 2
    cut = tokenizer("brick " * 50, truncation=True).input_ids
    assert len(cut) == 12 and cut[-1] == size - 1
    assert tokenizer("Rough BRICK").input_ids == tokenizer("rough brick").input_ids


@pytest.mark.parametrize("text", STRANGE)
def test_no_text_is_lost(tokenizer: CLIPTokenizer, text: str) -> None:
    def letters(text: str) -> str:  # what CLIP's normaliser keeps, without the spaces that decoding may move
        return "".join(unicodedata.normalize("NFC", text).lower().split())

    assert letters(tokenizer.decode(tokenizer(text).input_ids, skip_special_tokens=True)) == letters(text)


@settings(max_examples=60, deadline=None)
@given(st.text(max_size=40))
def test_ids_stay_in_the_vocabulary_and_nothing_is_unknown(tokenizer: CLIPTokenizer, text: str) -> None:
    first, *ids, last = tokenizer(text).input_ids
    assert (first, last) == (tokenizer.bos_token_id, tokenizer.eos_token_id)
    assert all(0 <= token < len(tokenizer) - 2 for token in ids)  # the unknown token would be the end token


def test_words_of_captions_and_prompts_are_single_tokens() -> None:
    tokenizer = train_tokenizer(list(TEXTS) * 5, 1024, 24)
    assert all(len(tokenizer(word).input_ids) == 3 for word in ("brick", "rough", "glass"))
    for prompt in PROMPTS:
        assert len(tokenizer(prompt).input_ids) <= len(prompt.replace(",", " ,").split()) + 2


def test_training_again_and_reading_give_the_same_ids(tokenizer: CLIPTokenizer, tmp_path: Path) -> None:
    tokenizer.save_pretrained(tmp_path)
    for again in (CLIPTokenizer.from_pretrained(tmp_path), *(train_tokenizer(TEXTS, 600, 12) for _ in range(3))):
        assert again.get_vocab() == tokenizer.get_vocab() and again.model_max_length == 12
        assert all(again(text).input_ids == tokenizer(text).input_ids for text in (*TEXTS, *STRANGE))


@pytest.mark.parametrize("size", [514, 530, 1024])
def test_the_vocabulary_is_no_larger_than_asked_for(size: int) -> None:
    assert len(train_tokenizer(TEXTS, size, 12)) <= size


@pytest.mark.parametrize(("size", "length", "name"), [(513, 12, "vocab_size"), (600, 0, "max_length")])
def test_a_vocabulary_too_small_for_every_byte_is_refused_by_name(size: int, length: int, name: str) -> None:
    with pytest.raises(InvalidInputError, match=f"`{name}` is "):
        train_tokenizer(TEXTS, size, length)
