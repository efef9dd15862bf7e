"""Calls, parts and folders of pipelines that cannot be used: each is refused by name, before any network runs."""

import itertools
import shutil
from collections import defaultdict
from collections.abc import Callable
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from diffusers import StableDiffusionPipeline
from diffusers.callbacks import SDCFGCutoffCallback
from safetensors.torch import load_file, save_file

import unitouch_gen
from tests.helpers.calls import Call, networks_of, shown_gels
from tests.helpers.components import make_components, make_language_parts, make_pipelines
from tests.helpers.published import converted, write_unclip
from tests.helpers.refusals import check_refusal
from tests.helpers.small_family import write_small_family
from unitouch_gen import weights
from unitouch_gen.cli.loading import load_pipeline
from unitouch_gen.conditioning import EmbeddingBank
from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.models.language import LanguageBridge
from unitouch_gen.pipelines import TouchToImagePipeline, TouchToTextPipeline, XToTouchPipeline
from unitouch_gen.pipelines.tiny import TURBO

NAN = float("nan")
INF = float("inf")
RATE = 16_000
TONE = np.sin(2 * np.pi * 440 * np.arange(4_000) / RATE)
GENERATOR = torch.Generator()

# Calls ----------------------------------------------------------------------------------------------------------------

# By argument: values that raise `InvalidInputError`, then values that raise `InvalidTypeError`.
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
    "sensor": (["gelsite", ["digit"] * 3, ["all", "digit"], []], []),
    "background": ([torch.zeros(3, 16, 16)], []),
    "weights": ([{"image": 0}, {"image": -1}, {"image": NAN}, {"text": 1}, {3: 1}, {}], [[1.0]]),
    "bridge": ([], ["london", 1]),
    "condition_embeds": ([torch.ones(1, 1, 16)], []),
}
ASK = {
    "question": ([" \n", ["How?"] * 3], [None]),
    "max_new_tokens": ([64], [2.5]),
    "num_beams": ([0], []),
    "generator": ([], [3]),
}
TABLES = {
    "pipe stylize x_to_touch": NUMBERS,
    "pipe stylize": TO_IMAGE,
    "stylize": STYLIZE,
    "x_to_touch": TO_TOUCH,
    "ask": ASK,
}
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
        {"source_sensor": "digit", "text": "brick", "image": None},
        {"image": torch.zeros(2, 3, 32, 32), "text": ["a", "b", "c"]},
        {"weights": {"text": 1}, "text": "a"},
        {"text": "a", "image": None, "condition_embeds": torch.ones(1, 1, 16)},
        *({"condition_embeds": bad, "image": None} for bad in (torch.zeros(1, 16), torch.zeros(1, 1, 32))),
    ],
    "ask": [
        {"question": "a" * 64, "max_new_tokens": 1},
        {"temperatur": 0.5, "do_sample": True},
        {"touch": None},
        {"touch": torch.zeros(2, 3, 32, 32), "image": torch.zeros(2, 3, 32, 32)},
        {"sensor": "digit", "touch": None, "image": torch.zeros(2, 3, 32, 32)},
        {"touch_embeds": torch.ones(1, 8), "touch": None},
    ],
}


def calls_by_argument() -> dict[str, list[tuple[str, dict[str, Any], type[Exception]]]]:
    """(fixture, options, error) by argument."""
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
def calls() -> dict[str, Call]:
    """A call of each pipeline."""
    pipes = make_pipelines()
    parts = make_components()
    joint = {name: parts[name] for name in ("unitouch", "processor")}
    ask = TouchToTextPipeline(**make_language_parts(), **joint)
    pictures = torch.rand(2, 3, 32, 32)
    return {
        "pipe": Call(pipes["touch-to-image"], {"touch": pictures}),
        "stylize": Call(pipes["stylize"], {"touch": pictures, "image": pictures}),
        "x_to_touch": Call(pipes["x-to-touch"], {"image": pictures}),
        "ask": partial(ask, touch=pictures, question="How?"),
    }


