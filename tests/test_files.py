"""Files that are replaced whole: at every moment the old one or the new one is there, and nothing else stays."""

from pathlib import Path

import pytest

from unitouch_gen.files import replacing, write_file


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
