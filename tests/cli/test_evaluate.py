"""`unitouch-gen evaluate`, on a tiny random joint space."""

import json
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch
from PIL import Image

from unitouch_gen.evaluation import classification
from unitouch_gen.evaluation.tables import Table
from unitouch_gen.training.data import embedded
from unitouch_gen.world import MATERIAL_NAMES, SENSORS, World


@pytest.fixture
def run(command, models):
    """Runs `unitouch-gen evaluate ... --model ...`."""
    return lambda *args: command("evaluate", "--model", models["x-to-touch"], "--device", "cpu", *args)


@pytest.fixture
def touches(tmp_path: Path) -> Path:
    """Bright touches of brick and dark ones of wood."""
    rng, folder = np.random.default_rng(0), tmp_path / "touches"
    folder.mkdir()
    rows = ["touch,object,material"]
    for number in range(120):
        bright = number // 2 % 2
        noise = rng.integers(60 + 120 * bright, 90 + 120 * bright, (32, 32, 3), dtype=np.uint8)
        Image.fromarray(noise).save(folder / f"{number}.png")
        rows.append(f"{number}.png,thing{number // 2},{('wood', 'brick')[bright]}")
    (folder / "labels.csv").write_text("\n".join(rows))
    return folder


def test_touches_of_ones_own_get_the_tables_that_they_allow(run, touches, tmp_path, files):
    code, out, err = run("real", "--data", touches, "-o", tmp_path / "tables")
    assert code == 0, err
    assert "plain statistics, probe" in out
    table = Table.read(tmp_path / "tables/real.json")
    assert table.rows["plain statistics, probe"]["material"] == [100.0]  # how bright they are
    assert table.facts["seeds"] == [0] and len(table.facts["sets"]) == 1
    code, out, err = run("material", "--data", touches, "-o", tmp_path / "tables")
    assert code == 0, err
    made = [name for name in files(tmp_path / "tables") if not name.startswith("cache/")]
    assert made == ["material.json", "material.md", "real.json", "real.md", "summary.md"]
    assert "touch encoder, probe" in (tmp_path / "tables/summary.md").read_text()


def test_the_world_gives_all_of_its_tables(run, few, tmp_path):
    code, out, err = run("all", *few, "-o", tmp_path)
    assert code == 0, err
    made = {"material", "prompts", "retrieval", "grasp", "x-to-touch"}  # of what the model is
    assert {file.stem for file in tmp_path.glob("*.json")} == made
    for name in made - {"x-to-touch"}:
        rows = json.loads((tmp_path / f"{name}.json").read_text())["rows"]
        assert all(0.0 <= value <= 100.0 for row in rows.values() for values in row.values() for value in values)
    rows = json.loads((tmp_path / "x-to-touch.json").read_text())["rows"]
    for what in ("picture", "caption", "sound", "touch by another sensor"):
        assert {what, f"{what}: mean of its class", f"{what}: of another contact"} <= set(rows)
    assert len(rows["caption"]) == 7
    assert "Whether a grasp holds" in out and (tmp_path / "cache").is_dir()


@pytest.fixture
def few(monkeypatch):
    """Worlds of a few contacts."""
    monkeypatch.setattr(embedded, "TRAIN_OBJECTS", 1)
    monkeypatch.setattr(embedded, "CONTACTS", 2)
    return ("--seeds", "1", "--objects", "2", "--each", "1")


@pytest.mark.slow
def test_pictures_of_touches_stand_beside_their_controls(command, models, few, tmp_path):
    code, _, err = command("evaluate", "touch-to-image", "--model", models["touch-to-image"], *few, "-o", tmp_path)
    assert code == 0, err
    rows = json.loads((tmp_path / "touch-to-image.json").read_text())["rows"]
    assert len(rows) == 14  # seven in domain, seven out
    assert len(rows["picture of the touch, out of domain: diffusion, supervised"]) == 6
    with Image.open(tmp_path / "touch-to-image.examples.png") as examples:
        assert examples.width > 1_000
    assert "touch-to-image.examples.png" in (tmp_path / "touch-to-image.md").read_text()
    drawn, real = (rows[f"{name}, in domain"] for name in ("picture of the touch", "real picture under another lamp"))
    assert len(drawn) == 6 and real["Frechet distance"] < drawn["Frechet distance"]