@pytest.fixture
def guarded(calls):
    """The same, whose networks fail the test if they run."""

    def fail(module, *args):
        raise AssertionError(f"{type(module).__name__} ran on input that cannot be used")

    ask = calls["ask"].func
    networks = [ask.language_bridge, ask.language_model, ask.unitouch.touch_model, ask.unitouch.vision_model]
    for kind in ("pipe", "stylize", "x_to_touch"):
        networks += networks_of(calls[kind].pipe).values()
    hooks = [network.register_forward_pre_hook(fail) for network in networks]
    yield calls
    for hook in hooks:
        hook.remove()


@pytest.mark.parametrize(("name", "rows"), [pytest.param(*item, id=item[0]) for item in calls_by_argument().items()])
def test_a_call_that_cannot_be_made_is_refused_before_any_network_runs(guarded, name, rows):
    for kind, options, error in rows:
        alone = options[name] if len(options) == 1 else None
        check_refusal(partial(guarded[kind], **options), name, kind=error, given=alone)
    with pytest.raises(AssertionError, match="ran on input"):  # the guard is awake
        guarded[rows[0][0]]()


@pytest.mark.parametrize(
    "options",
    [
        {"early_stopping": "soon"},
        {"top_k": -1, "do_sample": True},
        {"streamer": 3},
        {"logits_processor": [3]},
    ],
)
def test_options_that_transformers_refuses_are_told_in_its_words(calls, options):
    check_refusal(partial(calls["ask"], **options), "generate", r"cannot use its options \(.{10}")


RETURNED = [  # by `callback_on_step_end`, and the argument that is named
    *(({"latents": value}, "latents") for value in ([1], torch.zeros(3, 4, 8, 8), torch.zeros(2, 4, 8, 8).long())),
    *(
        ({"prompt_embeds": value}, "prompt_embeds")
        for value in (torch.tensor(1.0), torch.zeros(4, 12, 3), torch.zeros(3, 12, 16))
    ),
    *((value, "what it returned") for value in ([1], 3)),
]


def test_what_a_callback_may_not_return_is_refused(calls):
    for value, name in RETURNED:
        check_refusal(partial(calls["pipe"], callback_on_step_end=lambda *_, value=value: value), name)


@pytest.mark.parametrize("kind", ["pipe", "stylize", "x_to_touch"])
def test_a_guidance_scale_that_a_callback_may_not_set_is_refused(calls, kind):
    def setting(scale: Any) -> Callable:
        return lambda pipe, *_: setattr(pipe, "_guidance_scale", scale)

    for scale in ("much", None, NAN, 10**400):
        check_refusal(partial(calls[kind], callback_on_step_end=setting(scale)), "_guidance_scale")
    started_without = partial(calls[kind], guidance_scale=1.0, callback_on_step_end=setting(4.0))
    check_refusal(started_without, "guidance_scale", "start with a `guidance_scale` above 1")


# Parts ----------------------------------------------------------------------------------------------------------------


def test_a_call_that_needs_a_missing_part_is_refused(components, x_components, touch):
    bare = TouchToImagePipeline(**components | dict.fromkeys(("unitouch", "processor", "text_encoder", "tokenizer")))
    alone = XToTouchPipeline(**x_components | {"unitouch": None, "processor": None}, sensors=["gelsight", "digit"])
    mute = TouchToTextPipeline(**make_language_parts())
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
        (mute, "touch", {"touch": touch, "question": "How?"}),
        (TouchToImagePipeline(**components), "sensor", {"touch": touch}),
        (sensorless, "sensor", {"touch": touch, "sensor": "digit"}),
        (sensorless, "background", {"touch": touch, "background": touch}),
    ):
        check_refusal(partial(pipe, **options), name)
    check_refusal(bare.to_diffusers, "unitouch")


def test_sensors_and_backgrounds_that_do_not_fit_are_refused(x_to_touch):
    gel = torch.zeros(3, 16, 16)
    several = {"background": gel.expand(3, -1, -1, -1), "text": ["a", "b"]}
    for sensors, options in (
        (("gelsight",), {"sensor": "gelsight", "background": gel}),
        (("gelsight",), several),
        ((), {}),
    ):
        call = partial(shown_gels(x_to_touch, sensors), **{"text": "brick", **options})
        check_refusal(call, "background")
    check_refusal(partial(shown_gels, x_to_touch, backgrounds=None), "backgrounds")


