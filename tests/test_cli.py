"""The command line: what it writes and prints, and how it refuses; on saved pipelines of random weights."""

import json
import os
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers import UNet2DConditionModel
from PIL import Image

from unitouch_gen import weights
from unitouch_gen.cli import main
from unitouch_gen.cli.batches import note_endings
from unitouch_gen.diffusion import ReturnCode, RunReport
from unitouch_gen.encoders import UniTouchViT
from unitouch_gen.pipelines import TouchToImagePipeline
from unitouch_gen.world.materials import MATERIAL_NAMES

built_in = pytest.mark.skipif(
    not (weights.JOINT / "model.safetensors").exists(), reason="built-in weights are not there"
)

PARTS = runpy.run_path(str(Path(__file__).parent / "pipelines" / "conftest.py"))["make_components"]


@pytest.fixture(scope="session")
def model(tmp_path_factory) -> str:
    """The folder of a saved pipeline."""
    folder = tmp_path_factory.mktemp("model")
    pipe = TouchToImagePipeline(**PARTS(), default_num_inference_steps=2, default_guidance_scale=2.0)
    pipe.save_pretrained(folder)
    return str(folder)


@pytest.fixture
def here(tmp_path, monkeypatch) -> Path:
    """An empty folder to be in, with the touches dark.png and bright.png in a folder `in`."""
    (tmp_path / "in").mkdir()
    for name, level in (("dark", 50), ("bright", 200)):
        noise = np.random.default_rng(level).integers(level - 20, level + 20, (32, 32, 3), dtype=np.uint8)
        Image.fromarray(noise).save(tmp_path / "in" / f"{name}.png")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def run(monkeypatch, capsys):
    """Runs `unitouch-gen ...` in this process: (exit code, standard output, standard error)."""

    def call(*args: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["unitouch-gen", *map(str, args)])
        with pytest.raises(SystemExit) as ended:
            main()
        return ended.value.code or 0, *capsys.readouterr()

    return call


@pytest.fixture
def make(run, model):
    """Runs `unitouch-gen touch-to-image ... --model ...`."""
    return lambda *args: run("touch-to-image", *args, "--model", model)


