"""`unitouch-gen stylize` and `unitouch-gen x-to-touch`, and what every command says of unfamiliar touches.

Run in this process on tiny random pipelines.
"""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import soundfile
from PIL import Image

from unitouch_gen.cli.options import generators


@pytest.fixture
def here(tmp_path, monkeypatch) -> Path:
    """A folder to be in, with two touches, a photo, and a sound."""
    rng = np.random.default_rng(0)
    for name, shape in {"one.png": (32, 32, 3), "two.png": (32, 32, 3), "photo.jpg": (40, 60, 3)}.items():
        Image.fromarray(rng.integers(0, 256, shape, dtype=np.uint8)).save(tmp_path / name)
    soundfile.write(tmp_path / "hit.wav", rng.standard_normal(4000) * np.exp(-np.arange(4000) / 500), 16_000)
    soundfile.write(tmp_path / "silence.wav", np.zeros(4000), 16_000)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def run(command, models):
    """Runs a command with its model."""
    return lambda name, *args: command(name, *args, "--model", models[name])


def pixels(file: str | Path) -> np.ndarray:
    return np.asarray(Image.open(file))


# stylize --------------------------------------------------------------------------------------------------------------


def test_a_photo_is_restyled_by_each_touch(here, run):
    code, out, _ = run("stylize", "photo.jpg", "one.png", "two.png", "-o", "out", "--json")
    assert code == 0
    rows = json.loads(out)["pictures"]
    assert [Path(row["picture"]).name for row in rows] == ["photo-one.png", "photo-two.png"]
    assert all(pixels(row["picture"]).shape == (16, 16, 3) for row in rows)


def test_a_picture_does_not_depend_on_its_neighbours(here, run):
    run("stylize", "photo.jpg", "one.png", "two.png", "-o", "both")
    run("stylize", "photo.jpg", "two.png", "-o", "alone.png")
    np.testing.assert_allclose(pixels("alone.png").astype(int), pixels("both/photo-two.png").astype(int), atol=1)


def test_batches_make_the_same_pictures(here, run):
    run("stylize", "photo.jpg", "one.png", "two.png", "-o", "both")
    run("stylize", "photo.jpg", "one.png", "two.png", "-o", "each", "--batch-size", 1)
    for name in ("photo-one.png", "photo-two.png"):
        np.testing.assert_allclose(pixels(f"both/{name}").astype(int), pixels(f"each/{name}").astype(int), atol=1)


# x-to-touch -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "modality", [("--image", "photo.jpg"), ("--text", "rough brick"), ("--audio", "hit.wav"), ("--touch", "one.png")]
)
def test_each_modality_becomes_a_touch(here, run, modality):
    code, out, _ = run("x-to-touch", *modality, "-o", "out", "--json")
    assert code == 0
    (row,) = json.loads(out)["touches"]
    assert (row["sensor"], Path(row["touch"]).name) == ("gelsight", "gelsight.png")
    assert pixels(row["touch"]).shape == (16, 16, 3)


def test_all_sensors_are_drawn(here, run):
    code, out, _ = run("x-to-touch", "--text", "rough brick", "--sensor", "all", "-o", "out", "--candidates", 2)
    assert code == 0 and "gelsight.png" in out
    assert sorted(path.name for path in Path("out").iterdir()) == ["digit.png", "gelsight.png"]


def test_what_touches_of_unknown_sensors_feel_like_is_left_out(here, run, models, monkeypatch):
    folder = Path("strange")
    shutil.copytree(models["x-to-touch"], folder)
    index = folder / "model_index.json"
    index.write_text(json.dumps({**json.loads(index.read_text()), "sensors": ["gelsight", "gelslim"]}))
    monkeypatch.setitem(models, "x-to-touch", str(folder))
    code, out, err = run("x-to-touch", "--text", "rough brick", "--sensor", "all", "-o", "out", "--json")
    assert code == 0
    assert [len(row["materials"]) for row in json.loads(out)["touches"]] == [3, 0]
    assert err.startswith("unitouch-gen: what touches of gelslim feel like is left out") and err.count("\n") == 1


def test_modalities_are_mixed_by_weight(here, run):
    run("x-to-touch", "--text", "rough brick", "-o", "text.png")
    both = ("--text", "rough brick", "--image", "photo.jpg")
    run("x-to-touch", *both, "--weight", "text=1", "--weight", "image=0", "-o", "weighed.png")
    run("x-to-touch", *both, "-o", "even.png", "--bridge")
    assert np.array_equal(pixels("weighed.png"), pixels("text.png"))
    assert not np.array_equal(pixels("even.png"), pixels("text.png"))


# Unfamiliar touches ---------------------------------------------------------------------------------------------------