def test_parts_and_settings_that_do_not_fit_are_refused(pipe, components, x_components):
    unclip = x_components["unet"]
    unclip = unclip.from_config(unclip.config, num_class_embeds=None, class_embed_type="identity")
    parts = make_language_parts()
    narrow = LanguageBridge.for_model(parts["language_model"], 8)
    joint = {name: components[name] for name in ("unitouch", "processor")}
    for name, make, *said in (
        ("embedding_bank", partial(TouchToImagePipeline, **{**components, "embedding_bank": EmbeddingBank(3, 7)})),
        ("unet", partial(XToTouchPipeline, **{**x_components, "unet": unclip})),
        ("sensors", partial(XToTouchPipeline, **x_components, sensors=["gelsight"])),
        (
            "unitouch",
            partial(TouchToTextPipeline, **parts | joint | {"language_bridge": narrow}),
            "width 16.* has to be 8",
        ),
        ("prompt_template", partial(TouchToTextPipeline, **parts, prompt_template="Answer"), "is 'Answer'"),
        ("card", partial(pipe.save_pretrained, "two", card="bricks")),
    ):
        check_refusal(make, name, *said)
    stable = {name: components[name] for name in ("vae", "text_encoder", "tokenizer", "unet", "scheduler")}
    stable["scheduler"] = stable["scheduler"].from_config(stable["scheduler"].config, steps_offset=1)  # as theirs is
    optional = {"safety_checker": None, "feature_extractor": None, "requires_safety_checker": False}
    for name, make in {  # by diffusers itself
        "unitouche": partial(TouchToImagePipeline.from_pipe, pipe, unitouche=None),
        "image_normalizer": partial(TouchToImagePipeline.from_pipe, StableDiffusionPipeline(**stable, **optional)),
    }.items():
        with pytest.raises(TypeError, match=f"'{name}'"):
            make()


# Folders --------------------------------------------------------------------------------------------------------------

PLACE = "pretrained_model_name_or_path"


def test_misspelt_arguments_are_refused_with_the_one_that_was_meant(family, pipe):
    """diffusers and transformers would ignore them."""
    read = partial(TouchToImagePipeline.from_pretrained, family)
    for call, name, meant in (
        (read, "dtpye", "dtype"),
        (read, "default_guidanc_scale", "default_guidance_scale"),
        (partial(UniTouchModel.from_pretrained, family / "unitouch"), "modality", "modalities"),
        (partial(UniTouchProcessor.from_pretrained, family / "processor"), "imagesize", "image_size"),
        (partial(pipe.load_lora_weights, family), "weight_nmae", "weight_name"),
        (partial(load_pipeline, "touch-to-image", model=None), "dtpye", "dtype"),
        (partial(pipe.save_pretrained, family), "varient", "variant"),  # which would replace the whole weights
        (partial(pipe.unitouch.save_pretrained, family / "unitouch"), "max_shard_sice", "max_shard_size"),
    ):
        meaning = f"^`{name}` is no argument of .* Did you mean '{meant}'"
        check_refusal(partial(call, **{name: None}), name, meaning, kind=InvalidTypeError)
    for name in ("dtype", "torch_dtype"):
        for wrong in ("bfloat61", torch.int8):
            check_refusal(partial(read, **{name: wrong}), name)


@pytest.mark.parametrize("part", ["unet", "vae"])
def test_weights_that_are_cut_or_do_not_fill_a_network_and_pickles_are_refused(family, tmp_path, part):
    """diffusers would draw the rest at random, and say so in a line on standard error."""
    folder = Path(shutil.copytree(family, tmp_path / "there"))
    read = partial(TouchToImagePipeline.from_pretrained, folder)
    file = folder / part / "diffusion_pytorch_model.safetensors"
    state = load_file(file)
    whole = file.read_bytes()
    torch.save(state, file.with_suffix(".bin"))
    save_file(dict(list(state.items())[1:]), file, metadata={"format": "pt"})
    check_refusal(read, PLACE, rf"{folder}/{part}. holds \d+ of the \d+ numbers")
    for left in (whole[:-500], b"", None):
        file.unlink() if left is None else file.write_bytes(left)
        check_refusal(read, PLACE)
        check_refusal(partial(read, use_safetensors=False), "use_safetensors", "is False")


