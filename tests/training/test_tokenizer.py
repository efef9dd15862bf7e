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
WRITINGS = ("мягкая трава", "粗いレンガ", "العربية", "ελιά", "한국어", "naïve café", "🧱 brick 🤖")
STRANGE = (*WRITINGS, "e\u0301", "\u200d", "%$#", "a\tb\n c")


@pytest.fixture(scope="module")
def tokenizer() -> CLIPTokenizer:
    return train_tokenizer(TEXTS, 600, 12)


def letters(text: str) -> str:
    """What CLIP's normaliser keeps of a text, without the spaces that decoding may move."""
    return "".join(unicodedata.normalize("NFC", text).lower().split())


def test_start_and_end_are_the_last_two_ids(tokenizer: CLIPTokenizer) -> None:
    size = len(tokenizer)
    assert tokenizer.convert_tokens_to_ids([START, END]) == [size - 2, size - 1]
    assert (tokenizer.bos_token_id, tokenizer.eos_token_id, tokenizer.pad_token_id) == (size - 2, size - 1, size - 1)


def test_a_text_stands_between_start_and_end_and_is_padded(tokenizer: CLIPTokenizer) -> None:
    size = len(tokenizer)
    ids = tokenizer("rough brick", padding="max_length").input_ids
    assert len(ids) == 12 and ids[0] == size - 2
    first_end = ids.index(size - 1)
    assert set(ids[first_end:]) == {size - 1} and max(ids[1:first_end]) < size - 2


def test_a_long_text_is_cut_and_still_ends(tokenizer: CLIPTokenizer) -> None:
    ids = tokenizer("brick " * 50, truncation=True).input_ids
    assert len(ids) == 12 and ids[-1] == tokenizer.eos_token_id


@pytest.mark.parametrize("text", STRANGE)
def test_no_text_is_lost(tokenizer: CLIPTokenizer, text: str) -> None:
    ids = tokenizer(text).input_ids
    assert letters(tokenizer.decode(ids, skip_special_tokens=True)) == letters(text)


@settings(max_examples=60, deadline=None)
@given(st.text(max_size=40))
def test_ids_stay_in_the_vocabulary_and_nothing_is_unknown(tokenizer: CLIPTokenizer, text: str) -> None:
    size = len(tokenizer)
    ids = tokenizer(text).input_ids
    assert ids[0] == size - 2 and ids[-1] == size - 1
    assert all(0 <= token < size - 2 for token in ids[1:-1])  # the unknown token would be the end token


def test_case_does_not_matter(tokenizer: CLIPTokenizer) -> None:
    assert tokenizer("Rough BRICK").input_ids == tokenizer("rough brick").input_ids


def test_words_of_the_captions_are_single_tokens() -> None:
    tokenizer = train_tokenizer(list(TEXTS) * 5, 1024, 12)
    assert all(len(tokenizer(word).input_ids) == 3 for word in ("brick", "rough", "glass"))


def test_prompts_are_learnt_whatever_the_captions_are() -> None:
    tokenizer = train_tokenizer([], 1024, 24)
    for prompt in PROMPTS:
        assert len(tokenizer(prompt).input_ids) <= len(prompt.replace(",", " ,").split()) + 2


@pytest.mark.parametrize("size", [514, 530, 600, 1024])
def test_the_vocabulary_is_no_larger_than_asked_for(size: int) -> None:
    assert len(train_tokenizer(TEXTS, size, 12)) <= size


@pytest.mark.parametrize("size", [0, 300, 513])
def test_a_vocabulary_too_small_for_every_byte_is_refused_by_name(size: int) -> None:
    with pytest.raises(InvalidInputError, match=f"`vocab_size` is {size}; it has to be an integer from 514 to"):
        train_tokenizer(TEXTS, size, 12)


def test_training_again_gives_the_same_ids(tokenizer: CLIPTokenizer) -> None:
    for _ in range(4):  # a run that resumes trains it anew, and finds the embeddings it had of these ids
        assert train_tokenizer(TEXTS, 600, 12).get_vocab() == tokenizer.get_vocab()


def test_a_saved_tokenizer_reads_back_the_same(tokenizer: CLIPTokenizer, tmp_path: Path) -> None:
    tokenizer.save_pretrained(tmp_path)
    again = CLIPTokenizer.from_pretrained(tmp_path)
    assert again.model_max_length == 12 and len(again) == len(tokenizer)
    for text in (*TEXTS, *STRANGE):
        assert again(text, padding="max_length").input_ids == tokenizer(text, padding="max_length").input_ids
