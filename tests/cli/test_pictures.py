"""`unitouch-gen touch-to-image`, `stylize` and `x-to-touch`: what they write, what they print, and what they refuse.

Run in this process on tiny random pipelines.
"""

import io
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch
from diffusers import UNet2DConditionModel
from PIL import Image

from unitouch_gen import weights
from unitouch_gen.cli.pictures import endings, generators, save_picture, unique
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import UniTouchModel, UniTouchViT
from unitouch_gen.models.added_sensors import AddedSensor, print_of
from unitouch_gen.pipelines import TouchToImagePipeline
from unitouch_gen.sampling import ReturnCode, RunReport
from unitouch_gen.world import MATERIAL_NAMES, SENSORS

built_in = pytest.mark.skipif(
    not (weights.JOINT / "model.safetensors").exists(), reason="built-in weights are not there"
)


# touch-to-image: pictures ---------------------------------------------------------------------------------------------


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


def test_a_picture_that_is_there_is_replaced_where_one_asks_for_it(here, make, files, refused):
    make("in/dark.png", "-o", "out", "--seed", 1)
    before = (here / "out" / "dark.png").read_bytes()
    again = ("in/bright.png", "in/dark.png", "-o", "out", "--seed", 2)
    refused(make(*again), "`--output` would replace 'out/dark.png'", "`--overwrite`")
    assert (here / "out" / "dark.png").read_bytes() == before and files(here / "out") == ["dark.png"]
    assert make(*again, "--overwrite")[0] == 0
    assert (here / "out" / "dark.png").read_bytes() != before


def test_several_pictures_of_a_touch_are_numbered(here, make):
    """And the first is the one that would be made alone."""
    words = ("in/dark.png", "in/bright.png", "--batch-size", 3, "--json")
    rows = json.loads(make(*words, "--images", 2, "-o", "out")[1])["pictures"]
    assert [(row["touch"], row["picture"]) for row in rows] == [
        (f"in/{name}.png", f"out/{name}-{number}.png") for name in ("dark", "bright") for number in (1, 2)
    ]
    make("in/bright.png", "-o", "alone.png")
    one, two, alone = (pixels(file).astype(int) for file in ("out/bright-1.png", "out/bright-2.png", "alone.png"))
    assert abs(one - alone).max() <= 1 < abs(one - two).max()


# touch-to-image: inputs -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("words", [["in"], ["in/*.png"], ["in/br*", "in/dar?.png"], ["**/*.png"]])
def test_folders_and_patterns_stand_for_their_files(here, make, files, words):
    code, _, err = make(*words, "-o", "out")
    assert (code, err) == (0, "")
    assert files(here / "out") == ["bright.png", "dark.png"]


def test_files_of_a_folder_come_in_natural_order(here, make):
    for name in ("10.png", "9.PNG"):
        shutil.copy("in/dark.png", f"in/{name}")
    (here / "in" / "notes.txt").touch()
    rows = json.loads(make("in", "-o", "out", "--json")[1])["pictures"]
    assert [Path(row["touch"]).name for row in rows] == ["9.PNG", "10.png", "bright.png", "dark.png"]


def test_a_file_with_the_signs_of_a_pattern_is_a_file(here, make, files):
    shutil.copy("in/dark.png", "in/a[1].png")
    assert make("in/a[1].png", "-o", "out")[0] == 0 and files(here / "out") == ["a[1].png"]


def test_standard_input_is_a_touch(here, make, monkeypatch, refused):
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO((here / "in" / "dark.png").read_bytes())))
    (row,) = json.loads(make("-", "-o", "out", "--json")[1])["pictures"]
    assert (row["touch"], row["picture"]) == ("-", "out/stdin.png")
    make("in/dark.png", "-o", "out")
    assert (pixels("out/stdin.png") == pixels("out/dark.png")).all()
    refused(make("-", "-o", "more"), "`touch` is '-'", "empty")