@pytest.fixture
def pictured(tmp_path: Path) -> Path:
    """Touches of four materials of the world, with pictures of the same contacts, by `gelsight`."""
    sensor, folder = SENSORS["gelsight"], tmp_path / "pictured"
    material, thing, contact = (part.flatten() for part in torch.meshgrid(*map(torch.arange, (4, 6, 2)), indexing="ij"))
    scene = World(0, image_size=32).render(
        material, thing, contact, modalities=("image", "touch"), sensors=[sensor]
    )  # fmt: skip
    rows = ["touch,picture,object,material,split,sensor"]
    for name, images in (("touch", scene.touch[sensor.name]), ("picture", scene.image)):
        (folder / name).mkdir(parents=True)
        for number, image in enumerate(images):
            pixels = (255 * image).round().byte().movedim(0, -1).numpy()
            Image.fromarray(pixels).save(folder / name / f"{number}.png")
    for number in range(len(material)):
        split = "train" if thing[number] < 3 else "test"
        rows.append(f"touch/{number}.png,picture/{number}.png,thing{thing[number]},{MATERIAL_NAMES[material[number]]},"
                    f"{split},gelsight")  # fmt: skip
    (folder / "labels.csv").write_text("\n".join(rows))
    return folder


def test_pictures_of_ones_own_touches_stand_beside_their_controls(command, models, pictured, tmp_path):
    words = ("evaluate", "touch-to-image", "--model", models["touch-to-image"], "--data", pictured, "--each", "2")
    code, _, err = command(*words, "-o", tmp_path / "tables")
    assert code == 0, err
    table = Table.read(tmp_path / "tables/touch-to-image.json")
    controls = ["mean of its class", "of another contact", "real one of the nearest known touch",
                "diffusion, supervised", "its own embedding, regressed"]  # fmt: skip
    row = "picture of the touch"
    assert list(table.rows) == [row, *(f"{row}: {control}" for control in controls), "real picture"]
    judged = {"CVTP, x 100", "as real by the paper's prompt, %", "as real by a classifier, %",
              "contact within its material, %", "Frechet distance"}  # fmt: skip
    assert set(table.columns) == set(table.rows[row]) == judged
    assert set(table.rows["real picture"]) == {"CVTP, x 100", "Frechet distance"}
    assert set(table.rows[f"{row}: of another contact"]) == judged - {"Frechet distance"}  # the same pictures as a set
    assert table.rows["real picture"]["Frechet distance"] < table.rows[row]["Frechet distance"]
    assert "training split" in table.notes[-1] and (tmp_path / "tables/touch-to-image.examples.png").is_file()


def test_touches_of_ones_own_pictures_stand_beside_their_controls(run, pictured, tmp_path):
    code, _, err = run("x-to-touch", "--data", pictured, "--each", "2", "-o", tmp_path)
    assert code == 0, err
    rows = json.loads((tmp_path / "x-to-touch.json").read_text())["rows"]
    assert list(rows) == ["picture", "picture: mean of its class", "picture: of another contact", "real touch"]
    assert set(rows["picture"]) == {
        "CVTP with the picture, x 100",
        "contact within its material, %",
        "Frechet distance",
    }
    assert {"as of the picture, zero-shot, %", "as of the picture, classifier, %"} <= set(rows["real touch"])
    assert set(rows["picture: of another contact"]) == set(rows["picture"]) - {"Frechet distance"}  # the same as a set
    labels = pictured / "labels.csv"
    soundfile.write(pictured / "hit.wav", np.random.default_rng(0).normal(0, 0.1, 16_000), 16_000)
    first, *lines = labels.read_text().replace("material", "stuff").splitlines()  # a label that no prompt asks for
    labels.write_text("\n".join([f"{first},sound", *(f"{line},hit.wav" for line in lines)]))
    code, _, err = run("x-to-touch", "--data", pictured, "--each", "5", "-o", tmp_path, "--overwrite")
    assert code == 0, err
    rows = json.loads((tmp_path / "x-to-touch.json").read_text())["rows"]
    assert list(rows) == ["picture", "picture: of another contact", "sound", "sound: of another contact", "real touch"]


@pytest.mark.parametrize(("table", "change", "words", "said"), [
    ("touch-to-image", ("picture", "photo"), (), "no picture of every touch"),
    ("x-to-touch", ("picture", "photo"), (), "no pictures, captions or sounds"),
    ("x-to-touch", ("gelsight", "mine"), (), "was felt by mine, but the model draws touches by gelsight, digit"),
    ("x-to-touch", ("test", "val"), (), "and no 'test'"),
    ("touch-to-image", ("object", "size"), ("--each", "6"), "draws 24 of the 24 contacts in the test split"),
    ("x-to-touch", ("", ""), ("--data", "in"), "came several times"),
])  # fmt: skip
def test_data_that_nothing_can_be_measured_on_are_refused_before_a_file_is_read(
    command, models, here, refused, pictured, table, change, words, said
):
    for image in pictured.rglob("*.png"):
        image.write_bytes(b"no image")
    labels = pictured / "labels.csv"
    labels.write_text(labels.read_text().replace(*change))
    refused(command("evaluate", table, "--model", models[table], "--data", pictured, *words), said)


