"""Input that cannot be used: an error that names the argument, before any network runs, from all three pipelines."""

from fractions import Fraction

import numpy as np
import pytest
import torch
from diffusers import DDIMScheduler, PNDMScheduler, StableDiffusionPipeline
from diffusers.callbacks import SDCFGCutoffCallback

from tests.helpers.calls import Call, networks_of
from tests.helpers.components import make_components, make_x_to_touch
from unitouch_gen.conditioning import EmbeddingBank
from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.models import UniTouchModel
from unitouch_gen.pipelines import TactileStylizationPipeline, TouchToImagePipeline, XToTouchPipeline

NAN, INF = float("nan"), float("inf")
RATE = 16_000
TONE = np.sin(2 * np.pi * 440 * np.arange(4_000) / RATE)
GENERATOR = torch.Generator()

# Of an argument, values that cannot be used, and then values of a kind that cannot be.
NUMBERS = {
    "guidance_scale": ([NAN, INF, -1e-9, 1e7, 10**400, Fraction(10**400)], ["9", True, [3.0]]),
    "num_inference_steps": ([0, -1, 10**9], [2.5, "10", True]),
    "height": ([17, 0, -8, 10**9], [16.0, "16", True]),
    "width": ([17, 10**400], [16.5]),
    "num_images_per_prompt": ([0, -1, 10**9], [1.5, True]),
    "eta": ([2, -0.1, NAN], ["0", True]),
    "tolerance": ([0, -1.0, NAN, 1e-7, 2.0], ["tight"]),
    "guidance_interval": ([(0.8, 0.2), (0.5, 0.5), (-0.1, 0.5), (0.5, 1.1), (NAN, 1.0)], [0.5, "all", (0.1,)]),
    "output_type": (["bogus", "PIL", None, 3], []),
    "solver": (["dpm++2", "", 3, "DDIMScheduler"], []),
    "throw": ([], ["no", 1]),
    "generator": ([[GENERATOR] * 3, []], [0, [0, 1]]),
    "latents": ([torch.zeros(3, 4, 8, 8), torch.zeros(512), torch.full((2, 4, 8, 8), NAN)], [[0.0], np.ones(3)]),
    "callback_on_step_end": ([], [3]),
    "callback_on_step_end_tensor_inputs": ([["prompt"]], ["latents"]),
    "cross_attention_kwargs": ([{"scale": NAN}], [0.5, ["scale"], {"scale": None}, {"scale": "half"}]),
}
TO_IMAGE = {
    "strength": ([-0.1, NAN, 1e7, 1e39], ["1", False]),
    "noise_level": ([-1, 1000], [1.5, NAN, "0"]),
    "prompt": ([["a", "b", "c"], [], "rough \ud800"], [3, ["a", 3]]),
    "negative_prompt": ([["a", "b", "c"], "rough \ud800"], [3]),
    "prompt_embeds": (
        [torch.zeros(3, 12, 16), torch.zeros(2, 12, 8), torch.zeros(12, 16), torch.full((1, 12, 16), NAN),
         torch.zeros(1, 7, 16), torch.ones(1, 0, 16)],
        [[0.0], torch.ones(1, 12, 16).bool(), torch.ones(1, 12, 16).to_sparse(), torch.ones(1, 12, 16, device="meta")],
    ),
    "negative_prompt_embeds": ([torch.zeros(3, 12, 16)], []),
    "touch": (["gone.png", [], torch.zeros(2, 4, 32, 32), torch.full((3, 32, 32), 2.0)], [3, [None], {"a": 1}]),
    "sensor": (["gelsigt", "", ["gelsight", "taxim"], ["gelsight"] * 3, [], [3, None]], []),
    "background": ([torch.zeros(3, 3, 32, 32), "gone.png"], [3]),
    "bridge": ([True], ["london", 1]),
}  # fmt: skip
STYLIZE = {
    "image": ([None, "gone.png", torch.zeros(3, 3, 32, 32)], []),
    "touch": ([None], []),
    "touch_weight": ([1.2, -0.1, NAN, [0.1] * 3], ["much"]),
    "image_weight": ([NAN, INF, -1], ["much"]),
    "mix": (["slurp", 3], []),
    "init_strength": ([1.5, -0.1, NAN], ["much"]),
}
TO_TOUCH = {
    "text": (["  \n", ["brick", ""], []], [3]),
    "audio": ([(np.zeros(4_000), RATE), (np.full(4_000, 0.3), RATE), [(TONE, RATE), (np.zeros(4_000), RATE)],
               (np.ones(1), RATE), TONE, (np.where(TONE > 0.9, NAN, TONE), RATE), "gone.wav"], []),
    "sampling_rate": ([RATE], []),
    "source_sensor": (["digit"], []),
    "sensor": (["gelsite", ["digit"] * 3, ["all", "digit"], []], []),
    "background": ([torch.zeros(3, 16, 16)], []),
    "weights": ([{"image": 0}, {"image": -1}, {"image": NAN}, {"text": 1}, {"smell": 1}, {3: 1}, {}], [[1.0]]),
    "bridge": ([], ["london", 1]),
    "num_candidates": ([0], [1.5]),
    "condition_embeds": ([torch.ones(1, 1, 16)], []),
}  # fmt: skip
EMBEDS = {
    "touch_embeds": (
        [torch.ones(2, 8), torch.ones(16), torch.ones(0, 16), torch.full((2, 16), NAN), torch.full((1, 16), INF)],
        [torch.ones(2, 16).long(), np.ones((2, 16)), [1.0] * 16, torch.ones(2, 16).cfloat()],
    ),
    "condition_embeds": (
        [torch.zeros(1, 16), torch.zeros(0, 1, 16), torch.zeros(1, 1, 32), torch.full((1, 1, 16), INF)],
        [[[[0.0]]], torch.zeros(1, 1, 16).long()],
    ),
}
# Arguments that do not fit each other; the first of them is named.
PAIRS = {
    "call": [
        {"callback_on_step_end": SDCFGCutoffCallback(cutoff_step_ratio=0.5), "tolerance": 0.1},
        {"latents": torch.zeros(2, 4, 8, 8), "height": 32},
        {"generator": [GENERATOR] * 2, "num_images_per_prompt": 2},
    ],
    "pipe": [
        {"touch": torch.zeros(3, 32, 32), "touch_embeds": torch.ones(2, 16)},
        {"touch": None},
        {"prompt": "a", "prompt_embeds": torch.zeros(1, 12, 16)},
        {"negative_prompt": "a", "negative_prompt_embeds": torch.zeros(1, 12, 16)},
        *({name: value, "touch": None, "touch_embeds": torch.ones(1, 16)} for name, value in
          {"sensor": "digit", "strength": 0.5, "background": torch.zeros(3, 32, 32), "bridge": True}.items()),
    ],
    "stylize": [
        {"touch_weight": 0, "image_weight": 0},
        {"init_strength": 0.5, "image_weight": [0.3, 0.4], "touch_weight": [0.1, 0.2]},
    ],
    "x_to_touch": [
        {"image": None},
        {"image": torch.zeros(2, 3, 32, 32), "text": ["a", "b", "c"]},
        {"image": torch.zeros(2, 3, 32, 32), "audio": [(TONE, RATE)] * 3},
        {"weights": {"text": 1}, "text": "a"},
        {"text": "a", "image": None, "condition_embeds": torch.ones(1, 1, 16)},
        {"weights": {"text": 1}, "image": None, "condition_embeds": torch.ones(1, 1, 16)},
    ],
}  # fmt: skip


