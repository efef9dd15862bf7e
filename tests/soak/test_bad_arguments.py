"""Every argument of what is public, with values of every kind: each is refused by an error that names it, or used."""

import copy
import inspect
from collections.abc import Callable
from functools import partial, wraps
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import strategies as st
from transformers import PretrainedConfig

import unitouch_gen
from tests.helpers import components
from tests.helpers.attempts import Attempts, drawn
from tests.helpers.odd_values import DRAWN, ODD, SOUND, TOUCH, shown
from tests.helpers.published_files import published, small
from tests.helpers.published_parts import converted, write_ldm
from unitouch_gen.conditioning import EmbeddingBank
from unitouch_gen.convert import convert_published, read_published
from unitouch_gen.models import SensorBank, UniTouchConfig, UniTouchModel, UniTouchProcessor
from unitouch_gen.models.added_sensors import AddedSensor, print_of
from unitouch_gen.models.sounds import LogMel
from unitouch_gen.pipelines import TouchToImagePipeline, XToTouchPipeline
from unitouch_gen.pipelines.tiny import joint_space
from unitouch_gen.sampling import prepare_steps
from unitouch_gen.training.data import open_dataset
from unitouch_gen.training.recipe import read_recipe
from unitouch_gen.world import World

pytestmark = pytest.mark.slow

Entries = dict[str, tuple[Callable[..., Any], dict[str, Any]]]
"""What is called, by a name, with arguments that it can use, among them all that it takes as `**`."""

WRITTEN = ("output", "save_directory")
"""Arguments that name a folder to write to."""

SAMPLES = Path(__file__).parents[2] / "samples" / "inputs"

THEIRS = ("callback_on_step_end", "told", "written", "name", "attention_mask", "matches")
"""Arguments that are left alone: functions may raise what they like, messages call an argument by its `name`, and the
others are what our own methods return."""


@pytest.fixture
def whole(tmp_path_factory: pytest.TempPathFactory, pipes: dict[str, Any], saved: dict[str, Path]) -> dict[str, Any]:
    """What entries are made of: `pipes`, folders of `saved`, and checkpoints as they are published."""
    folder = tmp_path_factory.mktemp("published")
    (folder / "small").mkdir()
    write_ldm(folder / "parts")
    return {
        "pipes": pipes, "saved": saved, "parts": folder / "parts", "unitouch": converted(folder / "small"),
        "published": published(folder, small())[0],
    }  # fmt: skip


def pipelines(pipes: dict[str, Any], **_: Any) -> Entries:
    return {
        "touch-to-image": (pipes["touch-to-image"], {"touch": TOUCH}),
        "stylization": (pipes["stylize"], {"image": TOUCH + 0.4, "touch": TOUCH}),
        "x-to-touch": (pipes["x-to-touch"], {"text": "rough brick"}),
    }


def plans_and_embeddings(pipes: dict[str, Any], **_: Any) -> Entries:
    def planned(call: Any) -> Callable[..., Any]:
        return wraps(type(call).__call__)(lambda **given: type(call).plan(**given))

    def called_back(returned: Any, scale: Any) -> Any:
        def callback(pipe: Any, *_: object) -> Any:
            pipe._guidance_scale = scale
            return returned

        return pipes["touch-to-image"](TOUCH, guidance_scale=3.0, callback_on_step_end=callback)

    return {
        **{f"plan of {name}": (planned(call), good) for name, (call, good) in pipelines(pipes).items()},
        "encode_touch": (pipes["touch-to-image"].encode_touch, {"touch": TOUCH}),
        "encode_prompt": (pipes["touch-to-image"].encode_prompt, {"prompt": ["brick"]}),
        "encode_mix": (pipes["stylize"].encode_mix, {"image": TOUCH, "touch": TOUCH}),
        "encode_condition": (pipes["x-to-touch"].encode_condition, {"text": "rough brick"}),
        "what a callback does": (called_back, {"returned": {}, "scale": 2.0}),
    }


