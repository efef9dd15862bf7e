"""Files and folders are whole or not there, and what cannot be read or written is one error that names the argument."""

import os
import shutil
import subprocess
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import product
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from tests.helpers.processes import Child, finished
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.files import check_writable, filling, is_unfinished, read_table, reading, replacing, write_file


def names(folder: Path) -> set[str]:
    return {str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file()}


def test_a_file_takes_its_place_when_it_is_whole(tmp_path):
    file = write_file("output", tmp_path / "new" / "a.txt", "old")
    with replacing("output", file) as partial:
        partial.write_text("new")
        assert file.read_text() == "old" and partial.name == "a.txt"
    assert file.read_text() == "new" and names(tmp_path) == {"new/a.txt"}


def test_a_write_that_fails_leaves_the_old_file_or_folder_and_nothing_else(tmp_path):
    file = write_file("output", tmp_path / "model" / "a.txt", "old")
    with pytest.raises(RuntimeError), replacing("output", file) as partial:  # noqa: PT012
        partial.write_text("half")
        raise RuntimeError
    for folder in ("model", "new"):
        with pytest.raises(RuntimeError), filling("output", tmp_path / folder) as place:  # noqa: PT012
            write_file("x", place / "a.txt", "half")
            raise RuntimeError
    assert file.read_text() == "old" and names(tmp_path) == {"model/a.txt"}
    assert [path.name for path in tmp_path.iterdir()] == ["model"]


def fill(folder: Path, content: str = "new", parts: Sequence[str] = ("a.txt", "part/b.json")) -> None:
    with filling("output", folder) as place:
        for part in parts:
            write_file("x", place / part, content)


def test_a_link_stays_one(tmp_path):
    file = write_file("output", tmp_path / "a.txt", "old")
    (tmp_path / "link").symlink_to(file)
    write_file("output", tmp_path / "link", "new")
    assert (tmp_path / "link").is_symlink() and file.read_text() == "new"


def test_what_cannot_be_written_names_its_argument_and_checking_leaves_nothing(tmp_path):
    check_writable("output", tmp_path / "new" / "a.txt")
    assert not list(tmp_path.iterdir())
    (tmp_path / "folder").mkdir()
    write_file("output", tmp_path / "file", "")
    for place, write in product(("folder", "file/a.txt"), (check_writable, partial(write_file, content=""))):
        with pytest.raises(InvalidInputError, match=r"`output` cannot be written to .*Nothing was changed"):
            write("output", tmp_path / place)


def test_a_folder_that_is_filled_keeps_everything_else(tmp_path, monkeypatch):
    """The folder itself, its mode, links and empty folders in it, and files of others; also as the working folder."""
    folder, elsewhere = tmp_path / "model", tmp_path / "elsewhere"
    write_file("x", folder / "mine.txt", "mine")
    write_file("x", elsewhere / "a.txt", "theirs")
    (folder / ".git" / "refs").mkdir(parents=True)
    (folder / "part").symlink_to(elsewhere)
    (folder / "a.txt").symlink_to(elsewhere / "a.txt")
    folder.chmod(0o2770)
    before = folder.stat()
    monkeypatch.chdir(folder)
    fill(Path())
    assert (folder.stat().st_ino, folder.stat().st_mode) == (before.st_ino, before.st_mode)
    assert Path.cwd() == folder and (folder / ".git" / "refs").is_dir() and (folder / "part").is_symlink()
    assert (folder / "mine.txt").read_text() == "mine"
    # What a link points to is not written through; a folder behind one is the user's way to say where files go.
    assert (elsewhere / "a.txt").read_text() == "theirs" and (folder / "a.txt").read_text() == "new"
    assert names(folder) == {"mine.txt", "a.txt"} and names(elsewhere) == {"a.txt", "b.json"}


def test_files_get_the_mode_that_new_files_get_there(tmp_path):
    """safetensors alone writes files that nobody else may read."""
    before = os.umask(0o027)
    try:
        with filling("output", tmp_path / "model") as place:
            save_file({"a": torch.ones(2)}, place / "a.safetensors")
        with replacing("output", tmp_path / "b.safetensors") as partial:
            save_file({"b": torch.ones(2)}, partial)
    finally:
        os.umask(before)
    files = (tmp_path / "model" / "a.safetensors", tmp_path / "b.safetensors")
    assert [file.stat().st_mode & 0o777 for file in files] == [0o640, 0o640]


@pytest.fixture
def mounted(tmp_path):
    """A folder of the machine that is mounted inside a model's folder, and that folder."""
    host, inside = tmp_path / "host", tmp_path / "model" / "part"
    write_file("x", host / "precious.txt", "theirs")
    inside.mkdir(parents=True)
    if shutil.which("mount") is None or subprocess.run(["mount", "--bind", host, inside], check=False).returncode:
        pytest.skip("folders cannot be mounted without rights")
    yield host, inside
    subprocess.run(["umount", inside], check=True)