def rows():
    """(fixtures, argument, options, error)."""
    tables = {
        "pipe stylize x_to_touch": NUMBERS, "pipe stylize": TO_IMAGE, "stylize": STYLIZE, "x_to_touch": TO_TOUCH,
    }  # fmt: skip
    for kinds, table in tables.items():
        for name, values in table.items():
            for error, bad in zip((InvalidInputError, InvalidTypeError), values, strict=True):
                yield from ((kind, name, {name: value}, error) for kind in kinds.split() for value in bad)
    for name, values in EMBEDS.items():
        kind, instead = ("pipe", "touch") if name == "touch_embeds" else ("x_to_touch", "image")
        for error, bad in zip((InvalidInputError, InvalidTypeError), values, strict=True):
            yield from ((kind, name, {name: value, instead: None}, error) for value in bad)
    for kinds, pairs in PAIRS.items():
        for kind in ["pipe", "stylize", "x_to_touch"] if kinds == "call" else [kinds]:
            yield from ((kind, next(iter(pair)), pair, InvalidInputError) for pair in pairs)


@pytest.fixture(scope="module")
def guarded():
    """A call of each pipeline, whose networks fail the test if they run."""
    shared, own = make_components(), make_x_to_touch()
    joint = {name: shared[name] for name in ("unitouch", "processor", "scheduler")}
    touch, photo = torch.rand(2, 3, 32, 32), torch.rand(2, 3, 32, 32)
    calls = {
        "pipe": Call(TouchToImagePipeline(**shared), {"touch": touch}),
        "stylize": Call(TactileStylizationPipeline(**shared), {"touch": touch, "image": photo}),
        "x_to_touch": Call(XToTouchPipeline(**joint, **own, sensors=["gelsight", "digit"]), {"image": photo}),
    }

    def fail(module, *args):
        raise AssertionError(f"{type(module).__name__} ran on input that cannot be used")

    for call in calls.values():
        for network in networks_of(call.pipe).values():
            network.register_forward_pre_hook(fail)
    return calls


