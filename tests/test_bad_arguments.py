"""Arguments of the library's functions that cannot be used: each is refused by name. Pipelines have their own table."""

import copy
import math
import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import diffusers
import numpy as np
import pytest
import torch
from PIL import Image
from transformers import AutoConfig, AutoModelForCausalLM

from tests.helpers import recordings
from tests.helpers.components import LLAMA, D, clip_tokenizer, joint_config, make_components, make_language_parts
from tests.helpers.layouts import table
from tests.helpers.plain_sensor import PLAIN
from tests.helpers.refusals import check_refusal
from unitouch_gen import errors
from unitouch_gen.arguments import SamplingArguments
from unitouch_gen.errors import InvalidInputError, InvalidTypeError, NonFiniteError, NotConvergedError, check_fields
from unitouch_gen.evaluation.zero_shot import ZeroShotTouchClassifier
from unitouch_gen.examples import example
from unitouch_gen.files import reading
from unitouch_gen.models import SensorBank, UniTouchConfig, UniTouchModel, UniTouchProcessor, UniTouchViTConfig
from unitouch_gen.models.images import load_images
from unitouch_gen.models.language import LanguageBridge
from unitouch_gen.models.sounds import load_sounds
from unitouch_gen.models.videos import firmest
from unitouch_gen.numerics.problems import PROBLEMS, solve_flow
from unitouch_gen.sampling import prepare_steps
from unitouch_gen.schedule import NoiseSchedule
from unitouch_gen.training.data import DataConfig, DrawnConfig, columns_of, open_dataset
from unitouch_gen.training.texture import check_takes_texture
from unitouch_gen.world import MATERIAL_NAMES, World, draw_sensor, press, untouched_gel

NAN = math.nan
INF = math.inf
RATE = 16_000
NOISE = np.random.default_rng(0).standard_normal(RATE).clip(-1, 1).astype(np.float32)
PICTURE = np.random.default_rng(0).integers(0, 256, (24, 20, 3), dtype=np.uint8)

Row = tuple[dict[str, Any], *tuple[str, ...]]
"""Arguments, of which the first has to be named; then what the message has to say."""


def each(name: str, *values: Any, said: str = "") -> list[Row]:
    """A row for each value of an argument."""
    return [({name: value}, said) for value in values]


def check(call: Callable[..., Any], rows: list[Row], **others: Any) -> None:
    for given, *said in rows:
        name = next(iter(given))
        check_refusal(partial(call, **{**others, **given}), name, *said)


# Values ---------------------------------------------------------------------------------------------------------------


def test_a_message_says_what_came_and_what_is_wanted():
    for values, error, message in (
        ({"eta": 2}, InvalidInputError, "`eta` is 2; it has to be at most 1."),
        ({"height": 0}, InvalidInputError, "`height` is 0; it has to be at least 1."),
        ({"width": 2.5}, InvalidTypeError, "`width` is 2.5; it has to be a valid integer."),
        (
            {"mix": "papre"},
            InvalidInputError,
            "`mix` is 'papre'; it has to be 'linear' or 'paper'. Did you mean 'paper'?",
        ),
    ):
        name = next(iter(values))
        said = f"^{re.escape(message)}$"
        check_refusal(partial(check_fields, SamplingArguments, values), name, said, kind=error, given=values[name])


def test_numbers_and_tensors_out_of_bounds_are_refused():
    wide = torch.zeros(2, 3)
    of_shape = partial(errors.check_tensor, "x")
    for call, kind, *said in (
        (partial(errors.check_integer, "x", 0, 1, 5), InvalidInputError, "is 0; it has to be a number from 1 to 5"),
        (partial(errors.check_number, "x", 1.0000001, 0.0, 1.0), InvalidInputError, "a number from 0 to 1"),
        (partial(errors.check_choice, "x", "huen", ("heun", "ddim")), InvalidInputError, "Did you mean 'heun'"),
        *(
            (partial(of_shape, bad, "B", 3), InvalidTypeError)
            for bad in (wide.int(), wide.to_sparse(), wide.to("meta"))
        ),
        *((partial(of_shape, bad, "B", 3), InvalidInputError) for bad in (wide[:0], wide.log(), wide[0], wide[:, :2])),
    ):
        check_refusal(call, "x", *said, kind=kind)