@pytest.mark.slow
def test_what_was_made_before_is_found_again(command, models, few, tmp_path):
    words = ("evaluate", "touch-to-image", "--model", models["touch-to-image"], *few, "-o", tmp_path)
    times = []
    for _ in range(2):
        code, _, err = command(*words, "--overwrite")
        assert code == 0, err
        times.append({file: file.stat().st_mtime_ns for file in (tmp_path / "cache").rglob("*") if file.is_file()})
    assert times[0] == times[1]


def test_what_was_fitted_is_found_again(run, touches, tmp_path, monkeypatch):
    words = ("material", "--data", touches, "-o", tmp_path / "tables", "--overwrite")
    tables = []
    for _ in range(2):
        code, _, err = run(*words)
        assert code == 0, err
        tables.append(Table.read(tmp_path / "tables/material.json").rows)
        monkeypatch.setattr(classification, "linear_probe", None)
    assert tables[0] == tables[1]
    (touches / "labels.csv").write_text((touches / "labels.csv").read_text().replace("thing", "part"))
    with pytest.raises(TypeError):  # other splits are fitted to anew
        run(*words)


def test_another_joint_space_gets_a_row_of_its_own(run, refused, models, touches, tmp_path):
    other = models["touch-to-image"]
    code, _, err = run("real", "--data", touches, "--beside", other, "-o", tmp_path / "tables")
    assert code == 0, err
    table = Table.read(tmp_path / "tables/real.json")
    row = f"touch encoder of {Path(other).parent.name}/touch-to-image, probe"
    assert table.rows[row] == table.rows["touch encoder, probe"]  # the same weights
    assert row in table.beside["touch encoder, probe"]
    refused(run("material", "--data", touches, "--beside", other), "`--beside` came")


def test_all_of_a_folder_are_the_tables_that_it_allows(run, touches, tmp_path):
    code, _, err = run("all", "--data", touches, "-o", tmp_path)
    assert code == 0, err
    assert {file.stem for file in tmp_path.glob("*.json")} == {"material", "prompts", "real"}
    assert "No table 'grasp'" in err and "No table 'retrieval'" in err


@pytest.mark.parametrize(("words", "said"), [
    (("taste",), "`table` is 'taste'"),
    (("real",), "pass `--data FOLDER`"),
    (("material", "--data", "nowhere"), "nowhere"),
    (("material", "--seeds", "0"), "`--seeds` is 0"),
    (("material", "--objects", "1"), "`--objects` is 1"),
    (("material", "--device", "abacus"), "abacus"),
    (("material", "--data", "in", "--pattern", "touch"), "`--pattern`"),
    (("material", "--data", "in"), "no class of material in its train split"),
    (("grasp", "--data", "in"), "'grasp' in a split"),
    (("real", "--data", "in"), "every label is known"),
    (("real", "--data", "in", "--data", "in"), "came several times"),
    (("material", "-o", "in/dark.png/tables"), "`--output`"),
    (("touch-to-image",), "which is a pipeline for x-to-touch"),
    (("x-to-touch", "--data", "in"), "neither splits nor objects"),
    (("x-to-touch", "--each", "0"), "`--each` is 0"),
    (("x-to-touch", "--inception", "nowhere.pt"), "`--inception` is 'nowhere.pt', which is no file"),
])  # fmt: skip
def test_mistakes_are_one_line(run, refused, here, words, said):
    refused(run(*words), said)


def test_what_is_refused_is_so_before_a_file_is_read(run, refused, touches):
    for image in touches.glob("*.png"):
        image.write_bytes(b"no image")
    refused(run("grasp", "--data", touches), "'grasp' in a split")
    refused(run("retrieval", "--data", touches), "pictures, sounds or captions")
    table = touches / "labels.csv"
    table.write_text(table.read_text().replace("brick", "wood"))
    refused(run("material", "--data", touches), "a single class of material")
    refused(run("real", "--data", touches), "material of 1 classes and 60 objects")


def test_grasps_by_other_names_are_refused(run, refused, touches):
    table = touches / "labels.csv"
    table.write_text(table.read_text().replace("material", "grasp"))
    refused(run("grasp", "--data", touches), "brick, wood", "dropped or lifted")


def test_a_table_of_another_kind_in_the_folder_is_told_at_once(run, refused, touches, tmp_path):
    (tmp_path / "material.json").write_text("{}")
    refused(run("real", "--data", touches, "-o", tmp_path), "no table of this version")


def test_tables_are_not_replaced_unasked(run, refused, touches, tmp_path):
    (tmp_path / "real.json").write_text("{}")
    refused(run("real", "--data", touches, "-o", tmp_path), "`--output` would replace", "--overwrite")
    code, _, err = run("real", "--data", touches, "-o", tmp_path, "--overwrite")
    assert code == 0, err


def test_a_folder_without_a_joint_space_is_refused(command, refused, here):
    refused(command("evaluate", "material", "--model", "in"), "holds no joint space")