def test_examples_go_by_their_names(here, make, files):
    assert make("example:brick", "example:digit_wood", "-o", "out")[0] == 0
    assert files(here / "out") == ["digit_wood.png", "gelsight_brick.png"]


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("https://example.org/touch.png", "an address, and nothing is fetched"),
        ("s3://bucket/touch.png", "an address"),
        ("none/*.png", "is the pattern 'none/*.png', which no file matches"),
        ("empty", "names the folder 'empty', which holds no images"),
        ("example:brik", "Did you mean 'brick'?"),
    ],
)
def test_words_that_stand_for_nothing(here, make, refused, word, said):
    (here / "empty").mkdir()
    refused(make("in/dark.png", word, "-o", "out"), said)
    assert not (here / "out").exists()


def test_pipelines_refuse_addresses_too(make_components):
    with pytest.raises(InvalidInputError, match="an address, and nothing is fetched"):
        make_components()["processor"].touch("https://example.org/touch.png")


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


@pytest.mark.filterwarnings("ignore::unitouch_gen.errors.UnfamiliarInputWarning")  # a dark touch for a DIGIT
def test_pictures_are_those_of_the_pipeline(here, make, models):
    options = {"--seed": 3, "--steps": 4, "--guidance": 3, "--prompt": "rough brick", "--sensor": "digit",
               "--negative-prompt": "wood", "--strength": 0.5, "--noise-level": 30, "--solver": "ddim", "--eta": 0.5,
               "--height": 24, "--device": "cpu"}  # fmt: skip
    make("in/dark.png", "-o", "out", *(word for option in options.items() for word in option),
         "--guidance-interval", 0.1, 0.9)  # fmt: skip
    pipe = TouchToImagePipeline.from_pretrained(models["touch-to-image"])
    expected = pipe(
        "in/dark.png", "rough brick", num_inference_steps=4, guidance_scale=3.0, sensor="digit", solver="ddim", eta=0.5,
        negative_prompt="wood", strength=0.5, noise_level=30, height=24, guidance_interval=(0.1, 0.9),
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


def test_every_picture_that_is_no_success_has_a_line():
    report = RunReport()
    report.codes = [ReturnCode.SUCCESS, ReturnCode.DIVERGED]
    (line,) = endings(report, [Path("out/fine.png"), Path("out/wild.png")])
    assert line.startswith("wild.png is diverged: ")
    assert "`--guidance`" in line and "guidance_scale" not in line


# touch-to-image: what is printed --------------------------------------------------------------------------------------


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
    assert row["sensor"] in {*SENSORS, None}
    assert Image.open("out/dark.png").size == (128, 128)


@built_in
def test_the_built_in_family_says_which_sensors_it_knows(here, command, refused):
    refused(
        command("touch-to-image", "in/dark.png", "-o", "out", "--sensor", "finger"),
        "`sensor` is 'finger'",
        "'gelsight'",
    )


# stylize --------------------------------------------------------------------------------------------------------------


@pytest.fixture
def inputs(tmp_path, monkeypatch) -> Path:
    """A folder to be in, with two touches, a photo, and a sound."""
    rng = np.random.default_rng(0)
    for name, shape in {"one.png": (32, 32, 3), "two.png": (32, 32, 3), "photo.jpg": (40, 60, 3)}.items():
        Image.fromarray(rng.integers(0, 256, shape, dtype=np.uint8)).save(tmp_path / name)
    soundfile.write(tmp_path / "hit.wav", rng.standard_normal(4000) * np.exp(-np.arange(4000) / 500), 16_000)
    soundfile.write(tmp_path / "silence.wav", np.zeros(4000), 16_000)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def run(command, models):
    """Runs a command with its model."""
    return lambda name, *args: command(name, *args, "--model", models[name])


def pixels(file: str | Path) -> np.ndarray:
    return np.asarray(Image.open(file))


def test_a_photo_is_restyled_by_each_touch(inputs, run):
    code, out, _ = run("stylize", "photo.jpg", "one.png", "two.png", "-o", "out", "--json")
    assert code == 0
    rows = json.loads(out)["pictures"]
    assert [Path(row["picture"]).name for row in rows] == ["photo-one.png", "photo-two.png"]
    assert all(pixels(row["picture"]).shape == (16, 16, 3) for row in rows)


def test_a_picture_does_not_depend_on_its_neighbours(inputs, run):
    run("stylize", "photo.jpg", "one.png", "two.png", "-o", "both")
    run("stylize", "photo.jpg", "two.png", "-o", "alone.png")
    np.testing.assert_allclose(pixels("alone.png").astype(int), pixels("both/photo-two.png").astype(int), atol=1)


def test_batches_make_the_same_pictures(inputs, run):
    run("stylize", "photo.jpg", "one.png", "two.png", "-o", "both")
    run("stylize", "photo.jpg", "one.png", "two.png", "-o", "each", "--batch-size", 1)
    for name in ("photo-one.png", "photo-two.png"):
        np.testing.assert_allclose(pixels(f"both/{name}").astype(int), pixels(f"each/{name}").astype(int), atol=1)


@pytest.mark.parametrize("words", [("--timesteps", "900,500,100"), ("--sigmas", "9,2,0.5,0")])
def test_the_steps_themselves_may_be_named(here, make, words):
    code, out, _ = make("in/dark.png", "-o", "out", "--json", "--solver", "euler", *words)
    assert code == 0 and json.loads(out)["report"]["steps"] == 3


# x-to-touch -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("modality", "value", "stem"),
    [
        ("image", "photo.jpg", "photo"),
        ("text", "Rough brick!", "rough-brick"),
        ("audio", "hit.wav", "hit"),
        ("touch", "one.png", "one"),
    ],
)
def test_each_modality_becomes_a_touch(inputs, run, modality, value, stem):
    code, out, _ = run("x-to-touch", f"--{modality}", value, "-o", "out", "--json")
    assert code == 0
    (row,) = json.loads(out)["touches"]
    assert (row["sensor"], Path(row["touch"]).name) == ("gelsight", f"{stem}-gelsight.png")
    assert row["of"] == {modality: value}
    assert pixels(row["touch"]).shape == (16, 16, 3)


