"""Input that cannot be used: an error that names the argument and what came, before any network runs.

The pipeline of these tests has hooks on its networks that fail the test if one is called.
"""

import struct
import zlib
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers import DDIMScheduler, PNDMScheduler, StableDiffusionPipeline
from PIL import Image

from tests.helpers.odd_tensors import odd_tensors
from unitouch_gen.conditioning import EmbeddingBank
from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.models import UniTouchModel
from unitouch_gen.pipelines import TouchToImagePipeline

NAN, INF = float("nan"), float("inf")


def fail(module: torch.nn.Module, *args: object) -> None:
    raise AssertionError(f"{type(module).__name__} ran on input that cannot be used")


@pytest.fixture
def guarded(pipe):
    joint = pipe.unitouch
    networks = [pipe.unet, pipe.vae, pipe.vae.encoder, pipe.vae.decoder, pipe.text_encoder]
    for network in [*networks, joint.touch_model, joint.sensor_bank, joint.vision_model, joint.text_model]:
        network.register_forward_pre_hook(fail)
    return pipe


def refuses(call, *words: str) -> None:
    """The call raises one of the two errors of users' mistakes, with these words in its message."""
    with pytest.raises((InvalidInputError, InvalidTypeError)) as caught:
        call()
    assert isinstance(caught.value, ValueError | TypeError)
    message = str(caught.value)
    missing = [word for word in words if word not in message]
    assert not missing, f"{missing} not in: {message}"
    assert "\n" not in message


def test_the_guard_catches_a_network_that_runs(guarded, touch):
    with pytest.raises(AssertionError, match="ran on input"):
        guarded(touch)


# Touches that are files -----------------------------------------------------------------------------------------------


def no_image(folder: Path) -> Path:
    file = folder / "notes.png"
    file.write_text("This is no picture.")
    return file


def truncated(folder: Path) -> Path:
    file, whole = folder / "cut.png", folder / "whole.png"
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    Image.fromarray(noise).save(whole)
    file.write_bytes(whole.read_bytes()[:5000])
    return file


def one_pixel(folder: Path) -> Path:
    file = folder / "dot.png"
    Image.new("RGB", (1, 1)).save(file)
    return file