@pytest.mark.parametrize(
    ("kind", "name", "options", "error"),
    [pytest.param(*row, id=f"{row[0]}-{row[1]}-{number}") for number, row in enumerate(rows())],
)
def test_what_cannot_be_used_is_refused_by_name_before_any_network_runs(guarded, kind, name, options, error):
    with pytest.raises((InvalidInputError, InvalidTypeError), match=name) as caught:
        guarded[kind](**options)
    assert type(caught.value) is error and isinstance(caught.value, ValueError | TypeError)
    assert "\n" not in str(caught.value)


def test_the_guard_catches_a_network_that_runs(guarded):
    for call in guarded.values():
        with pytest.raises(AssertionError, match="ran on input"):
            call()


def test_an_argument_that_is_not_there_is_refused_by_python(call):
    with pytest.raises(TypeError, match="guidance_rescale"):
        call(guidance_rescale=0.7)


def test_the_message_says_what_came_what_there_is_and_what_may_be_meant(guarded):
    for kind, options, words in (
        ("pipe", {"solver": "dpm++2"}, ("'dpm++2'", "'ddim', 'euler'", "mean 'dpm++2m'")),
        ("pipe", {"sensor": "gelsigt"}, ("'gelsigt'", "'gelsight', 'digit'", "mean 'gelsight'")),
        ("pipe", {"height": 17}, ("17", "multiple of 2", "16", "18")),
        ("pipe", {"touch": [torch.zeros(3, 32, 32), "gone.png"]}, ("`touch[1]`", "gone.png", "does not exist")),
        ("stylize", {"image": torch.zeros(3, 3, 32, 32)}, ("3 photos", "2 touches")),
    ):
        with pytest.raises(InvalidInputError) as caught:
            guarded[kind](**options)
        assert [word for word in words if word not in str(caught.value)] == []


@pytest.mark.parametrize("scheduler", [DDIMScheduler, PNDMScheduler])
def test_steps_that_a_scheduler_would_make_wrongly(call, scheduler):
    """With an offset, 1000 steps start beyond the last noise level; one step of leading spacing is at the lowest."""
    for count, offset in ((1000, 1), (1, 0)):
        call.pipe.scheduler = scheduler.from_config(call.pipe.scheduler.config, steps_offset=offset)
        with pytest.raises(InvalidInputError, match=f"`num_inference_steps` is {count}.*{scheduler.__name__}"):
            call(num_inference_steps=count)


@pytest.mark.parametrize("method", ["encode_touch", "encode_mix", "encode_condition"])
def test_encoding_refuses_what_a_call_refuses(guarded, method):
    kind = {"encode_touch": "pipe", "encode_mix": "stylize", "encode_condition": "x_to_touch"}[method]
    inputs = guarded[kind].inputs
    for name, value in {"bridge": "london", **dict.fromkeys(inputs, "gone.png")}.items():
        with pytest.raises((InvalidInputError, InvalidTypeError), match=f"`{name}`"):
            getattr(guarded[kind].pipe, method)(**{**inputs, name: value})


