"""Files and folders that cannot be read or built on: each is refused by name, and nothing is written or run."""

import json
import re
import shutil
import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file, save_file

from tests.helpers.components import AUDIO, clip_tokenizer, joint_config, make_language_parts
from tests.helpers.damage import SETTINGS, WEIGHTS, chunk, encoded
from tests.helpers.layouts import (
    ONE,
    THREE,
    TWO,
    feeling_of_success,
    object_folder,
    ssvtp,
    table,
    tacquad,
    touch_and_go,
    write,
    ycb_slide,
)
from tests.helpers.published import published, sizes
from tests.helpers.refusals import check_refusal
from tests.helpers.touch_llm import files_of as touch_llm_files
from unitouch_gen.convert import convert_published, open_checkpoint
from unitouch_gen.convert_llm import read_touch_llm
from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.files import read_table, reading
from unitouch_gen.models import UniTouchConfig, UniTouchModel, UniTouchProcessor, UniTouchViTConfig
from unitouch_gen.models.images import load_images
from unitouch_gen.models.sounds import load_sounds
from unitouch_gen.models.videos import read_video
from unitouch_gen.training.data import open_dataset
from unitouch_gen.world import press

PLACE = "pretrained_model_name_or_path"
PICTURE = Image.fromarray(np.random.default_rng(0).integers(0, 256, (24, 20, 3), dtype=np.uint8))

# Images, sounds, height maps and tables -------------------------------------------------------------------------------


def palette() -> bytes:
    """A picture with a palette and a transparent colour, without which it would be another one."""
    image = PICTURE.quantize(16)
    image.info["transparency"] = 0
    return encoded(image)


def huge() -> bytes:
    """A PNG that claims more pixels than can be decoded."""
    whole = encoded(PICTURE)
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 20_000, 20_000, 1, 0, 0, 0, 0))
    return whole[:8] + header + whole[33:]


UNREADABLE = "cannot be read as an image"
IMAGES = [
    ("empty.png", b"", rf"{UNREADABLE} \(an empty file\)"),
    ("text.png", b"not an image", rf"{UNREADABLE} \(text\)"),
    ("page.png", b"<!DOCTYPE html><html></html>", rf"{UNREADABLE} \(a web page\)"),
    ("header.png", b"\x89PNG\r\n\x1a\n", UNREADABLE),
    ("bomb.png", encoded(Image.new("1", (9_000, 8_000))), "at most 64,000,000"),
    ("huge.png", huge(), "400000000 pixels.* pass a smaller one"),
    ("cut.png", encoded(PICTURE)[:-200], UNREADABLE),
    ("cut.jpg", encoded(PICTURE, "jpeg")[:-200], UNREADABLE),
    ("without_palette.png", palette().replace(b"PLTE", b"pLTE"), UNREADABLE),
    ("without_transparency.png", palette().replace(b"tRNS", b"tRNs"), UNREADABLE),
]


@pytest.mark.parametrize(("name", "content", "said"), [pytest.param(*row, id=row[0]) for row in IMAGES])
def test_files_that_are_no_images_are_refused(tmp_path, monkeypatch, name, content, said):
    """By a path that begins with `~`, the home folder."""
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / name).write_bytes(content)
    check_refusal(partial(load_images, "touch", f"~/{name}"), "touch", said)


def test_deep_tiffs_that_pillow_misreads_are_refused(tmp_path):
    """One of planes, and one whose zero is white, by the tags of TIFF 6.0."""
    for tag, value in ((284, 2), (262, 0)):
        Image.fromarray(np.zeros((32, 32), np.uint16)).save(tmp_path / "deep.tif", tiffinfo={tag: value})
        read = partial(load_images, "touch", tmp_path / "deep.tif")
        check_refusal(read, "touch", "names .*deep.tif.* with white as zero, which Pillow misreads")


@pytest.mark.parametrize("content", [b"", b"not a sound", b"RIFF\0\0\0\0WAVE", encoded(PICTURE)])
def test_files_that_are_no_sounds_are_refused(tmp_path, content):
    (tmp_path / "hit.wav").write_bytes(content)
    read = partial(load_sounds, "audio", tmp_path / "hit.wav")
    check_refusal(read, "audio", r"names .*hit\.wav.*cannot be read as a sound \(")


