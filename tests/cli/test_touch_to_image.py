"""`unitouch-gen touch-to-image`: what it writes and what it prints."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers import UNet2DConditionModel
from PIL import Image

from unitouch_gen import weights
from unitouch_gen.cli.batches import note_endings
from unitouch_gen.models import UniTouchViT
from unitouch_gen.pipelines import TouchToImagePipeline
from unitouch_gen.sampling import ReturnCode, RunReport
from unitouch_gen.world.materials import MATERIAL_NAMES

built_in = pytest.mark.skipif(
    not (weights.JOINT / "model.safetensors").exists(), reason="built-in weights are not there"
)


# Pictures -------------------------------------------------------------------------------------------------------------


def test_pictures_go_into_a_folder_under_the_names_of_their_touches(here, make, files):
    code, *_ = make("in/dark.png", "in/bright.png", "-o", "a/new/folder")
    assert code == 0
    assert files(here / "a") == ["new/folder/bright.png", "new/folder/dark.png"]
    assert Image.open("a/new/folder/dark.png").size == (16, 16)


def test_a_single_picture_may_have_a_file_name(here, make, files):
    code, *_ = make("in/dark.png", "-o", "some/picture.jpg")
    assert code == 0
    assert files(here / "some") == ["picture.jpg"]
    assert Image.open("some/picture.jpg").format == "JPEG"


def test_a_picture_that_is_there_is_replaced(here, make, files):
    make("in/dark.png", "-o", "out", "--seed", 1)
    before = (here / "out" / "dark.png").read_bytes()
    make("in/dark.png", "-o", "out", "--seed", 2)
    assert (here / "out" / "dark.png").read_bytes() != before
    assert files(here / "out") == ["dark.png"]


def test_touches_of_one_name_have_pictures_of_their_own(here, make, files):
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


def test_a_touch_of_a_later_batch_that_cannot_be_read_leaves_nothing_behind(here, make, refused):
    (here / "notes.png").write_text("This is no picture.")
    refused(
        make("in/dark.png", "in/bright.png", "notes.png", "-o", "out", "--batch-size", 1), "`touch[2]`", "notes.png"
    )
    assert not (here / "out").exists()


@pytest.mark.filterwarnings("ignore::unitouch_gen.errors.UnfamiliarTouchWarning")  # a dark touch for a DIGIT
def test_pictures_are_those_of_the_pipeline(here, make, models):
    options = {"--seed": 3, "--steps": 4, "--guidance": 3, "--prompt": "rough brick", "--sensor": "digit"}
    make("in/dark.png", "-o", "out", *(word for option in options.items() for word in option))
    pipe = TouchToImagePipeline.from_pretrained(models["touch-to-image"])
    expected = pipe(
        "in/dark.png", "rough brick", num_inference_steps=4, guidance_scale=3.0, sensor="digit",
        generator=torch.Generator().manual_seed(3),
    ).images[0]  # fmt: skip
    np.testing.assert_array_equal(np.asarray(Image.open("out/dark.png")), np.asarray(expected))


def test_the_networks_are_of_the_dtype_asked_for(here, make, monkeypatch, refused):
    seen = set()
    forward = UNet2DConditionModel.forward

    def look(self, sample, *args, **kwargs):
        seen.add((self.dtype, sample.dtype))
        return forward(self, sample, *args, **kwargs)

    monkeypatch.setattr(UNet2DConditionModel, "forward", look)
    for dtype in ("bfloat16", "float32"):
        assert make("in/dark.png", "-o", dtype, "--dtype", dtype)[0] == 0
        assert seen == {(getattr(torch, dtype),) * 2}
        seen.clear()
    refused(make("in/dark.png", "-o", "out", "--dtype", "float8"), "'float8'", "'bfloat16'")


def test_every_picture_that_is_no_success_has_a_line(capsys):
    report = RunReport()
    report.codes = [ReturnCode.SUCCESS, ReturnCode.DIVERGED]
    note_endings(report, [Path("out/fine.png"), Path("out/wild.png")])
    line = capsys.readouterr().err
    assert line.startswith("unitouch-gen: wild.png is diverged: ") and line.count("\n") == 1
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


def test_a_pipeline_without_a_tokenizer_for_the_joint_space_names_no_materials(
    here, command, tmp_path, make_components
):
    """Such as `from_pipe` makes of a diffusers pipeline."""
    parts = make_components()
    parts["processor"].tokenizer = None
    TouchToImagePipeline(**parts).save_pretrained(tmp_path / "model")
    code, out, _ = command(
        "touch-to-image", "in/dark.png", "-o", "out", "--steps", 2, "--json", "--model", tmp_path / "model"
    )
    assert code == 0
    assert json.loads(out)["pictures"][0]["materials"] == {}


# The built-in family --------------------------------------------------------------------------------------------------


@built_in
def test_the_built_in_family_needs_no_model(here, command):
    code, out, _ = command("touch-to-image", "in/dark.png", "-o", "out", "--steps", 2, "--json")
    row = json.loads(out)["pictures"][0]
    assert code == 0
    assert row["sensor"] in {"gelsight", "digit", "taxim"}
    assert Image.open("out/dark.png").size == (64, 64)


@built_in
def test_the_built_in_family_says_which_sensors_it_knows(here, command, refused):
    refused(
        command("touch-to-image", "in/dark.png", "-o", "out", "--sensor", "finger"),
        "`sensor` is 'finger'",
        "'gelsight'",
    )