def files(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def refused(result: tuple[int, str, str], *words: str) -> None:
    """Exit code 2 and one line on standard error that has these words."""
    code, out, err = result
    assert (code, out) == (2, "")
    assert err.startswith("unitouch-gen: ")
    assert err.count("\n") == 1
    assert "Traceback" not in err
    assert not [word for word in words if word not in err], err


# Pictures -------------------------------------------------------------------------------------------------------------


def test_pictures_go_into_a_folder_under_the_names_of_their_touches(here, make):
    code, *_ = make("in/dark.png", "in/bright.png", "-o", "a/new/folder")
    assert code == 0
    assert files(here / "a") == ["new/folder/bright.png", "new/folder/dark.png"]
    assert Image.open("a/new/folder/dark.png").size == (16, 16)


def test_a_single_picture_may_have_a_file_name(here, make):
    code, *_ = make("in/dark.png", "-o", "some/picture.jpg")
    assert code == 0
    assert files(here / "some") == ["picture.jpg"]
    assert Image.open("some/picture.jpg").format == "JPEG"


def test_a_picture_that_is_there_is_replaced(here, make):
    make("in/dark.png", "-o", "out", "--seed", 1)
    before = (here / "out" / "dark.png").read_bytes()
    make("in/dark.png", "-o", "out", "--seed", 2)
    assert (here / "out" / "dark.png").read_bytes() != before
    assert files(here / "out") == ["dark.png"]


def test_touches_of_one_name_have_pictures_of_their_own(here, make):
    (here / "more").mkdir()
    Image.open("in/bright.png").save("more/dark.png")
    make("in/dark.png", "more/dark.png", "-o", "out")
    assert files(here / "out") == ["dark-2.png", "dark.png"]


def test_a_seed_fixes_the_pictures(here, make):
    for folder, seed in (("one", 7), ("two", 7), ("three", 8)):
        make("in/dark.png", "-o", folder, "--seed", seed)
    one, two, three = (np.asarray(Image.open(f"{folder}/dark.png")) for folder in ("one", "two", "three"))
    np.testing.assert_array_equal(one, two)
    assert (one != three).any()


def test_a_picture_depends_on_its_own_touch_and_not_on_its_neighbours(here, make):
    make("in/bright.png", "-o", "alone")
    make("in/dark.png", "in/bright.png", "-o", "together")
    alone, together = (np.asarray(Image.open(f"{folder}/bright.png"), dtype=int) for folder in ("alone", "together"))
    assert np.abs(alone - together).max() <= 1


@pytest.fixture
def seen():
    """The batch sizes that the touch encoder and the UNet see, in any pipeline."""
    batches: dict[type, list[int]] = {UniTouchViT: [], UNet2DConditionModel: []}

    def note(module, args):
        if type(module) in batches:
            batches[type(module)].append(len(args[0]))

    hook = torch.nn.modules.module.register_module_forward_pre_hook(note)
    yield batches
    hook.remove()


def test_a_touch_is_encoded_once_and_few_are_in_memory(here, make, seen):
    """Two steps, and guidance doubles the batch."""
    code, *_ = make("in/dark.png", "in/bright.png", "in/dark.png", "-o", "out", "--batch-size", 2)
    assert code == 0
    assert seen == {UniTouchViT: [2, 1], UNet2DConditionModel: [4, 4, 2, 2]}


def test_batches_change_no_picture_and_no_row(here, make):
    touches = ["in/dark.png", "in/bright.png", "in/bright.png"]
    rows = []
    for size in (1, 2, 8):
        printed = json.loads(make(*touches, "-o", f"out{size}", "--json", "--batch-size", size)[1])
        rows.append([{key: row[key] for key in ("touch", "sensor")} for row in printed["pictures"]])
        assert printed["report"]["codes"] == ["success"] * 3
        assert printed["report"]["sensors"] == ["gelsight", "digit", "digit"]
    assert rows[0] == rows[1] == rows[2]
    for name in ("dark", "bright", "bright-2"):
        one, two, eight = (np.asarray(Image.open(f"out{size}/{name}.png"), dtype=int) for size in (1, 2, 8))
        assert max(np.abs(one - two).max(), np.abs(one - eight).max()) <= 1


def test_a_touch_of_a_later_batch_that_cannot_be_read_leaves_nothing_behind(here, make):
    (here / "notes.png").write_text("This is no picture.")
    refused(
        make("in/dark.png", "in/bright.png", "notes.png", "-o", "out", "--batch-size", 1), "`touch[2]`", "notes.png"
    )
    assert not (here / "out").exists()


def test_pictures_are_those_of_the_pipeline(here, make, model):
    options = {"--seed": 3, "--steps": 4, "--guidance": 3, "--prompt": "rough brick", "--sensor": "digit"}
    make("in/dark.png", "-o", "out", *(word for option in options.items() for word in option))
    pipe = TouchToImagePipeline.from_pretrained(model)
    expected = pipe(
        "in/dark.png", "rough brick", num_inference_steps=4, guidance_scale=3.0, sensor="digit",
        generator=torch.Generator().manual_seed(3),
    ).images[0]  # fmt: skip
    np.testing.assert_array_equal(np.asarray(Image.open("out/dark.png")), np.asarray(expected))


def test_every_picture_that_is_no_success_has_a_line(capsys):
    report = RunReport()
    report.codes = [ReturnCode.SUCCESS, ReturnCode.UNSTABLE]
    note_endings(report, [Path("out/fine.png"), Path("out/wild.png")])
    line = capsys.readouterr().err
    assert line.startswith("unitouch-gen: wild.png is unstable: ") and line.count("\n") == 1
    assert "`--guidance`" in line and "guidance_scale" not in line


# What is printed ------------------------------------------------------------------------------------------------------


def test_json_has_pictures_sensors_materials_and_the_report(here, make):
    code, out, err = make("in/dark.png", "in/bright.png", "-o", "out", "--json")
    printed = json.loads(out)
    assert (code, err) == (0, "")
    assert [row["picture"] for row in printed["pictures"]] == ["out/dark.png", "out/bright.png"]
    assert [row["touch"] for row in printed["pictures"]] == ["in/dark.png", "in/bright.png"]
    assert [row["sensor"] for row in printed["pictures"]] == ["gelsight", "digit"]
    assert all(0 <= row["sensor_distance"] < 0.2 for row in printed["pictures"])
    assert all(Path(row["picture"]).is_file() for row in printed["pictures"])
    assert printed["report"]["codes"] == ["success", "success"]
    assert printed["report"]["evaluations"] == 2


def test_materials_are_named_best_first(here, make):
    materials = json.loads(make("in/dark.png", "-o", "out", "--json")[1])["pictures"][0]["materials"]
    assert len(materials) == 3
    assert set(materials) <= set(MATERIAL_NAMES)
    assert list(materials.values()) == sorted(materials.values(), reverse=True)


def test_text_says_where_the_pictures_are_and_what_was_felt(here, make):
    code, out, err = make("in/dark.png", "-o", "out", "--steps", 3)
    assert (code, err) == (0, "")
    for word in ("dark.png", "gelsight", str(here / "out"), "3 steps", "%"):
        assert word in out.replace("\n", " ")


def test_a_pipeline_without_a_tokenizer_for_the_joint_space_names_no_materials(here, run, tmp_path):
    """Such as `from_pipe` makes of a diffusers pipeline."""
    parts = PARTS()
    parts["processor"].tokenizer = None
    TouchToImagePipeline(**parts).save_pretrained(tmp_path / "model")
    code, out, _ = run(
        "touch-to-image", "in/dark.png", "-o", "out", "--steps", 2, "--json", "--model", tmp_path / "model"
    )
    assert code == 0
    assert json.loads(out)["pictures"][0]["materials"] == {}


# Help and usage -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("args", "word"), [((), "touch-to-image"), (("touch-to-image",), "--guidance")])
def test_help_names_what_there_is(run, args, word):
    code, out, _ = run(*args, "--help")
    assert code == 0
    assert word in out


def test_no_arguments_show_the_help(run):
    code, out, err = run()
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
def test_wrong_usage_is_one_line(here, run, args, words):
    refused(run(*args), *words)
    assert not (here / "out").exists()


def in_a_shell(script: str, *args: str) -> tuple[int, str, str]:
    script = f"import sys\nfrom unitouch_gen.cli import main\n{script}"
    ended = subprocess.run(
        [sys.executable, "-c", script, *args], capture_output=True, text=True, timeout=300, check=False
    )
    return ended.returncode, ended.stdout, ended.stderr


def test_a_mistake_in_a_shell_is_one_line_and_exit_code_2(here, model):
    (here / "notes.png").write_text("This is no picture.")
    result = in_a_shell("main()", "touch-to-image", "notes.png", "-o", "out", "--model", model)
    refused(result, "`touch", "notes.png")
    assert not (here / "out").exists()


def test_help_does_not_wait_for_torch(here):
    code, out, _ = in_a_shell("try: main()\nfinally: print('torch' in sys.modules)", "touch-to-image", "--help")
    assert code == 0
    assert out.endswith("False\n")


# Refusals -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--steps", 0], ["`--steps` is 0"]),
        (["--steps", -1], ["`--steps` is -1"]),
        (["--steps", 1001], ["`--steps` is 1001"]),
        (["--guidance", "nan"], ["`--guidance` is nan"]),
        (["--guidance", -1], ["`--guidance` is -1"]),
        (["--seed", -1], ["`seed` is -1"]),
        (["--batch-size", 0], ["`batch_size` is 0"]),
        (["--seed", 2**63], ["`seed` is"]),
        (["--sensor", "gelsigt"], ["`sensor` is 'gelsigt'", "'gelsight'"]),
        (["--background", "gone.png"], ["`background`", "gone.png"]),
    ],
)
def test_options_that_cannot_be_used(here, make, options, words):
    refused(make("in/dark.png", "-o", "out", *options), *words)
    assert not (here / "out").exists()


