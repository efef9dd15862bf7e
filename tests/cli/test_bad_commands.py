"""Commands that cannot run: one line, exit code 2, nothing written, and no network has run."""

import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import huggingface_hub
import pytest
import torch
import typer
from PIL import Image

import unitouch_gen
from tests.helpers.data_sets import write_pictured
from tests.helpers.processes import Child
from tests.helpers.processes import command as commanded
from unitouch_gen.cli import commands

TO_IMAGE = "touch-to-image in/dark.png -o out"
TO_TOUCH = "x-to-touch -o out"
COIN = "press example:coin"
CHART = "work-precision -o out --problem mixture-7.5"
BAD = {
    "spelling": [
        ("bogus", "No such command 'bogus'"),
        ("touch-to-image in/dark.png", "--output"),
        (f"{TO_IMAGE} --solver dimm", "`solver` is 'dimm'", "Did you mean 'ddim'?"),
        (f"{TO_IMAGE} --set heigth=8", "`--set` is 'heigth'", "Did you mean 'height'?"),
        ("touch-to-image example:brik -o out", "Did you mean 'brick'?"),
        ("batch in -o out --pipeline stylize", "`--pipeline` is 'stylize'", "'stylization'"),
        ("batch tables/misspelt.csv -o out", "Did you mean 'prompt'?"),
        (f"{COIN} --sensor digt -o out", "`--sensor` is 'digt'", "Did you mean 'digit'?"),
        (f"{CHART} --solvers eulr", "Did you mean 'euler'?"),
        ("evaluate taste", "`table` is 'taste'"),
        ("stability --only fin", "`--only` is 'fin'"),
    ],
    "kinds and ranges": [
        (f"{TO_IMAGE} --steps 0", "--steps"),
        (f"{TO_IMAGE} --guidance nan", "--guidance-scale"),
        (f"{TO_IMAGE} --seed -1", "--seed"),
        (f"{TO_IMAGE} --dtype float8", "`--dtype` is 'float8'"),
        (f"{TO_IMAGE} --device cuda:99", "`--device` is 'cuda:99'"),
        ("app --host no.such.host.invalid", "'no.such.host.invalid'"),
        ("app --host 192.0.2.1", "'192.0.2.1'"),
        ("app --host 2001:db8::1", "'2001:db8::1'"),
        ("classify in/dark.png --labels wood", "`labels`"),
        ("doctor --device meta", "`--device` is 'meta'"),
        ("distill --model in -o out", "`model` names 'in/model_index.json', which does not exist"),
        ("distill --model in -o out --set steps=3", "`set` is 'steps=3'"),
        (f"{COIN} --mm -3 -o out", "`mm` is -3"),
        (f"{COIN} --mm wide -o out", "--mm"),
        (f"{COIN} --depth nan -o out", "`depth` is nan"),
        (f"{COIN} --at 3 -o out", "`--at` is '3'; pass X,Y"),
        (f"{COIN} --mm 24 --at 40,0 -o out", "`at` is 40.0; it has to be a number from -12 to 12"),
        ("evaluate material --scanned -0.1", "--scanned"),
        ("evaluate material --recordings nan", "--recordings"),
        ("stability --only", "requires an argument"),
        ("work-precision -o out --problem mixture-7", "`--problem` is 'mixture-7'"),
        (f"{CHART} --steps 5,x", "`--steps` is 'x'"),
        (f"{CHART} --tolerances 2", "`--tolerances` is 2"),
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
        ("batch empty -o out", "`source` is 'empty', where there are no images"),
        ("convert unitouch --touch in/dark.png -o out", "cannot be read as a checkpoint"),
        ("press flat.png -o out", "`height flat.png` is flat"),
        (f"{COIN} flat.png -o out", "`height flat.png` is flat"),
        ("press in/dark.png -o out", "is in colours; pass a grey height map"),
        ("evaluate material --data nowhere", "nowhere"),
        ("data check sorted --kind touch_and_go", "Data set 'sorted' (touch_and_go; all) has no records"),
    ],
    "models": [
        (f"{TO_IMAGE} --model gone", "`--model` is 'gone', which is no folder"),
        ("stylize in/dark.png in/dark.png -o out --model touch-to-image-turbo", "which is no folder"),
        ("app --model in", "`--model` names 'in/model_index.json'"),
        ("app --model {touch-to-image} --model {touch-to-image}", "`--model`", "touch-to-image"),
        ("evaluate material --data pictured --model in", "config.json', which does not exist"),
        ("evaluate touch-to-image --model {x-to-touch}", "holds a XToTouchPipeline; name a saved TouchToImagePipeline"),
        ("stability --model other", "holds a StableDiffusionPipeline; name a saved TouchToImagePipeline"),
    ],
    "columns of tables": [
        ("batch tables/text.csv -o out", "`column` is 'text'"),
        ("batch tables/word.csv -o out", "`seed` is 'x'"),
        ("batch tables/half.csv -o out", "`seed` is 1.5"),
        ("batch tables/nan.csv -o out", "`seed` is 'nan'"),
        ("batch tables/wide.csv -o out", f"`seed` is {2**64}"),
        ("batch tables/up.csv -o out", "`name` is '../up.png'"),
    ],
    "combinations": [
        (TO_TOUCH, "Pass at least one of `--image`, `--text`"),
        (f"{TO_TOUCH} --image in --text a --text b --text c", "`--image` holds 2 for 3 inputs"),
        (f"{TO_TOUCH} --text brick --set 'weights={{\"smell\": 1}}'", "`weights` has keys smell"),
        ("convert unitouch -o out", "Pass at least one of `imagebind`, `touch`"),
        ("work-precision -o out", "Pass exactly one of `--problem`, `--pipeline`"),
        (f"{CHART} --model in", "has no effect with `--problem`"),
        ("evaluate material --data pictured --scanned 0.5", "`--scanned` is 0.5, but has no effect with `--data`"),
        ("evaluate retrieval --data pictured --recordings 1", "`--recordings` is 1.0, but has no effect with `--data`"),
        ("data check sorted --materials wood", "`materials` names 1 of 2"),
    ],
    "outputs": [
        ("touch-to-image in/dark.png -o in", "`--output` would replace 'in/dark.png'"),
        ("touch-to-image in/dark.png -o in/bright.png", "`--output` would replace 'in/bright.png'"),
        ("touch-to-image in -o out.png", "'out.png' for 2 pictures"),
        ("touch-to-image in/dark.png -o out.xbm", "`--output` is 'out.xbm'"),
        ("touch-to-image in/dark.png -o words.png/below", "`--output`", "cannot be written to"),
        ("batch in -o /proc/self/out", "`--output`", "cannot be written to"),
        ("batch in -o in", "`--output` is 'in', the folder of the inputs"),
        ("batch tables/good.csv -o in/dark.png", "in/dark.png"),
        (f"{COIN} --sensor all -o out.png", "'out.png' for 4 pictures"),
        (f"{COIN} -o flat.png", "`--output` would replace 'flat.png'"),
        ("press flat.png --overwrite -o flat.png", "would replace 'flat.png'"),
        ("evaluate material -o measured", "`--output` would replace", "--overwrite"),
    ],
}
TABLES = {
    "good": "touch\n../in/dark.png\n",
    "misspelt": "touch,promt\nin/dark.png,1\n",
    "text": "touch,text\n../in/dark.png,brick\n",
    "word": "touch,seed\n../in/dark.png,x\n",
    "half": "touch,seed\n../in/dark.png,1.5\n",
    "nan": "touch,seed\n../in/dark.png,nan\n",
    "wide": f"touch,seed\n../in/dark.png,{2**64}\n",
    "up": "touch,name\n../in/dark.png,../up\n",
}