def test_files_that_are_no_height_maps_are_refused(tmp_path):
    (tmp_path / "words.png").write_text("no picture")
    (tmp_path / "map.exr").write_bytes(b"\x76\x2f\x31\x01" + bytes(64))
    np.save(tmp_path / "objects.npy", np.array([{}]), allow_pickle=True)
    Image.new("L", (10_000, 10_000)).save(tmp_path / "large.png")
    for name, said in (
        ("words.png", "cannot be read as an image"),
        ("map.exr", "save it as a PNG of 8 or 16 bits, a float TIFF"),
        ("objects.npy", "allow_pickle"),
        ("large.png", "is 10000 x 10000 pixels"),
    ):
        check_refusal(partial(press, tmp_path / name), "height", f"names '.*{name}'.*{said}")


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"a,b\n1\n", "another number of columns in row 1"),
        (b"a,a\n1,2", "two columns of one name"),
        (b"a,b", "no rows"),
        (b'a\n"b', "is no table: .*line 2"),
        ("k\xe4fer\n1".encode("cp1252"), "save it as UTF-8"),
    ],
)
def test_files_that_are_no_tables_are_refused(tmp_path, content, said):
    (tmp_path / "list.csv").write_bytes(content)
    check_refusal(partial(read_table, tmp_path / "list.csv"), None, "list.csv", said)


def test_git_lfs_pointers_are_refused(tmp_path):
    """As `git clone` leaves one without Git LFS: https://github.com/git-lfs/git-lfs/blob/main/docs/spec.md"""
    digest = "4d7a214614ab2935c943f9e0ff69d22eadbb8f32b1258daaa5e2ca24d17e2393"
    pointer = f"version https://git-lfs.github.com/spec/v1\noid sha256:{digest}\nsize 12345\n"

    def load_pipeline(weights: Path) -> None:
        with reading("--model", weights.parents[1]):
            load_file(weights)

    readers: dict[str, tuple[str | None, Callable]] = {
        "touch.png": ("touch", partial(load_images, "touch")),
        "touch.npy": ("touch", partial(load_images, "touch")),
        "hit.wav": ("audio", partial(load_sounds, "audio")),
        "press.mp4": ("touch", lambda file: next(read_video("touch", file))),
        "last.ckpt": ("touch", partial(open_checkpoint, "touch")),
        "labels.csv": (None, read_table),
        "model.safetensors": (PLACE, lambda file: UniTouchModel.from_pretrained(file.parent)),
        "unet/diffusion_pytorch_model.safetensors": ("--model", load_pipeline),
    }
    UniTouchConfig().save_pretrained(tmp_path)
    for name, (argument, read) in readers.items():
        file = tmp_path / name
        file.parent.mkdir(exist_ok=True)
        file.write_text(pointer)
        said = r"is a Git LFS pointer.*; run `git lfs pull` in its repository\."
        check_refusal(partial(read, file), argument, said)


# Folders of models ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def joint(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Folders of a joint space with its processor, by the size of the shards of its weights."""
    model = UniTouchModel(joint_config(clip_tokenizer()))
    processor = UniTouchProcessor(image_size=32, audio=AUDIO, tokenizer=clip_tokenizer())
    place = tmp_path_factory.mktemp("joint")
    for size in ("1GB", "20KB"):
        model.save_pretrained(place / size, max_shard_size=size)
        processor.save_pretrained(place / size)
    return lambda size: place / size


def read_touch(folder: Path) -> None:
    UniTouchModel.from_pretrained(folder, modalities=("touch",))


def copied(folder: Path, place: Path) -> Path:
    shutil.rmtree(place, ignore_errors=True)
    return Path(shutil.copytree(folder, place))


def test_places_that_hold_no_model_are_refused(joint):
    folder = joint("1GB")
    for place, said in {
        f"{folder}/nothing/here": "no folder",
        f"{folder}/..": r"config\.json', which does not exist",
        "x" * 5000: "is",
        3: "3",
        "a\0b": "the path of a file or folder",
        f"{folder}/config.json": "no folder; pass one",
        "user/no-such-model": "no repository that can be fetched",
    }.items():
        read = partial(UniTouchModel.from_pretrained, place, local_files_only=True)
        check_refusal(read, PLACE, f"(is|names) .*{said}")