def test_a_mounted_folder_keeps_its_files_and_may_be_written_to(mounted):
    host, inside = mounted
    fill(inside.parent)
    assert names(host) == {"precious.txt", "b.json"} and names(inside.parent) == {
        "a.txt", "part/precious.txt", "part/b.json",
    }  # fmt: skip
    fill(inside)  # a mount by itself, which no rename can replace
    assert (host / "a.txt").read_text() == "new" and (host / "precious.txt").read_text() == "theirs"


def test_a_folder_in_the_place_of_a_file_is_refused_before_anything_changes(tmp_path):
    write_file("x", tmp_path / "a.txt", "old")
    (tmp_path / "z" / "c.txt").mkdir(parents=True)
    (tmp_path / "file").touch()
    for part in ("z/c.txt", "file/d.txt"):
        with pytest.raises(InvalidInputError, match=r"`output` cannot be written to .* Nothing was changed"):
            fill(tmp_path, parts=("a.txt", "new/b.txt", part))
    assert {path.name for path in tmp_path.iterdir()} == {"a.txt", "z", "file"}
    assert (tmp_path / "a.txt").read_text() == "old"


def test_a_name_that_libraries_cannot_write_is_one_line(tmp_path):
    folder = tmp_path / "na\udcffme"  # bytes that are not UTF-8, as Python has them
    with pytest.raises(InvalidInputError, match=r"`output` cannot be written to .*surrogates"):  # noqa: SIM117
        with filling("output", folder):
            str(folder).encode()
    assert list(tmp_path.iterdir()) == []


def test_a_killed_save_leaves_the_old_files_or_the_new_ones_or_a_folder_that_is_refused(tmp_path):
    """Wherever the process is killed, files of two saves are never read as one model; the next save mends it."""
    folder = tmp_path / "model"
    fill(folder, "old")
    changes = finished(Child(fill, folder, "old", folder=tmp_path)).changes
    states = set()
    for killed_at in range(1, changes + 1):
        assert Child(fill, folder, "new", folder=tmp_path, killed_at=killed_at).wait() == -9
        if is_unfinished(folder):
            states.add("unfinished")
            with pytest.raises(InvalidInputError, match=r"`model` is .*a save into it is under way or was cut off"):
                reading("model", folder).__enter__()
        else:
            one, other = (folder / "a.txt").read_text(), (folder / "part" / "b.json").read_text()
            assert one == other
            states.add(one)
        fill(folder, "old")
        assert not is_unfinished(folder) and (folder / "part" / "b.json").read_text() == "old"
    assert states == {"old", "unfinished", "new"}


def test_of_two_saves_at_once_one_is_there(tmp_path):
    def fill_again(content: str) -> None:
        for _ in range(20):
            fill(tmp_path / "model", content)

    with ThreadPoolExecutor() as pool:
        list(pool.map(fill_again, ("one", "two")))
    one, other = (tmp_path / "model" / "a.txt").read_text(), (tmp_path / "model" / "part" / "b.json").read_text()
    assert one == other and names(tmp_path / "model") == {"a.txt", "part/b.json"}


def test_whatever_a_library_raises_is_one_error_and_one_that_names_its_argument_stays(tmp_path):
    with pytest.raises(InvalidInputError, match=r"`model` is .*cannot be loaded: broken$"), reading("model", tmp_path):
        raise RuntimeError("broken\nmore")
    with pytest.raises(InvalidInputError, match=r"^`model` is cut off$"), reading("model", tmp_path):
        raise InvalidInputError("`model` is cut off")
    with pytest.raises(InvalidInputError, match=r"^`--model` is .*, which cannot be loaded: no file$"):  # noqa: SIM117
        with reading("--model", tmp_path), reading("pretrained_model_name_or_path", tmp_path):
            raise OSError("no file")


@pytest.mark.parametrize(
    "content",
    [
        "Touch,Seed\na.png,1\n\n", "touch;seed\r\na.png;1\r\n", "touch\tseed\ra.png\t1\r", "sep=;\ntouch;seed\na.png;1",
        "touch,seed,,\na.png,1,,\n,,,", '"sep=|"\ntouch|seed\n"a.png"|1', "\n touch , seed\na.png, 1",
        ",touch,seed\n0,a.png,1",
    ],
)  # fmt: skip
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_tables_are_read_as_spreadsheets_write_them(tmp_path, content, encoding):
    (tmp_path / "list.csv").write_bytes(content.encode(encoding))
    assert read_table(tmp_path / "list.csv") == [{"touch": "a.png", "seed": "1"}]


def test_what_is_no_table_is_refused(tmp_path):
    for content, words in (
        (b"a,b\n1\n", "other columns in row 1"), (b"a,a\n1,2", "two of one name"), (b"a,b", "no rows"),
        (b'a\n"b', "is no table: .*line 2"), ("käfer\n1".encode("cp1252"), "save it as UTF-8"),
    ):  # fmt: skip
        (tmp_path / "list.csv").write_bytes(content)
        with pytest.raises(InvalidInputError, match=words):
            read_table(tmp_path / "list.csv")
