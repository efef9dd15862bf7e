"""What a package meets in other hands: threads, kills, full disks, and bad inputs that are drawn from a seed.

    OMP_NUM_THREADS=1 python -m tests.soak [SEED]

Ends with 1 unless nothing was lost (half written, or another thread's picture), silent (a bad input made a picture: of
numbers that are not finite, of half an image, or as if an argument had not been there) or raw (no error of the
package's own; of a command, more than a line or another exit code).
"""

import inspect
import io
import json
import random
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import chdir, contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import torch
import typer
from PIL import Image

import unitouch_gen
from tests.helpers import recordings
from tests.helpers.calls import quiet, seeded
from tests.helpers.components import make_pipelines
from tests.helpers.damage import ODD, WORDS, odd_array, whole_files
from tests.helpers.processes import Child, command, finished, save_numbered
from unitouch_gen import cli, example
from unitouch_gen.errors import InvalidInputError, InvalidTypeError, first_line
from unitouch_gen.files import is_hidden, reading

FOUND: dict[str, list[str]] = {"lost": [], "silent": [], "raw": []}
DRAW = random.Random()


def note(kind: str, what: str) -> None:
    FOUND[kind].append(what)
    print(f"{kind}: {what}", flush=True)


CALLS: list[tuple[str, dict[str, Any]]] = [
    ("touch-to-image", {"touch": example("digit_wood"), "prompt": "a photo of wood", "guidance_scale": 3.0}),
    ("stylization", {"image": example("wood", "image"), "touch": example("brick"), "num_inference_steps": 4}),
    ("x-to-touch", {"text": "rough brick", "solver": "dpm++2m"}),
    ("x-to-touch", {"audio": example("metal", "audio"), "touch": example("digit_wood"), "guidance_scale": 7.5}),
]


def share_pipelines(threads: int, calls: int) -> None:
    """Calls that begin at once on pipelines whose encoders nobody has used yet make the pictures they make alone."""

    def picture(pipes: dict[str, Any], number: int) -> np.ndarray:
        name, given = CALLS[number]
        return pipes[name](**{"num_inference_steps": 3, **given}, generator=seeded(), output_type="np").images

    shared, alone = ({name: quiet(unitouch_gen.tiny(name)) for name, _ in CALLS} for _ in range(2))
    expected = [picture(alone, number) for number in range(len(CALLS))]
    order = [*range(len(CALLS))] * calls
    with ThreadPoolExecutor(threads) as pool:
        for number, made in zip(order, pool.map(lambda number: picture(shared, number), order), strict=True):
            if abs(made - expected[number]).max() > 1e-5:
                note("lost", f"call {number} beside other threads")


def seen(folder: Path, pattern: str = "**/*") -> dict[str, bytes]:
    """Files that are not hidden."""
    files = {file.relative_to(folder): file for file in folder.glob(pattern) if file.is_file()}
    return {str(name): file.read_bytes() for name, file in files.items() if not is_hidden(name)}


def killed(function: Any, *words: Any, folder: Path, changes: int, seconds: float) -> str:
    """Runs a process that is killed just before one of its changes to files, or at any time; says when."""
    at, delay = DRAW.choice([(DRAW.randint(1, changes), None), (None, DRAW.uniform(0, seconds))])
    child = Child(function, *words, folder=folder, killed_at=at)
    if delay is not None:
        time.sleep(delay)
        child.kill()
    child.wait()
    return f"killed at change {at}, {delay} s"


@contextmanager
def what_others_have_there(folder: Path) -> Iterator[None]:
    """A folder with an empty folder, a link and, where there are rights to, a mount in it, which have to stay."""
    host = folder.parent / "host"
    empty = folder / ".git" / "refs"
    mount = folder / "unet" / "mounted"
    link = folder / "vae" / "link"
    for place in (host, empty, mount, link.parent):
        place.mkdir(parents=True)
    (host / "precious.txt").write_text("theirs")
    link.symlink_to(host)
    mounted = not subprocess.run(["mount", "--bind", host, mount], check=False, capture_output=True).returncode
    try:
        yield
    finally:
        if mounted:
            if not (mount / "precious.txt").is_file():
                note("lost", "a mounted file")
            subprocess.run(["umount", mount], check=True)
        if not (empty.is_dir() and link.is_symlink() and (host / "precious.txt").read_text() == "theirs"):
            note("lost", "an empty folder, a link, or a file behind it")


