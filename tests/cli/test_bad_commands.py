"""Commands that cannot run: one line, exit code 2, nothing written, and no network has run."""

import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import pytest
import torch
import typer
from PIL import Image

import unitouch_gen
from tests.helpers.processes import Child
from tests.helpers.processes import command as commanded
from unitouch_gen.cli import commands

TO_IMAGE = "touch-to-image in/dark.png -o out"
TO_TOUCH = "x-to-touch -o out"
BAD = {
    "spelling": [
        ("bogus", "No such command 'bogus'"),
        ("touch-to-image in/dark.png", "--output"),
        (f"{TO_IMAGE} --solver dimm", "`solver` is 'dimm'", "Did you mean 'ddim'?"),
        (f"{TO_IMAGE} --set heigth=8", "`--set` is 'heigth'", "Did you mean 'height'?"),
        ("touch-to-image example:brik -o out", "Did you mean 'brick'?"),
        ("batch in -o out --pipeline stylize", "`--pipeline` is 'stylize'", "'stylization'"),
    ],
    "kinds and ranges": [
        (f"{TO_IMAGE} --steps 0", "--steps"),
        (f"{TO_IMAGE} --guidance nan", "--guidance-scale"),
        (f"{TO_IMAGE} --seed -1", "--seed"),
        (f"{TO_IMAGE} --dtype float8", "`--dtype` is 'float8'"),
        (f"{TO_IMAGE} --device cuda:99", "`--device` is 'cuda:99'"),
        ("app --host no.such.host.invalid", "'no.such.host.invalid'"),
        ("classify in/dark.png --labels wood", "`labels`"),
        ("doctor --device meta", "`--device` is 'meta'"),
        ("distill --model in -o out", "`model` names 'in/model_index.json', which does not exist"),
        ("distill --model in -o out --set steps=3", "`set` is 'steps=3'"),
    ],
    "files": [
        ("touch-to-image gone.png -o out", "'gone.png', which does not exist"),
        ("touch-to-image empty -o out", "`touch` is 'empty', where there are no images"),
        ("touch-to-image 'in/*.jpg' -o out", "`touch` is 'in/*.jpg', where there are no images"),
        ("touch-to-image in/dark.png words.png -o out --batch-size 1", "`touch words.png`"),
        ("touch-to-image in/dark.png thin.png -o out", "`touch thin.png` is 1 x 1 pixels"),
        (f"{TO_IMAGE} --background gone.png", "--background", "gone.png"),
        ("stylize in in/dark.png -o out", "`image` is 'in', 2 files"),
        ("batch in/dark.png -o out", "`source` is 'in/dark.png', an image; pass its folder"),
        ("batch gone -o out", "'gone', which does not exist"),
        ("convert unitouch --touch in/dark.png -o out", "cannot be read as a checkpoint"),
    ],
    "models": [
        ("touch-to-image in/dark.png -o out --model gone", "`--model` is 'gone', which is no folder"),
        ("stylize in/dark.png in/dark.png -o out --model touch-to-image-turbo", "which is no folder"),
        ("app --model in", "`--model` names 'in/model_index.json'"),
    ],
    "combinations": [
        (TO_TOUCH, "Pass at least one of `--image`, `--text`"),
        (f"{TO_TOUCH} --image in --text a --text b --text c", "`--image` holds 2 for 3 inputs"),
        (f"{TO_TOUCH} --text brick --set 'weights={{\"smell\": 1}}'", "`weights` is of smell"),
        ("convert unitouch -o out", "Pass at least one of `imagebind`, `touch`"),
    ],
    "outputs": [
        ("touch-to-image in/dark.png -o in", "`--output` would replace 'in/dark.png'"),
        ("touch-to-image in/dark.png -o in/bright.png", "`--output` would replace 'in/bright.png'"),
        ("touch-to-image in -o out.png", "'out.png' for 2 pictures"),
        ("touch-to-image in/dark.png -o out.xbm", "`--output` is 'out.xbm'"),
        ("touch-to-image in/dark.png -o words.png/below", "`--output`", "cannot be written to"),
        ("batch in -o /proc/self/out", "`--output`", "cannot be written to"),
    ],
}  # fmt: skip


def runs(network: torch.nn.Module, *_: Any, **__: Any) -> None:
    raise AssertionError(f"{type(network).__name__} ran")


@pytest.mark.parametrize("kind", BAD)
def test_a_bad_command_is_one_line(here, command, models, refused, files, monkeypatch, kind):
    (here / "empty").mkdir()
    (here / "words.png").write_text("no picture")
    Image.new("RGB", (1, 1)).save("thin.png")
    monkeypatch.setattr(torch.nn.Module, "__call__", runs)
    before = files(here)
    for line, *said in BAD[kind]:
        words = shlex.split(line)
        if words[0] in models and "--model" not in words:
            words += ["--model", models[words[0]]]
        refused(command(*words), *said)
        assert files(here) == before, line


def test_help_and_mistyped_names_do_not_wait_for_torch(here):
    lines = ["touch-to-image --help", "touch-to-image gone.png -o out", f"{TO_IMAGE} --steps 0"]
    script = f"""if True:
        import sys
        from contextlib import suppress
        from unitouch_gen.cli import main
        for line in {lines}:
            sys.argv = ["unitouch-gen", *line.split()]
            with suppress(SystemExit):
                main()
            print("torch" in sys.modules)"""
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert ended.stdout.count("False\n") == 3 and ended.stderr.count("\n") == 2


@pytest.mark.parametrize("words", [["-o", "~/made"], ["--output=~/made"]])
def test_a_tilde_is_the_home_folder_also_where_the_shell_leaves_it(here, command, models, monkeypatch, words):
    monkeypatch.setenv("HOME", str(here / "home"))
    code, _, err = command("touch-to-image", "in/dark.png", *words, "--steps", "2", "--model", models["touch-to-image"])
    assert code == 0, err
    assert (here / "home" / "made" / "dark.png").is_file() and not (here / "~").exists()


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_an_interrupt_ends_with_130_and_leaves_no_temporary_folder(here, models, name):
    touches, model = ["in/dark.png"] * 500, ["--model", models["touch-to-image"]]
    child = Child(commanded, "touch-to-image", *touches, "-o", "out", "--batch-size", "1", *model, folder=here)
    while not list(here.glob("out/*.png")):
        assert child.process.is_alive(), child.err
        time.sleep(0.05)
    os.kill(child.process.pid, getattr(signal, name))
    assert child.wait() == 130 and list(here.glob("out/.*")) == []
    assert child.err == "unitouch-gen: stopped; what is written is whole.\n"


def found(command: Any = None, name: str = "unitouch-gen") -> Iterator[tuple[str, Any]]:
    """Every command, by the words that call it."""
    command = command or typer.main.get_command(commands)
    for word, inner in getattr(command, "commands", {}).items():
        yield from found(inner, f"{name} {word}")
    if not hasattr(command, "commands"):
        yield name, command


def test_each_command_shows_an_example_that_it_takes(here):
    for name, command in found():
        (example,) = re.findall(r"Example: (.+)", command.help)
        for word in re.findall(r"\S+\.(?:ckpt|pth)", example):  # files that have to be there
            (here / word).touch()
        assert example.startswith(name)
        command.make_context(name, shlex.split(example.removeprefix(name)))


def test_the_version_is_that_of_the_package(command):
    assert command("--version") == (0, f"unitouch_gen {unitouch_gen.__version__}\n", "")
