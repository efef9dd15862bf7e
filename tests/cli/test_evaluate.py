"""`unitouch-gen evaluate`, on a tiny random joint space."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from unitouch_gen.training.data import heldout
from unitouch_gen.world import MATERIAL_NAMES, SENSORS, World
from unitouch_gen.world.scans import scanned_surfaces


@pytest.fixture(scope="module")
def pictured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Touches of four materials of the world, with pictures of the same contacts, by `gelsight`."""
    sensor, folder = SENSORS["gelsight"], tmp_path_factory.mktemp("data") / "pictured"
    names = [np.repeat(range(4), 12), np.tile(np.repeat(range(6), 2), 4), np.tile(range(2), 24)]
    scene = World(0, image_size=32).render(*map(list, names), modalities=("image", "touch"), sensors=[sensor])
    rows = ["touch,picture,object,material,split,sensor"]
    for name, images in (("touch", scene.touch[sensor.name]), ("picture", scene.image)):
        (folder / name).mkdir(parents=True)
        for number, image in enumerate(images):
            pixels = (255 * image).round().byte().movedim(0, -1).numpy()
            Image.fromarray(pixels).save(folder / name / f"{number}.png")
    for number, (material, thing, _) in enumerate(zip(*names, strict=True)):
        split = ("train", "train", "train", "val", "test", "test")[thing]
        stuff = MATERIAL_NAMES[material]
        rows.append(f"touch/{number}.png,picture/{number}.png,{stuff}{thing},{stuff},{split},gelsight")
    (folder / "labels.csv").write_text("\n".join(rows))
    return folder


@pytest.fixture
def rows_of(command, tmp_path) -> Callable[..., dict[str, Any]]:
    """Makes a table and returns its rows."""

    def call(table: str, *words: object) -> dict[str, Any]:
        code, _, err = command("evaluate", table, *words, "--cache", tmp_path / "cache", "-o", tmp_path)
        assert code == 0, err
        return json.loads((tmp_path / f"{table}.json").read_text())["rows"]

    return call


def test_tables_of_a_data_set_stand_beside_their_controls(rows_of, models, pictured):
    tables = ("material", "prompts", "retrieval")
    found = {name: rows_of(name, "--model", models["x-to-touch"], "--data", pictured) for name in tables}
    assert found["material"]["chance"] == found["material"]["majority"] == {"pictured, in domain": [0.25]}
    assert {"touch encoder, probe", "touch encoder, zero-shot", "plain statistics, probe"} < set(found["material"])
    assert set(found["retrieval"]["touch encoder, in domain"]) == {"image"} and len(found["prompts"]) == 7


@pytest.mark.parametrize("table", ["touch-to-image", "x-to-touch"])
def test_what_pipelines_make_stands_beside_its_controls(rows_of, models, pictured, table):
    rows = rows_of(table, "--model", models[table], "--data", pictured, "--each", "2")
    row = "CVTP, in domain" if table == "touch-to-image" else "picture: CVTP, in domain"
    assert set(rows[row]) >= {"value", "class_mean", "shuffled", "ceiling"}
    distance = rows[row.replace("CVTP", "distance")]
    assert distance["ceiling"] < distance["value"]


@pytest.mark.slow
def test_the_world_gives_all_of_its_tables(rows_of, models, monkeypatch):
    monkeypatch.setattr(heldout, "OBJECTS", 1)
    words = ("--model", models["x-to-touch"], "--seeds", "1", "--objects", "2", "--each", "2")
    found = {name: rows_of(name, *words) for name in ("material", "prompts", "retrieval", "grasp", "x-to-touch")}
    sources = ("picture", "caption", "sound", "touch by another sensor")
    assert {f"{source}: CVTP, in domain" for source in sources} < set(found["x-to-touch"]) and all(found.values())


@pytest.mark.slow
def test_a_world_of_scanned_surfaces_has_their_materials_alone(rows_of, models, monkeypatch, tmp_path):
    monkeypatch.setattr(heldout, "OBJECTS", 1)
    words = ("--model", models["x-to-touch"], "--seeds", "1", "--objects", "2", "--scanned", "1", "--recordings", "0.5")
    chance = rows_of("material", *words)["chance"]
    materials = {one.material for one in scanned_surfaces() if one.split == "test" and one.heights != "none"}
    assert {share for shares in chance.values() for share in shares} == {1 / len(materials)}
    stored = json.loads((tmp_path / "material.json").read_text())
    assert (stored["scanned"], stored["recordings"]) == (1.0, 0.5)


REFUSED = [  # words of a command, what is changed in the labels, and what is said
    (("taste",), None, "`table` is 'taste'"),
    (("material", "--data", "nowhere"), None, "nowhere"),
    (("material", "--scanned", "0.5"), None, "`--scanned` is 0.5, but has no effect with `--data`"),
    (("retrieval", "--recordings", "1"), None, "`--recordings` is 1.0, but has no effect with `--data`"),
    (("touch-to-image",), None, "holds a XToTouchPipeline; name a saved TouchToImagePipeline"),
    (("material", "--model", "in"), None, "config.json', which does not exist"),
    (("grasp",), None, "the classes none of grasp to train on, not dropped and lifted"),
    (("grasp",), ("material", "grasp"), "not dropped and lifted"),
    (("material",), ("material", "stuff"), "the classes none of material to train on, not two or more"),
    (("retrieval",), ("picture", "photo"), "no audio or image or text of every touch"),
    (("x-to-touch",), ("gelsight", "mine"), "are by sensors other than"),
    (("x-to-touch",), ("test", "val"), "and no 'test'"),
    (("x-to-touch", "--each", "4"), None, "needs 18"),
]  # fmt: skip


def test_what_cannot_be_measured_is_one_line_before_a_file_is_read(command, models, here, refused, pictured):
    for name in pictured.rglob("*.png"):
        file = here / "pictured" / name.relative_to(pictured)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(b"no image")
    for words, change, said in REFUSED:
        labels = (pictured / "labels.csv").read_text().replace(*change or ("", ""))
        (here / "pictured" / "labels.csv").write_text(labels)
        refused(command("evaluate", "--data", "pictured", "--model", models["x-to-touch"], *words), said)


@pytest.mark.parametrize("option", ["--scanned", "--recordings"])
@pytest.mark.parametrize("share", ["-0.1", "1.5", "nan", "half"])
def test_a_share_is_from_none_to_all(command, refused, option, share):
    refused(command("evaluate", "material", option, share), option)


def test_tables_are_not_replaced_unasked(command, refused, tmp_path):
    (tmp_path / "material.json").write_text("{}")
    refused(command("evaluate", "material", "-o", tmp_path), "`--output` would replace", "--overwrite")
