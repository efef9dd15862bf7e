"""`convert_published`: the folder it writes, and what it leaves alone when something is wrong."""

import errno
import json
import shutil
import weakref
from pathlib import Path

import pytest
import torch
from transformers import CLIPTokenizer

from tests.helpers.published_files import features_of, inputs_of, published, small
from unitouch_gen.convert import unitouch as conversion
from unitouch_gen.convert.checkpoints import open_checkpoint
from unitouch_gen.convert.unitouch import convert_published
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import UniTouchConfig, UniTouchModel, UniTouchProcessor


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> dict[str, Path]:
    return published(tmp_path_factory.mktemp("published"), small())[0]


@pytest.fixture(scope="module")
def folder(files, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("converted")
    convert_published(folder, **files, config=small(), told=lambda line: None)
    return folder


def edited(files: dict[str, Path], folder: Path, change) -> Path:
    """A copy of UniTouch's file whose state dict was changed."""
    state = dict(open_checkpoint("touch", files["touch"]).tensors)
    change(state)
    torch.save({"state_dict": state}, folder / "edited.ckpt")
    return folder / "edited.ckpt"


# The folder -----------------------------------------------------------------------------------------------------------


def test_there_is_one_file_for_each_modality(folder):
    assert sorted(path.name for path in folder.iterdir()) == [
        "config.json", "model-audio.safetensors", "model-image.safetensors", "model-text.safetensors",
        "model-touch.safetensors", "model.safetensors.index.json", "preprocessor_config.json",
    ]  # fmt: skip


@pytest.mark.parametrize("modality", ["image", "text", "audio", "touch"])
def test_the_folder_is_the_model_of_the_files(files, folder, modality):
    model = UniTouchModel.from_pretrained(folder)
    direct = UniTouchModel.from_published(**files, config=small())
    values = inputs_of(small())[modality]
    torch.testing.assert_close(
        features_of(model, modality, values), features_of(direct, modality, values), rtol=0, atol=0
    )
    assert model.loaded_modalities == (modality,)
    assert model.config.logit_scales == direct.config.logit_scales


def test_the_processor_prepares_for_it(folder):
    processor = UniTouchProcessor.from_pretrained(folder)
    assert processor.image_size == 28 and processor.tokenizer is None


def test_the_same_input_makes_the_same_bytes(files, folder, tmp_path, contents):
    for _ in range(2):  # the second one writes over the first
        convert_published(tmp_path / "again", **files, config=small(), told=lambda line: None)
        assert contents(tmp_path / "again") == contents(folder)


def test_a_changed_model_saved_into_the_folder_is_the_one_that_is_read(files, tmp_path):
    convert_published(tmp_path / "model", **files, config=small(), told=lambda line: None)
    model = UniTouchModel.from_pretrained(tmp_path / "model", modalities=("touch",))
    with torch.no_grad():
        model.touch_model.projection.weight.mul_(2.0)
    expected = {modality: features_of(model, modality, values) for modality, values in inputs_of(small()).items()}
    model.save_pretrained(tmp_path / "model")
    again = UniTouchModel.from_pretrained(tmp_path / "model")
    for modality, values in inputs_of(small()).items():
        torch.testing.assert_close(features_of(again, modality, values), expected[modality])
    assert not (tmp_path / "model" / "model-touch.safetensors").exists()


@pytest.mark.parametrize(
    "content", [b"{", b"[]", b"\xff\xfe", b'{"weight_map": 3}', b'{"weight_map": {"touch_model.": ".."}}']
)
@pytest.mark.parametrize("name", ["config.json", "model.safetensors.index.json"])
def test_a_folder_with_broken_settings_is_told_in_words(files, folder, tmp_path, contents, name, content):
    shutil.copytree(folder, tmp_path / "model")
    (tmp_path / "model" / name).write_bytes(content)
    before = contents(tmp_path)
    with pytest.raises(InvalidInputError):
        convert_published(tmp_path / "model", touch=files["touch"], config=small())
    assert contents(tmp_path) == before


@pytest.mark.parametrize("name", ["model_index.json", "unet"])
def test_a_pipeline_is_not_mixed_with_a_joint_space(files, tmp_path, name):
    (tmp_path / "pipeline" / name).mkdir(parents=True)
    with pytest.raises(InvalidInputError, match=rf"`output` is .*holds a pipeline \({name}\)"):
        convert_published(tmp_path / "pipeline", **files, config=small())


def test_an_encoder_that_was_not_converted_is_told_by_name(files, tmp_path):
    convert_published(tmp_path / "model", touch=files["touch"], config=small(), told=lambda line: None)
    with pytest.raises(InvalidInputError, match=r"holds no text encoder; it has touch\. .* convert the checkpoint"):
        UniTouchModel.from_pretrained(tmp_path / "model").load("text")


def test_weights_that_are_cut_off_are_told_with_their_file(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "model")
    weights = tmp_path / "model" / "model-touch.safetensors"
    weights.write_bytes(weights.read_bytes()[:-100])
    with pytest.raises(InvalidInputError, match=r"model-touch.safetensors` does not hold what it says"):
        UniTouchModel.from_pretrained(tmp_path / "model").load("touch")


def test_sounds_are_prepared_for_the_encoder(files, tmp_path):
    convert_published(tmp_path / "model", **files, config=small(), told=lambda line: None)
    processor = UniTouchProcessor.from_pretrained(tmp_path / "model")
    model = UniTouchModel.from_pretrained(tmp_path / "model")
    sound = torch.randn(16_000, generator=torch.Generator().manual_seed(0)).numpy()
    assert model.get_audio_features(processor.sounds((sound, 16_000))).shape == (1, 32)


def test_a_file_is_let_go_when_its_modalities_are_written(files, tmp_path, monkeypatch):
    opened, write = conversion.open_published, conversion.write_tensors
    held, seen = [], {}

    def open_and_watch(*arguments):
        config, parts = opened(*arguments)
        held.extend(weakref.ref(part) for part in parts)
        return config, parts

    def write_and_look(path, promises, written):
        write(path, promises, written)
        seen[path.name] = [part() is not None for part in held]

    monkeypatch.setattr(conversion, "open_published", open_and_watch)
    monkeypatch.setattr(conversion, "write_tensors", write_and_look)
    convert_published(tmp_path / "model", **files, config=small(), told=lambda line: None)
    assert seen["model-image.safetensors"] == [True, True] and seen["model-touch.safetensors"] == [False, True]


@pytest.mark.parametrize("order", [("touch", "imagebind"), ("imagebind", "touch")])
def test_files_converted_one_after_the_other_join(files, folder, tmp_path, order, contents):
    for name in order:
        convert_published(tmp_path / "joined", **{name: files[name]}, config=small(), told=lambda line: None)
    found = contents(tmp_path / "joined")
    assert {key: value for key, value in found.items() if key.endswith("safetensors")} == {
        key: value for key, value in contents(folder).items() if key.endswith("safetensors")
    }
    assert json.loads(found["model.safetensors.index.json"]) == json.loads(
        contents(folder)["model.safetensors.index.json"]
    )
    assert UniTouchModel.from_pretrained(tmp_path / "joined").config.logit_scales.keys() == {"text", "audio", "touch"}


def test_what_was_used_ignored_and_missed_is_told(files, tmp_path):
    lines: list[str] = []
    convert_published(tmp_path / "model", touch=files["touch"], config=small(), told=lines.append)
    used, ignored, missed = lines
    assert used.startswith("Used of last_new.ckpt: modality_heads.touch (3)") and "modality_trunks.touch (42)" in used
    assert (
        ignored.startswith("Ignored of last_new.ckpt: modality_heads.vision (3)")
        and "modality_heads.touch" not in ignored
    )
    assert missed.startswith("Missed: the image encoder; the text encoder; the audio encoder; sensor tokens")


def test_the_dtype_is_the_one_asked_for(files, tmp_path):
    convert_published(
        tmp_path / "half", touch=files["touch"], config=small(), dtype=torch.float16, told=lambda line: None
    )
    tensors = open_checkpoint("touch", tmp_path / "half" / "model-touch.safetensors").tensors
    assert {tensor.dtype for tensor in tensors.values() if tensor.is_floating_point()} == {torch.float16}


def test_a_tokenizer_comes_along(files, tmp_path, tokenizer_folder):
    convert_published(tmp_path / "model", imagebind=files["imagebind"], tokenizer=tokenizer_folder, config=small(),
                      told=lambda line: None)  # fmt: skip
    known = CLIPTokenizer.from_pretrained(tokenizer_folder)
    found = UniTouchProcessor.from_pretrained(tmp_path / "model").tokenizer
    assert found("rough brick").input_ids == known("rough brick").input_ids


# Refusals -------------------------------------------------------------------------------------------------------------


def nan(state):
    state["model.modality_trunks.touch.blocks.1.mlp.fc1.weight"][3, 5] = torch.nan


def missing(state):
    for number in range(3):
        del state[f"model.modality_trunks.touch.blocks.{number}.attn.bias_k"]


def misshapen(state):
    state["model.modality_heads.touch.2.weight"] = torch.zeros(32, 65)


def integers(state):
    state["model.modality_heads.touch.2.weight"] = torch.zeros(32, 64, dtype=torch.long)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (nan, ["`touch: modality_trunks.touch.blocks.1.mlp.fc1.weight` holds 1 of 16384 values that are NaN"]),
        (missing, ["`touch` names", "misses modality_trunks.touch.blocks.0.attn.bias_k;", "blocks.2.attn.bias_k"]),
        (misshapen, ["modality_heads.touch.2.weight of (32, 65), float32, for (32, 64)"]),
        (integers, ["modality_heads.touch.2.weight of (32, 64), int64, for (32, 64)"]),
        (lambda state: state.clear() or state.update(one=torch.ones(1)), ["and ", " more"]),
    ],
)
def test_files_of_another_network_change_nothing(files, tmp_path, change, words):
    file = edited(files, tmp_path, change)
    with pytest.raises(InvalidInputError) as caught:
        convert_published(tmp_path / "model", touch=file, config=small())
    assert not [word for word in words if word not in str(caught.value)], caught.value
    assert sorted(path.name for path in tmp_path.iterdir()) == ["edited.ckpt"]