def test_extras_that_are_missing_or_cannot_be_imported_are_named(tmp_path, monkeypatch):
    (tmp_path / "broken_extra.py").write_text("raise ImportError('Using SOCKS proxy, without its package.')")
    monkeypatch.syspath_prepend(tmp_path)
    missing = r'is missing: pip install "unitouch_gen\[train\]"'
    check_refusal(partial(errors.import_optional, "no_such_module"), "no_such_module", missing)
    broken = r"cannot be imported \(Using SOCKS proxy.*: pip install"
    check_refusal(partial(errors.import_optional, "broken_extra"), "broken_extra", broken)


def test_whatever_a_library_raises_is_one_error_that_names_the_outermost_argument(tmp_path):
    def read(error: Exception, *names: str) -> None:
        with reading(names[0], tmp_path):
            if len(names) > 1:
                read(error, *names[1:])
            raise error

    check_refusal(partial(read, RuntimeError("broken\nmore"), "model"), "model", r"cannot be loaded: broken$")
    own = InvalidInputError("`model` is cut off")
    check_refusal(partial(read, own, "model"), "model", r"^`model` is cut off$")
    inner = partial(read, OSError("no file"), "--model", "pretrained_model_name_or_path")
    check_refusal(inner, "--model", r"^`--model` is .*, which cannot be loaded: no file$")


# Images, sounds and recordings ----------------------------------------------------------------------------------------


def bad(value: float, dtype: type = np.float32) -> np.ndarray:
    array = np.zeros((16, 16, 3), dtype)
    array[3, 4, 0] = value
    return array


SHAPE = "is an? (array|tensor) of shape"
RANGE = "holds values from .*0 to 1 and integer images from 0 to 255"
IMAGES: list[Row] = [
    ({"touch": "gone/nothing.png"}, "names '.*nothing.png', which does not exist"),
    ({"touch": "/"}, "is a folder"),
    ({"touch": "a\0b"}, "names"),
    ({"touch": np.zeros((7, 100, 3), np.uint8)}, "100 x 7 pixels"),
    ({"touch": Image.new("RGB", (1, 1))}, "1 x 1 pixels; .* least 8 x 8"),
    ({"touch": np.zeros((8, 801, 3), np.uint8)}, "801 x 8 pixels; .*100 times the other"),
    *each("touch", bad(NAN), bad(-INF), said="holds 1 of 768 values that are NaN or infinite"),
    *each(
        "touch", bad(1.5), bad(-0.1), bad(300, int), bad(-1, int), bad(2**63, np.uint64), bad(1e300, float), said=RANGE
    ),
    ({"touch": torch.full((3, 16, 16), 255.0)}, RANGE),
    *each("touch", *(Image.fromarray(np.full((16, 16), v, np.int32)) for v in (-1, 70_000)), said="or to 65535"),
    ({"touch": Image.fromarray(np.full((16, 16), 99.0, np.float32))}, RANGE),
    *each("touch", *map(np.zeros, ((16, 16, 2), (3, 16, 16), (16,), (1, 1, 16, 16, 3), (0, 16, 16, 3))), said=SHAPE),
    *each("touch", *map(torch.zeros, ((16, 16), (4, 16, 16), (16, 16, 3), (0, 3, 16, 16))), said=SHAPE),
    ({"touch": []}, "is an empty list"),
    ({"touch": [PICTURE, "nothing.png"]}, r"\[1\]` names"),
]
NO_IMAGES = (
    *(None, 3, b"bytes", np.zeros((16, 16), object), np.zeros((16, 16), complex), torch.eye(16).to_sparse()),
    torch.empty(3, 16, 16, device="meta"),
)


def test_images_that_cannot_be_used_are_refused():
    check(lambda touch: load_images("touch", touch), IMAGES)
    for value in NO_IMAGES:
        check_refusal(partial(load_images, "touch", value), "touch", " is", kind=InvalidTypeError)