def runs(network: torch.nn.Module, *_: Any, **__: Any) -> None:
    raise AssertionError(f"{type(network).__name__} ran")


@pytest.fixture
def bad(here: Path) -> Path:
    """A folder with what the commands of `BAD` name: files that cannot be used beside those that can."""
    for name in ("empty", "tables", "other", "measured", "sorted/wood", "sorted/glass"):
        (here / name).mkdir(parents=True)
    (here / "words.png").write_text("no picture")
    Image.new("RGB", (1, 1)).save("thin.png")
    Image.new("L", (16, 16), 9).save("flat.png")
    (here / "other" / "model_index.json").write_text('{"_class_name": "StableDiffusionPipeline"}')
    (here / "measured" / "material.json").write_text("{}")
    for material in ("wood", "glass"):
        shutil.copy("in/dark.png", here / "sorted" / material / "1.png")
    for name, content in TABLES.items():
        (here / "tables" / f"{name}.csv").write_text(content)
    write_pictured(here / "pictured")
    return here


@pytest.mark.parametrize("kind", BAD)
def test_a_bad_command_is_one_line(bad, command, models, refused, files, monkeypatch, kind):
    monkeypatch.setattr(torch.nn.Module, "__call__", runs)
    before = files(bad)
    for line, *said in BAD[kind]:
        words = [word.format(**models) if word[0] == "{" else word for word in shlex.split(line)]
        if words[0] in models and "--model" not in words:
            words += ["--model", models[words[0]]]
        if words[0] == "batch":
            words += ["--model", models["touch-to-image"]]
        if words[0] == "evaluate" and "--model" not in words:
            words += ["--model", models["x-to-touch"]]
        refused(command(*words), *said)
        assert files(bad) == before, line