def test_every_input_of_an_option_becomes_a_touch(inputs, run, files):
    """And two runs into one folder stand beside each other."""
    words = ("x-to-touch", "--image", "one.png", "--image", "two.png", "-o", "out", "--json", "--batch-size", 3)
    rows = json.loads(run(*words, "--sensor", "all")[1])["touches"]
    assert [(row["of"]["image"], row["sensor"], Path(row["touch"]).name) for row in rows] == [
        (f"{name}.png", sensor, f"{name}-{sensor}.png") for name in ("one", "two") for sensor in ("gelsight", "digit")
    ]
    run("x-to-touch", "--image", "two.png", "--sensor", "digit", "-o", "alone.png")
    assert abs(pixels("alone.png").astype(int) - pixels("out/two-digit.png")).max() <= 1
    assert run("x-to-touch", "--image", "photo.jpg", "-o", "out")[0] == 0
    assert len(files(inputs / "out")) == 5


def test_several_inputs_go_in_pairs_or_with_one(inputs, run, refused):
    both = ("x-to-touch", "--image", "one.png", "--image", "two.png", "-o", "out", "--json")
    rows = json.loads(run(*both, "--text", "rough brick")[1])["touches"]
    assert [row["of"]["text"] for row in rows] == ["rough brick", "rough brick"]
    assert [Path(row["touch"]).name for row in rows] == ["one-rough-brick-gelsight.png", "two-rough-brick-gelsight.png"]
    refused(run(*both, *("--text", "a", "--text", "b", "--text", "c")), "`--image` came 2 times", "3 times")


def test_all_sensors_are_drawn(inputs, run):
    code, out, _ = run("x-to-touch", "--text", "rough brick", "--sensor", "all", "-o", "out", "--candidates", 2)
    assert code == 0 and "rough-brick-gelsight.png" in out
    assert sorted(path.name for path in Path("out").iterdir()) == ["rough-brick-digit.png", "rough-brick-gelsight.png"]


