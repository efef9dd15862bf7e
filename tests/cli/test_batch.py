"""`unitouch-gen batch`: a picture of each item, once, whatever ends the run, in one process or several."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch
from PIL import Image

from tests.helpers import recordings


@pytest.fixture
def run(command, models):
    """Runs `unitouch-gen batch SOURCE -o out ...`."""

    def call(source, *words, pipeline="touch-to-image"):
        return command("batch", source, "-o", "out", "--pipeline", pipeline, *words, "--model", models[pipeline])

    return call


def lines(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "manifest.jsonl").read_text().splitlines()]


def test_lines_of_a_table_say_what_each_picture_is(here, run, pipes, files):
    """Of a table with semicolons and a mark in front, as spreadsheets write them."""
    (here / "in" / "table.CSV").write_text(
        "\ufeffTouch;name;prompt;seed\ndark.png;walls/one;rough, brick;5.0\nbright.png;;wood;\n;;;\ndark.png;;;6\n"
    )
    code, out, err = run("in/table.CSV", "--seed", 4, "--steps", 3, "--sensor", "digit", "--set", "strength=0.5")
    assert (code, err) == (0, "")
    assert f"3 of 3 pictures are in {here / 'out'}" in out
    assert files(here / "out") == ["bright.png", "dark.png", "manifest.jsonl", "walls/one.png"]
    told = {Path(line["picture"]).stem: (line["seed"], line["num_inference_steps"]) for line in lines(here / "out")}
    assert told == {"one": (5, 3), "bright": (4, 3), "dark": (6, 3)}
    seed = torch.Generator().manual_seed(5)
    alone = pipes["touch-to-image"](
        "in/dark.png", "rough, brick", sensor="digit", strength=0.5, num_inference_steps=3, generator=seed
    ).images[0]
    assert abs(np.asarray(alone, dtype=int) - np.asarray(Image.open("out/walls/one.png"))).max() <= 1


def test_folders_leave_out_the_hidden_the_foreign_and_what_was_made(here, run, files):
    """A video goes with the pictures, and so does what is behind a link, once."""
    pytest.importorskip("av")
    for name in ("._a.png", ".DS_Store", "@eaDir/dark.png", ".ipynb_checkpoints/dark-checkpoint.png", "out/old.png"):
        (here / "in" / name).parent.mkdir(exist_ok=True)
        (here / "in" / name).write_bytes((here / "in" / "dark.png").read_bytes())
    recordings.write(here / "in" / "press.MP4", list(recordings.frames()))
    (here / "far").mkdir()
    (here / "in" / "dark.png").rename(here / "far" / "dark.png")
    (here / "in" / "link").symlink_to(here / "far")
    (here / "far" / "back").symlink_to(here / "in")
    code, _, err = run("in", "-o", "in/out")
    assert (code, err) == (0, "unitouch-gen: 4 other files in in are left out.\n")
    assert files(here / "in" / "out") == ["bright.png", "link/dark.png", "manifest.jsonl", "old.png", "press.png"]


def test_words_and_folders_for_x_to_touch(here, run, files):
    (here / "list.csv").write_text("text,sensor\nbrick,digit\nbrick,\n")
    assert run("list.csv", "--set", "bridge=False", "--sensor", "gelsight", pipeline="x-to-touch")[0] == 0
    assert [(line["sensor"], line["bridge"]) for line in lines(here / "out")] == [("digit", False), ("gelsight", False)]
    soundfile.write("in/hit.wav", np.random.default_rng(0).normal(0, 0.1, 4000), 16_000)
    assert run("in", pipeline="x-to-touch")[0] == 0
    wanted = ["brick-2.png", "brick.png", "bright.png", "dark.png", "hit.png", "manifest.jsonl"]
    assert files(here / "out") == wanted
    assert len(lines(here / "out")) == 5


def test_items_that_fail_are_told_and_tried_again(here, run, files):
    (here / "in" / "notes.png").write_text("no picture")
    for _ in range(2):
        code, out, err = run("in", "--batch-size", 8)
        assert code == 1
        assert "2 of 3 pictures are in" in out
        assert err.startswith("unitouch-gen: out/notes.png failed: `touch")
        assert err.count("\n") == 1
    before = (here / "out" / "dark.png").stat().st_mtime_ns
    Image.new("RGB", (32, 32)).save("in/notes.png")
    assert run("in")[0] == 0
    assert (here / "out" / "dark.png").stat().st_mtime_ns == before
    assert files(here / "out") == ["bright.png", "dark.png", "manifest.jsonl", "notes.png"]


@pytest.mark.parametrize(("last", "kept"), [('{"mine": 2}', 2), ('{"mine": ', 1)])
def test_a_manifest_without_an_end_of_line_loses_no_whole_line(here, run, last, kept):
    """As editors and other programs leave one; half a line, as a full disk does, is left out."""
    (here / "table.csv").write_text("touch\nin/dark.png\n")
    (here / "out").mkdir()
    (here / "out" / "manifest.jsonl").write_text('{"mine": 1}\n' + last)
    assert run("table.csv")[0] == 0
    assert [line.get("mine") for line in lines(here / "out")] == [*range(1, kept + 1), None]


@pytest.mark.slow
def test_processes_of_a_launcher_share_the_work(here, models):
    (here / "table.csv").write_text("touch,seed\n" + "".join(f"in/dark.png,{seed}\n" for seed in range(6)))
    words = ["batch", "table.csv", "-o", "out", "--batch-size", "1", "--model", models["touch-to-image"]]
    script = "import sys; from unitouch_gen.cli import main; sys.argv[0] = 'unitouch-gen'; main()"
    launcher = ["torch.distributed.run", "--standalone", "--nproc-per-node", "2", "--no-python"]
    command = [sys.executable, "-m", *launcher, sys.executable, "-c", script, *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("6 of 6 pictures are in") == 1, done.stderr
    assert sorted(line["seed"] for line in lines(here / "out")) == [*range(6)]