def test_a_language_model_that_is_not_filled_is_refused(tmp_path):
    TouchToTextPipeline(**make_language_parts()).save_pretrained(tmp_path)
    file = tmp_path / "language_model" / "model.safetensors"
    state = load_file(file)
    del state["model.layers.0.mlp.up_proj.weight"]
    save_file(state, file, metadata={"format": "pt"})
    read = partial(TouchToTextPipeline.from_pretrained, tmp_path)
    check_refusal(read, PLACE, r"language_model` holds \d+ of the \d+ numbers")


def test_lora_weights_that_do_not_fit_or_are_a_pickle_are_refused(calls, tmp_path):
    peft = pytest.importorskip("peft", reason="LoRA needs peft")
    pipe = make_pipelines()["touch-to-image"]
    layers = {}
    for name, targets in (("unet", ["to_q", "to_v"]), ("text_encoder", ["q_proj"])):
        network = getattr(pipe, name)
        network.add_adapter(peft.LoraConfig(target_modules=targets, init_lora_weights=False), "made")
        layers[f"{name}_lora_layers"] = peft.get_peft_model_state_dict(network, adapter_name="made")
    pipe.save_lora_weights(tmp_path / "pictures", **layers)
    (tmp_path / "pickle").mkdir()
    torch.save({"lora": torch.ones(1)}, tmp_path / "pickle" / "pytorch_lora_weights.bin")
    for kind, place in (("x_to_touch", "pictures"), ("pipe", "pickle"), ("pipe", "no/such")):
        load = partial(calls[kind].pipe.load_lora_weights, tmp_path / place, local_files_only=True)
        check_refusal(load, f"{PLACE}_or_dict")


def test_a_published_folder_that_cannot_be_built_on_is_refused(tmp_path):
    joint = converted(tmp_path)
    encoder = UniTouchModel.from_pretrained(joint, modalities=("image",)).vision_model
    (tmp_path / "other").mkdir()
    places = {
        "joint": joint,
        "unclip": write_unclip(tmp_path / "unclip", encoder),
        "narrow": converted(tmp_path / "other", width=24, imagebind=False),
    }
    for kind in ("pickled", "broken"):
        places[kind] = shutil.copytree(places["unclip"], tmp_path / kind)
        file = places[kind] / "unet" / "diffusion_pytorch_model.safetensors"
        torch.save({}, file.with_suffix(".bin"))
        file.unlink() if kind == "pickled" else file.write_bytes(file.read_bytes()[:-500])
    for unclip, other, options, named in (
        ("./gone", "joint", {}, "unclip"),
        ("unclip", "../gone", {}, "unitouch"),
        ("joint", "joint", {}, "unclip"),
        ("unclip", "unclip", {}, "unitouch"),
        ("pickled", "joint", {}, "unclip"),
        ("broken", "joint", {}, "unclip"),
        ("unclip", "narrow", {}, "unitouch"),
        ("unclip", "joint", {"dtype": torch.int8}, "dtype"),
    ):
        folders = (places.get(unclip, unclip), places.get(other, other))
        check_refusal(partial(TouchToImagePipeline.from_published, *folders, **options), named)


def test_a_family_that_is_damaged_or_none_is_refused(tmp_path):
    write_small_family(tmp_path)
    file = tmp_path / weights.X_TO_TOUCH.name / "unet" / "diffusion_pytorch_model.safetensors"
    save_file(dict(list(load_file(file).items())[1:]), file, metadata={"format": "pt"})
    check_refusal(partial(unitouch_gen.tiny, "x-to-touch", family=tmp_path), "family")
    shutil.rmtree(file.parent)
    rows = [{"family": family} for family in (tmp_path, 3, "gone")]
    rows += [{"family": tmp_path, "name": name} for name in TURBO]  # without their LoRA weights
    for wrong in (*rows, {"name": "touch-to-imag"}, {"dtype": "int8"}):
        check_refusal(partial(unitouch_gen.tiny, **{"name": "x-to-touch", **wrong}), next(iter(wrong)))