NON_FINITE = [np.where(np.arange(RATE) == 7, value, NOISE.astype(np.float64)) for value in (NAN, 1e300)]
SOUNDS: list[Row] = [
    ({"audio": "nothing.wav"}, "names '.*nothing.wav', which does not exist"),
    ({"audio": "/"}, "names .*which is a folder"),
    *each("audio", *((samples, RATE) for samples in NON_FINITE), said="holds .* values that are NaN or infinite"),
    ({"audio": NOISE}, "without a sampling rate"),
    ({"audio": (32_767 * NOISE, RATE)}, "holds samples up to 32767; floats run from -1 to 1"),
    *(({"audio": (NOISE, rate)}, f"sampling rate` is {rate}") for rate in (999, 768_001, 16_000.0, True)),
    *each("audio", *((np.zeros(shape), RATE) for shape in ((1,), (2, 0), (2, 2, 50), (500, 2))), said="has to be"),
    *each("audio", *((np.zeros(9, dtype), RATE) for dtype in (complex, bool, np.uint8)), said="signed integers"),
    *each("audio", None, {"a": 1}, ([0.1], RATE), said="pass the path of a sound file"),
    ({"audio": []}, "is an empty list"),
    ({"audio": [(NOISE, RATE), (NOISE[:1], RATE)]}, r"\[1\]` is an array"),
]


def test_sounds_that_cannot_be_used_are_refused():
    for given, said in SOUNDS:
        with pytest.raises((InvalidInputError, InvalidTypeError), match=f"^`audio.*{said}"):
            load_sounds("audio", given["audio"])


def test_recordings_that_show_no_contact_are_refused():
    rest = recordings.rest()
    rows: list[Row] = [
        ({"touch": iter([])}, "shows no contact"),
        ({"touch": iter([np.roll(rest, 20 * row, 1) for row in range(12)])}, "are alike"),
        ({"touch": iter([rest] * 20)}, "press while it records"),
        ({"touch": iter([rest, rest[:-8]])}, r"`touch\[1\]` is \(40, 64\) pixels"),
        ({"touch": iter([3])}, r"`touch\[0\]`"),
        ({"touch": "gone.mp4"}, "does not exist"),
    ]
    check(lambda touch: firmest("touch", touch), rows)


def test_unknown_names_of_examples_are_refused():
    check_refusal(partial(example, "brik"), "name", "is 'brik'.*Did you mean 'brick'")
    check_refusal(partial(example, "brick", "smell"), "modality", "is 'smell'")


# Models ---------------------------------------------------------------------------------------------------------------

TRANSFORMER: list[Row] = [
    *each("hidden_size", 1000, "wide", 0),
    *(({name: 0},) for name in ("num_attention_heads", "projection_dim", "patch_size", "patch_stride")),
    ({"num_hidden_layers": -1},),
    ({"image_height": 8},),
    ({"stem": "resnet"},),
    ({"patch_size": 14, "stem": "residual"},),  # no power of two
    ({"patch_size": 16, "patch_stride": 8, "stem": "residual"},),
    ({"patch_size": 16, "patch_stride": 16, "stem": "residual", "image_width": 100},),
    ({"mlp_ratio": "4"},),
    ({"hiden_size": 32},),
]
JOINT_SPACE: list[Row] = [
    ({"sensor": ["digit"]},),
    ({"sensor_tokens": 0},),
    ({"prototype_size": -1},),
    ({"temperature": 0.0},),
    ({"embedding_norm": NAN},),
    ({"projection_dim": "wide"},),
    *each("sensors", [1, 2], ["digit", "gelsight", "digit"]),
    ({"sensor_reaches": {"digit": "large"}}, r"`sensor_reaches\['digit'\]`"),
    ({"touch_config": 5},),
]
PARTS_OF_IT = [  # a part's settings, and what is named
    ({"vision_config": {"hidden_size": "wide", "projection_dim": 1024}}, "hidden_size"),
    ({"vision_config": {"stem": "relief", "projection_dim": 1024}}, "vision_config.stem"),
    ({"vision_config": {"stem": "residual", "patch_size": 12, "projection_dim": 1024}}, "patch_size"),
    ({"touch_config": {"stem": "resnet"}}, "stem"),
    ({"audio_config": {"projection_dim": 17}}, "audio_config.projection_dim"),
]


def test_sizes_that_no_network_can_have_are_refused():
    check(UniTouchViTConfig, TRANSFORMER)
    check(UniTouchConfig, JOINT_SPACE)
    for part, named in PARTS_OF_IT:
        with pytest.raises((InvalidInputError, InvalidTypeError), match=named):
            UniTouchConfig(**part)


PROCESSOR: list[Row] = [
    ({"image_size": 10**9}, "is 1000000000"),
    ({"image_size": 32.0}, "is 32.0"),
    ({"audio": [16_000]}, "is a list"),
    ({"tokenizer": "clip"}, "is 'clip'"),
]
AUDIO = {"sampling_rate": 0, "clip_seconds": 0.0, "clips": 0, "frames": "204", "std": 0.0, "frame_length": 1e-5}
AUDIO |= {"frame_shift": 0.0, "mean": INF}


