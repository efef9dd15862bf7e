"""The processor: text, settings that cannot be used, and a round trip over disk with the tokenizer."""

import copy
import json
import shutil
import unicodedata
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


def letters(text: str) -> str:
    """What CLIP's normaliser keeps, without the spaces that decoding may move."""
    return "".join(unicodedata.normalize("NFC", text).lower().split())


@pytest.mark.parametrize("text", ["粗いレンガ", "العربية", "naïve café", "🧱 brick", "e\u0301", "a\tb\n c"])
def test_the_built_in_tokenizer_loses_no_text(tokenizer: CLIPTokenizer, text: str) -> None:
    assert letters(tokenizer.decode(tokenizer(text).input_ids, skip_special_tokens=True)) == letters(text)


def test_a_tokenizer_that_cannot_pad_is_refused(tokenizer: CLIPTokenizer) -> None:
    """It would ask for gigabytes."""
    other = copy.deepcopy(tokenizer)
    for other.model_max_length in (10**9, 2):
        with pytest.raises(InvalidInputError, match=f"`model_max_length` is {other.model_max_length}"):
            UniTouchProcessor(image_size=32, tokenizer=other).text("rough brick")
    with pytest.raises(InvalidInputError, match="`text` cannot be read: this processor has no tokenizer"):
        UniTouchProcessor(image_size=32).text("rough brick")


def test_settings_that_cannot_be_used_are_refused_by_name() -> None:
    audio = {"sampling_rate": 0, "clip_seconds": 0.0, "clips": 0, "frames": "204", "std": 0.0, "frame_length": 1e-5,
             "frame_shift": 0.0, "mean": float("inf")}  # fmt: skip
    for settings, words in (
        ({"image_size": 10**9}, "`image_size` is 1000000000"), ({"image_size": 32.0}, "`image_size` is 32.0"),
        ({"audio": {"frames": 10**12}}, "`frames` is 1000000000000"), ({"audio": [16_000]}, "`audio` is a list"),
        ({"tokenizer": "clip"}, "`tokenizer` is 'clip'"),
        *(({"audio": {name: value}}, f"`{name}` is ") for name, value in audio.items()),
    ):  # fmt: skip
        with pytest.raises((InvalidInputError, InvalidTypeError), match=words):
            UniTouchProcessor(**settings)


@pytest.mark.parametrize("subfolder", ["", "processor"])
def test_a_round_trip_keeps_settings_and_tokenizer(processor, tmp_path, subfolder) -> None:
    processor.save_pretrained(tmp_path / subfolder)
    again = UniTouchProcessor.from_pretrained(tmp_path, subfolder=subfolder)
    assert (again.image_size, again.audio) == (processor.image_size, processor.audio)
    texts = ["rough brick", "A photo of GLASS, a flat face", "🧱", ""]
    assert torch.equal(again.text(texts)["input_ids"], processor.text(texts)["input_ids"])


def test_what_holds_no_processor_is_refused_by_its_place(tmp_path: Path) -> None:
    for place in (f"{tmp_path}/nothing", str(tmp_path), "user/no-such-processor", "spaces in it"):
        with pytest.raises(InvalidInputError, match=f"`pretrained_model_name_or_path` is '{place}'"):
            UniTouchProcessor.from_pretrained(place, local_files_only=True)


@pytest.mark.parametrize("file", ["preprocessor_config", "tokenizer", "tokenizer_config"])
def test_damaged_settings_are_refused_by_their_place(processor: UniTouchProcessor, tmp_path: Path, file: str) -> None:
    processor.save_pretrained(tmp_path / "whole")
    for number, damage in enumerate(SETTINGS.values()):
        folder = shutil.copytree(tmp_path / "whole", tmp_path / str(number))
        damage(folder / f"{file}.json")
        with pytest.raises(InvalidInputError, match=f"`pretrained_model_name_or_path` .*{folder}"):
            UniTouchProcessor.from_pretrained(folder)


def test_stored_settings_that_cannot_be_used_are_refused_by_name(processor: UniTouchProcessor, tmp_path: Path) -> None:
    processor.save_pretrained(tmp_path)
    file = tmp_path / "preprocessor_config.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"image_size": "big"}))
    with pytest.raises(InvalidInputError, match=r"`pretrained_model_name_or_path` is .*`image_size` is 'big'"):
        UniTouchProcessor.from_pretrained(tmp_path)
