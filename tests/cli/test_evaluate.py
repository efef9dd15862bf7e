"""`unitouch-gen evaluate`, on a tiny random joint space."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from tests.helpers.data_sets import pictured_labels, write_pictured
from unitouch_gen.evaluation.tables import TEMPLATES
from unitouch_gen.training.data import heldout
from unitouch_gen.world import MATERIAL_NAMES, SENSORS, World
from unitouch_gen.world.scans import scanned_surfaces


@pytest.fixture(scope="module")
def pictured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Touches of four materials of the world, with pictures of the same contacts, by `gelsight`."""
    sensor = SENSORS["gelsight"]
    folder = tmp_path_factory.mktemp("data") / "pictured"
    write_pictured(folder)
    names = zip(*pictured_labels(), strict=True)
    scene = World(0, image_size=32).render(*names, modalities=("image", "touch"), sensors=[sensor])
    for name, images in (("touch", scene.touch[sensor.name]), ("picture", scene.image)):
        for number, image in enumerate(images):
            pixels = (255 * image).round().byte().movedim(0, -1).numpy()
            Image.fromarray(pixels).save(folder / name / f"{number}.png")
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
    assert set(found["retrieval"]["touch encoder, in domain"]) == {"image"}
    assert set(found["prompts"]) == {"chance", *(f"{template}" for template in TEMPLATES)}


@pytest.mark.parametrize("table", ["touch-to-image", "x-to-touch"])
def test_tables_of_pipelines_rank_real_images_first(rows_of, models, pictured, table):
    rows = rows_of(table, "--model", models[table], "--data", pictured, "--each", "2")
    distance = rows["distance, in domain" if table == "touch-to-image" else "picture: distance, in domain"]
    assert distance["ceiling"] < distance["value"]


@pytest.mark.slow
def test_the_world_gives_all_of_its_tables(rows_of, models, monkeypatch):
    monkeypatch.setattr(heldout, "OBJECTS", 1)
    words = ("--model", models["x-to-touch"], "--seeds", "1", "--objects", "2", "--each", "2")
    found = {name: rows_of(name, *words) for name in ("material", "prompts", "retrieval", "grasp", "x-to-touch")}
    chances = {"material": 1 / len(MATERIAL_NAMES), "prompts": 1 / len(MATERIAL_NAMES), "grasp": 0.5}
    for table, chance in chances.items():
        assert {share for shares in found[table]["chance"].values() for share in shares} == {chance}
    for source in ("picture", "caption", "sound", "touch by another sensor"):
        distance = found["x-to-touch"][f"{source}: distance, in domain"]
        assert distance["ceiling"] < distance["value"]


@pytest.mark.slow
def test_a_world_of_scanned_surfaces_has_their_materials_alone(rows_of, models, monkeypatch, tmp_path):
    monkeypatch.setattr(heldout, "OBJECTS", 1)
    words = ("--model", models["x-to-touch"], "--seeds", "1", "--objects", "2", "--scanned", "1", "--recordings", "0.5")
    chance = rows_of("material", *words)["chance"]
    materials = {one.material for one in scanned_surfaces() if one.split == "test" and one.heights != "none"}
    assert {share for shares in chance.values() for share in shares} == {1 / len(materials)}
    stored = json.loads((tmp_path / "material.json").read_text())
    assert (stored["scanned"], stored["recordings"]) == (1.0, 0.5)