def test_settings_that_a_processor_cannot_have_are_refused():
    check(UniTouchProcessor, PROCESSOR)
    for name, value in (*AUDIO.items(), ("frames", 10**12)):
        with pytest.raises((InvalidInputError, InvalidTypeError), match=f"`{name}` is "):
            UniTouchProcessor(audio={name: value})


def test_tokenizers_that_are_missing_or_cannot_pad_are_refused():
    """One without a length would ask for gigabytes."""
    for length in (10**9, 2):
        other = copy.deepcopy(clip_tokenizer())
        other.model_max_length = length
        read = partial(UniTouchProcessor(image_size=32, tokenizer=other).text, "rough brick")
        check_refusal(read, "model_max_length", given=length)
    check_refusal(partial(UniTouchProcessor(image_size=32).text, "rough brick"), "text", "has no tokenizer")


def test_sensors_that_a_bank_does_not_hold_are_refused():
    bank = SensorBank(("gelsight", "digit"), 5, 16, 8)
    check_refusal(partial(bank.match, torch.zeros(1, 3, 8, 8)), "sensor", "is None.*no prototypes.*gelsight")
    none = SensorBank((), 5, 16, 8)
    check_refusal(partial(none.match, torch.zeros(1, 3, 8, 8), "digit"), "sensor", "has no sensor tokens")


def test_language_models_that_do_not_fit_a_bridge_are_refused():
    def model_of(kind: str, **sizes: Any) -> Any:
        return AutoModelForCausalLM.from_config(AutoConfig.for_model(kind, **sizes)).eval()

    parts = make_language_parts()
    bridge = parts["language_bridge"]
    tokens = {"pad_token_id": 0, "bos_token_id": 1, "eos_token_id": 2, "vocab_size": 280}
    for change, named, said in (
        ({"num_hidden_layers": 3}, "num_layers", "2; it has to be 3"),
        ({"hidden_size": 64, "head_dim": 8}, "hidden_size", "32"),
        ({"num_attention_heads": 2}, "num_heads", "4"),
    ):
        model = model_of("llama", **{**LLAMA, **tokens, **change})
        check_refusal(partial(bridge.attach, model, torch.ones(3, D)), named, said)
    gpt = partial(LanguageBridge.for_model, model_of("gpt2", n_layer=1, n_embd=32, n_head=4), D)
    check_refusal(gpt, "o_proj", "GPT2LMHeadModel, whose attention has no")


def test_joint_spaces_that_texture_has_no_place_in_are_refused():
    config = joint_config(clip_tokenizer())
    stemmed = {**config.vision_config.to_dict(), "stem": "residual", "texture_width": 8}
    textured = {**config.touch_config.to_dict(), "texture_width": 8}
    model = UniTouchModel(joint_config(clip_tokenizer(), vision_config=stemmed, touch_config=textured))
    check_refusal(partial(check_takes_texture, model), "joint", "has texture already")
    check_refusal(partial(check_takes_texture, UniTouchModel(config)), "joint", "has a plain CLIP encoder")


CLASSIFIED: list[Row] = [
    ({"sensor": "skin"}, "is 'skin'"),
    ({"labels": ["wood"]}, " is"),
    ({"labels": ["wood", "wood"]}, "each once"),
    ({"labels": ["wood", " "]}, "none of them blank"),
    ({"labels": [1, 2]},),
    *each("template", "feels like", "{} and {}", "{0}", said="write {} once"),
    ({"template": 3},),
]


def test_labels_and_templates_that_cannot_be_classified_by_are_refused():
    parts = make_components()
    images = torch.rand(1, 3, 32, 32)
    classifier = ZeroShotTouchClassifier(parts["unitouch"], parts["processor"])
    check(partial(classifier, images), CLASSIFIED)
    wordless = ZeroShotTouchClassifier(parts["unitouch"], UniTouchProcessor(image_size=32))
    with pytest.raises(InvalidInputError, match="no tokenizer"):
        wordless(images)


# Steps ----------------------------------------------------------------------------------------------------------------

