"""Input that cannot be used: an error that names the argument, before any network runs, from all three pipelines."""

import itertools
from collections import defaultdict
from fractions import Fraction

import numpy as np
import pytest
import torch
from diffusers import StableDiffusionPipeline
from diffusers.callbacks import SDCFGCutoffCallback

from tests.helpers.calls import Call, networks_of
from tests.helpers.components import make_pipelines
from unitouch_gen.conditioning import EmbeddingBank
from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.models import UniTouchModel
from unitouch_gen.pipelines import TouchToImagePipeline, XToTouchPipeline

NAN = float("nan")
INF = float("inf")
RATE = 16_000
TONE = np.sin(2 * np.pi * 440 * np.arange(4_000) / RATE)
GENERATOR = torch.Generator()

# Of an argument, values that cannot be used, and then values of a kind that cannot be.
NUMBERS = {
    "guidance_scale": ([NAN, INF, -1e-9, 1e7], ["9", True, [3.0], 10**400, Fraction(10**400)]),
    "num_inference_steps": ([0, 10**9], [2.5, "10", True, np.zeros((3, 3)), torch.tensor([])]),
    "height": ([17, 0, 10**9], [16.0, "16"]),
    "width": ([17, 10**400], [16.5]),
    "num_images_per_prompt": ([0, 10**9], [1.5, True]),
    "eta": ([2, -0.1, NAN], ["0"]),
    "tolerance": ([0, NAN, 2.0], ["tight"]),
    "throw": ([], ["no", 1]),
    "output_type": (["PIL", None, 3], []),
    "solver": (["dpm++2", ""], [3, np.zeros((3, 3))]),
    "generator": ([[GENERATOR] * 3, []], [0, [0, 1]]),
    "latents": ([torch.zeros(3, 4, 8, 8), torch.zeros(512), torch.full((2, 4, 8, 8), NAN)], [[0.0], np.ones(3)]),
    "callback_on_step_end": ([], [3]),
    "callback_on_step_end_tensor_inputs": ([["prompt"]], ["latents"]),
    "cross_attention_kwargs": ([{"scale": NAN}], [0, ["scale"], {"scale": "half"}]),
}
TO_IMAGE = {
    "strength": ([-0.1, NAN, 1e7], ["1", False]),
    "noise_level": ([-1, 1000], [1.5, NAN, "0"]),
    "prompt": ([["a", "b", "c"], [], "rough \ud800"], [3, ["a", 3]]),
    "negative_prompt": ([["a", "b", "c"]], [3]),
    "prompt_embeds": (
        [
            torch.zeros(3, 12, 16),
            torch.zeros(2, 12, 8),
            torch.zeros(12, 16),
            torch.full((1, 12, 16), NAN),
            torch.zeros(1, 7, 16),
        ],
        [[0.0], torch.ones(1, 12, 16).bool(), torch.ones(1, 12, 16).to_sparse()],
    ),
    "negative_prompt_embeds": ([torch.zeros(3, 12, 16)], []),
    "touch": (["gone.png", [], torch.zeros(2, 4, 32, 32), torch.full((3, 32, 32), 2.0)], [3, [None]]),
    "sensor": (["gelsigt", "", ["gelsight"] * 3, [], [3, None]], [3]),
    "background": ([torch.zeros(3, 3, 32, 32), "gone.png"], [3]),
    "bridge": ([True], ["london", 1]),
}
STYLIZE = {
    "image": ([None, "gone.png", torch.zeros(3, 3, 32, 32)], []),
    "touch": ([None], []),
    "mix": (["slurp", 3], []),
    "touch_weight": ([1.2, -0.1, NAN], ["much", [0.1] * 3]),
    "image_weight": ([NAN, INF, -1], ["much", [0.3, 0.4]]),
    "init_strength": ([1.5, -0.1, NAN], ["much", np.ones((2, 2))]),
}
TO_TOUCH = {
    "text": (["  \n", ["brick", ""], []], [3]),
    "audio": (
        [(np.zeros(4_000), RATE), (np.ones(1), RATE), TONE, (np.where(TONE > 0.9, NAN, TONE), RATE), "gone.wav"],
        [(torch.eye(100).to_sparse(), RATE)],
    ),
    "source_sensor": (["digit"], []),
    "sensor": (["gelsite", ["digit"] * 3, ["all", "digit"], []], []),
    "background": ([torch.zeros(3, 16, 16)], []),
    "weights": ([{"image": 0}, {"image": -1}, {"image": NAN}, {"text": 1}, {3: 1}, {}], [[1.0]]),
    "bridge": ([], ["london", 1]),
    "condition_embeds": ([torch.ones(1, 1, 16)], []),
}
TABLES = {"pipe stylize x_to_touch": NUMBERS, "pipe stylize": TO_IMAGE, "stylize": STYLIZE, "x_to_touch": TO_TOUCH}
# Arguments that do not fit each other; the first of them is named.
PAIRS = {
    "pipe stylize x_to_touch": [
        {"tolerance": 0.1, "num_inference_steps": 5},
        {"tolerance": 0.1, "solver": "heun"},
        {"max_evaluations": 5},
        {"callback_on_step_end": SDCFGCutoffCallback(cutoff_step_ratio=0.5), "tolerance": 0.1},
        {"latents": torch.zeros(2, 4, 8, 8), "height": 32},
        {"generator": [GENERATOR] * 2, "num_images_per_prompt": 2},
    ],
    "pipe": [
        *({"touch_embeds": bad, "touch": None} for bad in (torch.ones(2, 8), torch.ones(16), torch.full((2, 16), NAN))),
        {"touch": torch.zeros(3, 32, 32), "touch_embeds": torch.ones(2, 16)},
        {"touch": None},
        {"prompt": "a", "prompt_embeds": torch.zeros(1, 12, 16)},
        *(
            {name: value, "touch": None, "touch_embeds": torch.ones(1, 16)}
            for name, value in {
                "sensor": "digit",
                "strength": 0.5,
                "background": torch.zeros(3, 32, 32),
                "bridge": True,
            }.items()
        ),
    ],
    "stylize": [{"touch_weight": 0, "image_weight": 0}],
    "x_to_touch": [
        {"image": None},
        {"image": torch.zeros(2, 3, 32, 32), "text": ["a", "b", "c"]},
        {"weights": {"text": 1}, "text": "a"},
        {"text": "a", "image": None, "condition_embeds": torch.ones(1, 1, 16)},
        *({"condition_embeds": bad, "image": None} for bad in (torch.zeros(1, 16), torch.zeros(1, 1, 32))),
    ],
}


