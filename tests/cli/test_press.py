"""`unitouch-gen press`: what it writes, and what it refuses before anything is written."""

import json

import numpy as np
import pytest
from PIL import Image

from unitouch_gen.examples import example
from unitouch_gen.world import SENSORS, press


def test_touches_and_depth_maps_are_the_librarys(command, here):
    words = ("press", "example:coin", "--mm", 24, "--sensor", "digit", "--sensor", "gelsight", "--size", 64)
    code, out, err = command(*words, "--at", "0,0", "--at", "8,-1.5", "--depth-maps", "-o", "out", "--json")
    assert (code, err) == (0, "")
    rows = json.loads(out)["pictures"]
    assert [(row["sensor"], row["picture"].rpartition("-")[2]) for row in rows] == [
        ("digit", "1.png"),
        ("digit", "2.png"),
        ("gelsight", "1.png"),
        ("gelsight", "2.png"),
    ]
    for row, name in ((1, "digit"), (3, "gelsight")):
        made = press(example("coin", "height"), 24.0, name, at=[(0.0, 0.0), (8.0, -1.5)], image_size=64)
        pixels = np.asarray(Image.open(rows[row]["picture"])) / 255
        np.testing.assert_allclose(pixels, made.touch[1].permute(1, 2, 0), atol=0.5 / 255 + 1e-6)
        image = Image.open(rows[row]["depth_map"])
        depth = float(image.text["mm_per_level"]) * np.asarray(image)
        np.testing.assert_allclose(depth, made.depth[1].clamp_min(0.0), atol=1e-4)
        assert float(image.text["mm_per_pixel"]) == pytest.approx(SENSORS[name].field_of_view / 64, rel=1e-5)
        assert rows[row]["deepest_mm"] == pytest.approx(depth.max(), abs=2e-4)


def test_one_touch_may_be_named_and_all_sensors_asked_for(command, here):
    assert command("press", "example:coin", "--mm", 24, "-o", "one.png")[0] == 0
    assert Image.open("one.png").size == (128, 128)
    code, out, _ = command("press", "example:coin", "--mm", 24, "--sensor", "all", "-o", "all")
    assert code == 0
    assert "Touches are in" in out
    assert {file.stem for file in (here / "all").iterdir()} == {f"coin-{name}" for name in SENSORS}
