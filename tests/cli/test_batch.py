"""`unitouch-gen batch`: from the manifest to pictures, ledger and exit code."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.helpers.processes import Child, finished
from tests.helpers.processes import command as commanded


@pytest.fixture
def run(command, models):
    """Runs `unitouch-gen batch ... -o out` on the model of touch-to-image."""
    return lambda *args: command("batch", "-o", "out", *args, "--model", models["touch-to-image"])


def lines(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "ledger.jsonl").read_text().splitlines()]


def test_a_folder_becomes_pictures_and_a_ledger(here, run, files):
    code, out, err = run("in")
    assert (code, err) == (0, "")
    assert "2 pictures are in" in out and "ledger.jsonl" in out
    assert files(here / "out") == ["bright.png", "dark.png", "ledger.jsonl", "run.json"]
    assert [(line["name"], line["touch_sensor"]) for line in lines(here / "out")] == [
        ("bright", "digit"),
        ("dark", "gelsight"),
    ]


def test_options_are_what_items_say_nothing_of(here, run, command, models):
    (here / "table.csv").write_text("touch,steps,seed\nin/dark.png,3,\nin/bright.png,,9\n")
    assert run("table.csv", "--steps", 2, "--seed", 4, "--set", "sensor=digit")[0] == 0
    assert [(line["steps"], line["seed"], line["sensor"]) for line in lines(here / "out")] == [
        (3, 4, "digit"),
        (2, 9, "digit"),
    ]
    words = ["--steps", 3, "--seed", 4, "--sensor", "digit", "--model", models["touch-to-image"]]
    assert command("touch-to-image", "in/dark.png", "-o", "dark.png", *words)[0] == 0
    assert (here / "dark.png").read_bytes() == (here / "out" / "dark.png").read_bytes()


def test_some_that_fail_are_told_and_make_exit_code_1(here, run):
    (here / "in" / "notes.png").write_text("This is no picture.")
    code, out, err = run("in")
    assert code == 1 and "2 pictures are in" in out and "1 failed" in out
    assert err.startswith("unitouch-gen: notes failed: `touch` names ") and err.count("\n") == 1
    code, out, _ = run("in", "--json")
    assert code == 1
    told = json.loads(out)
    assert told["made"] == 2 and [*told["failed"]] == ["notes"]


def test_pictures_that_are_guesses_are_told(here, run):
    code, out, err = run("in", "--set", "background=in/dark.png")
    assert code == 0 and "2 pictures are in" in out
    assert err == "unitouch-gen: Unknown to the model, so a guess: dark (touch: nothing is touched)\n"
    assert json.loads(run("in", "--set", "background=in/dark.png", "--json")[1])["unknown"] == {
        "dark": {"touch": "nothing is touched"}
    }


@pytest.mark.parametrize(
    ("table", "options", "words"),
    [
        ("touch,seed\nin/dark.png,x\n", [], ["`manifest` is 'table.csv'", "line 2", "`seed` is 'x'"]),
        ("touch,stepps\nin/dark.png,1\n", [], ["names 'stepps'", "Did you mean 'steps'"]),
        ("", [], ["`manifest` is 'table.csv'", "nothing"]),
        ("touch\nin/dark.png\n", ["--set", "bogus=1"], ["`--set` is 'bogus=1'"]),
        ("touch\nin/dark.png\n", ["--set", "strength"], ["`--set` is 'strength'"]),
        ("touch\nin/dark.png\n", ["--steps", 0], ["`--steps` is 0"]),
        ("touch\nin/dark.png\n", ["--batch-size", 0], ["`batch_size` is 0"]),
        ("touch\nin/dark.png\n", ["--shard-size", 0], ["`shard_size` is 0"]),
        ("touch\nin/dark.png\n", ["--pipeline", "stylize"], ["`pipeline` is 'stylize'", "stylization"]),
        ("touch\nin/dark.png\n", ["--kind", "touch"], ["`kind` is 'touch'"]),
        ("touch,text,pipeline\nin/dark.png,,\n,brick,x-to-touch\n", [], ["`--model` came for"]),
        ("touch\nin/dark.png\n", ["-o", "in/dark.png"], ["`output`", "in/dark.png"]),
    ],
)
def test_what_cannot_be_begun_is_one_line_and_leaves_nothing(here, run, refused, files, table, options, words):
    (here / "table.csv").write_text(table)
    refused(run("table.csv", *options), *words)
    assert files(here) == ["in/bright.png", "in/dark.png", "table.csv"]
    assert not (here / "out").exists()


def test_pictures_do_not_go_among_the_inputs(here, command, refused):
    refused(command("batch", "in", "-o", "in/out"), "`--output` is 'in/out'")


LAUNCHERS = {
    "torchrun": ["torch.distributed.run", "--standalone", "--nproc-per-node", "2", "--no-python"],
    "accelerate": ["accelerate.commands.launch", "--multi_gpu", "--num_processes", "2", "--main_process_port", "0",
                   "--no_python"],
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_processes_are_those_of_a_launcher(here, run, models, launcher):
    words = ["batch", "table.csv", "-o", "out", "--batch-size", "1", "--model", models["touch-to-image"]]
    (here / "table.csv").write_text("touch,seed\n" + "".join(f"in/dark.png,{seed}\n" for seed in range(6)))
    script = "import sys; from unitouch_gen.cli import main; sys.argv[0] = 'unitouch-gen'; main()"
    command = [sys.executable, "-m", *LAUNCHERS[launcher], sys.executable, "-c", script, *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and done.stdout.count("6 pictures are in") == 1, done.stderr
    assert [line["seed"] for line in lines(here / "out")] == [*range(6)]


def test_kills_neither_repeat_nor_lose_an_item(here, models):
    (here / "table.csv").write_text("touch,seed\n" + "".join(f"in/dark.png,{seed}\n" for seed in range(6)))
    words = ["batch", "table.csv", "--batch-size", "2", "--model", models["touch-to-image"], "-o"]
    whole = finished(Child(commanded, *words, "whole", folder=here))
    for part in (3, 3, 2):  # of the changes to files that are left
        assert Child(commanded, *words, "killed", folder=here, killed_at=whole.changes // part).wait() == -9
    finished(Child(commanded, *words, "killed", folder=here))
    found = [{file.name: file.read_bytes() for file in (here / name).iterdir()} for name in ("whole", "killed")]
    assert found[0] == found[1]