def calls_by_argument():
    """(argument, [(fixture, options, error)])."""
    found = defaultdict(list)
    for kinds, table in TABLES.items():
        for (name, values), kind in itertools.product(table.items(), kinds.split()):
            for error, bad in zip((InvalidInputError, InvalidTypeError), values, strict=True):
                found[name] += [(kind, {name: value}, error) for value in bad]
    for kinds, pairs in PAIRS.items():
        for pair, kind in itertools.product(pairs, kinds.split()):
            found[next(iter(pair))].append((kind, pair, InvalidInputError))
    return found


@pytest.fixture(scope="module")
def guarded():
    """A call of each pipeline, whose networks fail the test if they run."""
    pipes = make_pipelines()
    pictures = torch.rand(2, 3, 32, 32)
    calls = {
        "pipe": Call(pipes["touch-to-image"], {"touch": pictures}),
        "stylize": Call(pipes["stylize"], {"touch": pictures, "image": pictures}),
        "x_to_touch": Call(pipes["x-to-touch"], {"image": pictures}),
    }

    def fail(module, *args):
        raise AssertionError(f"{type(module).__name__} ran on input that cannot be used")

    for network in [network for call in calls.values() for network in networks_of(call.pipe).values()]:
        network.register_forward_pre_hook(fail)
    return calls


@pytest.mark.parametrize(("name", "calls"), [pytest.param(*item, id=item[0]) for item in calls_by_argument().items()])
def test_what_cannot_be_used_is_refused_by_name_before_any_network_runs(guarded, name, calls):
    for kind, options, error in calls:
        with pytest.raises((InvalidInputError, InvalidTypeError), match=name) as caught:
            guarded[kind](**options)
        assert type(caught.value) is error and "\n" not in str(caught.value), (kind, options)
    with pytest.raises(AssertionError, match="ran on input"):  # the guard is awake
        guarded[calls[0][0]]()


def test_what_needs_a_part_that_is_missing(components, x_components, touch):
    bare = TouchToImagePipeline(**components | dict.fromkeys(("unitouch", "processor", "text_encoder", "tokenizer")))
    alone = XToTouchPipeline(**x_components | {"unitouch": None, "processor": None}, sensors=["gelsight", "digit"])
    joint = components["unitouch"]
    config = type(joint.config).from_dict(joint.config.to_dict() | {"sensors": []})
    sensorless = TouchToImagePipeline(**components | {"unitouch": UniTouchModel(config)})
    joint.sensor_bank.known.fill_(False)  # its prototypes
    embeds = torch.ones(2, 16)
    states = torch.zeros(1, 12, 16)
    for pipe, name, options in (
        (bare, "touch", {"touch": touch}),
        (bare, "prompt", {"touch_embeds": embeds, "prompt": "brick"}),
        (bare, "negative_prompt", {"touch_embeds": embeds, "prompt_embeds": states}),
        (alone, "text", {"text": "brick"}),
        (TouchToImagePipeline(**components), "sensor", {"touch": touch}),
        (sensorless, "sensor", {"touch": touch, "sensor": "digit"}),
        (sensorless, "background", {"touch": touch, "background": touch}),
    ):
        with pytest.raises(InvalidInputError, match=f"`{name}`"):
            pipe(**options)


def test_parts_and_settings_that_do_not_fit_are_refused_by_name(pipe, components, x_components):
    unclip = x_components["unet"]
    unclip = unclip.from_config(unclip.config, num_class_embeds=None, class_embed_type="identity")
    stable = {name: components[name] for name in ("vae", "text_encoder", "tokenizer", "unet", "scheduler")}
    stable["scheduler"] = stable["scheduler"].from_config(stable["scheduler"].config, steps_offset=1)  # as theirs is
    optional = {"safety_checker": None, "feature_extractor": None, "requires_safety_checker": False}
    for name, make in {
        "embedding_bank": lambda: TouchToImagePipeline(**{**components, "embedding_bank": EmbeddingBank(3, 7)}),
        "unet": lambda: XToTouchPipeline(**{**x_components, "unet": unclip}),
        "sensors": lambda: XToTouchPipeline(**x_components, sensors=["gelsight"]),
    }.items():
        with pytest.raises((InvalidInputError, InvalidTypeError), match=f"`{name}`"):
            make()
    for name, make in {
        "unitouche": lambda: TouchToImagePipeline.from_pipe(pipe, unitouche=None),
        "image_normalizer": lambda: TouchToImagePipeline.from_pipe(StableDiffusionPipeline(**stable, **optional)),
    }.items():
        with pytest.raises(TypeError, match=f"'{name}'"):
            make()
