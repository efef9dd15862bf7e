"""The processor: text, its errors, and a round trip over disk with the tokenizer."""

import copy
import json
from pathlib import Path

import pytest
import torch
from transformers import CLIPTokenizer

from tests.helpers.damage import SETTINGS
from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.models import UniTouchProcessor
from unitouch_gen.models.sounds import LogMel


def test_text_becomes_padded_ids_between_start_and_end(processor: UniTouchProcessor, tokenizer: CLIPTokenizer) -> None:
    encoded = processor.text("rough brick")
    ids, length = encoded["input_ids"][0].tolist(), int(encoded["attention_mask"].sum())
    assert encoded["input_ids"].shape == (1, 12)
    assert ids[0] == tokenizer.bos_token_id
    assert ids[length - 1] == tokenizer.eos_token_id
    assert set(ids[length:]) == {tokenizer.pad_token_id}
    assert tokenizer.decode(ids, skip_special_tokens=True).strip() == "rough brick"


def test_texts_are_one_batch_in_order(processor: UniTouchProcessor) -> None:
    batch = processor.text(["rough brick", "slick glass"])["input_ids"]
    for row, text in enumerate(("rough brick", "slick glass")):
        assert torch.equal(batch[row], processor.text(text)["input_ids"][0])


def test_case_and_spaces_do_not_matter(processor: UniTouchProcessor) -> None:
    assert torch.equal(processor.text("Rough  BRICK ")["input_ids"], processor.text("rough brick")["input_ids"])


def test_long_text_is_cut_and_still_ends(processor: UniTouchProcessor, tokenizer: CLIPTokenizer) -> None:
    ids = processor.text("rough brick " * 100)["input_ids"]
    assert ids.shape == (1, 12)
    assert ids[0, -1] == tokenizer.eos_token_id


@pytest.mark.parametrize("text", ["", "🧱 кирпич レンガ", "a\nb\tc", "{}[]<|endoftext|>"])
def test_any_text_can_be_read(processor: UniTouchProcessor, text: str) -> None:
    ids = processor.text(text)["input_ids"]
    assert ids.shape == (1, 12)
    assert ids.min() >= 0
    assert ids.max() < len(processor.tokenizer)


@pytest.mark.parametrize("text", [None, 3, b"bytes", ["a", None], [["a"]], {"a": "b"}])
def test_what_is_no_text_is_refused_by_name(processor: UniTouchProcessor, text: object) -> None:
    with pytest.raises(InvalidTypeError, match=r"`prompt` is .*string"):
        processor.text(text, name="prompt")


def test_an_empty_list_of_texts_is_refused_by_name(processor: UniTouchProcessor) -> None:
    with pytest.raises(InvalidInputError, match="`text` is an empty list"):
        processor.text([])


def test_text_without_a_tokenizer_is_refused_by_name() -> None:
    with pytest.raises(InvalidInputError, match="`text` cannot be read: this processor has no tokenizer"):
        UniTouchProcessor(image_size=32).text("rough brick")


@pytest.mark.parametrize(
    ("setting", "value"), [("model_max_length", 10**9), ("model_max_length", 2), ("pad_token", None)]
)
def test_a_tokenizer_that_cannot_pad_is_refused(tokenizer: CLIPTokenizer, setting: str, value: object) -> None:
    """It would ask for gigabytes, or leave texts of different lengths."""
    other = copy.deepcopy(tokenizer)
    setattr(other, setting, value)
    with pytest.raises(InvalidInputError, match=f"`{setting}` is {value}"):
        UniTouchProcessor(image_size=32, tokenizer=other).text("rough brick")


def test_settings_may_come_as_fields_or_whole() -> None:
    audio = LogMel(mel_bins=16, frames=24)
    assert UniTouchProcessor(audio=audio).audio == UniTouchProcessor(audio={"mel_bins": 16, "frames": 24}).audio


@pytest.mark.parametrize(
    ("settings", "words", "error"),
    [
        ({"image_size": 0}, "`image_size` is 0", InvalidInputError),
        ({"image_size": -32}, "`image_size` is -32", InvalidInputError),
        ({"image_size": 32.0}, "`image_size` is 32.0", InvalidTypeError),
        ({"image_size": {"height": 32}}, "`image_size` is a dict", InvalidTypeError),
        ({"audio": {"mel_bin": 16}}, "`audio` is 'mel_bin'.*Did you mean 'mel_bins'", InvalidInputError),
        ({"audio": {"clips": 0}}, "`clips` is 0", InvalidInputError),
        ({"audio": [16_000]}, "`audio` is a list", InvalidTypeError),
        ({"tokenizer": "clip"}, "`tokenizer` is 'clip'", InvalidTypeError),
    ],
)
def test_settings_that_cannot_be_used_are_refused_by_name(settings: dict, words: str, error: type[Exception]) -> None:
    with pytest.raises(error, match=words):
        UniTouchProcessor(**settings)


def test_stored_settings_that_cannot_be_used_are_refused_by_name(processor: UniTouchProcessor, tmp_path: Path) -> None:
    processor.save_pretrained(tmp_path)
    file = tmp_path / "preprocessor_config.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"image_size": "big"}))
    with pytest.raises(InvalidInputError, match=r"`pretrained_model_name_or_path` is .*`image_size` is 'big'"):
        UniTouchProcessor.from_pretrained(tmp_path)


