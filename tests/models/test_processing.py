"""The processor: text, settings that cannot be used, and a round trip over disk with the tokenizer."""

import unicodedata

import pytest
import torch
from transformers import CLIPTokenizer

from unitouch_gen.models import UniTouchProcessor


def test_text_becomes_padded_ids_between_start_and_end(processor: UniTouchProcessor, tokenizer: CLIPTokenizer) -> None:
    encoded = processor.text(["Rough  BRICK ", "rough brick " * 100, "🧱 {}[]<|endoftext|>", ""])
    ids = encoded["input_ids"][0].tolist()
    length = int(encoded["attention_mask"][0].sum())
    assert encoded["input_ids"].shape == (4, 12)
    assert ids[0] == tokenizer.bos_token_id
    assert ids[length - 1] == tokenizer.eos_token_id
    assert set(ids[length:]) == {tokenizer.pad_token_id}
    assert tokenizer.decode(ids, skip_special_tokens=True).strip() == "rough brick"
    assert encoded["input_ids"][1, -1] == tokenizer.eos_token_id  # cut
    assert encoded["input_ids"].min() >= 0
    assert encoded["input_ids"].max() < len(tokenizer)


def letters(text: str) -> str:
    """What CLIP's normaliser keeps, without the spaces that decoding may move."""
    return "".join(unicodedata.normalize("NFC", text).lower().split())


@pytest.mark.parametrize("text", ["粗いレンガ", "العربية", "naïve café", "🧱 brick", "e\u0301", "a\tb\n c"])
def test_the_built_in_tokenizer_loses_no_text(tokenizer: CLIPTokenizer, text: str) -> None:
    assert letters(tokenizer.decode(tokenizer(text).input_ids, skip_special_tokens=True)) == letters(text)


@pytest.mark.parametrize("subfolder", ["", "processor"])
def test_a_round_trip_keeps_settings_and_tokenizer(processor, tmp_path, subfolder) -> None:
    processor.save_pretrained(tmp_path / subfolder)
    again = UniTouchProcessor.from_pretrained(tmp_path, subfolder=subfolder)
    assert (again.image_size, again.audio) == (processor.image_size, processor.audio)
    texts = ["rough brick", "A photo of GLASS, a flat face", "🧱", ""]
    assert torch.equal(again.text(texts)["input_ids"], processor.text(texts)["input_ids"])
