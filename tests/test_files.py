"""Files and folders that are replaced whole, watched at every rename and after a kill: at every moment the old one or
the new one is there, and nothing else stays.
"""

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.files import adding_to_folder, replacing, replacing_folder, restore_folder, write_file


@pytest.mark.parametrize(("content", "data"), [("a ü\n", b"a \xc3\xbc\n"), (b"\xff\r\n", b"\xff\r\n"), ("", b"")])
def test_text_is_utf_8_and_bytes_stay_as_they_are(tmp_path: Path, content: str | bytes, data: bytes) -> None:
    file = tmp_path / "new" / "folder" / "file.json"
    write_file(file, content)
    assert file.read_bytes() == data


def test_the_old_file_is_there_until_the_new_one_is_whole(tmp_path: Path) -> None:
    file = tmp_path / "picture.png"
    file.write_text("old")
    with replacing(file) as partial:
        partial.write_text("ne")
        assert file.read_text() == "old" and partial.parent == tmp_path
        assert partial.name.startswith(".") and partial.suffix == ".png"  # by which libraries know the format
        partial.write_text("new")
    assert file.read_text() == "new" and [path.name for path in tmp_path.iterdir()] == ["picture.png"]


def test_a_write_that_fails_leaves_the_old_file_alone(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("old")

    def fail() -> None:
        with replacing(file) as partial:
            partial.write_text("ne")
            raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        fail()
    assert file.read_text() == "old" and list(tmp_path.iterdir()) == [file]


def test_a_folder_that_is_a_file_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="file"):
        write_file(tmp_path / "file" / "inside", "")


def test_a_name_as_long_as_names_may_be_can_be_written(tmp_path: Path) -> None:
    file = tmp_path / f"{'n' * 251}.txt"
    write_file(file, "text")
    assert file.read_text() == "text"


# Folders -------------------------------------------------------------------------------------------------------------


WATCHERS: list[Callable[[], None]] = []


def _hook(event: str, _: tuple) -> None:
    if WATCHERS and event in ("os.rename", "shutil.rmtree", "os.remove", "os.rmdir"):
        WATCHERS[0]()


sys.addaudithook(_hook)  # sees each rename and removal of this process just before it happens


@contextmanager
def watched(check: Callable[[], None]) -> Iterator[None]:
    WATCHERS[:] = [check]
    try:
        yield
    finally:
        WATCHERS.clear()
    check()


def folder(path: Path, content: str) -> Path:
    path.mkdir()
    (path / "weights").write_text(content)
    return path


def contents(*paths: Path) -> list[str]:
    return [(path / "weights").read_text() for path in paths if (path / "weights").is_file()]


def test_a_whole_folder_is_there_at_every_moment(tmp_path: Path) -> None:
    final, old = folder(tmp_path / "final", "old"), tmp_path / "final.old"
    seen = []

    def check() -> None:
        seen.append(contents(final, old))
        assert seen[-1]

    with watched(check), replacing_folder(final) as partial:
        (partial / "weights").write_text("new")
    assert len(seen) > 3
    assert contents(final) == ["new"] and {path.name for path in tmp_path.iterdir()} == {"final"}


def test_a_whole_folder_is_there_at_every_moment_after_a_kill_between_the_renames(tmp_path: Path) -> None:
    final, old = tmp_path / "final", folder(tmp_path / "final.old", "old")

    def check() -> None:
        assert contents(final, old)

    with watched(check), replacing_folder(final) as partial:
        (partial / "weights").write_text("new")
    assert contents(final) == ["new"] and not old.exists()


def test_a_folder_that_is_new_is_just_renamed(tmp_path: Path) -> None:
    with replacing_folder(tmp_path / "new" / "final") as partial:
        (partial / "weights").write_text("new")
    assert contents(tmp_path / "new" / "final") == ["new"] and not partial.exists()