@built_in
def test_a_sensor_without_a_name_is_drawn_by_its_untouched_gel(inputs, command):
    made = []
    for name in ("one", "two"):
        words = (
            "--text",
            "rough brick",
            "--background",
            f"{name}.png",
            "-o",
            f"out/{name}.png",
            "--steps",
            2,
            "--json",
        )
        code, out, _ = command("x-to-touch", *words)
        (row,) = json.loads(out)["touches"]
        assert code == 0 and row["sensor"] is None
        made.append(pixels(f"out/{name}.png"))
    assert not np.array_equal(*made)


def test_what_touches_of_unknown_sensors_feel_like_is_left_out(inputs, run, models, monkeypatch):
    folder = Path("unknown")
    shutil.copytree(models["x-to-touch"], folder)
    index = folder / "model_index.json"
    index.write_text(json.dumps({**json.loads(index.read_text()), "sensors": ["gelsight", "gelslim"]}))
    monkeypatch.setitem(models, "x-to-touch", str(folder))
    code, out, err = run("x-to-touch", "--text", "rough brick", "--sensor", "all", "-o", "out", "--json")
    assert code == 0
    assert [len(row["materials"]) for row in json.loads(out)["touches"]] == [3, 0]
    assert err.startswith("unitouch-gen: what touches of gelslim feel like is left out") and err.count("\n") == 1


def test_modalities_are_mixed_by_weight(inputs, run):
    run("x-to-touch", "--text", "rough brick", "-o", "text.png")
    both = ("--text", "rough brick", "--image", "photo.jpg")
    run("x-to-touch", *both, "--weight", "text=1", "--weight", "image=0", "-o", "weighed.png")
    run("x-to-touch", *both, "-o", "even.png", "--no-bridge")
    assert np.array_equal(pixels("weighed.png"), pixels("text.png"))
    assert not np.array_equal(pixels("even.png"), pixels("text.png"))


# Devices, sensors of one's own ----------------------------------------------------------------------------------------


def test_a_picture_may_go_nowhere(here, make, files):
    code, _, err = make("in/dark.png", "-o", "/dev/null")
    assert (code, err) == (0, "")
    assert files(here) == ["in/bright.png", "in/dark.png"]


@pytest.fixture
def mine(here, models) -> Path:
    """A file of a sensor whose touches are dark."""
    encoder, bank = UniTouchModel.from_pretrained(f"{models['touch-to-image']}/unitouch").load("touch")
    prototype = torch.full((3, bank.prototype_size, bank.prototype_size), 50 / 255)
    AddedSensor("mine", print_of(encoder), torch.zeros(bank.tokens.shape[1:]), prototype).save(
        here / "mine.safetensors"
    )
    return here / "mine.safetensors"


@pytest.mark.parametrize("named", [(), ("--sensor", "mine")])
def test_a_sensor_of_ones_own_is_added_for_a_command(here, make, mine, named):
    code, out, _ = make("in/dark.png", "-o", "out", "--load-sensor", mine, *named, "--json")
    assert code == 0 and json.loads(out)["pictures"][0]["sensor"] == "mine"


def test_a_touch_of_ones_own_sensor_is_translated(here, command, models, mine, refused):
    words = ("--load-sensor", mine, "--source-sensor", "mine", "-o", "out", "--model", models["x-to-touch"])
    code, out, err = command("x-to-touch", "--touch", "in/bright.png", *words, "--json")
    assert code == 0, err
    assert json.loads(out)["report"]["sensors"] == ["mine"]
    refused(command("x-to-touch", "--text", "brick", *words), "--touch", "no effect")


def test_what_is_no_sensor_is_refused(here, make, refused):
    refused(make("in/dark.png", "-o", "out", "--load-sensor", "in/dark.png"), "`--load-sensor` is", "no whole file")


@built_in
def test_batches_draw_the_same_touches(here, command):
    words = ("x-to-touch", "--text", "rough brick", "--sensor", "all", "--steps", 2, "--json")
    reports = [json.loads(command(*words, "-o", f"out{size}", "--batch-size", size)[1])["report"] for size in (8, 2)]
    assert [len(report["codes"]) for report in reports] == [4, 4]
    for name in SENSORS:
        one, two = (np.asarray(Image.open(f"out{size}/rough-brick-{name}.png"), dtype=int) for size in (8, 2))
        assert abs(one - two).max() <= 1