@pytest.mark.parametrize("name", ["nothing", "nothing/here", "a/b/c", ""])
def test_what_holds_no_processor_is_refused_by_its_path(name: str, tmp_path: Path) -> None:
    words = f"`pretrained_model_name_or_path` is '{tmp_path / name}'.*(?i:pass (a|the) folder)"
    with pytest.raises(InvalidInputError, match=words):
        UniTouchProcessor.from_pretrained(tmp_path / name)


def test_a_broken_file_of_settings_is_refused_by_its_path(processor: UniTouchProcessor, tmp_path: Path) -> None:
    processor.save_pretrained(tmp_path)
    (tmp_path / "preprocessor_config.json").write_text('{"image_size": ')
    with pytest.raises(InvalidInputError, match=r"preprocessor_config\.json.*cannot be read as JSON"):
        UniTouchProcessor.from_pretrained(tmp_path)


@pytest.mark.parametrize("name", ["user/no-such-processor", "no/repository/id", "spaces in it"])
def test_a_repository_that_is_not_there_is_refused_by_its_id(name: str) -> None:
    with pytest.raises(InvalidInputError, match=f"`pretrained_model_name_or_path` is '{name}'"):
        UniTouchProcessor.from_pretrained(name, local_files_only=True)


def test_the_defaults_are_the_papers() -> None:
    processor = UniTouchProcessor()
    assert processor.image_size == 224
    assert (processor.audio.sampling_rate, processor.audio.clips, processor.audio.clip_seconds) == (16_000, 3, 2.0)


def test_a_round_trip_keeps_settings_and_tokenizer(processor: UniTouchProcessor, tmp_path: Path) -> None:
    processor.save_pretrained(tmp_path)
    again = UniTouchProcessor.from_pretrained(tmp_path)
    assert again.image_size == processor.image_size
    assert again.audio == processor.audio
    texts = ["rough brick", "A photo of GLASS, a flat face", "🧱", ""]
    assert torch.equal(again.text(texts)["input_ids"], processor.text(texts)["input_ids"])


def test_a_round_trip_works_from_a_subfolder(processor: UniTouchProcessor, tmp_path: Path) -> None:
    processor.save_pretrained(tmp_path / "processor")
    again = UniTouchProcessor.from_pretrained(tmp_path, subfolder="processor")
    assert again.audio == processor.audio
    assert torch.equal(again.text("rough brick")["input_ids"], processor.text("rough brick")["input_ids"])


def test_a_round_trip_without_a_tokenizer_has_none(tmp_path: Path) -> None:
    UniTouchProcessor(image_size=48).save_pretrained(tmp_path)
    again = UniTouchProcessor.from_pretrained(tmp_path)
    assert again.image_size == 48
    assert again.tokenizer is None


def test_saving_twice_writes_the_same_files(processor: UniTouchProcessor, tmp_path: Path) -> None:
    for name in ("first", "second"):
        processor.save_pretrained(tmp_path / name)
    names = sorted(path.relative_to(tmp_path / "first") for path in (tmp_path / "first").rglob("*") if path.is_file())
    assert names
    for name in names:
        assert (tmp_path / "first" / name).read_bytes() == (tmp_path / "second" / name).read_bytes()


# Damaged files --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("damage", SETTINGS)
@pytest.mark.parametrize("file", ["preprocessor_config", "tokenizer", "tokenizer_config"])
def test_damaged_settings_are_refused_by_their_place(
    processor: UniTouchProcessor, tmp_path: Path, file: str, damage: str
) -> None:
    processor.save_pretrained(tmp_path)
    SETTINGS[damage](tmp_path / f"{file}.json")
    with pytest.raises(InvalidInputError, match="`pretrained_model_name_or_path` "):
        UniTouchProcessor.from_pretrained(tmp_path)


def test_a_tokenizer_without_a_vocabulary_is_refused(processor: UniTouchProcessor, tmp_path: Path) -> None:
    processor.save_pretrained(tmp_path)
    (tmp_path / "tokenizer.json").unlink()
    with pytest.raises(InvalidInputError, match=r"holds no tokenizer\.json or vocab\.json"):
        UniTouchProcessor.from_pretrained(tmp_path)


@pytest.mark.parametrize(
    "settings",
    [{"image_size": 10**9}, {"audio": {"clips": 10**9}}, {"audio": {"frames": 10**12}}, {"audio": {"mel_bins": 10**9}},
     {"audio": {"clip_seconds": 1e300}}, {"audio": {"frame_shift": 1e300}},
     {"audio": {"frame_length": 1e9, "clip_seconds": 1e10}}],
)  # fmt: skip
def test_settings_that_no_memory_can_hold_are_refused(settings: dict) -> None:
    with pytest.raises(InvalidInputError, match="it has to be"):
        UniTouchProcessor(**settings)


def test_an_argument_that_there_is_not_is_refused(processor: UniTouchProcessor, tmp_path: Path) -> None:
    processor.save_pretrained(tmp_path)
    for make in (lambda: UniTouchProcessor(imagesize=32), lambda: UniTouchProcessor.from_pretrained(tmp_path, size=32)):
        with pytest.raises(InvalidInputError, match=r"got \['(image)?size'\]; it takes"):
            make()


def test_a_setting_may_be_another_than_the_stored_one(processor: UniTouchProcessor, tmp_path: Path) -> None:
    processor.save_pretrained(tmp_path)
    assert UniTouchProcessor.from_pretrained(tmp_path, image_size=48).image_size == 48
