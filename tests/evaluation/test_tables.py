"""Tables of the paper on contacts whose answers are known by construction, and how they are written."""

import json

import numpy as np
import pytest
import torch
from PIL import Image

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.evaluation.classification import TEMPLATES, grasp_table, material_table, prompts_table
from unitouch_gen.evaluation.contacts import SPLITS, Contacts, EvaluationSet
from unitouch_gen.evaluation.cross_modal import retrieval_table
from unitouch_gen.evaluation.real import real_table
from unitouch_gen.evaluation.tables import Table, draw_examples, summary

NAMES = ("brick", "grass", "leather", "wood")
WIDTH = 8


def contacts(count: int, seed: int, labels: dict[str, int]) -> Contacts:
    """Touches that say their class, statistics that say nothing, and pictures that say the object."""
    generator = torch.Generator().manual_seed(seed)
    objects = torch.arange(count) // 4
    known = {name: (objects + shift) % len(NAMES) for name, shift in labels.items()}
    first = next(iter(known.values()))

    def noise() -> torch.Tensor:
        return torch.randn(count, WIDTH, generator=generator)

    features = {
        "touch": torch.eye(WIDTH)[first] + 0.02 * noise(),
        "image": torch.eye(WIDTH)[first] + 0.02 * noise(),
        "statistics": noise(),
    }
    return Contacts(features, known, objects)


def set_of(name: str = "gelsight", known: bool = True, seed: int = 0, label: str = "material") -> EvaluationSet:
    splits = {split: contacts(64, 10 * seed + place, {label: 0}) for place, split in enumerate(SPLITS)}
    return EvaluationSet(name, known, {label: NAMES}, splits, seed)


def embed(texts):
    """The corner of the class that a text names."""
    return torch.stack([torch.eye(WIDTH)[next(i for i, name in enumerate(NAMES) if name in text)] for text in texts])


def test_a_material_table_tells_what_knows_from_what_does_not():
    sets = [set_of(name, known, seed) for seed in (0, 1) for name, known in (("other", False), ("gelsight", True))]
    table = material_table(sets, embed)
    assert list(table.columns.items()) == [("gelsight", "in domain"), ("other", "out of domain")]
    for column in table.columns:
        assert table.rows["chance"][column] == table.rows["majority"][column] == [25.0, 25.0]
        assert (
            table.rows["touch encoder, zero-shot"][column] == table.rows["touch encoder, probe"][column] == [100.0] * 2
        )
        assert all(abs(value - 25.0) < 20.0 for value in table.rows["plain statistics, probe"][column])
    assert "untouched gel, probe" not in table.rows  # there is none


def test_labels_that_are_not_known_do_not_count():
    one = set_of()
    for split in one.splits.values():
        split.labels["material"][::2] = -1
        split.features["touch"][::2] = torch.eye(WIDTH)[WIDTH - 1]
    assert material_table([one], embed).rows["touch encoder, zero-shot"]["gelsight"] == [100.0]


def test_each_template_asks_for_itself():
    def answer(texts):
        classes = embed(texts)
        return classes if texts[0].startswith("this feels") else classes.roll(1, 0)

    rows = prompts_table([set_of()], answer).rows
    assert {name: row["gelsight"] for name, row in rows.items()} == {
        "chance": [25.0], **{name: [100.0 if name == "this feels like {}" else 0.0] for name in TEMPLATES}
    }  # fmt: skip


def test_templates_of_touch_stand_beside_those_of_images():
    assert prompts_table([set_of()], embed).beside == {
        "this is a touch image of {}": ["this is an image of {}"], "this feels like {}": ["this looks like {}"],
        "touch of {}": ["image of {}"],
    }  # fmt: skip


def test_grasps_weigh_classes_alike():
    one = set_of()
    held = {split: torch.zeros(64, dtype=torch.long) for split in SPLITS}
    for split, labels in held.items():
        labels[:16] = 1
        one.splits[split].labels["grasp"] = labels
    grasps = EvaluationSet("gelsight", True, {"grasp": ("dropped", "lifted")}, one.splits)
    rows = grasp_table([grasps], lambda texts: torch.eye(WIDTH)[: len(texts)]).rows
    assert rows["majority"]["gelsight"] == [50.0]  # 75 % of all


def test_objects_are_found_by_touches_that_know_them():
    sets = [set_of(), set_of("other", False)]
    rows = retrieval_table(sets).rows
    column = "picture, in domain"
    assert rows["touch encoder"][column] > rows["chance (another contact's touch)"][column]
    assert rows["class mean"][column][0] == pytest.approx(rows["touch encoder"][column][0], abs=5.0)  # class is all
    assert set(rows["touch encoder"]) == {column, "picture, out of domain"}