def bomb(folder: Path) -> Path:
    """A PNG of a few bytes that says it has 3.6 billion pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0)
    parts = chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(b"\0" * 100)), chunk(b"IEND", b"")
    file = folder / "bomb.png"
    file.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))
    return file


def empty(folder: Path) -> Path:
    (folder / "empty.png").touch()
    return folder / "empty.png"


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (no_image, ("notes.png", "no known image format")),
        (truncated, ("cut.png", "cannot be read as an image")),
        (one_pixel, ("dot.png", "1 x 1")),
        (bomb, ("bomb.png", "pixels")),
        (empty, ("empty.png", "cannot be read as an image")),
        (lambda folder: folder / "gone.png", ("gone.png", "does not exist")),
        (lambda folder: folder, ("is a folder",)),
    ],
    ids=["no image", "truncated", "one pixel", "bomb", "empty file", "no file", "a folder"],
)
def test_files_that_are_no_touch(guarded, tmp_path, make, words):
    file = make(tmp_path)
    refuses(lambda: guarded(file), "`touch", *words)
    refuses(lambda: guarded.encode_touch(str(file)), "`touch", *words)


def test_a_bad_file_in_a_list_is_named_by_its_place(guarded, touch, tmp_path):
    refuses(lambda: guarded([touch[0], no_image(tmp_path)]), "`touch[1]`", "notes.png")


# Touches that are arrays ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (np.full((32, 32, 3), NAN, np.float32), ("3072 of 3072", "NaN")),
        (torch.full((3, 32, 32), INF), ("3072 of 3072", "infinite")),
        (np.full((32, 32, 3), -INF), ("infinite",)),
        (np.zeros((32, 32, 4), np.uint8), ("(1, 32, 32, 4)", "channels")),
        (np.zeros((32, 32, 2), np.uint8), ("(1, 32, 32, 2)", "channels")),
        (torch.zeros(2, 4, 32, 32), ("(2, 4, 32, 32)", "channels")),
        (torch.zeros(32), ("(32,)",)),
        (torch.zeros(0, 3, 32, 32), ("(0, 3, 32, 32)",)),
        (torch.zeros(3, 1, 1), ("1 x 1",)),
        (torch.full((3, 32, 32), 2.0), ("from 2 to 2", "0 to 1")),
        (torch.full((3, 32, 32), -0.1), ("-0.1",)),
        (torch.full((3, 32, 32), 300), ("300", "0 to 255")),
        (torch.zeros(3, 32, 32, dtype=torch.complex64), ("complex64", "real numbers")),
        (np.full((32, 32, 3), "a"), ("numbers",)),
        (Image.new("RGB", (1, 1)), ("1 x 1",)),
        ([], ("empty list",)),
        ([None], ("`touch[0]`", "None")),
        (3, ("3",)),
        (b"touch.png", ("bytes",)),
        ({"touch": "a.png"}, ("dict",)),
    ],
    ids=lambda value: None if isinstance(value, tuple) else "-",
)
def test_arrays_that_are_no_touch(guarded, bad, words):
    refuses(lambda: guarded(bad), "`touch", *words)


ODD = {
    name: odd_tensors(torch.rand(shape))
    for name, shape in {
        "touch": (2, 3, 32, 32), "touch_embeds": (2, 16), "prompt_embeds": (2, 12, 16), "latents": (2, 4, 8, 8),
    }.items()
}  # fmt: skip


@pytest.mark.parametrize("kind", ODD["touch"])
@pytest.mark.parametrize("name", ODD)
def test_tensors_that_hold_no_numbers_one_by_one(guarded, touch, name, kind):
    source = {} if name in ("touch", "touch_embeds") else {"touch": touch}
    refuses(lambda: guarded(**source, **{name: ODD[name][kind]}), f"`{name}` is a", "tensor", "dense")


@pytest.mark.parametrize("dtype", [torch.bool, torch.int64])
def test_prompts_that_are_no_floating_point_numbers(guarded, touch, dtype):
    refuses(lambda: guarded(touch, prompt_embeds=torch.ones(1, 12, 16).to(dtype)), "`prompt_embeds`", "floating-point")


def test_prompts_of_no_tokens(guarded, touch):
    refuses(lambda: guarded(touch, prompt_embeds=torch.ones(1, 0, 16)), "`prompt_embeds`", "(B, T, 16)")


@pytest.mark.parametrize("name", ["prompt", "negative_prompt"])
def test_prompts_that_cannot_be_written(guarded, touch, name):
    refuses(lambda: guarded(touch, **{name: "rough \ud800"}), f"`{name}` is 'rough \\ud800'")


@pytest.mark.parametrize("name", ["throw", "return_dict"])
def test_flags_that_are_words(guarded, touch, name):
    refuses(lambda: guarded(touch, **{name: "no"}), f"`{name}` is 'no'", "True or False")


@pytest.mark.parametrize("name", ["width", "height", "num_images_per_prompt"])
@pytest.mark.parametrize("value", [10**9, 10**400])
def test_sizes_that_cannot_be_meant(guarded, touch, name, value):
    refuses(lambda: guarded(touch, **{name: value}), f"`{name}` is 1", "an integer from")


def test_an_argument_that_is_not_there_is_refused_by_python(guarded, touch):
    with pytest.raises(TypeError, match="guidance_rescale"):
        guarded(touch, guidance_rescale=0.7)


# The numbers of a call ------------------------------------------------------------------------------------------------

NUMBERS = [
    ("guidance_scale", [NAN, INF, -INF, -1, -1e-9, 1e7, "9", True, [3.0]]),
    ("num_inference_steps", [0, -1, 1001, 2.5, NAN, True, "10", [2]]),
    ("strength", [-0.1, -1, NAN, INF, 1e7, 1e39, "1", False]),
    ("noise_level", [-1, 1000, 1.5, NAN, "0", True]),
    ("height", [65, 17, 0, -8, 1, 16.0, "16", True]),
    ("width", [65, 0, -8, 16.5]),
    ("num_images_per_prompt", [0, -1, 1.5, True]),
    ("eta", [2, -1, 1.01, NAN, INF, "0", True]),
    *((name, [10**400, Fraction(10**400)]) for name in ("guidance_scale", "strength", "eta")),
]


@pytest.mark.parametrize(("name", "value"), [(name, value) for name, values in NUMBERS for value in values])
def test_numbers_out_of_range(guarded, touch, name, value):
    shown = "a list of 1" if isinstance(value, list) else str(value)[:37]
    refuses(lambda: guarded(touch, **{name: value}), f"`{name}`", shown)


def test_a_height_that_does_not_fit_comes_with_two_that_do(guarded, touch):
    refuses(lambda: guarded(touch, height=65), "`height` is 65", "multiple of 2", "64", "66")


@pytest.mark.parametrize("scheduler", [DDIMScheduler, PNDMScheduler])
def test_steps_that_a_scheduler_cannot_make(guarded, touch, scheduler):
    """With an offset, 1000 steps start beyond the last noise level, which diffusers meets in the middle of the call."""
    guarded.scheduler = scheduler.from_config(guarded.scheduler.config, steps_offset=1)
    refuses(lambda: guarded(touch, num_inference_steps=1000), "`num_inference_steps` is 1000", scheduler.__name__)


@pytest.mark.parametrize("options", [{}, {"tolerance": 0.1}])
def test_a_schedule_that_float32_cannot_hold(guarded, touch, options):
    """Its noise levels would be asked for when the first prediction is there, or the steps are chosen."""
    config = {**guarded.scheduler.config, "beta_start": 1e-9, "beta_schedule": "linear"}
    guarded.scheduler = DDIMScheduler.from_config(config)
    refuses(lambda: guarded(touch, **options), "`scheduler` is DDIMScheduler", "do not rise in float32")


@pytest.mark.parametrize("scheduler", [DDIMScheduler, PNDMScheduler])
def test_one_step_of_leading_spacing(guarded, touch, scheduler):
    """It would be a step at the lowest noise level: what comes out is the noise."""
    guarded.scheduler = scheduler.from_config(guarded.scheduler.config)
    refuses(lambda: guarded(touch, num_inference_steps=1), "`num_inference_steps` is 1", scheduler.__name__)


# Choices --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", ["bogus", "PIL", "", None, 3])
def test_unknown_output_types(guarded, touch, value):
    refuses(lambda: guarded(touch, output_type=value), "`output_type`", repr(value), "'pil', 'np', 'pt', 'latent'")


def test_an_unknown_solver_comes_with_all_names_and_the_nearest(guarded, touch):
    refuses(lambda: guarded(touch, solver="dpm++2"), "`solver`", "'dpm++2'", "'ddim', 'euler'", "mean 'dpm++2m'")


@pytest.mark.parametrize("value", ["", 3, "DDIMScheduler"])
def test_unknown_solvers(guarded, touch, value):
    refuses(lambda: guarded(touch, solver=value), "`solver`", repr(value))


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ("gelsigt", ("'gelsigt'", "'gelsight', 'digit'", "mean 'gelsight'")),
        ("", ("''",)),
        (["gelsight", "taxim"], ("'taxim'",)),
        (["gelsight"], ("1 for 2",)),
        (["gelsight"] * 3, ("3 for 2",)),
        ([], ("0 for 2",)),
        ([3, None], ("3",)),
        (3, ("3",)),
        ({"a": 1}, ("dict",)),
    ],
)
def test_unknown_sensors(guarded, touch, value, words):
    refuses(lambda: guarded(touch, sensor=value), "`sensor`", *words)
    refuses(lambda: guarded.encode_touch(touch, sensor=value), "`sensor`", *words)


def test_a_sensor_for_a_model_without_sensor_tokens(components, touch):
    config = UniTouchModel.config_class.from_dict(components["unitouch"].config.to_dict() | {"sensors": []})
    components["unitouch"] = UniTouchModel(config).eval()
    refuses(
        lambda: TouchToImagePipeline(**components)(touch, sensor="digit"), "`sensor` is 'digit'", "no sensor tokens"
    )


def test_no_sensor_for_a_model_without_prototypes(guarded, touch):
    guarded.unitouch.sensor_bank.known.fill_(False)
    refuses(lambda: guarded(touch), "`sensor` is None", "'gelsight', 'digit'")


def test_backgrounds_that_do_not_fit(guarded, touch):
    refuses(lambda: guarded(touch, background=torch.zeros(3, 3, 32, 32)), "`background`", "3 images for 2")
    refuses(lambda: guarded(touch, background="gone.png"), "`background`", "gone.png")


# Combinations and batches ---------------------------------------------------------------------------------------------


def test_both_touch_and_embeddings(guarded, touch):
    refuses(lambda: guarded(touch, touch_embeds=torch.ones(2, 16)), "`touch`", "`touch_embeds`", "both")


def test_neither_touch_nor_embeddings(guarded):
    refuses(lambda: guarded(), "`touch`", "`touch_embeds`", "neither")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("sensor", "digit"),
        ("sensor", [None]),
        ("background", torch.zeros(3, 32, 32)),
        ("strength", 0.5),
        ("bridge", True),
    ],
)
def test_what_is_about_touches_with_embeddings(guarded, name, value):
    refuses(lambda: guarded(touch_embeds=torch.ones(1, 16), **{name: value}), f"`{name}`", "`touch_embeds`")


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("touch_embeds", torch.ones(2, 8), ("(2, 8)", "(B, 16)")),
        ("touch_embeds", torch.ones(16), ("(16,)",)),
        ("touch_embeds", torch.ones(0, 16), ("(0, 16)",)),
        ("touch_embeds", torch.full((2, 16), NAN), ("32 of 32",)),
        ("touch_embeds", torch.tensor([[INF] + [0.0] * 15]), ("1 of 16",)),
        ("touch_embeds", torch.ones(2, 16, dtype=torch.long), ("int64",)),
        ("touch_embeds", np.ones((2, 16)), ("array of shape (2, 16)",)),
        ("touch_embeds", [1.0] * 16, ("list of 16",)),
    ],
)
def test_embeddings_that_do_not_fit(guarded, name, value, words):
    refuses(lambda: guarded(touch_embeds=value), f"`{name}`", *words)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"prompt": ["a", "b", "c"]}, ("`prompt`", "list of 3 for 2")),
        ({"prompt": []}, ("`prompt` is an empty list",)),
        ({"prompt": 3}, ("`prompt` is 3",)),
        ({"prompt": ["a", 3]}, ("`prompt`", "list of 2")),
        ({"negative_prompt": ["a", "b", "c"]}, ("`negative_prompt`", "list of 3 for 2")),
        ({"negative_prompt": 3}, ("`negative_prompt` is 3",)),
        ({"prompt_embeds": torch.zeros(3, 12, 16)}, ("`prompt_embeds`", "3 prompts for 2")),
        ({"prompt_embeds": torch.zeros(2, 12, 8)}, ("`prompt_embeds`", "(2, 12, 8)", "16")),
        ({"prompt_embeds": torch.zeros(12, 16)}, ("`prompt_embeds`", "(12, 16)")),
        ({"prompt_embeds": torch.full((1, 12, 16), NAN)}, ("`prompt_embeds`", "192 of 192")),
        ({"prompt_embeds": torch.full((1, 12, 16), INF)}, ("`prompt_embeds`", "192 of 192")),
        ({"prompt_embeds": [0.0]}, ("`prompt_embeds`", "list of 1")),
        ({"prompt_embeds": torch.zeros(1, 7, 16)}, ("`prompt_embeds` hold 7", "`negative_prompt_embeds` 12")),
        ({"negative_prompt_embeds": torch.zeros(3, 12, 16)}, ("`negative_prompt_embeds`", "3 prompts for 2")),
        ({"prompt": "a", "prompt_embeds": torch.zeros(1, 12, 16)}, ("`prompt`", "`prompt_embeds`", "not both")),
        ({"generator": [torch.Generator()] * 3}, ("`generator`", "list of 3 for 2")),
        ({"generator": []}, ("`generator`", "list of 0 for 2")),
        ({"generator": 0}, ("`generator` is 0",)),
        ({"generator": [0, 1]}, ("`generator`", "list of 2")),
        ({"generator": [torch.Generator()] * 2, "num_images_per_prompt": 2}, ("`generator`", "2 for 4")),
        ({"latents": torch.zeros(3, 4, 8, 8)}, ("`latents`", "(3, 4, 8, 8)", "(2, 4, 8, 8)")),
        ({"latents": torch.zeros(2, 4, 16, 16)}, ("`latents`", "(2, 4, 16, 16)")),
        ({"latents": torch.zeros(2, 4, 8, 8), "height": 32}, ("`latents`", "(2, 4, 16, 8)")),
        ({"latents": torch.full((2, 4, 8, 8), NAN)}, ("`latents`", "512 of 512")),
        ({"latents": torch.full((2, 4, 8, 8), INF)}, ("`latents`", "512 of 512")),
        ({"latents": torch.zeros(2, 4, 8, 8).long()}, ("`latents`", "int64")),
        ({"latents": torch.zeros(512)}, ("`latents`", "(512,)")),
        ({"latents": [0.0]}, ("`latents`", "list of 1")),
        ({"callback_on_step_end_tensor_inputs": ["prompt"]}, ("`callback_on_step_end_tensor_inputs`", "'prompt'")),
        ({"callback_on_step_end_tensor_inputs": "latents"}, ("`callback_on_step_end_tensor_inputs`", "'latents'")),
        ({"callback_on_step_end": 3}, ("`callback_on_step_end` is 3",)),
        ({"cross_attention_kwargs": 0.5}, ("`cross_attention_kwargs` is 0.5", "dict", '{"scale": 0.5}')),
        ({"cross_attention_kwargs": ["scale"]}, ("`cross_attention_kwargs` is a list of 1", "dict")),
        ({"cross_attention_kwargs": {3: 0.5}}, ("`cross_attention_kwargs` has the key 3", "names")),
        ({"cross_attention_kwargs": {"attention_mask": None}}, ("the key 'attention_mask'", "leave it out")),
        ({"cross_attention_kwargs": {"scale": None}}, ("`cross_attention_kwargs['scale']` is None", "a number")),
        ({"cross_attention_kwargs": {"scale": "half"}}, ("`cross_attention_kwargs['scale']` is 'half'", "LoRA")),
        ({"cross_attention_kwargs": {"scale": NAN}}, ("`cross_attention_kwargs['scale']` is nan", "finite")),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, dict) else "",
)
def test_arguments_that_do_not_fit_the_touches(guarded, touch, options, words):
    refuses(lambda: guarded(touch, **options), *words)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"negative_prompt": 3}, ("`negative_prompt` is 3",)),
        ({"negative_prompt": ["a", "b", "c"]}, ("`negative_prompt`", "list of 3 for 2")),
        ({"negative_prompt_embeds": torch.zeros(3, 12, 16)}, ("`negative_prompt_embeds`", "3 prompts for 2")),
        ({"negative_prompt": "a", "negative_prompt_embeds": torch.zeros(1, 12, 16)}, ("not both",)),
    ],
)
def test_negative_prompts_are_checked_without_guidance(guarded, touch, options, words):
    refuses(lambda: guarded(touch, guidance_scale=1.0, **options), *words)


# What callbacks return ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("returned", "words"),
    [
        ([1], ("`callback_on_step_end` returned a list of 1", "dictionary")),
        (torch.zeros(2), ("`callback_on_step_end` returned a tensor of shape (2,)",)),
        (3, ("`callback_on_step_end` returned 3",)),
        ({"latent": torch.zeros(2, 4, 8, 8)}, ("`callback_on_step_end` is 'latent'", "mean 'latents'")),
        ({"latents": [1]}, ("`callback_on_step_end: latents`", "a list of 1", "(B, 4, 8, 8)")),
        ({"latents": torch.zeros(1)}, ("`callback_on_step_end: latents`", "(1,)")),
        ({"latents": torch.zeros(3, 4, 8, 8)}, ("`latents`", "(3, 4, 8, 8)", "(2, 4, 8, 8)")),
        ({"latents": torch.zeros(2, 4, 8, 8).long()}, ("`callback_on_step_end: latents`", "int64")),
        ({"latents": torch.zeros(2, 4, 8, 8).cfloat()}, ("`callback_on_step_end: latents`", "complex64")),
        ({"latents": torch.zeros(2, 4, 8, 8, device="meta")}, ("`callback_on_step_end: latents`", "meta tensor")),
        ({"prompt_embeds": [1]}, ("`callback_on_step_end: prompt_embeds`", "(B, T, 16)")),
        ({"prompt_embeds": torch.tensor(1.0)}, ("`callback_on_step_end: prompt_embeds`", "shape ()")),
        ({"prompt_embeds": torch.zeros(4, 12, 3)}, ("`callback_on_step_end: prompt_embeds`", "(4, 12, 3)")),
        ({"prompt_embeds": torch.zeros(3, 12, 16)}, ("`prompt_embeds`", "(3, 12, 16)", "2 pictures")),
    ],
)
def test_what_a_callback_may_not_return(pipe, touch, returned, words):
    refuses(lambda: pipe(touch, callback_on_step_end=lambda *_: returned), *words)


def test_a_callback_that_returns_nothing_of_a_tensor_leaves_it(pipe, touch):
    pipe(touch, callback_on_step_end=lambda *_: {"latents": None, "prompt_embeds": None})


@pytest.mark.parametrize("scale", ["much", None, [1.0], NAN, INF, 10**400, 1e30, torch.tensor(2.0)], ids=type)
def test_scales_that_a_callback_may_not_set(pipe, touch, scale):
    def change(pipeline, *_):
        pipeline._guidance_scale = scale

    refuses(lambda: pipe(touch, callback_on_step_end=change), "`callback_on_step_end: _guidance_scale` is")


# Pipelines that lack a part -------------------------------------------------------------------------------------------


def without(components: dict, *names: str) -> TouchToImagePipeline:
    return TouchToImagePipeline(**(components | dict.fromkeys(names)))


def test_scales_that_a_prompt_may_not_be_encoded_at(guarded):
    for scale in ("half", NAN, 1e30):
        refuses(lambda scale=scale: guarded.encode_prompt(["brick"], lora_scale=scale), "`lora_scale` is")


def test_a_touch_without_a_joint_space(components, touch):
    refuses(lambda: without(components, "unitouch", "processor")(touch), "`touch`", "`touch_embeds`")


def test_a_prompt_without_a_text_encoder(components, touch):
    refuses(lambda: without(components, "text_encoder")(touch, prompt="brick"), "`prompt`", "`prompt_embeds`")


def test_no_negative_embeddings_without_a_text_encoder(components, touch):
    pipe = without(components, "text_encoder", "tokenizer")
    refuses(lambda: pipe(touch, prompt_embeds=torch.zeros(1, 12, 16)), "`negative_prompt", "_embeds`")


def test_a_bank_of_another_width(components):
    components["embedding_bank"] = EmbeddingBank(3, 7)
    refuses(lambda: TouchToImagePipeline(**components), "`embedding_bank`", "width 7", "16")


def test_a_joint_space_of_another_width(components):
    config = components["unitouch"].config.to_dict() | {"projection_dim": 8}
    for name in ("vision", "text", "touch", "audio"):
        config[f"{name}_config"]["projection_dim"] = 8
    components["unitouch"] = UniTouchModel(UniTouchModel.config_class.from_dict(config))
    refuses(lambda: TouchToImagePipeline(**components), "`unitouch`", "width 8", "16")


def test_arguments_that_from_pipe_does_not_know(pipe):
    refuses(lambda: TouchToImagePipeline.from_pipe(pipe, unitouche=None), "`from_pipe`", "unitouche")


def test_a_pipeline_that_is_no_unclip(components):
    shared = {name: components[name] for name in ("vae", "text_encoder", "tokenizer", "unet")}
    shared["scheduler"] = DDIMScheduler(steps_offset=1, clip_sample=False)
    other = StableDiffusionPipeline(
        **shared, safety_checker=None, feature_extractor=None, requires_safety_checker=False
    )
    refuses(lambda: TouchToImagePipeline.from_pipe(other), "`pipeline`", "image_normalizer")


# Pipelines ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("part", ["unet", "vae", "scheduler", "unitouch", "tokenizer"])
@pytest.mark.parametrize("value", [3, "unet", [], torch.nn.Linear(1, 1)])
def test_what_is_no_part_of_a_pipeline_is_refused_by_name(pipe, part, value):
    refuses(lambda: TouchToImagePipeline(**{**pipe.components, part: value}), f"`{part}`")


@pytest.mark.parametrize("part", ["unet", "vae", "scheduler", "image_normalizer", "image_noising_scheduler"])
def test_parts_that_every_call_needs_have_to_come(pipe, part):
    refuses(lambda: TouchToImagePipeline(**{**pipe.components, part: None}), f"`{part}` is None")


@pytest.mark.parametrize(("name", "value"), [("default_guidance_scale", "9"), ("default_strength", NAN),
                                             ("default_num_inference_steps", 10**400)])  # fmt: skip
def test_settings_of_a_pipeline_are_refused_by_name(pipe, name, value):
    refuses(lambda: TouchToImagePipeline(**pipe.components, **{name: value}), f"`{name}`")


@pytest.mark.parametrize("value", [None, 3, {}])
def test_what_is_no_pipeline_has_no_parts_to_share(value):
    refuses(lambda: TouchToImagePipeline.from_pipe(value), "`pipeline`")


def test_a_tolerance_may_be_any_kind_of_number(pipe, touch):
    plain, half = (
        pipe(touch, tolerance=one, generator=torch.Generator().manual_seed(0)) for one in (0.5, np.float16(0.5))
    )
    assert half.report.evaluations == plain.report.evaluations > 0


@pytest.mark.parametrize("device", [3.5, "brick", 2**63, torch.zeros(2)])
def test_what_is_no_device_encodes_nothing(guarded, device):
    refuses(lambda: guarded.encode_prompt(["brick"], device), "`device`")
