"""Files and folders that are written whole, watched at every rename and removal: a process that is killed there leaves
the old one or the new one, what cannot be written leaves the old one, and nothing else stays.
"""

import inspect
import json
import os
import re
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from diffusers import DiffusionPipeline
from safetensors.torch import save_file

from tests.helpers.damage import SETTINGS
from unitouch_gen.conditioning import EmbeddingBank
from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.files import (
    LARGEST_SETTINGS,
    READ_OPTIONS,
    allocate,
    as_path,
    check_file,
    check_writable,
    complete_folder,
    read_json,
    read_yaml,
    reading,
    replacing,
    running_system,
    write_file,
    writing_folder,
)


def put(file: Path, content: str, error: BaseException | None = None) -> None:
    """Writes a file; then raises an error, if one is given."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(content)
    if error is not None:
        raise error


def names(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


# Files ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("content", "data"), [("a ü\n", b"a \xc3\xbc\n"), (b"\xff\r\n", b"\xff\r\n"), ("", b"")])
def test_text_is_utf_8_and_bytes_stay_as_they_are(tmp_path: Path, content: str | bytes, data: bytes) -> None:
    file = write_file("output", tmp_path / "new" / "folder" / "file.json", content)
    assert file.read_bytes() == data and len(names(tmp_path)) == 3


@pytest.mark.parametrize(
    ("path", "said"),
    [("https://a.org/a.png", "an address"), ("none.png", "does not exist"), (".", "is a folder"), ("a" * 300, "")],
)
def test_what_is_no_file_is_refused_with_what_to_pass(path: str, said: str) -> None:
    with pytest.raises(InvalidInputError, match=f"^`file` .*{said}.*pass the path of"):
        check_file("file", path, "an image file")


def test_the_old_file_is_there_until_the_new_one_is_whole(tmp_path: Path) -> None:
    file = tmp_path / "picture.png"
    file.write_text("old")
    with replacing("output", file) as partial:
        partial.write_text("ne")
        assert file.read_text() == "old" and list(tmp_path.glob("*.png")) == [file]
        assert partial.suffix == ".png"  # by which libraries know the format
        partial.write_text("new")
    assert file.read_text() == "new" and names(tmp_path) == {"picture.png"}


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_write_that_fails_leaves_the_old_file_alone(tmp_path: Path, error: BaseException) -> None:
    file = tmp_path / "file"
    file.write_text("old")
    with pytest.raises((InvalidInputError, KeyboardInterrupt)), replacing("output", file) as partial:
        put(partial, "ne", error)
    assert file.read_text() == "old" and names(tmp_path) == {"file"}


def save_with_torch(place: Path) -> None:
    """What torch says of a disk that gets full after it has begun."""
    with (place / "weights.bin").open("wb") as file:
        write = file.write
        torch.save(torch.zeros(1000), SimpleNamespace(write=lambda data: write(data) if len(data) < 100 else full()))


def full() -> None:
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize(
    "save",
    [
        save_with_torch,
        lambda place: save_file({"a": torch.zeros(1)}, place / "no" / "folder"),
        lambda place: (place / "no" / "folder").write_text(""),
    ],
    ids=["torch", "safetensors", "python"],
)
def test_every_library_that_cannot_write_is_one_line(tmp_path: Path, save: Callable[[Path], object]) -> None:
    one_line = r"^`output` cannot be written to '.*'.*Nothing was changed.*$"
    with (
        pytest.raises(InvalidInputError, match=one_line) as caught,
        writing_folder("output", tmp_path / "new") as place,
    ):
        save(place)
    assert "\n" not in str(caught.value) and names(tmp_path) == set()


def test_a_folder_that_is_a_file_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InvalidInputError, match="file is a file"):
        write_file("output", tmp_path / "file" / "inside", "")


def test_a_folder_is_no_file(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    with pytest.raises(InvalidInputError, match="s a directory"):
        write_file("output", tmp_path / "folder", "")
    assert names(tmp_path) == {"folder"}


def test_a_name_as_long_as_names_may_be_can_be_written(tmp_path: Path) -> None:
    file = tmp_path / f"{'n' * 251}.txt"
    check_writable("output", file)
    write_file("output", file, "text")
    assert file.read_text() == "text"


def test_a_link_stays_one_and_its_file_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    for link, target in (("link", "disk/file"), ("other", "link"), ("first", "new/file")):
        (tmp_path / link).symlink_to(tmp_path / target)
    write_file("output", tmp_path / "other", "one")
    write_file("output", tmp_path / "first", "two")
    assert (tmp_path / "disk" / "file").read_text() == "one" and (tmp_path / "new" / "file").read_text() == "two"
    assert all((tmp_path / link).is_symlink() for link in ("link", "other", "first"))
    assert len(names(tmp_path)) == 7


def test_a_pipe_gets_what_is_written_and_stays(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with ThreadPoolExecutor() as pool:
        read = pool.submit(pipe.read_text)
        write_file("output", pipe, "text")
        assert read.result(timeout=60) == "text"
    assert pipe.is_fifo() and names(tmp_path) == {"pipe"}


@pytest.mark.parametrize("name", ["null", "link"])
def test_a_device_stays_one(tmp_path: Path, name: str) -> None:
    """One of our own, as root may replace those of the system."""
    if subprocess.run(["mknod", tmp_path / "null", "c", "1", "3"], capture_output=True, check=False).returncode:
        pytest.skip("only root makes devices")
    (tmp_path / "link").symlink_to(tmp_path / "null")
    check_writable("output", tmp_path / name)
    write_file("output", tmp_path / name, "text")
    assert (tmp_path / "null").is_char_device() and (tmp_path / "link").is_symlink()
    assert names(tmp_path) == {"null", "link"}


PRINT = """
from pathlib import Path
from unitouch_gen.files import check_writable, write_file
print("before")
check_writable("output", Path("/dev/stdout"))
write_file("output", Path("/dev/stdout"), "between\\n")
print("after")
"""


@pytest.mark.parametrize("to", ["a pipe", "a file"])
def test_standard_output_gets_it_between_what_is_printed(tmp_path: Path, to: str) -> None:
    with (tmp_path / "out").open("wb") as file:
        place = subprocess.PIPE if to == "a pipe" else file
        done = subprocess.run([sys.executable, "-c", PRINT], stdout=place, check=True)
    text = done.stdout if to == "a pipe" else (tmp_path / "out").read_bytes()
    assert text == b"before\nbetween\nafter\n" and names(tmp_path) == {"out"}


# Checked before any work ----------------------------------------------------------------------------------------------


def test_a_check_leaves_nothing_behind(tmp_path: Path) -> None:
    check_writable("output", tmp_path / "new" / "folder" / "file")
    (tmp_path / "file").write_text("old")
    check_writable("output", tmp_path / "file")
    assert names(tmp_path) == {"file"} and (tmp_path / "file").read_text() == "old"


@pytest.mark.parametrize(
    "file", ["folder", "file/inside", "/proc/file", "/proc/new/file", "/dev/null/file", f"{'n' * 300}/file"]
)
def test_what_cannot_be_written_is_told_before(tmp_path: Path, file: str) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("")
    with pytest.raises(InvalidInputError, match=r"^`output` cannot be written to .* changed; name another place"):
        check_writable("output", tmp_path / file)
    assert names(tmp_path) == {"folder", "file"}


def test_a_disk_that_is_too_small_is_told_before(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"1000000000000.0 MB are needed and .* MB free"):
        check_writable("output", tmp_path / "file", 10**18)
    too_much = writing_folder("output", tmp_path / "new", 10**18)
    with pytest.raises(InvalidInputError, match=r"1000000000000.0 MB are needed"), too_much:
        raise AssertionError("nothing is to be done")
    assert names(tmp_path) == set()


def test_room_is_really_taken(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"abc")
    os.truncate(tmp_path / "file", 2**20)
    allocate(tmp_path / "file", 2**20)
    found = (tmp_path / "file").stat()
    assert found.st_blocks * 512 >= 2**20 == found.st_size
    assert (tmp_path / "file").read_bytes()[:4] == b"abc\0"


# Several writers ------------------------------------------------------------------------------------------------------


def test_threads_that_write_different_files_write_their_own(tmp_path: Path) -> None:
    for _ in range(20):
        with ThreadPoolExecutor(8) as pool:
            list(pool.map(lambda name: write_file("output", tmp_path / "new" / name, name * 10_000), "abcdefgh"))
        assert {file.name: file.read_text() for file in (tmp_path / "new").iterdir()} == {
            name: name * 10_000 for name in "abcdefgh"
        }
        shutil.rmtree(tmp_path / "new")


def test_threads_that_write_the_same_file_leave_one_of_theirs(tmp_path: Path) -> None:
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda name: write_file("output", tmp_path / "file", name * 10_000), "abcdefgh" * 20))
    assert (tmp_path / "file").read_text() in {name * 10_000 for name in "abcdefgh"} and names(tmp_path) == {"file"}


@pytest.mark.parametrize("replace", [False, True])
def test_threads_that_write_the_same_folder_leave_one_of_theirs(tmp_path: Path, replace: bool) -> None:
    together = threading.Barrier(8)

    def write(name: str) -> None:
        together.wait()
        with writing_folder("output", tmp_path / "new", replace=replace) as place:
            for number in range(5):
                (place / f"{number}.json").write_text(name)

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(write, "abcdefgh" * 5))
    assert len({file.read_text() for file in (tmp_path / "new").iterdir()}) == 1
    assert names(tmp_path / "new") == {f"{number}.json" for number in range(5)}


WRITE = """
import sys
from pathlib import Path
from unitouch_gen.files import replacing
with replacing("output", Path(sys.argv[1])) as partial:
    partial.write_text("ne")
    print("writing", flush=True)
    input()
