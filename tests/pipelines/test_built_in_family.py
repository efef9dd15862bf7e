"""The pipelines of the built-in family that share its weights, held to what they are for."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from drawing import flat_contacts
from tests.benchmarks.quality import load_classifier
from unitouch_gen import weights
from unitouch_gen.evaluation.consistency import consistency
from unitouch_gen.evaluation.zero_shot import MaterialNamer
from unitouch_gen.pipelines.tiny import tiny
from unitouch_gen.world import MATERIAL_NAMES, World

COUNT = len(MATERIAL_NAMES)
SENSOR = "gelsight"


@pytest.fixture(scope="module")
def scene():
    """A flat contact with a held-out object of each material."""
    world = World()
    return world.render(*flat_contacts(world), modalities=("image", "touch", "text"), sensors=(SENSOR,))


@pytest.fixture(scope="module")
def x_to_touch():
    pipe = tiny("x-to-touch")
    pipe.set_progress_bar_config(disable=True)
    return pipe


@pytest.mark.parametrize("folder", [weights.PICTURE_CLASSIFIER, weights.TOUCH_CLASSIFIER])
def test_the_classifiers_know_the_materials(folder: str):
    labels = load_classifier(folder).config.id2label
    assert tuple(labels[number] for number in range(len(labels))) == MATERIAL_NAMES


def test_touches_are_felt_for_what_they_are(scene, x_to_touch):
    named = MaterialNamer(x_to_touch.unitouch, x_to_touch.processor).touch(scene.touch[SENSOR], top=1)
    hits = [next(iter(names)) == material for names, material in zip(named, MATERIAL_NAMES, strict=True)]
    assert sum(hits) >= 12


def test_imagined_touches_show_their_material(scene, x_to_touch):
    touches = x_to_touch(
        text=scene.text, bridge="nearest", sensor=SENSOR, generator=torch.Generator().manual_seed(0), output_type="pt",
        num_inference_steps=10,
    ).images  # fmt: skip
    classifier = load_classifier(weights.TOUCH_CLASSIFIER)
    assert consistency(classifier, scene.touch[SENSOR], torch.arange(COUNT)) >= 0.75
    assert consistency(classifier, touches, torch.arange(COUNT)) >= 0.5  # one in sixteen by chance


def test_text_to_touch_reads_the_text_encoder_alone():
    pipe = tiny("x-to-touch")
    pipe.set_progress_bar_config(disable=True)
    pipe(text="rough brick", num_inference_steps=2)
    assert pipe.unitouch.loaded_modalities == ("text",)


def test_a_photo_is_restyled(scene):
    pipe = tiny("stylization")
    pipe.set_progress_bar_config(disable=True)
    pictures = pipe(scene.image[:2], scene.touch[SENSOR][5:7], num_inference_steps=4, output_type="pt").images
    assert pictures.shape == (2, 3, 128, 128)


def test_every_tensor_is_stored_once():
    seen: dict[tuple, str] = {}
    for file in sorted(Path(weights.FAMILY).rglob("*.safetensors")):
        for name, tensor in load_file(file).items():
            if tensor.ndim < 2 or tensor.numel() < 64:
                continue  # biases that started alike and add to one sum stay alike
            key = (tuple(tensor.shape), tensor.flatten()[:64].float().numpy().tobytes())
            assert key not in seen, f"{file.name}: {name} is {seen[key]}"
            seen[key] = f"{file.parent.name}/{name}"


def test_the_family_is_small():
    assert sum(file.stat().st_size for file in Path(weights.FAMILY).rglob("*.safetensors")) < 40e6