FLOW = diffusers.FlowMatchEulerDiscreteScheduler()
STEPS: list[Row] = [
    ({"scheduler": "ddim"}, "is 'ddim'"),
    ({"scheduler": FLOW, "solver": "ddim"}, "has no noise levels"),
    ({"num_inference_steps": 1001}, "is 1001"),
    ({"eta": 0.5, "tolerance": 0.1}, "is 0.5, but has no effect with `tolerance`"),
    ({"eta": 0.5, "solver": "euler"}, "is 0.5, but has no effect with 'euler'"),
    ({"max_evaluations": 1, "tolerance": 0.1}, "is 1"),
    ({"solver": "heun", "timesteps": [9]}, "is 'heun', but has no effect with `timesteps`"),
    ({"timesteps": [9], "tolerance": 0.1}, "is .* no effect with `tolerance`"),
    ({"timesteps": [500, 999]}, "is .*; each has to be below the one before"),
    ({"timesteps": [1000, 1]}, "is 1000"),
    ({"timesteps": 5}, "is"),
    ({"timesteps": [999, 9]}, "DDIMScheduler chooses its own"),
    ({"timesteps": [99, 9], "scheduler": diffusers.DDPMScheduler()}, "99, 9], .* starts at timestep 99 of 1000"),
    ({"init_strength": 0.5, "scheduler": FLOW}, "can only start from noise"),
    (
        {"num_inference_steps": 1000, "scheduler": diffusers.DDIMScheduler(steps_offset=1)},
        "1000, with .* timestep 1000 of",
    ),
    (
        {"num_inference_steps": 1, "scheduler": diffusers.EulerDiscreteScheduler(timestep_spacing="leading")},
        "timestep 0 of",
    ),
]


def test_steps_that_cannot_be_made_are_refused():
    def make(scheduler: Any, **arguments: Any) -> None:
        prepare_steps(scheduler, check_fields(SamplingArguments, arguments))

    check(make, STEPS, scheduler=PROBLEMS["gaussian"].scheduler())


def test_noise_levels_that_do_not_rise_in_float32_are_refused():
    settings = ({"beta_start": 1e-8}, {"beta_end": 0.999}, {"num_train_timesteps": 1, "trained_betas": [0.9]})
    for scheduler in (*(diffusers.DDIMScheduler(**one) for one in settings), FLOW):
        check_refusal(partial(NoiseSchedule.of, scheduler), "scheduler", "is .*noise levels")


def test_computations_that_leave_the_range_of_floats_or_do_not_converge():
    """Not a caller's mistake: these have errors of their own."""
    mixture = PROBLEMS["mixture"]

    def breaking(x: torch.Tensor, sigma: float) -> torch.Tensor:
        return mixture.denoise(x, sigma).index_fill(0, torch.tensor(1), NAN if sigma < 5 else 0.0)

    with pytest.raises(NotConvergedError, match="stopped after"):
        solve_flow(breaking, 10 * mixture.noise(2), [10.0, 0.1], 1e-6)
    parts = make_language_parts()
    with pytest.raises(NonFiniteError, match="float32 or bfloat16"):
        parts["language_bridge"].attach(parts["language_model"], torch.full((1, D), NAN))


# The world ------------------------------------------------------------------------------------------------------------

AXIS = (np.arange(400) + 0.5) / 400 - 0.5
BALL = np.sqrt(np.maximum(4.0**2 - (10.0 * AXIS[:, None]) ** 2 - (10.0 * AXIS[None, :]) ** 2, 0.0))  # mm
MAPS: list[Row] = [
    *each("height", np.zeros((50, 50)), np.full((50, 50), 7, np.uint8), said="is flat; pass a relief"),
    *each("height", *(np.where(BALL > 3.9, v, BALL) for v in (NAN, INF)), said="that are NaN or infinite"),
    ({"height": np.ones((1, 1))}, "is 1 x 1 pixels; pass a map of 8 to 8192"),
    ({"height": np.broadcast_to(np.uint8(3), (10_000, 10_000))}, "is 10000 x 10000 pixels; pass a map of 8 to 8192"),
    ({"height": PICTURE}, "is in colours; pass a grey height map"),
    *each("height", np.zeros((9, 9), np.int32), np.zeros((9, 9), bool), said="floats in mm, or uint8 or uint16"),
    ({"height": np.ones(9)}, r"pass heights \(H, W\)"),
    ({"height": []}, "is an empty list; pass at least one"),
    ({"height": None}, "is None; pass a path"),
    ({"height": 3}, "is 3; pass a path"),
    ({"height": "gone.png"}, "which does not exist; pass the path of a height map"),
    ({"height": BALL * 1e6}, "reaches over"),
]
PRESSES: list[Row] = [
    *each("mm", -1.0, 0.0, None, NAN, INF, "30"),
    *each("depth", -1.0, 0.0, [], "deep", [1.0, None]),
    *each("sensor", "digt", None, 3),
    *each("at", 3, [], [(99.0, 0.0)], [("a", 1.0)], [(1.0,)], [(NAN, 0.0)]),
    *each("relief_mm", 0.0, -1.0, None),
    *each("image_size", 1, 10**6, 64.0),
    *each("seed", -1, 0.5),
    ({"at": [(0.0, 0.0), (1.0, 0.0)], "depth": [1.0, 1.0, 1.0]},),
]