"""


def test_what_a_killed_writer_left_goes_at_once_and_what_a_living_one_writes_stays(tmp_path: Path) -> None:
    command = [sys.executable, "-c", WRITE, str(tmp_path / "file")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as writer:
        assert writer.stdout is not None and writer.stdout.readline() == b"writing\n"
        write_file("output", tmp_path / "other", "one")
        assert len(names(tmp_path)) == 3  # with its hidden folder and what is in that
        writer.kill()
    assert not (tmp_path / "file").exists() and len(names(tmp_path)) == 3
    write_file("output", tmp_path / "other", "two")
    assert names(tmp_path) == {"other"}


@pytest.mark.parametrize(
    ("name", "days", "goes"),
    [
        (f".unitouch-{running_system()}-a_1.partial", 0, True),
        (".unitouch-0123abcd-a_1.partial", 0, False),  # of another machine, whose locks are not seen
        (".unitouch-0123abcd-a_1.partial", 2, True),
        (".others-0123abcd-a_1.partial", 2, False),
        (".unitouch-notes.partial", 2, False),
    ],
)
def test_only_what_is_surely_left_goes(tmp_path: Path, name: str, days: int, goes: bool) -> None:
    (tmp_path / name).mkdir()
    (tmp_path / name / "cut").write_text("sho")
    then = time.time() - days * 24 * 60 * 60
    os.utime(tmp_path / name, (then, then))
    write_file("output", tmp_path / "file", "")
    assert (tmp_path / name).exists() != goes


# Folders --------------------------------------------------------------------------------------------------------------

WATCHERS: list[Callable[[], None]] = []


def _hook(event: str, _: tuple) -> None:
    if WATCHERS and event in ("os.rename", "shutil.rmtree", "os.remove", "os.rmdir", "os.mkdir"):
        check = WATCHERS.pop()  # what it does itself is not watched
        check()
        WATCHERS.append(check)


sys.addaudithook(_hook)  # sees each rename and removal of this process just before it happens


@contextmanager
def watched(check: Callable[[], None]) -> Iterator[None]:
    WATCHERS[:] = [check]
    try:
        yield
    finally:
        WATCHERS.clear()
    check()


SHARDED = {
    "unet/model.safetensors.index.json": json.dumps({"weight_map": {"a": "model-1.safetensors"}}),
    "unet/model-1.safetensors": "old",
}
OLD = {"index.json": "old", "unet/config.json": "old", "vae/weights": "old", "README.md": "theirs", "extra/own": "own"}
NEW = {"index.json": "new", "unet/config.json": "new", "vae/weights": "new", "unet/model.safetensors": "new"}


def write_tree(folder: Path, files: dict[str, str]) -> None:
    for name, content in files.items():
        put(folder / name, content)


def write(folder: Path, files: dict[str, str], **options: bool) -> None:
    with writing_folder("output", folder, **options) as place:
        write_tree(place, files)


def tree(folder: Path) -> dict[str, str]:
    return {str(file.relative_to(folder)): file.read_text() for file in folder.rglob("*") if file.is_file()}


def seen(folder: Path) -> dict[str, str]:
    """What a library looks at."""
    return {name: content for name, content in tree(folder).items() if not name.startswith(".")}


@pytest.mark.parametrize("replace", [False, True])
def test_whenever_it_is_killed_a_folder_is_the_old_or_the_new_one(tmp_path: Path, replace: bool) -> None:
    """At each rename and removal, a copy of the folder stands for what a process killed there would leave."""
    final, left, moments = tmp_path / "final", tmp_path / "left", list[bool]()
    old = {**OLD, **SHARDED, "vae/of before": "old"}
    new = {**OLD, **NEW} if replace else {**OLD, **NEW, "vae/of before": "old"}
    write_tree(final, old)

    def check() -> None:
        shutil.copytree(final, left)
        before = seen(left)
        if before not in (old, new):  # libraries refuse what has no settings
            assert not {"index.json", "unet/config.json"} <= set(before)
        complete_folder(left / "unet")
        for _ in range(2):
            assert seen(left) in (old, new)
            moments.append(seen(left) == new)
            write(left, {"other": ""})
            (left / "other").unlink()
            assert tree(left) == seen(left)  # nothing is left behind
        shutil.rmtree(left)

    with watched(check):
        write(final, NEW, replace=replace)
    assert len(moments) > 20 and moments == sorted(moments) and {*moments} == {False, True}
    assert tree(final) == new and names(tmp_path) == {"final", *(f"final/{name}" for name in names(final))}


def test_a_process_killed_as_it_completes_a_folder_is_made_good_for(tmp_path: Path) -> None:
    """The same for the kill of whoever does the rest."""
    folder, left = tmp_path / "folder", tmp_path / "left"
    write_tree(folder, {**OLD, **SHARDED})
    write_tree(folder / ".unitouch-adds", NEW)
    completed = []

    def check() -> None:
        shutil.copytree(folder, left)
        complete_folder(left)
        completed.append(tree(left))
        shutil.rmtree(left)

    with watched(check):
        complete_folder(folder / "unet")
    assert len(completed) > 5 and all(found == {**OLD, **NEW} for found in completed)


def test_what_is_half_replaced_and_cannot_be_completed_is_refused(tmp_path: Path) -> None:
    write_tree(tmp_path / ".unitouch-adds", {"file": "new", "other/file": "new"})  # others have removed its place
    with pytest.raises(InvalidInputError, match=f"`{tmp_path}` is half replaced, .*No such file"):
        complete_folder(tmp_path)


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), RuntimeError("broken")])
@pytest.mark.parametrize("replace", [False, True])
def test_what_fails_changes_nothing(tmp_path: Path, error: Exception, replace: bool) -> None:
    write_tree(tmp_path / "there", OLD)
    for name in ("there", "new/folder"):
        write = writing_folder("output", tmp_path / name, replace=replace)
        with pytest.raises((InvalidInputError, RuntimeError), match=str(error.args[-1])), write as place:
            put(place / "unet" / "config.json", "new", error)
    assert tree(tmp_path / "there") == OLD and [path.name for path in tmp_path.iterdir()] == ["there"]


def test_a_write_starts_from_an_empty_folder_and_may_hold_others(tmp_path: Path) -> None:
    write_tree(tmp_path / "final", OLD)
    with writing_folder("output", tmp_path / "final") as place:
        assert list(place.iterdir()) == []
        with writing_folder("output", place / "unet") as inner:
            (inner / "config.json").write_text("new")
        assert inner == place / "unet" and tree(tmp_path / "final")["unet/config.json"] == "old"
    assert tree(tmp_path / "final") == {**OLD, "unet/config.json": "new"}


def test_files_go_where_a_link_leads(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "disk")
    write(tmp_path / "link", NEW)
    assert (tmp_path / "link").is_symlink() and tree(tmp_path / "disk") == NEW


def test_files_of_a_folder_that_are_links_are_replaced(tmp_path: Path) -> None:
    """As in a cache of repositories, where other revisions share what they lead to."""
    put(tmp_path / "blob", "old")
    put(tmp_path / "folder" / "config.json", "old")
    (tmp_path / "folder" / "weights").symlink_to(tmp_path / "blob")
    write(tmp_path / "folder", {"weights": "new", "config.json": "new"})
    assert tree(tmp_path / "folder") == {"weights": "new", "config.json": "new"}
    assert (tmp_path / "blob").read_text() == "old"


def test_a_folder_that_is_there_needs_no_other(tmp_path: Path) -> None:
    """As one that is a disk of its own, from which nothing can be renamed into its parent."""
    output = tmp_path / "output"
    output.mkdir()
    with writing_folder("output", output) as place:
        assert list(tmp_path.iterdir()) == [output] and place.parent == output


def test_a_folder_in_the_place_of_a_file_changes_nothing(tmp_path: Path) -> None:
    write_tree(tmp_path, {"index.json": "old", "unet/config.json/sub": "old"})
    with pytest.raises(InvalidInputError, match=r"config.json is a folder there. Nothing was changed"):
        write(tmp_path, NEW)
    with pytest.raises(InvalidInputError, match=r"index.json is a file there. Nothing was changed"):
        write(tmp_path, {"index.json/sub": "new"}, replace=True)
    assert tree(tmp_path) == {"index.json": "old", "unet/config.json/sub": "old"}


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "model.pth").write_text("")
    with pytest.raises(InvalidInputError, match=r"`output` .*model.pth is a file"):
        write(tmp_path / "model.pth", NEW)
    assert (tmp_path / "model.pth").is_file()


INDEX, HALF_INDEX = "model.safetensors.index.json", "model.safetensors.index.fp16.json"


def weights(*shards: str, index: str = INDEX) -> dict[str, str]:
    return {**dict.fromkeys(shards, ""), index: json.dumps({"weight_map": {shard: shard for shard in shards}})}


@pytest.mark.parametrize(
    ("old", "new", "goes"),
    [
        ({"model.safetensors": ""}, weights("model-00001-of-00001.safetensors"), {"model.safetensors"}),
        (weights("model-touch.safetensors"), {"model.safetensors": ""}, {INDEX, "model-touch.safetensors"}),
        (weights("a.safetensors", "b.safetensors"), weights("a.safetensors"), {"b.safetensors"}),
        ({"a.safetensors": ""}, {**weights("a.safetensors", "b.safetensors"), "a.safetensors": ""}, set()),
        ({"model.safetensors": ""}, {"model.fp16.safetensors": ""}, set()),
        ({"model.fp16.safetensors": ""}, weights("model-1.safetensors"), set()),
        (weights("m.fp16-1.safetensors", index=HALF_INDEX), {"model.safetensors": ""}, set()),
        (
            weights("m.fp16-1.safetensors", index=HALF_INDEX),
            {"model.fp16.safetensors": ""},
            {HALF_INDEX, "m.fp16-1.safetensors"},
        ),
        ({INDEX: "damaged", "model-1.safetensors": ""}, {"model.safetensors": ""}, {INDEX}),
        ({INDEX: '{"weight_map": {"a": "../b"}}'}, {"model.safetensors": ""}, {INDEX}),
        ({"model-own.safetensors": "", "own.json": ""}, {"model.safetensors": "", "config.json": ""}, set()),
    ],
)
def test_weights_that_readers_would_take_for_new_ones_go(
    tmp_path: Path, old: dict[str, str], new: dict[str, str], goes: set[str]
) -> None:
    write_tree(tmp_path, old)
    write(tmp_path, {**new, "config.json": ""})
    assert set(tree(tmp_path)) == ({*old, *new, "config.json"} - goes)


# Reading --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("damage", SETTINGS)
@pytest.mark.parametrize("read", [read_json, read_yaml])
def test_settings_that_cannot_be_read_are_refused_by_their_file(tmp_path, read, damage):
    (tmp_path / "config.json").write_text('{"a": 1}')
    assert read("config", tmp_path / "config.json") == {"a": 1}
    SETTINGS[damage](tmp_path / "config.json")
    with pytest.raises(InvalidInputError, match=rf"`config` names '{tmp_path}/config\.json', which "):
        read("config", tmp_path / "config.json")


def test_settings_are_read_to_a_bound(tmp_path):
    """Some files say that they hold nothing, and never end; this one has holes alone."""
    with (tmp_path / "config.json").open("wb") as file:
        file.truncate(LARGEST_SETTINGS + 1)
    with pytest.raises(InvalidInputError, match=rf"has {LARGEST_SETTINGS + 1} bytes"):
        read_json("config", tmp_path / "config.json")


@pytest.mark.parametrize("claimed", [{"layers_per_block": 10**9}, {"blocks": [{"num_layers": 2000}]}, {"size": 10**12}])
def test_settings_of_networks_that_could_not_be_built_are_refused(tmp_path, claimed):
    (tmp_path / "unet").mkdir()
    (tmp_path / "unet" / "config.json").write_text(json.dumps(claimed))
    with (
        pytest.raises(InvalidInputError, match=r"`model` is .*config\.json.*at most"),
        reading("model", tmp_path),
    ):
        pytest.fail("it was read")


@pytest.mark.parametrize(
    "claimed",
    [
        {"freq_shift": None},
        {"norm_eps": []},
        {"act_fn": 3},
        {"norm_num_groups": -1},
        {"downsample_padding": True},
        {"norm_num_groups": True},
        {"attention_head_dim": True},
        {"layers_per_block": [1, False]},
    ],
    ids=lambda claimed: next(iter(claimed)),
)
def test_settings_of_another_kind_than_declared_are_refused(tmp_path, claimed):
    (tmp_path / "config.json").write_text(json.dumps({"_class_name": "UNet2DConditionModel", **claimed}))
    with (
        pytest.raises(InvalidInputError, match=rf"says that `{next(iter(claimed))}` is .*; it has to be "),
        reading("model", tmp_path),
    ):
        pytest.fail("it was read")


def test_errors_of_readers_become_one_that_names_the_argument(tmp_path):
    def broken():
        with reading("model", tmp_path):
            raise KeyError("weight")

    with pytest.raises(InvalidInputError, match=rf"`model` is '{tmp_path}', which cannot be loaded: 'weight'"):
        broken()


def test_an_error_that_names_the_argument_stays_as_it_is(tmp_path):
    error = InvalidInputError("`model` is too old")
    with pytest.raises(InvalidInputError) as caught, reading("model", tmp_path):
        raise error
    assert caught.value is error


def test_options_of_readers_are_those_of_diffusers():
    """As its source has them: what it does not know it would ignore, with a line on standard error."""
    taken = set(re.findall(r'kwargs\.pop\("(\w+)"', inspect.getsource(DiffusionPipeline.from_pretrained)))
    assert len(taken) > 15 and taken <= set(READ_OPTIONS)


@pytest.mark.parametrize("place", ["a\0b", "\ud800", "x" * 5000])
def test_what_no_file_can_be_called_is_refused_by_name(place):
    with pytest.raises(InvalidInputError, match=r"`path` is .*, no path at all") as caught:
        as_path("path", place)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize("place", [None, 3, b"folder", ["folder"]])
def test_what_is_no_path_is_refused_by_name(place):
    with pytest.raises(InvalidTypeError, match="`save_directory` is"):
        EmbeddingBank(1, 2).save_pretrained(place)


@pytest.mark.parametrize("place", ["gone", "gone/\udcff", "/dev/null", "."])
def test_paths_may_lead_to_nothing(place):
    assert as_path("path", place) == Path(place)


@pytest.mark.parametrize("variant", ["", "a.b", "../a", "a\nb", "x" * 5000, 16, {}])
def test_a_variant_is_a_word(variant, tmp_path):
    with pytest.raises((InvalidInputError, InvalidTypeError), match="`variant` is"):
        EmbeddingBank(1, 2).save_pretrained(tmp_path / "bank", variant=variant)
    assert not any(tmp_path.iterdir())
