"""`unitouch-gen`: help, and what is refused: one line, exit code 2, and nothing written."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import unitouch_gen
from unitouch_gen.pipelines import TouchToImagePipeline

# Help and usage -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("args", "word"), [((), "touch-to-image"), (("touch-to-image",), "--guidance")])
def test_help_names_what_there_is(command, args, word):
    code, out, _ = command(*args, "--help")
    assert code == 0
    assert word in out


def test_the_version_is_that_of_the_package(command):
    assert command("--version") == (0, f"unitouch_gen {unitouch_gen.__version__}\n", "")


def test_shells_complete_commands_and_options(here):
    """As bash asks for it."""
    for line, place, word in (
        ("unitouch-gen x-to", 1, "x-to-touch"),
        ("unitouch-gen stylize --touch-w", 2, "--touch-"),
    ):
        asked = {"_UNITOUCH_GEN_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(place)}
        script = "import sys; sys.argv = ['unitouch-gen']; from unitouch_gen.cli import main; main()"
        done = subprocess.run(
            [sys.executable, "-c", script], env={**os.environ, **asked}, capture_output=True, text=True, check=False
        )
        assert word in done.stdout, done.stderr


def test_flags_take_no_value(command):
    _, out, _ = command("x-to-touch", "--help")
    assert all("<" not in line for line in out.splitlines() if "--bridge" in line or "--json" in line)


def test_no_arguments_show_the_help(command):
    code, out, err = command()
    assert code == 2
    assert "touch-to-image" in out + err
    assert "Traceback" not in out + err


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["bogus"], ["'bogus'"]),
        (["touch-to-image"], ["touch"]),
        (["touch-to-image", "in/dark.png"], ["--output"]),
        (["touch-to-image", "in/dark.png", "-o", "out", "--bogus"], ["--bogus"]),
        (["touch-to-image", "in/dark.png", "-o", "out", "--steps", "many"], ["--steps"]),
        (["touch-to-image", "in/dark.png", "-o", "out", "--guidance"], ["--guidance"]),
    ],
)
def test_wrong_usage_is_one_line(here, command, args, words, refused):
    refused(command(*args), *words)
    assert not (here / "out").exists()


def in_a_shell(script: str, *args: str) -> tuple[int, str, str]:
    script = f"import sys\nfrom unitouch_gen.cli import main\n{script}"
    ended = subprocess.run(
        [sys.executable, "-c", script, *args], capture_output=True, text=True, timeout=300, check=False
    )
    return ended.returncode, ended.stdout, ended.stderr


def test_a_mistake_in_a_shell_is_one_line_and_exit_code_2(here, models, refused):
    (here / "notes.png").write_text("This is no picture.")
    result = in_a_shell("main()", "touch-to-image", "notes.png", "-o", "out", "--model", models["touch-to-image"])
    refused(result, "`touch", "notes.png")
    assert not (here / "out").exists()


def test_help_does_not_wait_for_torch(here):
    code, out, _ = in_a_shell("try: main()\nfinally: print('torch' in sys.modules)", "touch-to-image", "--help")
    assert code == 0
    assert out.endswith("False\n")


@pytest.mark.parametrize("words", [
    "touch-to-image gone.png -o out", "stylize gone.png example:brick -o out", "x-to-touch --audio gone.png -o out",
    "classify gone.png", "watch gone.png -o out", "batch gone.png -o out",
    "touch-to-image example:brick --background gone.png", "x-to-touch --text brick --background gone.png -o out",
])  # fmt: skip
def test_a_file_that_is_not_there_is_told_before_torch_is_imported(here, words):
    code, out, error = in_a_shell("try: main()\nfinally: print('torch' in sys.modules)", *words.split())
    assert (code, out) == (2, "False\n")
    assert "'gone.png', which does not exist" in error and error.count("\n") == 1


# Refusals -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--steps", 0], ["`--steps` is 0"]),
        (["--steps", -1], ["`--steps` is -1"]),
        (["--steps", 1001], ["`--steps` is 1001"]),
        (["--timesteps", "900,5.5"], ["`--timesteps` is '900,5.5'", "whole numbers"]),
        (["--timesteps", "100,900"], ["`timesteps` is", "below the one before"]),
        (["--sigmas", "9,,0"], ["`--sigmas` is '9,,0'"]),
        (["--sigmas", "9,1"], ["`sigmas` is", "end in 0"]),
        (["--guidance", "nan"], ["`--guidance` is nan"]),
        (["--guidance", -1], ["`--guidance` is -1"]),
        (["--seed", -1], ["`seed` is -1"]),
        (["--batch-size", 0], ["`batch_size` is 0"]),
        (["--seed", 2**63], ["`seed` is"]),
        (["--sensor", "gelsigt"], ["`sensor` is 'gelsigt'", "'gelsight'"]),
        (["--background", "gone.png"], ["`--background`", "gone.png"]),
        (["--background", "https://example.org/gel.png"], ["`--background`", "nothing is fetched"]),
    ],
)
def test_options_that_cannot_be_used(here, make, options, words, refused):
    refused(make("in/dark.png", "-o", "out", *options), *words)
    assert not (here / "out").exists()


@pytest.mark.parametrize(
    ("name", "contents"),
    [("notes.png", b"no picture"), ("cut.png", None), ("empty.png", b"")],
)
def test_touches_that_cannot_be_read(here, make, name, contents, refused):
    whole = (here / "in" / "dark.png").read_bytes()
    (here / name).write_bytes(whole[: len(whole) // 2] if contents is None else contents)
    refused(make("in/dark.png", name, "-o", "out"), "`touch[1]`", name)
    assert not (here / "out").exists()


@pytest.mark.parametrize("suffix", [".bogus", ".txt", ".psd", ".xbm"])
def test_suffixes_that_are_no_format_for_pictures(here, make, suffix, files, refused):
    refused(make("in/dark.png", "-o", f"picture{suffix}"), "`--output`", f"picture{suffix}", ".png")
    assert files(here) == ["in/bright.png", "in/dark.png"]


def test_several_pictures_for_one_file(here, make, refused):
    refused(make("in/dark.png", "in/bright.png", "-o", "out.png"), "`--output`", "out.png", "2 pictures")
    assert not (here / "out.png").exists()


@pytest.mark.parametrize("output", ["in", "in/dark.png", "./in/../in"])
def test_a_picture_never_replaces_its_touch(here, make, output, refused):
    before = (here / "in" / "dark.png").read_bytes()
    refused(make("in/dark.png", "-o", output), "`--output`", "dark.png")
    assert (here / "in" / "dark.png").read_bytes() == before


def test_a_file_is_no_folder(here, make, refused):
    (here / "taken").touch()
    refused(make("in/dark.png", "-o", "taken"), "`--output` is 'taken'")
    refused(make("in/dark.png", "-o", "taken/below"), "`--output`", "'taken/below/dark.png'", "taken is a file")
    refused(make("in/dark.png", "-o", "taken/below.png"), "`--output`", "'taken/below.png'", "taken is a file")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_cannot_be_written_to(here, make, refused):
    (here / "locked").mkdir(mode=0o500)
    refused(make("in/dark.png", "-o", "locked/out"), "`--output`", "locked")


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs a file system that takes no files")
def test_a_folder_that_takes_no_files(here, make, refused):
    refused(make("in/dark.png", "-o", "/proc/self/out"), "`--output`", "/proc/self")


@pytest.mark.parametrize("name", [f"out/{'x' * 300}.png", "x" * 300])
def test_a_name_that_is_too_long(here, make, files, refused, name):
    refused(make("in/dark.png", "-o", name), "`--output`")
    assert files(here) == ["in/bright.png", "in/dark.png"]


# Models ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["gone", "./gone", "a/b/c", "", "in"])
def test_folders_that_hold_no_pipeline(here, command, name, refused):
    refused(command("touch-to-image", "in/dark.png", "-o", "out", "--model", name), f"`--model` is {name!r}")
    assert not (here / "out").exists()


@pytest.mark.parametrize(
    "broken",
    ["model_index.json", "unet/config.json", "unet/diffusion_pytorch_model.safetensors", "unitouch/model.safetensors"],
)
def test_a_model_with_a_broken_file(here, command, tmp_path, broken, refused, make_components):
    TouchToImagePipeline(**make_components()).save_pretrained(tmp_path / "model")
    file = tmp_path / "model" / broken
    file.write_bytes(file.read_bytes()[:100])
    refused(command("touch-to-image", "in/dark.png", "-o", "out", "--model", "model"), "`--model` ", "'model")
    assert not (here / "out").exists()


def test_a_model_of_another_pipeline(here, command, tmp_path, refused):
    (tmp_path / "model").mkdir()
    index = {"_class_name": "DDPMPipeline", "_diffusers_version": "0.42.1", "scheduler": ["diffusers", "DDPMScheduler"]}
    (tmp_path / "model" / "model_index.json").write_text(json.dumps(index))
    refused(command("touch-to-image", "in/dark.png", "-o", "out", "--model", "model"), "`--model` is 'model'")


def test_more_candidates_than_anybody_has_memory_for_are_refused_at_once(here, command, models, refused):
    words = ("x-to-touch", "--text", "brick", "-o", "out", "--model", models["x-to-touch"])
    refused(command(*words, "--candidates", "9" * 400), "candidates")


def test_a_name_longer_than_names_may_be_is_no_model(here, command, refused):
    refused(
        command("x-to-touch", "--text", "brick", "-o", "out", "--model", "x" * 5000), "--model", "File name too long"
    )


def test_a_name_in_another_encoding_is_printed_as_it_is(here, models):
    """Of bytes that are no UTF-8, as Latin-1 leaves them."""
    words = ["x-to-touch", "--text", "brick", "--steps", "2", "-o", b"\xff", "--model", models["x-to-touch"]]
    script = "import sys; from unitouch_gen.cli import main; main()"
    done = subprocess.run([sys.executable, "-c", script, *words], capture_output=True, timeout=300, check=False)
    assert done.returncode == 0 and b"/\xff\n" in done.stdout, done.stderr