@pytest.fixture
def bowl(here) -> str:
    """What no sensor here would see; `known.png` is the prototype of the first."""
    checks = 255 * ((np.arange(32)[:, None] + np.arange(32)) % 2)
    Image.fromarray(np.stack([checks] * 3, axis=2).astype(np.uint8)).save("bowl.png")
    Image.new("RGB", (32, 32), (51, 51, 51)).save("known.png")
    return "bowl.png"


@pytest.mark.parametrize("words", [["touch-to-image"], ["stylize", "photo.jpg"], ["x-to-touch", "--touch"]])
def test_a_touch_unlike_any_known_is_named_in_one_line(bowl, run, words):
    code, out, err = run(*words, bowl, "-o", "out", "--json")
    assert code == 0 and json.loads(out)
    assert err.startswith("unitouch-gen: bowl.png: unlike") and err.count("\n") == 1
    assert run(*words, "known.png", "-o", "out", "--json")[2] == ""


def test_a_photo_in_the_place_of_the_touch_is_one_line_more(bowl, run):
    code, _, err = run("stylize", "known.png", bowl, "-o", "out", "--json")
    assert code == 0 and err.startswith("unitouch-gen: `image` looks more like a touch") and err.count("\n") == 2


def test_batches_do_not_repeat_the_line(bowl, run):
    _, _, err = run("touch-to-image", bowl, "known.png", bowl, "-o", "out", "--json", "--batch-size", 1)
    assert err.startswith("unitouch-gen: bowl.png, bowl.png: unlike") and err.count("\n") == 1


@pytest.mark.parametrize("words", [["touch-to-image"], ["stylize", "photo.jpg"]])
def test_re_centred_touches_need_no_such_line(bowl, run, words):
    assert run(*words, bowl, "-o", "out", "--json", "--background", bowl)[2] == ""


# Mistakes -------------------------------------------------------------------------------------------------------------

MISTAKES = {
    "no modality": (["x-to-touch", "-o", "out"], "Nothing to make a touch of came"),
    "silence": (["x-to-touch", "--audio", "silence.wav", "-o", "out"], "`audio` is silent"),
    "no sound": (["x-to-touch", "--audio", "one.png", "-o", "out"], "cannot be read as a sound"),
    "blank text": (["x-to-touch", "--text", " ", "-o", "out"], "`text` is blank"),
    "unknown sensor": (["x-to-touch", "--text", "brick", "--sensor", "digits", "-o", "out"], "Did you mean 'digit'"),
    "weight of no modality": (
        ["x-to-touch", "--text", "brick", "--weight", "smell=1", "-o", "out"],
        "`weights` names 'smell', which is no modality; `text` came",
    ),
    "weight of no number": (
        ["x-to-touch", "--text", "brick", "--weight", "text=x", "-o", "out"],
        "`--weight` is 'text=x'",
    ),
    "no candidates": (["x-to-touch", "--text", "brick", "--candidates", "0", "-o", "out"], "`candidates` is 0"),
    "two sensors, one file": (
        ["x-to-touch", "--text", "brick", "--sensor", "all", "-o", "out.png"],
        "is the file 'out.png' for 2 pictures",
    ),
    "photo is missing": (["stylize", "none.jpg", "one.png", "-o", "out"], "'none.jpg', which does not exist"),
    "touch is missing": (["stylize", "photo.jpg", "none.png", "-o", "out"], "'none.png', which does not exist"),
    "weight above 1": (["stylize", "photo.jpg", "one.png", "--touch-weight", "1.5", "-o", "out"], "`--touch-weight`"),
    "negative weight": (["stylize", "photo.jpg", "one.png", "--touch-weight", "-1", "-o", "out"], "`--touch-weight`"),
    "unknown mix": (["stylize", "photo.jpg", "one.png", "--mix", "slurp", "-o", "out"], "Did you mean 'slerp'"),
    "init strength": (["stylize", "photo.jpg", "one.png", "--init-strength", "2", "-o", "out"], "`init_strength` is 2"),
    "replaces the photo": (["stylize", "photo.jpg", "one.png", "-o", "photo.jpg"], "would replace the input"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_one_line_and_leaves_nothing(here, run, name):
    before = sorted(path.name for path in here.rglob("*"))
    args, words = MISTAKES[name]
    code, out, err = run(*args)
    assert (code, out) == (2, "")
    assert err.count("\n") == 1 and words in err
    assert sorted(path.name for path in here.rglob("*")) == before


def test_candidates_start_from_noise_of_their_own():
    """And what a picture is made from does not depend on how many there are."""
    seeds = [generator.initial_seed() for generator in generators(5, 2, 3)]
    assert seeds == [5, 6, 7, 5, 6, 7]
