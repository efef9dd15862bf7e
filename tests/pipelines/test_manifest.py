"""Manifests: what they say, and that nothing is begun with one that cannot be used."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
from PIL import Image

from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.pipelines.manifest import CHOICES, COLUMNS, LONGEST_NAME, NUMBERS, OWN, Item, read_manifest


def table(folder: Path, text: str | bytes, name: str = "table.csv") -> Path:
    (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    return folder / name


def test_tables_of_all_kinds_say_the_same(tmp_path: Path) -> None:
    rows = [["a/brick.png", "", "7"], ["b.png", "0.5", ""]]
    written = {
        ",": "touch,strength,seed\r\n" + "\r\n".join(",".join(row) for row in rows),
        "\t": "\ufefftouch\tstrength\tseed\n\n" + "\n".join("\t".join(row) for row in rows) + "\n",
    }
    lines = [{"touch": "a/brick.png", "strength": None, "seed": 7}, {"touch": "b.png", "strength": 0.5}]
    files = [
        table(tmp_path, written[","], "a.csv"),
        table(tmp_path, written["\t"], "a.tsv"),
        table(tmp_path, "\n\n".join(map(json.dumps, lines)), "a.jsonl"),
    ]
    expected = [
        Item(0, "brick", "touch-to-image", 7, {"touch": "a/brick.png"}),
        Item(1, "b", "touch-to-image", 3, {"touch": "b.png", "strength": 0.5}),
    ]
    for file in files:
        assert read_manifest(file, defaults={"seed": 3}).items == expected


def test_a_folder_is_every_picture_in_it_by_its_place(tmp_path: Path) -> None:
    for name in ("b.png", "a.b.JPG", "in/b.png", "in/b.jpg", "notes.txt", ".hidden.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        Image.fromarray(np.zeros((9, 9, 3), np.uint8)).save(tmp_path / name, format="PNG")
    soundfile.write(tmp_path / "hit.wav", np.zeros(9), 16000)
    found = read_manifest(tmp_path).items
    assert [(item.name, item.cells) for item in found] == [
        ("a_b", {"touch": "a.b.JPG"}), ("b", {"touch": "b.png"}), ("in/b", {"touch": "in/b.jpg"}),
        ("in/b-2", {"touch": "in/b.png"}),
    ]  # fmt: skip
    cells = [item.cells for item in read_manifest(tmp_path, "x-to-touch").items]
    assert cells[0] == {"image": "a.b.JPG"} and cells[2] == {"audio": "hit.wav"}
    assert read_manifest(tmp_path, "x-to-touch", kind="touch").items[0].cells == {"touch": "a.b.JPG"}


def test_plans_are_of_all_items_of_a_pipeline(tmp_path: Path) -> None:
    rows = "pipeline,touch,text,bridge\nx-to-touch,,brick,no\nx-to-touch,,tile,yes\n,a.png,,\n"
    plans = read_manifest(table(tmp_path, rows)).plans
    assert {name: plan.modalities for name, plan in plans.items()} == {
        "x-to-touch": ("text",),
        "touch-to-image": ("touch",),
    }
    assert plans["x-to-touch"].parts["bank of image embeddings"]


def test_names_are_of_one_item_each(tmp_path: Path) -> None:
    rows = "touch,name\na/x.png,\nb/X.png,\nc.png,x-2\nd/x.png,\n"
    assert [item.name for item in read_manifest(table(tmp_path, rows)).items] == ["x", "X-3", "x-2", "x-4"]


def test_settings_that_no_item_takes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"`prompt` came, which x-to-touch"):
        read_manifest(table(tmp_path, "text\nbrick\n"), "x-to-touch", defaults={"prompt": "a"})


# What is refused ------------------------------------------------------------------------------------------------------

TYPED: list[Any] = [True, [], {}, [1], {"a": 1}]
WORDS = ["x", "nan", "-inf", "-1", "1e400", "9" * 5000, "0x10", "1,5", "\u00b2", "--", "1 2", "\ud800"]


def bad_manifests() -> Iterator[tuple[str, bytes, str]]:
    """Suffix, content, and a word of the refusal."""
    for column in (*NUMBERS, *CHOICES, "bridge"):
        other = {"x-to-touch": ("text", "brick"), "stylization": ("touch", "a.png")}
        pipeline = "x-to-touch" if column in ("bridge", "candidates") else "stylization"
        base: dict[str, Any] = dict(
            [other[pipeline]], pipeline=pipeline, **({} if pipeline == "x-to-touch" else {"image": "b.png"})
        )
        for value in WORDS:
            if value in ("-1", "-inf") and column == "bridge":
                continue
            yield ".jsonl", json.dumps({**base, column: value}).encode(), f"`{column}`"
        for value in TYPED:
            if not (column == "bridge" and value is True):
                yield ".jsonl", json.dumps({**base, column: value}).encode(), f"`{column}`"
    for column in (*OWN, "name"):
        for value in (*TYPED, 1, 0.5, "a\0", "\ud800"):
            yield ".jsonl", json.dumps({"touch": "a.png", column: value}).encode(), f"`{column}`"
    long = "x" * (LONGEST_NAME + 1)
    for name in ("../a", "/a", "a/", "a//b", "a.png", ".", "..", "a\\b", "c:a", " a", "a\n", long):
        yield ".jsonl", json.dumps({"touch": "a.png", "name": name}).encode(), "`name`"
    for line in ("", "[]", "1", "null", '"touch"', "{", '{"touch": "a.png"', "{]", "[" * 9999,
                 '{"touch": 1, "touch": 2}',
                 '{"tuch": "a.png"}', "{}", '{"text": "brick"}', '{"touch": "a.png", "text": "b"}', '{"prompt": "a"}',
                 '{"touch": "a.png", "tolerance": 0.1, "steps": 5}',
                 '{"pipeline": "x-to-touch", "sensor": "all", "text": "a"}',
                 '{"pipeline": "stylization", "touch": "a.png"}', '{"touch": "a.png", "steps": 1e999}',
                 '{"touch": "a", "steps": NaN}', '{"touch": "a.png", "": "b"}'):  # fmt: skip
        yield ".jsonl", line.encode(), "`manifest`"
    for text in ("", "touch", "touch\n", "touch\n \n", "a.png\nb.png\n", "touch,touch\na,b\n", "touch,\na,b\n",
                 "touch;seed\na;1\n",
                 "touch,seed\na\n", "touch,seed\na,1,2\n", 'touch\n"a\n', 'touch\n"a"b\n', "touch,name\na,x\nb,X\n",
                 "touch\n" + "x" * 200_000 + ",1\n", "pipeline\ntouch-to-image\n",
                 "touch,pipeline\na,stylize\n"):  # fmt: skip
        yield ".csv", text.encode(), "`manifest`"
        yield ".tsv", text.replace(",", "\t").encode(), "`manifest`"
    for data in (b"touch\n\xff\n", b"\xff\xfet\0o\0", b"PK\3\4", bytes(range(256))):
        yield ".csv", data, "`manifest`"
        yield ".jsonl", data, "`manifest`"


def test_bad_manifests_are_refused_in_a_line_that_names_them(tmp_path: Path) -> None:
    tried, wrong = 0, []
    for suffix, data, word in bad_manifests():
        file, tried = table(tmp_path, data, f"bad{suffix}"), tried + 1
        try:
            found = read_manifest(file)
            wrong.append(f"{data[:80]!r} became {found.items[:1]}")
        except (InvalidInputError, InvalidTypeError) as error:
            said = str(error)
            if not said.startswith("`manifest` ") or word not in said or "\n" in said or len(said) > 1200:
                wrong.append(f"{data[:80]!r}: {said[:300]}")
        except Exception as error:
            wrong.append(f"{data[:80]!r}: {type(error).__name__}: {error}")
    assert tried >= 300 and not wrong, "\n".join(wrong)


@pytest.mark.parametrize(
    "place", ["gone.csv", "gone", "notes.txt", "empty", "/dev/zero", "", "x" * 5000, "a.csv/b.csv"]
)
def test_what_is_no_manifest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    for name in ("notes.txt", "a.csv"):
        (tmp_path / name).write_text("touch\n")
    with pytest.raises(InvalidInputError, match=r"^`manifest` "):
        read_manifest(place)


def test_every_column_is_taken_by_a_pipeline() -> None:
    assert len(set(COLUMNS)) == len(COLUMNS) and {*NUMBERS, *CHOICES, *OWN} < {*COLUMNS}
