"""The processor: text, settings that cannot be used, and a round trip over disk with the tokenizer."""

import copy
import json
from pathlib import Path

import pytest
import torch
from transformers import CLIPTokenizer

from tests.helpers.damage import SETTINGS
from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.models import UniTouchProcessor


def test_text_becomes_padded_ids_between_start_and_end(processor: UniTouchProcessor, tokenizer: CLIPTokenizer) -> None:
    encoded = processor.text(["Rough  BRICK ", "rough brick " * 100, "🧱 {}[]<|endoftext|>", ""])
    ids, length = encoded["input_ids"][0].tolist(), int(encoded["attention_mask"][0].sum())
    assert encoded["input_ids"].shape == (4, 12)
    assert ids[0] == tokenizer.bos_token_id and ids[length - 1] == tokenizer.eos_token_id
    assert set(ids[length:]) == {tokenizer.pad_token_id}
    assert tokenizer.decode(ids, skip_special_tokens=True).strip() == "rough brick"
    assert encoded["input_ids"][1, -1] == tokenizer.eos_token_id  # cut
    assert encoded["input_ids"].min() >= 0 and encoded["input_ids"].max() < len(tokenizer)


def test_what_is_no_text_is_refused_by_name(processor: UniTouchProcessor) -> None:
    for text in (None, ["a", None], [], "\ud800"):
        with pytest.raises((InvalidInputError, InvalidTypeError), match="`prompt` is"):
            processor.text(text, name="prompt")


@pytest.mark.parametrize("length", [10**9, 2])
def test_a_tokenizer_that_cannot_pad_is_refused(tokenizer: CLIPTokenizer, length: int) -> None:
    """It would ask for gigabytes."""
    other = copy.deepcopy(tokenizer)
    other.model_max_length = length
    with pytest.raises(InvalidInputError, match=f"`model_max_length` is {length}"):
        UniTouchProcessor(image_size=32, tokenizer=other).text("rough brick")
    with pytest.raises(InvalidInputError, match="`text` cannot be read: this processor has no tokenizer"):
        UniTouchProcessor(image_size=32).text("rough brick")


@pytest.mark.parametrize(
    ("settings", "words"),
    [({"image_size": 10**9}, "`image_size` is 1000000000"), ({"image_size": 32.0}, "`image_size` is 32.0"),
     ({"audio": {"frames": 10**12}}, "`frames` is 1000000000000"), ({"audio": [16_000]}, "`audio` is a list"),
     ({"tokenizer": "clip"}, "`tokenizer` is 'clip'")],
)  # fmt: skip
def test_settings_that_cannot_be_used_are_refused_by_name(settings: dict, words: str) -> None:
    with pytest.raises((InvalidInputError, InvalidTypeError), match=words):
        UniTouchProcessor(**settings)


@pytest.mark.parametrize("subfolder", ["", "processor"])
def test_a_round_trip_keeps_settings_and_tokenizer(processor, tmp_path, subfolder) -> None:
    processor.save_pretrained(tmp_path / subfolder)
    again = UniTouchProcessor.from_pretrained(tmp_path, subfolder=subfolder)
    assert (again.image_size, again.audio) == (processor.image_size, processor.audio)
    texts = ["rough brick", "A photo of GLASS, a flat face", "🧱", ""]
    assert torch.equal(again.text(texts)["input_ids"], processor.text(texts)["input_ids"])


@pytest.mark.parametrize("name", ["{}/nothing", "{}", "user/no-such-processor", "spaces in it"])
def test_what_holds_no_processor_is_refused_by_its_place(name: str, tmp_path: Path) -> None:
    place = name.format(tmp_path)
    with pytest.raises(InvalidInputError, match=f"`pretrained_model_name_or_path` is '{place}'"):
        UniTouchProcessor.from_pretrained(place, local_files_only=True)


@pytest.mark.parametrize("damage", SETTINGS)
@pytest.mark.parametrize("file", ["preprocessor_config", "tokenizer", "tokenizer_config"])
def test_damaged_settings_are_refused_by_their_place(processor, tmp_path, file: str, damage: str) -> None:
    processor.save_pretrained(tmp_path)
    SETTINGS[damage](tmp_path / f"{file}.json")
    with pytest.raises(InvalidInputError, match="`pretrained_model_name_or_path` "):
        UniTouchProcessor.from_pretrained(tmp_path)


def test_stored_settings_that_cannot_be_used_are_refused_by_name(processor: UniTouchProcessor, tmp_path: Path) -> None:
    processor.save_pretrained(tmp_path)
    file = tmp_path / "preprocessor_config.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"image_size": "big"}))
    with pytest.raises(InvalidInputError, match=r"`pretrained_model_name_or_path` is .*`image_size` is 'big'"):
        UniTouchProcessor.from_pretrained(tmp_path)