def test_exchanged_files_are_told_by_what_they_lack(files, tmp_path):
    for name, other in (("touch", "imagebind"), ("imagebind", "touch")):
        with pytest.raises(InvalidInputError, match=rf"misses modality_.* It may be the one to pass as `{other}`"):
            convert_published(tmp_path / "model", **{name: files[other]}, config=small())
    assert not (tmp_path / "model").exists()


def test_something_has_to_come(tmp_path):
    with pytest.raises(InvalidInputError, match=r"Pass `touch`, `imagebind` or both"):
        convert_published(tmp_path / "model", config=small())


def test_a_full_disk_leaves_what_was_there(files, tmp_path, monkeypatch, contents):
    convert_published(tmp_path / "model", touch=files["touch"], config=small(), told=lambda line: None)
    before, write = contents(tmp_path), conversion.write_tensors

    def full(path, promises, written):
        write(path, dict(list(promises.items())[:3]), written)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(conversion, "write_tensors", full)
    with pytest.raises(InvalidInputError, match=r"`output` is .*No space left on device. Nothing was changed"):
        convert_published(tmp_path / "model", imagebind=files["imagebind"], config=small())
    assert contents(tmp_path) == before


def test_a_disk_that_is_too_small_is_told_before_anything_is_written(files, tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=1000))
    with pytest.raises(InvalidInputError, match=r"`output` is .*GB are needed"):
        convert_published(tmp_path / "model", touch=files["touch"], config=small())
    assert list(tmp_path.iterdir()) == []