@pytest.mark.parametrize("damage", WEIGHTS)
@pytest.mark.parametrize("size", ["1GB", "20KB"])
def test_damaged_weights_are_named_by_their_file(joint, tmp_path, size, damage):
    folder = copied(joint(size), tmp_path / "model")
    index = folder / "model.safetensors.index.json"
    names = json.loads(index.read_text())["weight_map"] if index.is_file() else {}
    name = names.get("touch_model.position", "model.safetensors")
    WEIGHTS[damage](folder / name)
    with pytest.raises(InvalidInputError, match=f"{folder}.*{name}"):
        read_touch(folder)


@pytest.mark.parametrize("damage", SETTINGS)
def test_damaged_settings_are_named_by_their_place(joint, tmp_path, damage):
    for file, kind in (
        ("config", UniTouchModel),
        ("preprocessor_config", UniTouchProcessor),
        ("tokenizer", UniTouchProcessor),
        ("tokenizer_config", UniTouchProcessor),
    ):
        folder = copied(joint("1GB"), tmp_path / file)
        SETTINGS[damage](folder / f"{file}.json")
        check_refusal(partial(kind.from_pretrained, folder), PLACE, re.escape(str(folder)))


def test_an_index_that_leads_out_of_its_folder_is_refused(joint, tmp_path):
    folder = copied(joint("20KB"), tmp_path / "model")
    index = folder / "model.safetensors.index.json"
    next(folder.glob("model-*.safetensors")).rename(tmp_path / "outside.safetensors")
    names = json.loads(index.read_text())["weight_map"]
    index.write_text(json.dumps({"weight_map": dict.fromkeys(names, "../outside.safetensors")}))
    with pytest.raises(InvalidInputError, match=rf"{folder}/outside.safetensors', which does not exist"):
        read_touch(folder)


def test_stored_settings_that_nothing_can_be_built_from_are_refused(joint, tmp_path):
    for kind, file, changes, said in (
        (UniTouchViTConfig, "config", {"hidden_size": "wide"}, "hidden_size"),
        (UniTouchConfig, "config", {"sensor_tokens": 0}, "sensor_tokens"),
        (UniTouchProcessor, "preprocessor_config", {"image_size": "big"}, "`image_size` is 'big'"),
    ):
        folder = tmp_path / kind.__name__
        if kind is UniTouchProcessor:
            copied(joint("1GB"), folder)
        else:
            kind().save_pretrained(folder)
        path = folder / f"{file}.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | changes))
        with pytest.raises((InvalidInputError, InvalidTypeError), match=said):
            kind.from_pretrained(folder)


def test_places_that_hold_no_processor_are_refused(tmp_path):
    for place in (f"{tmp_path}/nothing", str(tmp_path), "user/no-such-processor", "spaces in it"):
        read = partial(UniTouchProcessor.from_pretrained, place, local_files_only=True)
        check_refusal(read, PLACE, f"is '{place}'")


# Published files ------------------------------------------------------------------------------------------------------


def test_published_files_that_are_exchanged_or_left_out_are_refused(tmp_path):
    files, _ = published(tmp_path, sizes())
    convert = partial(convert_published, tmp_path / "model")
    for name, other in (("touch", "imagebind"), ("imagebind", "touch")):
        exchanged = partial(convert, **{name: files[other]}, config=sizes())
        check_refusal(exchanged, "touch", "is for UniTouch's last_new.ckpt")
    check_refusal(partial(convert, config=sizes()), "touch", "Pass at least one of `imagebind`, `touch`")
    named = partial(convert, touch=files["touch"], config=UniTouchConfig(sensors=["digit"]))
    check_refusal(named, "config.sensors", "has no effect on published files")
    assert not (tmp_path / "model").exists()


NO_CHECKPOINT: dict[str, Callable[[Path], Any]] = {
    "empty": lambda file: file.write_bytes(b""),
    "text": lambda file: file.write_bytes(b"these are no weights\n" * 10),
    "archive": lambda file: file.write_bytes(b"PK\x03\x04" + bytes(200)),
    "missing": lambda file: None,
    "a tensor": lambda file: torch.save(torch.ones(3), file),
    "numbers": lambda file: torch.save({"state_dict": {"epoch": 1}}, file),
}