@pytest.mark.parametrize("scale", ["half", NAN, 1e30, torch.zeros(2)])
def test_scales_that_a_prompt_may_not_be_encoded_at(guarded, scale):
    with pytest.raises((InvalidInputError, InvalidTypeError), match="`lora_scale`"):
        guarded["pipe"].pipe.encode_prompt(["brick"], lora_scale=scale)


# Pipelines that lack a part, or have a wrong one ----------------------------------------------------------------------


def test_what_needs_a_part_that_is_missing(components, x_components, touch):
    without = {**components, **dict.fromkeys(("unitouch", "processor", "text_encoder", "tokenizer"))}
    bare = TouchToImagePipeline(**without)
    alone = XToTouchPipeline(
        **{**x_components, "unitouch": None, "processor": None, "embedding_bank": None}, sensors=["gelsight", "digit"]
    )
    embeds, token, states = torch.ones(2, 16), torch.ones(1, 1, 16), torch.zeros(1, 12, 16)
    for pipe, options, name in (
        (bare, {"touch": touch}, "touch"),
        (bare, {"touch_embeds": embeds, "prompt": "brick"}, "prompt"),
        (bare, {"touch_embeds": embeds, "prompt_embeds": states}, "negative_prompt"),
        (alone, {"text": "brick"}, "text"),
        (alone, {"condition_embeds": token, "num_candidates": 2}, "num_candidates"),
    ):
        with pytest.raises(InvalidInputError, match=f"`{name}`"):
            pipe(**options)


def test_sensors_that_a_joint_space_does_not_know(components, touch):
    joint = components["unitouch"]
    joint.sensor_bank.known.fill_(False)
    with pytest.raises(InvalidInputError, match="`sensor`"):
        TouchToImagePipeline(**components)(touch)
    components["unitouch"] = UniTouchModel(type(joint.config).from_dict(joint.config.to_dict() | {"sensors": []}))
    for options in ({"sensor": "digit"}, {"background": touch}):
        with pytest.raises(InvalidInputError, match=f"`{next(iter(options))}`"):
            TouchToImagePipeline(**components)(touch, **options)


@pytest.mark.parametrize("part", ["unet", "vae", "scheduler", "unitouch", "tokenizer", "image_normalizer"])
@pytest.mark.parametrize("value", [3, "unet", [], torch.nn.Linear(1, 1), None])
def test_what_is_no_part_of_a_pipeline_is_refused_by_name(components, part, value):
    if value is None and part in TouchToImagePipeline._optional_components:
        pytest.skip("it may be left out")
    with pytest.raises((InvalidInputError, InvalidTypeError), match=f"`{part}`"):
        TouchToImagePipeline(**{**components, part: value})


def test_parts_and_settings_that_do_not_fit_are_refused_by_name(pipe, components, x_components):
    wide = components["unitouch"].config.to_dict() | {"projection_dim": 8}
    for name in ("vision", "text", "touch", "audio"):
        wide[f"{name}_config"]["projection_dim"] = 8
    other = UniTouchModel(type(components["unitouch"].config).from_dict(wide))
    shared = {name: components[name] for name in ("vae", "text_encoder", "tokenizer", "unet", "scheduler")}
    plain = StableDiffusionPipeline(
        **shared, safety_checker=None, feature_extractor=None, requires_safety_checker=False
    )
    for make, name in (
        (lambda: TouchToImagePipeline(**{**components, "embedding_bank": EmbeddingBank(3, 7)}), "embedding_bank"),
        (lambda: TouchToImagePipeline(**{**components, "unitouch": other}), "unitouch"),
        (lambda: TouchToImagePipeline(**components, default_guidance_scale="9"), "default_guidance_scale"),
        (lambda: TouchToImagePipeline(**components, default_strength=NAN), "default_strength"),
        (lambda: XToTouchPipeline(**x_components, sensors=["gelsight"]), "sensors"),
        (lambda: TouchToImagePipeline.from_pipe(pipe, unitouche=None), "from_pipe"),
        (lambda: TouchToImagePipeline.from_pipe(plain), "pipeline"),
        (lambda: TouchToImagePipeline.from_pipe(3), "pipeline"),
    ):
        with pytest.raises((InvalidInputError, InvalidTypeError), match=f"`{name}`"):
            make()
