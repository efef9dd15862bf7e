"""Standard error of commands in a process of their own that shows every warning: lines of ours, or nothing."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.helpers.published_files import published, small
from unitouch_gen import weights

COMMANDS = {
    "touch-to-image": "touch-to-image in/dark.png -o out --solver deis --steps 4 --model {touch-to-image}",
    "stylize": "stylize in/bright.png in/dark.png -o out --tolerance 0.1 --model {stylize}",
    "x-to-touch": "x-to-touch --text brick --sensor all --candidates 2 -o out --model {x-to-touch}",
    "convert": "convert unitouch --touch last_new.ckpt --config config.json -o out",
    "work-precision": "work-precision --problem mixture-7.5 --solvers unipc --steps 4,8,12 --repeats 1 -o out",
    "stability": "stability --only 'touch-to-image: guidance_scale 1e6'",
    "data": "data check in -o sheet.png",
}
STAGE = (
    "unitouch_gen.training.image_vae --output out --set trainer.steps=2 --set data.drawn.sensors=[digit] "
    "--set data.drawn.objects=1"
)
BAR = re.compile(r".*\d+%\|.*")


def run(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-W", "default", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)


def ran(line: str) -> None:
    done = run("-c", "from unitouch_gen.cli import main; main()", *shlex.split(line))
    assert done.returncode == 0, done.stderr
    assert not [line for line in done.stderr.splitlines() if not line.startswith("unitouch-gen: ")]


@pytest.mark.parametrize(
    "name", [name if name == "touch-to-image" else pytest.param(name, marks=pytest.mark.slow) for name in COMMANDS]
)
def test_a_command_leaves_out_what_libraries_warn_of(here: Path, models: dict[str, str], name: str) -> None:
    if name == "convert":
        published(here, small())
        small().save_pretrained(here)
    ran(COMMANDS[name].format(**models))


@pytest.mark.slow
@pytest.mark.skipif(not (weights.JOINT / "model.safetensors").exists(), reason="built-in weights are not there")
def test_learning_a_sensor_leaves_it_out_too(here: Path) -> None:
    for number in range(10):
        pixels = np.random.default_rng(number).integers(90, 130, (64, 64, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(here / "in" / f"{number}.png")
    ran("adapt in --sensor mine --steps 2")


@pytest.mark.slow
@pytest.mark.parametrize("launch", ["-m", "-m accelerate.commands.launch --cpu --num_processes 1 --num_machines 1 "
                                    "--mixed_precision no --dynamo_backend no -m"])  # fmt: skip
def test_training_shows_bars_and_nothing_else(here: Path, launch: str) -> None:
    for words in ("", "--set trainer.steps=3 --resume"):
        done = run(*launch.split(), *STAGE.split(), *words.split())
        lines = [line for line in re.split(r"[\r\n]+", done.stderr) if line.strip() and not BAR.fullmatch(line)]
        assert done.returncode == 0, done.stderr
        assert lines == []