@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
@pytest.mark.parametrize("kind", NO_CHECKPOINT)
def test_files_that_are_no_checkpoints_are_refused(tmp_path, suffix, kind):
    file = tmp_path / f"{kind}{suffix}"
    NO_CHECKPOINT[kind](file)
    said = f"names .*{kind}.*(be read|does not exist|no weights)"
    check_refusal(partial(open_checkpoint, "touch", file), "touch", said)


@pytest.fixture
def llama(tmp_path) -> tuple[Path, Path]:
    """The folder of a LLaMA, and Touch-LLM's checkpoint."""
    folder = tmp_path / "llama"
    tokenizer = make_language_parts()["tokenizer"]
    tokenizer.save_pretrained(folder)
    touch_llm_files(folder, len(tokenizer), legacy=False)
    return folder, folder.with_suffix(".pth")


def test_folders_without_a_llama_in_transformers_layout_are_refused(llama, tmp_path):
    folder, bridge = llama
    (folder / "config.json").rename(folder / "params.json")
    for place in (folder, tmp_path):
        said = f"'{re.escape(str(place))}.*transformers' layout"
        check_refusal(partial(read_touch_llm, bridge, place), "llama", said)


def test_a_llama_that_is_not_whole_is_refused(llama, tmp_path):
    folder, bridge = llama
    read = partial(read_touch_llm, bridge, folder)
    (folder / "tokenizer.json").rename(tmp_path / "tokenizer.json")
    check_refusal(read, "llama", r"holds no tokenizer\.json")
    (tmp_path / "tokenizer.json").rename(folder / "tokenizer.json")
    (file,) = folder.glob("*.safetensors")
    state = {key: value for key, value in load_file(file).items() if "up_proj" not in key}
    save_file(state, file, metadata={"format": "pt"})
    check_refusal(read, "llama", r"lacks 2 tensors, such as .*mlp\.up_proj")


# Data sets ------------------------------------------------------------------------------------------------------------

BROKEN = [
    (touch_and_go, {f"dataset/{ONE}/gelsight_frame": None}, r"1 of 6 files are not there: .*gelsight_frame/0+\.jpg"),
    (touch_and_go, {f"dataset/{name}/gelsight_frame": None for name in (ONE, TWO, THREE)}, r"run .* extract_frame\.py"),
    (ycb_slide, {"real/004_box/dataset_1/frames": None}, r"has no images; .* run: .*ffmpeg"),
    (touch_and_go, {"test.txt": f"{ONE}/0000000000.jpg,3\n"}, r"train.txt and test.txt both list .*00\.jpg"),
    (touch_and_go, {"label.txt": f"{ONE}/0.jpg;3\n"}, r"label\.txt' has '.*;3'; a line is recording/frame"),
    (feeling_of_success, {"calandra_corl2017_001.h5": "gone"}, r"_001\.h5' is no list of attempts"),
    (object_folder, {"label.json": '{"7": "wood", "101": 7}'}, "no label from 0 to 6 for the objects 101; 7"),
    (object_folder, {"split.json": '{"train": [["7", 0]], "test": [["7", 0]]}'}, "several records of one id: 7/0"),
    (ssvtp, {"test.csv": "url\nimages_rgb/image_1_rgb.jpg\n"}, r"image_1_rgb\.jpg', which is in another split"),
    (tacquad, {"contact_indoor.csv": "mug,2,12,0,1,3,3"}, "has 12 images, but contact from 2 to 12"),
    (table, {"labels.csv": "tuoch,material\na.png,wood\n"}, r"columns \['tuoch', 'material'\], and none of touch"),
    (table, {"labels.csv": "touch,split\na.png,training\n"}, "has the split 'training'"),
    (table, {"more.csv": ""}, r"2 tables, labels\.csv; more\.csv; leave one"),
    (lambda folder: None, {"a/b/c/d/1.png": 1}, r"it has no touches where they are expected: MATERIAL/x\.png"),
]


@pytest.mark.parametrize(("make", "damage", "said"), BROKEN)
def test_data_sets_that_are_broken_are_refused(tmp_path, make, damage, said):
    make(tmp_path)
    write(tmp_path, damage)
    check_refusal(partial(open_dataset, tmp_path), "path", f"`path` is .*, read as .*{said}")
