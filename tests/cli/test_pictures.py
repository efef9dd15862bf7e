"""`unitouch-gen touch-to-image`, `stylize` and `x-to-touch` on tiny random pipelines: pictures, and what is printed."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch
from PIL import Image

from tests.helpers import recordings
from unitouch_gen.cli.pictures import save, unique
from unitouch_gen.errors import InvalidInputError


@pytest.fixture
def run(command, models):
    """Runs a command of a line with its model, and gives what it printed as JSON."""

    def call(line: str, *words: object) -> dict:
        name, *rest = line.split()
        code, out, err = command(name, *rest, *words, "--model", models[name], "--json")
        assert code == 0, err
        return json.loads(out)

    return call


def pixels(file: str | Path) -> np.ndarray:
    return np.asarray(Image.open(file), dtype=int)


def same(file: str | Path, other: str | Path, tolerance: int = 1) -> bool:
    """Whether two pictures are the same, but for rounding in calls of another size."""
    return abs(pixels(file) - pixels(other)).max() <= tolerance


def test_pictures_are_those_of_the_pipeline(here, run, pipes):
    words = "--steps 4 --guidance 1.5 --sensor digit --strength 0.5 --negative-prompt wood --noise-level 30"
    settings = "--solver ddim --set height=24 --set eta=0.5"
    run(f"touch-to-image in/dark.png -o out --seed 3 {words} {settings}", "--prompt", "rough brick")
    expected = pipes["touch-to-image"](
        "in/dark.png",
        "rough brick",
        num_inference_steps=4,
        guidance_scale=1.5,
        sensor="digit",
        solver="ddim",
        strength=0.5,
        negative_prompt="wood",
        noise_level=30,
        height=24,
        eta=0.5,
        generator=torch.Generator().manual_seed(3),
    ).images[0]
    assert np.array_equal(pixels("out/dark.png"), np.asarray(expected))


def test_a_picture_is_the_same_alone_and_among_others(here, run):
    rows = run("touch-to-image in/dark.png in/bright.png -o two --images 2 --batch-size 3")["pictures"]
    assert [(row["touch"], row["picture"], row["touch_sensor"]) for row in rows] == [
        (f"in/{name}.png", f"two/{name}-{number}.png", sensor)
        for name, sensor in (("dark", "gelsight"), ("bright", "digit"))
        for number in (1, 2)
    ]
    run("touch-to-image in/bright.png -o alone.png")
    assert same("alone.png", "two/bright-1.png")
    assert not same("alone.png", "two/bright-2.png")
    run("touch-to-image in/bright.png -o seed.jpg --seed 1")
    assert Image.open("seed.jpg").format == "JPEG"
    assert not same("seed.jpg", "two/bright-1.png")


def test_a_photo_is_restyled_by_each_touch(here, run, pipes):
    rows = run("stylize in/dark.png in/dark.png in/bright.png -o out")["pictures"]
    assert [Path(row["picture"]).name for row in rows] == ["dark-dark.png", "dark-bright.png"]
    alone = pipes["stylize"]("in/dark.png", "in/bright.png", generator=torch.Generator().manual_seed(0))
    assert abs(np.asarray(alone.images[0], dtype=int) - pixels("out/dark-bright.png")).max() <= 1


def test_anything_becomes_a_touch(here, run):
    soundfile.write("hit.wav", np.random.default_rng(0).normal(0, 0.1, 4000), 16_000)
    for option, value, stem in (
        ("image", "in/dark.png", "dark"),
        ("text", "Rough_brick!", "rough_brick"),
        ("audio", "hit.wav", "hit"),
        ("touch", "in/bright.png", "bright"),
    ):
        (row,) = run(f"x-to-touch --{option} {value} -o out")["pictures"]
        assert (row[option], row["sensor"], row["picture"]) == (value, "gelsight", f"out/{stem}-gelsight.png")


def test_inputs_go_in_pairs_and_are_drawn_for_each_sensor(here, run):
    rows = run("x-to-touch --image in --text brick --sensor all -o out --batch-size 3")["pictures"]
    assert [Path(row["picture"]).stem for row in rows] == [
        f"{name}-brick-{sensor}" for name in ("bright", "dark") for sensor in ("gelsight", "digit")
    ]
    run("x-to-touch --image in/dark.png --text brick --sensor digit -o alone.png")
    assert same("alone.png", "out/dark-brick-digit.png")
    run("x-to-touch --text brick -o text.png")
    weights = '--set weights={"text":1,"image":0}'
    run(f"x-to-touch --image in/dark.png --text brick -o weighed.png {weights}")
    assert same("weighed.png", "text.png", tolerance=0)


@pytest.mark.parametrize(
    ("words", "stems"),
    [
        ("in", ["9", "10", "a[1]", "bright", "dark"]),
        ("in/*.png **/br*", ["10", "a[1]", "bright", "dark", "bright-2"]),
        ("in[7]/b* in[7]/*", ["bright", "9", "10", "a[1]", "bright-2", "dark"]),
        ("in/a[1].png in/press.mp4", ["a[1]", "press"]),
        ("loop/**/*.png", ["bright", "dark"]),
        ("example:brick example:digit_wood", ["gelsight_brick", "digit_wood"]),
    ],
)
def test_globs_folders_and_examples_stand_for_files(here, run, words, stems):
    for name in ("10.png", "9.PNG", "a[1].png"):
        shutil.copy("in/dark.png", f"in/{name}")
    for name in ("._a.png", "Thumbs.db", "notes.txt"):
        (here / "in" / name).touch()
    if "[7]" in words:
        (here / "in").rename("in[7]")
    if "loop" in words:  # of links, two of which `glob` would not come out of
        shutil.copytree("in", "loop/a", ignore=shutil.ignore_patterns("1*", "9*", "a*"))
        for name in ("up", "top"):
            (here / "loop" / "a" / name).symlink_to("..")
    if "press" in words:
        pytest.importorskip("av")
        recordings.write(here / "in" / "press.mp4", list(recordings.frames()))
    rows = run(f"touch-to-image {words} -o out")["pictures"]
    assert [Path(row["picture"]).stem for row in rows] == stems


def test_text_says_where_pictures_are_and_overwrite_replaces_them(here, command, models):
    words = ("touch-to-image", "in/dark.png", "-o", "out", "--steps", 3, "--model", models["touch-to-image"])
    code, out, err = command(*words)
    assert (code, err) == (0, "")
    assert all(word in out.replace("\n", "") for word in ("dark.png", "gelsight", str(here / "out"), "3 steps"))
    before = pixels("out/dark.png")
    assert command(*words, "--seed", 2, "--overwrite")[0] == 0
    assert not np.array_equal(pixels("out/dark.png"), before)


def test_no_two_pictures_have_one_name():
    assert unique(["a-2", "a", "A", "a"]) == ["a-2", "a", "A-3", "a-4"]


def test_a_picture_that_cannot_be_saved_leaves_the_one_before_it(tmp_path):
    """A format that Pillow starts to write and then gives up."""
    save(Image.new("RGB", (8, 8)), tmp_path / "picture.jpg")
    before = (tmp_path / "picture.jpg").read_bytes()
    with pytest.raises(InvalidInputError, match="`--output` cannot be written"):
        save(Image.new("RGB", (70_000, 1)), tmp_path / "picture.jpg")
    assert (tmp_path / "picture.jpg").read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 1