def test_a_table_of_real_touches_leaves_objects_out():
    whole = contacts(64, 0, {"material": 0, "hardness": 1})
    table = real_table(EvaluationSet("mine", False, {"material": NAMES, "hardness": NAMES}, {"test": whole}))
    assert table.rows["touch encoder, probe"] == {"material": [100.0], "hardness": [100.0], "mean": [100.0]}
    assert table.rows["plain statistics, probe"]["mean"][0] < 50.0
    assert table.notes[0].startswith("64 of 64 touches, which have every label, of 16 objects")


def test_objects_are_found_without_a_class_mean_where_a_material_is_not_known():
    one = set_of()
    one.splits["test"].labels["material"][0] = -1
    rows = retrieval_table([one]).rows
    assert "class mean" not in rows and "touch encoder" in rows


@pytest.mark.parametrize(("spoil", "said"), [
    (lambda one: one.splits.pop("val"), "'material' in a split 'val'"),
    (lambda one: one.classes.pop("material"), "the labels none"),
    (lambda one: one.splits["test"].labels["material"].fill_(1), "a single class of material in its test split"),
    (lambda one: one.splits["train"].labels["material"].fill_(-1), "no class of material in its train split"),
])  # fmt: skip
def test_what_a_table_cannot_be_of_is_refused(spoil, said):
    one = set_of()
    spoil(one)
    with pytest.raises(InvalidInputError, match=said):
        material_table([one], embed)


def test_without_labels_or_another_modality_there_is_no_table():
    bare = EvaluationSet("mine", True, {}, {"test": Contacts({"touch": torch.eye(4)}, {}, torch.arange(4))})
    with pytest.raises(InvalidInputError, match="every label is known, of none"):
        real_table(bare)
    with pytest.raises(InvalidInputError, match="pictures, sounds or captions"):
        retrieval_table([bare])


def test_a_table_is_written_and_read_again(tmp_path):
    table = material_table([set_of(seed=seed) for seed in range(3)], embed)
    table.write(tmp_path)
    assert {file.name for file in tmp_path.iterdir()} == {"material.json", "material.md"}
    read = Table.read(tmp_path / "material.json")
    assert read.markdown() == table.markdown() == (tmp_path / "material.md").read_text()
    rows = [line.split("|")[1:-1] for line in read.markdown().splitlines() if line.startswith("|")]
    assert [cell.strip() for cell in rows[2]] == ["chance", "25.0 (0.0)"]
    json.loads((tmp_path / "material.json").read_text())


def test_a_summary_holds_the_model_to_the_best_beside_it():
    rows = {"ours": {"a": [3.0, 5.0], "b": [1.0]}, "one": {"a": [9.0, 1.0], "b": [2.0]}, "two": {"a": [1.0, 2.0]},
            "ceiling": {"a": [99.0], "b": [0.0]}}  # fmt: skip
    table = Table("x", "T", "%", {"a": "here", "b": ""}, rows, beside={"ours": ["one", "two"]}, falling=["b"])
    assert table.summary() == [
        ["T", "a, here", "ours", "4.0 (2.0)", "one", "5.0 (8.0)"], ["T", "b", "ours", "1.0", "one", "2.0"]
    ]  # fmt: skip
    assert "| T | b | ours | 1.0 | one | 2.0 |" in summary([table])


def test_examples_have_a_row_for_each_contact_and_a_column_for_each_way(tmp_path):
    red, grey = torch.zeros(20, 3, 16, 16), torch.linspace(0, 0.9, 20)[:, None, None, None].expand(20, 3, 8, 8)
    red[:, 0] = 1.0
    draw_examples(tmp_path / "grid.png", {"red": red, "grey": grey}, most=4)
    pixels = np.asarray(Image.open(tmp_path / "grid.png").convert("RGB")).astype(int)
    reds = (pixels[..., 0] > 250) & (pixels[..., 1] < 5)
    columns, rows = np.flatnonzero(reds.any(axis=0)), np.flatnonzero(reds.any(axis=1))
    assert (np.diff(rows) > 1).sum() == 3 and (np.diff(columns) > 1).sum() == 0  # four tiles above each other
    beside = pixels[rows, 3 * pixels.shape[1] // 4]  # the other column, from dark to bright
    shades = beside[(np.ptp(beside, axis=1) == 0) & (beside[:, 0] < 250)][:, 0]
    assert len(np.unique(shades)) == 4 and (np.diff(shades) >= 0).all()