def kill_saves(here: Path, kills: int) -> None:
    """Of a pipeline that is saved over another one, the old or the new one is there."""
    whole = []
    begun = time.monotonic()
    folder = here / "there"
    for number in (1, 2, 1):
        child = finished(Child(save_numbered, str(folder), number, folder=here))
        whole.append(seen(folder))
    limits = {"changes": child.changes, "seconds": (time.monotonic() - begun) / 3}
    for count in range(kills):
        how = killed(save_numbered, str(folder), 2 - count % 2, folder=here, **limits)
        with reading("folder", folder):  # which finishes a save that was cut off
            pass
        if seen(folder) not in whole:
            note("lost", f"a save, {how}")
    before = seen(folder)
    child = Child(save_numbered, str(folder), 2, folder=here, longest=DRAW.choice([0, 60_000]))
    if child.wait() != 1 or "`save_directory` cannot be written to" not in child.err.splitlines()[-1]:
        note("raw", f"a save to a full disk: {child.err[-300:]}")
    if seen(folder) != before:
        note("lost", "a save to a full disk")


def kill_batches(here: Path, model: str, kills: int) -> None:
    """A batch goes on where it was killed: each picture is there whole or not at all, and in the end all are."""
    (here / "table.csv").write_text("touch,seed\n" + "".join(f"in/a.png,{seed}\n" for seed in range(6)))
    words = ["batch", "table.csv", "--batch-size", "2", "--model", model, "-o"]
    begun = time.monotonic()
    child = finished(Child(command, *words, "whole", folder=here))
    limits = {"changes": child.changes, "seconds": time.monotonic() - begun}
    whole = seen(here / "whole", "*.png")
    for count in range(kills):
        out = f"out{count // 3}"
        how = killed(command, *words, out, folder=here, **limits)
        if not seen(here / out, "*.png").items() <= whole.items():
            note("lost", f"a picture of a batch, {how}")
        if count % 3 == 2:
            finished(Child(command, *words, out, folder=here))
            told = [json.loads(line)["picture"] for line in (here / out / "manifest.jsonl").open()]
            if seen(here / out, "*.png") != whole or {Path(picture).name for picture in told} != {*whole}:
                note("lost", f"what a batch had made before it went on, {how}")
    for full in (words, ["touch-to-image", "in/a.png", "--model", model, "-o"]):
        child = Child(command, *full, f"full-{full[0]}", folder=here, longest=DRAW.choice([0, 300]))
        if child.wait() != 2 or child.err.count("\n") != 1:
            note("raw", f"{full[0]} to a full disk: {child.wait()}, {child.err[-300:]}")
        if seen(here, f"full-{full[0]}/*.png"):
            note("lost", f"a picture of {full[0]} to a full disk")