@pytest.mark.parametrize(
    ("name", "contents"),
    [("notes.png", b"no picture"), ("cut.png", None), ("empty.png", b""), ("gone.png", ...), ("in", ...)],
)
def test_touches_that_cannot_be_read(here, make, name, contents):
    whole = (here / "in" / "dark.png").read_bytes()
    if contents is not ...:
        (here / name).write_bytes(whole[: len(whole) // 2] if contents is None else contents)
    refused(make("in/dark.png", name, "-o", "out"), "`touch[1]`", name)
    assert not (here / "out").exists()


@pytest.mark.parametrize("suffix", [".bogus", ".txt", ".psd", ".xbm"])
def test_suffixes_that_are_no_format_for_pictures(here, make, suffix):
    refused(make("in/dark.png", "-o", f"picture{suffix}"), "`--output`", f"picture{suffix}", ".png")
    assert files(here) == ["in/bright.png", "in/dark.png"]


def test_several_pictures_for_one_file(here, make):
    refused(make("in/dark.png", "in/bright.png", "-o", "out.png"), "`--output`", "out.png", "2 pictures")
    assert not (here / "out.png").exists()


@pytest.mark.parametrize("output", ["in", "in/dark.png", "./in/../in"])
def test_a_picture_never_replaces_its_touch(here, make, output):
    before = (here / "in" / "dark.png").read_bytes()
    refused(make("in/dark.png", "-o", output), "`--output`", "dark.png")
    assert (here / "in" / "dark.png").read_bytes() == before


def test_a_file_is_no_folder(here, make):
    (here / "taken").touch()
    refused(make("in/dark.png", "-o", "taken"), "`--output` is 'taken'")
    refused(make("in/dark.png", "-o", "taken/below"), "`--output` is 'taken/below'", "file")
    refused(make("in/dark.png", "-o", "taken/below.png"), "`--output` is 'taken/below.png'", "file")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_cannot_be_written_to(here, make):
    (here / "locked").mkdir(mode=0o500)
    refused(make("in/dark.png", "-o", "locked/out"), "`--output`", "locked")


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs a file system that takes no files")
def test_a_folder_that_takes_no_files(here, make):
    refused(make("in/dark.png", "-o", "/proc/self/out"), "`--output`", "/proc/self")


def test_a_name_that_is_too_long(here, make):
    refused(make("in/dark.png", "-o", f"out/{'x' * 300}.png"), "`--output`")
    assert files(here) == ["in/bright.png", "in/dark.png"]


# Models ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["gone", "./gone", "a/b/c", "", "in"])
def test_folders_that_hold_no_pipeline(here, run, name):
    refused(run("touch-to-image", "in/dark.png", "-o", "out", "--model", name), f"`--model` is {name!r}")
    assert not (here / "out").exists()


@pytest.mark.parametrize(
    "broken",
    ["model_index.json", "unet/config.json", "unet/diffusion_pytorch_model.safetensors", "unitouch/model.safetensors"],
)
def test_a_model_with_a_broken_file(here, run, tmp_path, broken):
    TouchToImagePipeline(**PARTS()).save_pretrained(tmp_path / "model")
    file = tmp_path / "model" / broken
    file.write_bytes(file.read_bytes()[:100])
    refused(run("touch-to-image", "in/dark.png", "-o", "out", "--model", "model"), "`--model` is 'model'")
    assert not (here / "out").exists()


def test_a_model_of_another_pipeline(here, run, tmp_path):
    (tmp_path / "model").mkdir()
    index = {"_class_name": "DDPMPipeline", "_diffusers_version": "0.42.1", "scheduler": ["diffusers", "DDPMScheduler"]}
    (tmp_path / "model" / "model_index.json").write_text(json.dumps(index))
    refused(run("touch-to-image", "in/dark.png", "-o", "out", "--model", "model"), "`--model` is 'model'")


# The built-in family --------------------------------------------------------------------------------------------------


@built_in
def test_the_built_in_family_needs_no_model(here, run):
    code, out, _ = run("touch-to-image", "in/dark.png", "-o", "out", "--steps", 2, "--json")
    row = json.loads(out)["pictures"][0]
    assert code == 0
    assert row["sensor"] in {"gelsight", "digit", "taxim"}
    assert Image.open("out/dark.png").size == (64, 64)


@built_in
def test_the_built_in_family_says_which_sensors_it_knows(here, run):
    refused(
        run("touch-to-image", "in/dark.png", "-o", "out", "--sensor", "finger"), "`sensor` is 'finger'", "'gelsight'"
    )