def pipelines_that_are_made(
    pipes: dict[str, Any], saved: dict[str, Path], parts: Path, unitouch: Path, **_: Any
) -> Entries:
    few = {"default_guidance_scale": 2.0, "default_num_inference_steps": 2}
    shared = {name: pipes["x-to-touch"].components[name] for name in ("unitouch", "processor", "scheduler")}
    read = {"plan": None, "dtype": None, "torch_dtype": None, "variant": None, "local_files_only": True}
    return {
        "TouchToImagePipeline": (partial(TouchToImagePipeline, **components.make_components()),
                                 {**few, "default_strength": 0.5, "default_noise_level": 1}),
        "XToTouchPipeline": (partial(XToTouchPipeline, **shared, **components.make_x_to_touch()),
                             {**few, "sensors": ["gelsight", "digit"]}),
        "from_pretrained": (XToTouchPipeline.from_pretrained,
                            {"pretrained_model_name_or_path": saved["x-to-touch"], **read}),
        "from_published": (XToTouchPipeline.from_published,
                           {"ldm": parts, "unitouch": unitouch, "sensors": ["gelsight", "digit"]}),
        "from_pipe": (TouchToImagePipeline.from_pipe, {"pipeline": pipes["stylize"]}),
        "save_pretrained": (pipes["x-to-touch"].save_pretrained, {"save_directory": "out", "variant": None}),
        "tiny": (lambda kind, **given: unitouch_gen.tiny(kind, **given),
                 {"kind": "x-to-touch", "family": saved["family"], "dtype": torch.float32, "plan": None,
                  "low_memory": False}),
        "joint_space": (joint_space, {"family": saved["family"]}),
    }  # fmt: skip


def encoders(pipes: dict[str, Any], saved: dict[str, Path], **_: Any) -> Entries:
    model, config = pipes["touch-to-image"].unitouch, components.joint_config()
    of_a_folder = {"modalities": ["touch"], "dtype": None, "subfolder": "", "variant": None, "local_files_only": True}
    matches, sensor = model.match_sensors(TOUCH), saved["joint"].parent / "mine.safetensors"
    AddedSensor("mine", print_of(model.touch_model), torch.zeros(2, 16), TOUCH[0]).save(sensor)
    return {
        "get_touch_features": (model.get_touch_features, {"pixel_values": TOUCH}),
        "get_image_features": (model.get_image_features, {"pixel_values": TOUCH}),
        "get_text_features": (model.get_text_features, {"input_ids": torch.zeros(1, 12).long()}),
        "get_audio_features": (model.get_audio_features, {"input_values": torch.zeros(1, 1, 1, 32, 16)}),
        "match_sensors": (model.match_sensors, {"pixel_values": TOUCH}),
        "recentre": (model.recentre, {"pixel_values": TOUCH, "background": TOUCH, "matches": matches}),
        "scaled": (model.scaled, {"modality": "text", "features": torch.ones(1, 16)}),
        "load": (model.load, {"modality": "touch"}),
        "set_prototype": (partial(SensorBank(["a"], 2, 16, 32).set_prototype, "a"), {"mean_pixels": TOUCH[0]}),
        "load_sensor": (lambda file: copy.deepcopy(model).load_sensor(file), {"file": sensor}),
        "UniTouchModel": (UniTouchModel, {"config": config, "modalities": ["touch"]}),
        "from_pretrained": (UniTouchModel.from_pretrained,
                            {"pretrained_model_name_or_path": saved["joint"], **of_a_folder}),
        "save_pretrained": (model.save_pretrained, {"save_directory": "out", "variant": None}),
    }  # fmt: skip


def configurations(**_: Any) -> Entries:
    sizes = components.joint_config().to_dict()
    sections = [name for name, value in sizes.items() if name.endswith("_config")]
    of_transformers = PretrainedConfig().to_dict()

    def model(**changed: Any) -> UniTouchModel:
        whole = copy.deepcopy(sizes)
        for key, value in changed.items():
            section, _, inner = key.rpartition("__")
            (whole[section] if section else whole)[inner] = value
        return UniTouchModel(UniTouchConfig(**whole), modalities=())

    own = {name: value for name, value in sizes.items() if name not in of_transformers}
    inner = {f"{section}__{name}": value for section in sections for name, value in sizes[section].items()
             if name not in of_transformers}  # fmt: skip
    return {"UniTouchConfig": (model, own), "its sections": (model, inner)}