def tried(what: str, call: Any) -> Any:
    """What a call makes, or `None` where it refuses its input as the package does."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return call()
    except (InvalidInputError, InvalidTypeError) as error:
        if "\n" in str(error):
            note("raw", f"{what}: {str(error)[:300]!r}")
    except Exception as error:
        note("raw", f"{what}: {type(error).__name__}: {first_line(error)[:300]}")
    return None


def read_damaged_files(here: Path, pipes: dict[str, Any], count: int) -> None:
    """Cut files and such with turned bits, often in their heads, are refused, or make a picture of finite numbers."""
    whole = whole_files(here)
    for number in range(count):
        name = DRAW.choice(list(whole))
        content = bytearray(whole[name])
        file = here / f"{number}.{name}"
        places = [DRAW.randrange(min(DRAW.choice([64, 10**9]), len(content))) for _ in range(DRAW.randint(1, 12))]
        for place in places:
            content[place] ^= 1 << DRAW.randrange(8)
        cut = DRAW.random() < 0.3
        file.write_bytes(whole[name][: places[0]] if cut else content)
        kind, given = ("x-to-touch", "audio") if name.startswith("sound") else ("touch-to-image", "touch")
        what = f"{name} {'cut' if cut else 'turned'} at {places}"
        made = tried(what, lambda: pipes[kind](**{given: file}, output_type="latent").images)  # noqa: B023
        half = cut and name.startswith("still") and 2 * places[0] < len(content)
        if made is not None and (half or not made.isfinite().all()):
            note("silent", what)


ARRAYS = "touch image audio background latents touch_embeds condition_embeds prompt_embeds negative_prompt_embeds"
FREE = ("throw", "bridge", "output_type", "generator", "cross_attention", "callback")  # need not change the picture


def pass_odd_arguments(pipes: dict[str, Any], count: int) -> None:
    """Each is refused, or changes the picture, which is finite."""
    touch = {"touch": torch.rand(1, 3, 32, 32)}
    photo = {"image": torch.rand(1, 3, 32, 32)}
    for kind, base in {"touch-to-image": touch, "stylize": {**photo, **touch}, "x-to-touch": photo}.items():
        known = {*inspect.signature(type(pipes[kind]).__call__).parameters} - {"self", "return_dict"}
        expected = pipes[kind](**base, output_type="latent", generator=seeded()).images
        for _ in range(count):
            name = DRAW.choice(sorted(known))
            value = odd_array(DRAW) if name in ARRAYS.split() and DRAW.random() < 0.7 else DRAW.choice(ODD)
            given = {**base, "output_type": "latent", "generator": seeded(), name: value}
            if name == "callback_on_step_end" and callable(value):
                continue  # whatever it raises is its own
            if name in ("touch_embeds", "condition_embeds"):
                given |= dict.fromkeys(base)
            what = f"{kind} {name}={str(value)[:70]!r}"
            output = tried(what, lambda: pipes[kind](**given))  # noqa: B023
            if output is not None and isinstance(output.images, torch.Tensor):
                left_out = name.startswith(FREE) or (isinstance(value, str | int) and not str(value).strip("0 "))
                same = output.images.shape == expected.shape and torch.equal(output.images, expected)
                broken = isinstance(value, np.ndarray | torch.Tensor) and not np.isfinite(np.asarray(value)).all()
                if broken or (same and not left_out) or not output.images.isfinite().all():
                    note("silent", what)


COMMANDS = {
    "touch-to-image": "in/a.png -o out",
    "stylize": "in/a.png in/a.png -o out",
    "x-to-touch": "--text brick -o out",
    "batch": "table.csv -o out",
    "classify": "in/a.png --labels wood,glass",
    "convert unitouch": "--touch in/a.png -o out",
    "data check": "in",
    "stability": "--only none",
    "distill": "--model in -o out",
}


class Ran(BaseException):
    """A network was about to run: the command has taken its arguments."""


def run_odd_commands(models: dict[str, str], count: int) -> None:
    """Each ends with a line and 2, or takes what it is given."""

    def stop(*_: Any, **__: Any) -> None:
        raise Ran

    torch.nn.Module.__call__ = stop  # type: ignore[method-assign]
    for _ in range(count):
        name = DRAW.choice(list(COMMANDS))
        known = typer.main.get_command(cli.commands)
        for word in name.split():
            known = known.commands[word]  # type: ignore[attr-defined]
        given = COMMANDS[name].split() + (["--model", models[name]] if name in models else [])
        if DRAW.random() < 0.3:
            given[DRAW.randrange(len(given))] = DRAW.choice(WORDS)
        options: Any = [option for option in known.params if option.opts[0].startswith("-")]
        for option in DRAW.sample(options, DRAW.choice([0, 1, 1, 2])):
            given += [DRAW.choice(option.opts)] + ([] if option.is_flag else [DRAW.choice(WORDS)])
        sys.argv, code, what = ["unitouch-gen", *name.split(), *given], 0, f"{name} {' '.join(given)[:200]!r}"
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()) as said:
            try:
                tried(what, cli.main)
            except Ran:
                continue
            except SystemExit as ended:
                code = ended.code or 0
        if code not in (0, 1, 2) or (code == 2 and said.getvalue().count("\n") != 1):
            note("raw", f"{what} ended with {code} and {said.getvalue()[-300:]!r}")


def soak(here: Path) -> None:
    """All of it, in an empty folder."""
    pipes = {name: quiet(pipe) for name, pipe in make_pipelines().items()}
    models = {name: str(here / "models" / name) for name in pipes}
    for name, pipe in pipes.items():
        pipe.save_pretrained(models[name])
    for folder in ("in", "saves", "damaged"):
        (here / folder).mkdir()
    Image.fromarray(next(recordings.frames())).save(here / "in" / "a.png")
    share_pipelines(threads=6, calls=4)
    with what_others_have_there(here / "saves" / "there"):
        kill_saves(here / "saves", kills=9)
    kill_batches(here, models["touch-to-image"], kills=9)
    read_damaged_files(here / "damaged", pipes, count=200)
    pass_odd_arguments(pipes, count=150)
    run_odd_commands(models, count=150)


if __name__ == "__main__":
    DRAW.seed(int(sys.argv[1]) if len(sys.argv) > 1 else 0)
    torch.manual_seed(0)
    with tempfile.TemporaryDirectory() as place, chdir(place):
        soak(Path(place))
    print(", ".join(f"{len(items)} {kind}" for kind, items in FOUND.items()))
    sys.exit(any(FOUND.values()))
