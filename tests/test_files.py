"""Files and folders are whole or not there, and what cannot be read or written is one error that names the argument."""

from functools import partial
from itertools import product
from pathlib import Path

import pytest

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.files import check_writable, files_below, read_table, replacing, write_file


def names(folder: Path) -> set[str]:
    return {str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file()}


def test_a_file_takes_its_place_when_it_is_whole(tmp_path):
    file = write_file("output", tmp_path / "new" / "a.txt", "old")
    with replacing("output", file) as partial:
        partial.write_text("new")
        assert file.read_text() == "old"
        assert partial.name == "a.txt"
    assert file.read_text() == "new"
    assert names(tmp_path) == {"new/a.txt"}


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path):
    file = write_file("output", tmp_path / "a.txt", "old")
    with pytest.raises(RuntimeError), replacing("output", file) as partial:  # noqa: PT012
        partial.write_text("half")
        raise RuntimeError
    assert file.read_text() == "old"
    assert names(tmp_path) == {"a.txt"}


def test_files_below_are_listed_once_by_their_own_names_whatever_links_lead_back(tmp_path):
    """Two loops of links, and a folder that is there by its own name and behind a link."""
    for name in ("a/1.png", "a/10.png", "a/2.png", "b/c/3.png", "far/4.png"):
        write_file("x", tmp_path / "in" / name, name)
    (tmp_path / "in" / "far").rename(tmp_path / "far")
    for link, target in (("a/up", ".."), ("b/up", ".."), ("a/0", "../b"), ("far", "../far")):
        (tmp_path / "in" / link).symlink_to(target)
    found = [str(file.relative_to(tmp_path / "in")) for file in files_below(tmp_path / "in")]
    assert found == ["a/1.png", "a/2.png", "a/10.png", "b/c/3.png", "far/4.png"]


def test_write_file_keeps_a_link(tmp_path):
    file = write_file("output", tmp_path / "a.txt", "old")
    (tmp_path / "link").symlink_to(file)
    write_file("output", tmp_path / "link", "new")
    assert (tmp_path / "link").is_symlink()
    assert file.read_text() == "new"


def test_check_writable_names_its_argument_and_leaves_nothing(tmp_path):
    check_writable("output", tmp_path / "new" / "a.txt")
    assert not list(tmp_path.iterdir())
    (tmp_path / "folder").mkdir()
    write_file("output", tmp_path / "file", "")
    for place, write in product(("folder", "file/a.txt"), (check_writable, partial(write_file, content=""))):
        with pytest.raises(InvalidInputError, match=r"`output` cannot be written to .*Nothing was changed"):
            write("output", tmp_path / place)


@pytest.mark.parametrize(
    "content",
    [
        "Touch,Seed\na.png,1\n\n",
        "touch;seed\r\na.png;1\r\n",
        "touch\tseed\ra.png\t1\r",
        "sep=;\ntouch;seed\na.png;1",
        "touch,seed,,\na.png,1,,\n,,,",
        '"sep=|"\ntouch|seed\n"a.png"|1',
        "\n touch , seed\na.png, 1",
        ",touch,seed\n0,a.png,1",
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_tables_are_read_as_spreadsheets_write_them(tmp_path, content, encoding):
    (tmp_path / "list.csv").write_bytes(content.encode(encoding))
    assert read_table(tmp_path / "list.csv") == [{"touch": "a.png", "seed": "1"}]