def test_another_model_is_not_written_over(files, folder, tmp_path, contents):
    other = small().to_dict()
    other["sensors"] = ["digit"]
    (tmp_path / "model").mkdir()
    UniTouchConfig.from_dict(other).save_pretrained(tmp_path / "model")
    before = contents(tmp_path)
    with pytest.raises(InvalidInputError, match=r"holds another model"):
        convert_published(tmp_path / "model", touch=files["touch"], config=small())
    assert contents(tmp_path) == before


def test_an_index_never_leads_out_of_its_folder(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "model")
    (tmp_path / "model" / "model-touch.safetensors").rename(tmp_path / "outside.safetensors")
    index = tmp_path / "model" / "model.safetensors.index.json"
    index.write_text(index.read_text().replace("model-touch.safetensors", "../outside.safetensors"))
    with pytest.raises(InvalidInputError, match=r"'../outside.safetensors', which is not in its folder"):
        UniTouchModel.from_pretrained(tmp_path / "model", modalities=("touch",))


@pytest.fixture
def tokenizer_folder(tmp_path) -> Path:
    words = [
        "<|startoftext|>",
        "<|endoftext|>",
        *"abcdefghijklmnopqrstuvwxyz",
        *(f"{letter}</w>" for letter in "abcdefghijklmnopqrstuvwxyz"),
    ]
    (tmp_path / "words").mkdir()
    (tmp_path / "words" / "vocab.json").write_text(json.dumps({word: number for number, word in enumerate(words)}))
    (tmp_path / "words" / "merges.txt").write_text("#version: 0.2\n")
    CLIPTokenizer(str(tmp_path / "words" / "vocab.json"), str(tmp_path / "words" / "merges.txt")).save_pretrained(
        tmp_path / "tokenizer"
    )
    return tmp_path / "tokenizer"