def inputs(pipes: dict[str, Any], saved: dict[str, Path], **_: Any) -> Entries:
    processor = pipes["x-to-touch"].processor

    def heard(**audio: Any) -> torch.Tensor:
        return UniTouchProcessor(audio=audio).sounds(SOUND)

    return {
        "images": (processor.images, {"images": TOUCH}),
        "touch": (processor.touch, {"touch": TOUCH}),
        "raw_images": (processor.raw_images, {"images": TOUCH}),
        "sounds": (processor.sounds, {"sounds": SOUND}),
        "text": (processor.text, {"text": "brick"}),
        "UniTouchProcessor": (partial(UniTouchProcessor, tokenizer=processor.tokenizer), {"image_size": 32}),
        "LogMel": (heard, vars(LogMel())),
        "from_pretrained": (UniTouchProcessor.from_pretrained, {"pretrained_model_name_or_path": saved["joint"]}),
        "save_pretrained": (processor.save_pretrained, {"save_directory": "out"}),
    }


def banks_and_schedulers(pipes: dict[str, Any], saved: dict[str, Path], **_: Any) -> Entries:
    bank, scheduler = EmbeddingBank.of(torch.rand(4, 16)), pipes["touch-to-image"].scheduler

    return {
        "EmbeddingBank.of": (EmbeddingBank.of,
                             {"embeds": torch.rand(4, 16), "neighbours": 1, "temperature": 0.5, "share": 1.0}),
        "EmbeddingBank": (EmbeddingBank, {"size": 4, "embedding_dim": 16}),
        "bridge": (bank.bridge, {"embeds": torch.rand(1, 16)}),
        "prepare_steps": (prepare_steps, {"scheduler": scheduler, "solver": "unipc", "num_inference_steps": 2}),
    }  # fmt: skip


def the_world(**_: Any) -> Entries:
    scene = {"material": [0], "object": [0], "contact": [0], "modalities": ["touch"]}

    return {
        "World": (World, {}),
        "render": (lambda **given: World().render(**given).touch, {**scene, "sensors": ["digit"]}),
    }


def what_is_converted(published: dict[str, Path], **_: Any) -> Entries:
    quiet = {"log_fn": lambda line: None}
    of_unitouch = {"touch": published["touch"], "imagebind": published["imagebind"], "config": small()}
    return {
        "convert_published": (partial(convert_published, **quiet), {**of_unitouch, "output": "out"}),
        "read_published": (partial(read_published, **quiet), of_unitouch),
    }


def recipes_and_data_sets(**_: Any) -> Entries:
    return {
        "read_recipe": (read_recipe, {"path": "touch", "overrides": ["trainer.steps=3"]}),
        "open_dataset": (open_dataset, {"path": SAMPLES}),
    }


TABLES = (pipelines, plans_and_embeddings, pipelines_that_are_made, encoders, configurations, inputs,
          banks_and_schedulers, the_world, what_is_converted, recipes_and_data_sets)  # fmt: skip

EVERY = {pipelines: 2, pipelines_that_are_made: 5, configurations: 3, what_is_converted: 8}
"""Of how many values an argument gets one, where calls take their time; the next argument gets the next one."""


def arguments_of(function: Callable[..., Any]) -> list[str]:
    """Names of the arguments of a function, but for those behind `**` and `THEIRS`."""
    found = inspect.signature(function).parameters.values()
    return [one.name for one in found if one.kind in (one.POSITIONAL_OR_KEYWORD, one.KEYWORD_ONLY)
            and one.name not in ("self", *THEIRS)]  # fmt: skip


def outside(changes: dict[str, Any]) -> bool:
    """Whether something would be written beside the folder of the test."""
    places = [str(value) for name, value in changes.items() if name in WRITTEN and isinstance(value, str | Path)]
    return any(place.startswith("/") or ".." in place for place in places)


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.__name__)
def test_odd_values(table: Callable[..., Entries], whole: dict[str, Any], attempt: Attempts) -> None:
    for name, (call, good) in table(**whole).items():

        def tried(changes: dict[str, Any], *, used: bool = False) -> None:
            if not outside(changes):
                words = ", ".join(f"{key}={shown(value)}" for key, value in changes.items())
                attempt(f"{name} {words}", partial(call, **{**good, **changes}), used=used)  # noqa: B023

        tried({}, used=True)
        arguments = sorted({*arguments_of(call), *good} - {*THEIRS})
        every = EVERY.get(table, 1)
        for place, argument in enumerate(arguments):
            for value in ODD[place % every :: every]:
                tried({argument: value})

        @drawn(50, changes=st.dictionaries(st.sampled_from(arguments), DRAWN, min_size=1, max_size=3))
        def several(changes: dict[str, Any]) -> None:
            tried(changes)

        tried({}, used=True)
