"""Folders of models: nothing in them is lost, whatever is there, fails, is killed, or is saved at the same time."""

import json
import os
import shutil
import subprocess
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from tests.helpers.processes import Child, finished
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.files import UNFINISHED, is_unfinished, reading, replacing, write_file
from unitouch_gen.saving import filling


def names(folder: Path) -> set[str]:
    return {str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file()}


def fill(folder: Path, content: str = "new", parts: Sequence[str] = ("a.txt", "part/b.json")) -> None:
    with filling("output", folder) as place:
        for part in parts:
            write_file("x", place / part, content)


def test_a_save_that_fails_leaves_the_old_folder_and_nothing_else(tmp_path):
    fill(tmp_path / "model", "old")
    for folder in ("model", "new"):
        with pytest.raises(RuntimeError), filling("output", tmp_path / folder) as place:  # noqa: PT012
            write_file("x", place / "a.txt", "half")
            raise RuntimeError
    assert names(tmp_path) == {"model/a.txt", "model/part/b.json"}
    assert (tmp_path / "model" / "a.txt").read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["model"]


def test_a_folder_that_is_filled_keeps_everything_else(tmp_path, monkeypatch):
    """The folder itself, its mode, links and empty folders in it, and files of others; also as the working folder."""
    folder = tmp_path / "model"
    elsewhere = tmp_path / "elsewhere"
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
    assert Path.cwd() == folder
    assert (folder / ".git" / "refs").is_dir()
    assert (folder / "part").is_symlink()
    assert (folder / "mine.txt").read_text() == "mine"
    # What a link points to is not written through; a folder behind one is the user's way to say where files go.
    assert (elsewhere / "a.txt").read_text() == "theirs"
    assert (folder / "a.txt").read_text() == "new"
    assert names(folder) == {"mine.txt", "a.txt"}
    assert names(elsewhere) == {"a.txt", "b.json"}


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
    files[1].chmod(0o600)  # a file that is replaced keeps its own
    write_file("x", files[1], "new")
    assert files[1].stat().st_mode & 0o777 == 0o600


@pytest.fixture
def mounted(tmp_path):
    """A folder of the machine that is mounted inside a model's folder, and that folder."""
    host = tmp_path / "host"
    inside = tmp_path / "model" / "part"
    write_file("x", host / "precious.txt", "theirs")
    inside.mkdir(parents=True)
    if shutil.which("mount") is None or subprocess.run(["mount", "--bind", host, inside], check=False).returncode:
        pytest.skip("folders cannot be mounted without rights")
    yield host, inside
    subprocess.run(["umount", inside], check=True)


def test_a_mounted_folder_keeps_its_files_and_may_be_written_to(mounted):
    host, inside = mounted
    fill(inside.parent)
    assert names(host) == {"precious.txt", "b.json"}
    assert names(inside.parent) == {
        "a.txt",
        "part/precious.txt",
        "part/b.json",
    }
    fill(inside)  # a mount by itself, which no rename can replace
    assert (host / "a.txt").read_text() == "new"
    assert (host / "precious.txt").read_text() == "theirs"


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


def test_a_killed_save_leaves_the_old_files_or_the_new_ones(tmp_path):
    """A save that was decided is finished by whoever reads or fills the folder next. `make soak` kills at any time."""
    folder = tmp_path / "model"
    fill(folder, "old")
    changes = finished(Child(fill, folder, "old", folder=tmp_path)).changes
    states = set()
    for number, killed_at in enumerate(range(1, changes + 1, 2)):
        assert Child(fill, folder, "new", folder=tmp_path, killed_at=killed_at).wait() == -9
        if is_unfinished(folder):
            states.add("unfinished")
            if number % 2:
                with reading("model", folder):
                    pass
            else:
                fill(folder, "newer", parts=["c.txt"])
        one = (folder / "a.txt").read_text()
        other = (folder / "part" / "b.json").read_text()
        assert one == other
        assert not is_unfinished(folder)
        states.add(one)
        fill(folder, "old")
    assert states == {"old", "unfinished", "new"}


def test_a_plan_of_a_save_that_leads_out_of_its_folder_is_not_followed(tmp_path):
    """As a folder from elsewhere could hold one."""
    precious = write_file("x", tmp_path / "mine" / "precious.txt", "mine")
    folder = tmp_path / "model"
    folder.mkdir()
    (folder / "link").symlink_to(precious.parent)
    for removed in ("../mine/precious.txt", str(precious), "link/precious.txt"):
        (folder / UNFINISHED).write_text(json.dumps({"moves": [], "removed": [removed]}))
        with suppress(InvalidInputError), reading("model", folder):
            pass
        assert precious.is_file()
    (folder / UNFINISHED).write_text("{}")
    with pytest.raises(InvalidInputError, match="is no plan of a save"), reading("model", folder):
        pass


def test_a_plan_of_a_save_that_is_damaged_moves_nothing(tmp_path):
    write_file("x", tmp_path / "old.txt", "old")
    write_file("x", tmp_path / ".new.txt", "new")
    for damaged in (["old.txt"], ["a", "b", "c"], 3, [1, 2]):
        (tmp_path / UNFINISHED).write_text(json.dumps({"moves": [[".new.txt", "old.txt"], damaged], "removed": []}))
        with pytest.raises(InvalidInputError, match="is no plan of a save"), reading("model", tmp_path):
            pass
        assert (tmp_path / "old.txt").read_text() == "old"


def test_two_components_in_one_folder_are_refused_before_anything_changes(tmp_path):
    write_file("x", tmp_path / "one" / "a.txt", "old")
    (tmp_path / "other").symlink_to("one")
    with pytest.raises(InvalidInputError, match=r"link to another component's folder. Nothing was changed"):
        fill(tmp_path, parts=["one/a.txt", "other/a.txt"])
    assert names(tmp_path / "one") == {"a.txt"}
    assert (tmp_path / "one" / "a.txt").read_text() == "old"


def test_a_reader_beside_a_save_reads_one_of_two_models(tmp_path):
    """Files take their places when the reader has ended."""
    fill(tmp_path / "model", "one")
    with ThreadPoolExecutor() as pool:
        with reading("model", tmp_path / "model"):
            first = (tmp_path / "model" / "a.txt").read_text()
            saved = pool.submit(fill, tmp_path / "model", "two")
            with pytest.raises(TimeoutError):
                saved.result(timeout=0.3)
            assert first == (tmp_path / "model" / "part" / "b.json").read_text() == "one"
        saved.result()
    assert (tmp_path / "model" / "part" / "b.json").read_text() == "two"


def test_one_of_two_saves_at_once_is_there(tmp_path):
    def fill_again(content: str) -> None:
        for _ in range(20):
            fill(tmp_path / "model", content)

    with ThreadPoolExecutor() as pool:
        list(pool.map(fill_again, ("one", "two")))
    one = (tmp_path / "model" / "a.txt").read_text()
    other = (tmp_path / "model" / "part" / "b.json").read_text()
    assert one == other
    assert names(tmp_path / "model") == {"a.txt", "part/b.json"}