# Unfamiliar touches ---------------------------------------------------------------------------------------------------


@pytest.fixture
def bowl(inputs) -> str:
    """What no sensor inputs would see; `known.png` is the prototype of the first."""
    checks = 255 * ((np.arange(32)[:, None] + np.arange(32)) % 2)
    Image.fromarray(np.stack([checks] * 3, axis=2).astype(np.uint8)).save("bowl.png")
    Image.new("RGB", (32, 32), (51, 51, 51)).save("known.png")
    return "bowl.png"


@pytest.mark.parametrize("words", [["touch-to-image"], ["stylize", "photo.jpg"], ["x-to-touch", "--touch"]])
def test_a_touch_unlike_any_known_is_named_in_one_line(bowl, run, words):
    code, out, err = run(*words, bowl, "-o", "out", "--json")
    assert code == 0 and json.loads(out)
    assert err.startswith("unitouch-gen: bowl.png: unlike") and err.count("\n") == 1
    assert run(*words, "known.png", "-o", "out", "--json")[2] == ""


def test_a_photo_in_the_place_of_the_touch_is_one_line_more(bowl, run):
    code, _, err = run("stylize", "known.png", bowl, "-o", "out", "--json")
    assert code == 0 and err.startswith("unitouch-gen: `image` looks more like a touch") and err.count("\n") == 2


def test_batches_do_not_repeat_the_line(bowl, run):
    _, _, err = run("touch-to-image", bowl, "known.png", bowl, "-o", "out", "--json", "--batch-size", 1)
    assert err.startswith("unitouch-gen: bowl.png, bowl.png: unlike") and err.count("\n") == 1


@pytest.mark.parametrize("words", [["touch-to-image"], ["stylize", "photo.jpg"]])
def test_re_centred_touches_need_no_such_line(bowl, run, words):
    assert run(*words, bowl, "-o", "out", "--json", "--background", "known.png")[2] == ""


def test_a_touch_that_is_its_background_is_one_of_nothing(bowl, run):
    _, out, err = run("touch-to-image", bowl, "-o", "out", "--json", "--background", bowl)
    assert err == "unitouch-gen: bowl.png: nothing is touched. What is made of it is a guess.\n"
    printed = json.loads(out)
    assert printed["pictures"][0]["unknown"] == "nothing is touched"
    assert printed["report"]["unknown"] == {"touch": ["nothing is touched"]}
    assert "nothing is touched │" in run("touch-to-image", bowl, "-o", "again", "--background", bowl)[1]


def test_a_sensor_that_is_named_is_no_doubt(bowl, run):
    assert run("touch-to-image", bowl, "-o", "out", "--json", "--sensor", "digit")[2] == ""


def test_what_a_percentage_is_stands_below_the_table(bowl, run):
    assert "how sure the model is of a material (not calibrated)" in run("touch-to-image", "known.png", "-o", "out")[1]


# Mistakes -------------------------------------------------------------------------------------------------------------