def test_a_kill_between_the_renames_is_undone(tmp_path: Path) -> None:
    folder(tmp_path / "final.old", "old")
    restore_folder(tmp_path / "final")
    assert contents(tmp_path / "final") == ["old"]


def test_a_kill_after_the_renames_is_left_alone(tmp_path: Path) -> None:
    folder(tmp_path / "final", "new"), folder(tmp_path / "final.old", "old")
    restore_folder(tmp_path / "final")
    assert contents(tmp_path / "final") == ["new"]


@pytest.mark.parametrize("name", ["final", "final.old"], ids=["whole", "killed between the renames"])
def test_a_write_that_fails_leaves_the_folder_as_it_was(tmp_path: Path, name: str) -> None:
    folder(tmp_path / name, "old")

    def fail() -> None:
        with replacing_folder(tmp_path / "final") as partial:
            (partial / "weights").write_text("ne")
            raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        fail()
    assert contents(tmp_path / "final") == ["old"] and len(list(tmp_path.iterdir())) == 1


def test_a_write_starts_from_an_empty_folder(tmp_path: Path) -> None:
    folder(tmp_path / "final.partial", "of a write that was killed")
    with replacing_folder(tmp_path / "final") as partial:
        (partial / "figures.json").write_text("{}")
    assert [path.name for path in (tmp_path / "final").iterdir()] == ["figures.json"]


# Files that are added to a folder -------------------------------------------------------------------------------------


def put(folder: Path, error: Exception | None = None) -> None:
    """Two files into a folder; then an error, if one is given."""
    with adding_to_folder("output", folder) as place:
        (place / "sub").mkdir()
        (place / "a.txt").write_text("new")
        (place / "sub" / "b.txt").write_text("new")
        if error is not None:
            raise error


def test_files_go_where_a_link_leads(tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "disk")
    put(tmp_path / "link")
    assert (tmp_path / "link").is_symlink()
    assert {path.name for path in (tmp_path / "disk").iterdir()} == {"a.txt", "sub"}


def test_a_folder_that_is_there_needs_no_other(tmp_path):
    """As one that is a disk of its own, from which nothing can be renamed into its parent."""
    output = tmp_path / "output"
    output.mkdir()
    with adding_to_folder("output", output) as place:
        assert list(tmp_path.iterdir()) == [output] and place.parent == output


def test_a_folder_in_the_place_of_a_file_changes_nothing(tmp_path):
    (tmp_path / "output" / "sub" / "b.txt").mkdir(parents=True)
    (tmp_path / "output" / "a.txt").write_text("old")
    with pytest.raises(InvalidInputError, match=r"`output` is .*b.txt is a folder. Nothing was changed"):
        put(tmp_path / "output")
    assert (tmp_path / "output" / "a.txt").read_text() == "old"
    assert len(list((tmp_path / "output").iterdir())) == 2


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), RuntimeError("broken")])
def test_what_fails_leaves_no_folder(tmp_path, error):
    with pytest.raises((InvalidInputError, RuntimeError), match=str(error.args[-1])):
        put(tmp_path / "new" / "output", error)
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_write_left_is_removed_and_what_another_process_writes_stays(tmp_path):
    for name, days in ((".1.partial", 2), (".2.partial", 0)):
        (tmp_path / "output" / name).mkdir(parents=True)
        (tmp_path / "output" / name / "c.txt").write_text("cut sho")
        then = time.time() - days * 24 * 60 * 60
        os.utime(tmp_path / "output" / name, (then, then))
    put(tmp_path / "output")
    assert {path.name for path in (tmp_path / "output").iterdir()} == {"a.txt", "sub", ".2.partial"}


def test_a_file_is_no_folder(tmp_path):
    (tmp_path / "model.pth").write_text("")
    with pytest.raises(InvalidInputError, match=r"`output` is .*model.pth is a file"):
        put(tmp_path / "model.pth")
    assert (tmp_path / "model.pth").is_file()