def test_height_maps_that_cannot_be_pressed_are_refused():
    check(press, MAPS)
    check(press, PRESSES, height=BALL)


NO_ROWS = [1.7], torch.tensor([1.0]), [True], ["1"], [None], [2**70], 1, [[1]], [-1], [], torch.tensor(1)
SCENES: list[Row] = [
    *(row for label in ("material", "object", "contact") for row in each(label, *NO_ROWS)),
    ({"material": [len(MATERIAL_NAMES)]},),
    ({"object": [1], "material": [1, 2]},),
    *(({label: [1, 2]},) for label in ("object", "contact")),
    *each("modalities", ("smell",), None, (), "imge", [3]),
    *each("sensors", ("braille",), (), "gelsight", None, 3, [[]]),
    ({"sensors": (draw_sensor(0, 2), replace(draw_sensor(0, 2), gain=0.1))},),
]


def test_scenes_that_a_world_cannot_render_are_refused():
    check(World, [*each("seed", -1, 1.5, True, "0"), *each("image_size", 0, 64.0, "64", 10**9)])
    render = World(image_size=32).render
    check(render, SCENES, material=[1], object=[1], contact=[1])


def test_sensors_that_cannot_be_drawn_are_refused():
    for named, call in (
        ("seed", partial(draw_sensor, -1, 0)),
        ("number", partial(draw_sensor, 0, 1.5)),
        ("near", partial(draw_sensor, 0, 0, near=NAN)),
        ("sensor", partial(untouched_gel, "digit", 64)),
        ("resolution", partial(untouched_gel, PLAIN, 0)),
    ):
        check_refusal(call, named, " is")


# Data sets ------------------------------------------------------------------------------------------------------------


def test_arguments_that_open_no_data_set_are_refused(tmp_path, monkeypatch):
    table(tmp_path)
    for name in ("images_tac/image_1_tac.jpg", "label.json"):
        (tmp_path / "two" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "two" / name).write_bytes((tmp_path / "a.png").read_bytes())
    monkeypatch.chdir(tmp_path)
    rows: list[Row] = [
        ({"path": "nowhere"}, "is 'nowhere', which is not there"),
        ({"path": "labels.csv"}, "which is no folder; unpack it"),
        ({"path": "two"}, "looks like object_folder and ssvtp; say its `kind`"),
        ({"kind": "touch_and_goo"}, "is 'touch_and_goo'.*Did you mean 'touch_and_go'"),
        *(({name: 3}, "is 3") for name in ("path", "sensor", "materials")),
    ]
    check(open_dataset, rows, path=tmp_path)


def test_contacts_that_cannot_be_drawn_are_refused(tmp_path):
    def columns(needs: tuple[str, ...], size: int | None = None, **drawn: Any) -> None:
        config = DataConfig(drawn=DrawnConfig(objects=1, contacts_per_object=1, **drawn), touch_size=size)
        columns_of(config.sources(), tmp_path, config, UniTouchProcessor(image_size=32), needs)

    colours = partial(columns, ("image", "touch"), scanned=1.0, colours_alone=True)
    check_refusal(colours, "data.drawn.colours_alone", "is true, but this stage needs touches")
    check_refusal(partial(columns, ("image", "gel")), "data.drawn", "renders no gel, which this stage needs")
    check_refusal(partial(columns, (), 64), "touch_size", "is 64; with drawn sensors")
    both = DataConfig(drawn=DrawnConfig(objects=1, contacts_per_object=1), sets=[{"path": str(tmp_path)}])
    check_refusal(both.sources, "data", "takes one of the two")