# Of a data set that a table cannot be made of: the table, a change to its labels, and what is said.
UNFIT = [
    ("grasp", None, "the classes none of grasp to train on, not dropped and lifted"),
    ("grasp", ("material", "grasp"), "not dropped and lifted"),
    ("material", ("material", "stuff"), "the classes none of material to train on, not two or more"),
    ("retrieval", ("picture", "photo"), "no audio or image or text of every touch"),
    ("x-to-touch", ("gelsight", "mine"), "are by sensors other than"),
    ("x-to-touch", ("test", "val"), "and no 'test'"),
    ("x-to-touch --each 4", None, "needs 18"),
]


@pytest.mark.parametrize(("table", "change", "said"), UNFIT)
def test_a_table_that_data_cannot_fill_is_refused_before_a_file_is_read(
    bad, command, models, refused, table, change, said
):
    if change is not None:
        labels = bad / "pictured" / "labels.csv"
        labels.write_text(labels.read_text().replace(*change))
    words = ["evaluate", *table.split(), "--data", "pictured", "--model", models["x-to-touch"]]
    refused(command(*words), said)


def test_a_port_that_is_taken_is_refused_before_anything_is_read(command, refused):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        refused(command("app", "--port", port, "--model", "gone"), "`--port`", str(port), "in use")


def test_a_repository_behind_a_proxy_that_cannot_be_asked_is_refused(command, refused, monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    monkeypatch.setenv("all_proxy", f"socks5://127.0.0.1:{port}")
    huggingface_hub.close_session()  # which keeps its proxies
    try:
        refused(command("app", "--port", port, "--model", "someone/model"), "`--model` is 'someone/model'")
    finally:
        huggingface_hub.close_session()


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
    assert ended.stdout.count("False\n") == 3
    assert ended.stderr.count("\n") == 2


@pytest.mark.parametrize("words", [["-o", "~/made"], ["--output=~/made"]])
def test_a_tilde_is_the_home_folder_also_where_the_shell_leaves_it(here, command, models, monkeypatch, words):
    monkeypatch.setenv("HOME", str(here / "home"))
    code, _, err = command("touch-to-image", "in/dark.png", *words, "--steps", "2", "--model", models["touch-to-image"])
    assert code == 0, err
    assert (here / "home" / "made" / "dark.png").is_file()
    assert not (here / "~").exists()


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_an_interrupt_ends_with_130_and_leaves_no_temporary_folder(here, models, name):
    touches = ["in/dark.png"] * 500
    model = ["--model", models["touch-to-image"]]
    child = Child(commanded, "touch-to-image", *touches, "-o", "out", "--batch-size", "1", *model, folder=here)
    while not list(here.glob("out/*.png")):
        assert child.process.is_alive(), child.err
        time.sleep(0.05)
    os.kill(child.process.pid, getattr(signal, name))
    assert child.wait() == 130
    assert list(here.glob("out/.*")) == []
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