MISTAKES = {
    "no modality": (["x-to-touch", "-o", "out"], "Nothing to make a touch of came"),
    "silence": (["x-to-touch", "--audio", "silence.wav", "-o", "out"], "`audio` is silent"),
    "no sound": (["x-to-touch", "--audio", "one.png", "-o", "out"], "cannot be read as a sound"),
    "blank text": (["x-to-touch", "--text", " ", "-o", "out"], "`text` is blank"),
    "unknown sensor": (["x-to-touch", "--text", "brick", "--sensor", "digits", "-o", "out"], "Did you mean 'digit'"),
    "weight of no modality": (
        ["x-to-touch", "--text", "brick", "--weight", "smell=1", "-o", "out"],
        "`weights` names 'smell', which is no modality; `text` came",
    ),
    "weight of no number": (
        ["x-to-touch", "--text", "brick", "--weight", "text=x", "-o", "out"],
        "`--weight` is 'text=x'",
    ),
    "two weights of one modality": (
        ["x-to-touch", "--text", "brick", "--weight", "text=1", "--weight", "text=0.5", "-o", "out"],
        "`--weight` names 'text' twice",
    ),
    "a sensor and a gel": (
        ["x-to-touch", "--text", "brick", "--sensor", "digit", "--background", "one.png", "-o", "out"],
        "`--background` came with `--sensor`",
    ),
    "no gel": (
        ["x-to-touch", "--text", "brick", "--background", "gone.png", "-o", "out"],
        "'gone.png', which does not exist",
    ),
    "no candidates": (["x-to-touch", "--text", "brick", "--candidates", "0", "-o", "out"], "`candidates` is 0"),
    "two sensors, one file": (
        ["x-to-touch", "--text", "brick", "--sensor", "all", "-o", "out.png"],
        "is the file 'out.png' for 2 pictures",
    ),
    "photo is missing": (["stylize", "none.jpg", "one.png", "-o", "out"], "'none.jpg', which does not exist"),
    "touch is missing": (["stylize", "photo.jpg", "none.png", "-o", "out"], "'none.png', which does not exist"),
    "weight above 1": (["stylize", "photo.jpg", "one.png", "--touch-weight", "1.5", "-o", "out"], "`--touch-weight`"),
    "negative weight": (["stylize", "photo.jpg", "one.png", "--touch-weight", "-1", "-o", "out"], "`--touch-weight`"),
    "unknown mix": (["stylize", "photo.jpg", "one.png", "--mix", "slurp", "-o", "out"], "Did you mean 'slerp'"),
    "init strength": (["stylize", "photo.jpg", "one.png", "--init-strength", "2", "-o", "out"], "`init_strength` is 2"),
    "replaces the photo": (["stylize", "photo.jpg", "one.png", "-o", "photo.jpg"], "would replace the input"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_one_line_and_leaves_nothing(inputs, run, name):
    before = sorted(path.name for path in inputs.rglob("*"))
    args, words = MISTAKES[name]
    code, out, err = run(*args)
    assert (code, out) == (2, "")
    assert err.count("\n") == 1 and words in err
    assert sorted(path.name for path in inputs.rglob("*")) == before


def test_candidates_start_from_noise_of_their_own():
    """And what a picture is made from does not depend on how many there are."""
    seeds = [generator.initial_seed() for generator in generators(5, [0, 0], 3)]
    assert seeds == [5, 6, 7, 5, 6, 7]
    seeds = [generator.initial_seed() for generator in generators(5, [0, 1], 3)]
    assert seeds == [5, 6, 7, 8, 9, 10]


# Files ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("names", "stems"),
    [
        (["a.png", "b.png"], ["a", "b"]),
        (["a.png", "x/a.png", "a.jpg"], ["a", "a-2", "a-3"]),
        (["a.png", "x/a.png", "a-2.png"], ["a", "a-2", "a-2-2"]),
        (["a-2.png", "a.png", "x/a.png"], ["a-2", "a", "a-3"]),
        (["A.png", "a.png"], ["A", "a-2"]),
    ],
)
def test_no_two_pictures_have_one_name(names, stems):
    assert unique([Path(name).stem for name in names]) == stems


def test_a_picture_that_cannot_be_saved_leaves_nothing_half_written(tmp_path):
    """A format that Pillow starts to write and then gives up."""
    picture = Image.new("RGB", (70_000, 1))
    with pytest.raises(InvalidInputError, match="`--output` cannot be written"):
        save_picture(picture, tmp_path / "picture.jpg")
    assert list(tmp_path.iterdir()) == []


def test_a_picture_that_cannot_be_saved_leaves_the_one_before_it(tmp_path):
    Image.new("RGB", (8, 8)).save(tmp_path / "picture.jpg")
    before = (tmp_path / "picture.jpg").read_bytes()
    with pytest.raises(InvalidInputError):
        save_picture(Image.new("RGB", (70_000, 1)), tmp_path / "picture.jpg")
    assert (tmp_path / "picture.jpg").read_bytes() == before
