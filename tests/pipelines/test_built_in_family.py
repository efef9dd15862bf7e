"""The pipelines of the built-in family that share its weights, held to what they are for."""

from pathlib import Path
from statistics import mean

import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import load_file

from drawing import flat_contacts
from tests.benchmarks.measuring import attribute_agreement
from unitouch_gen import weights
from unitouch_gen.evaluation.contacts import image_embeddings
from unitouch_gen.models.classifier import ContactClassifier
from unitouch_gen.pipelines.tiny import joint_space, tiny
from unitouch_gen.world import ATTRIBUTES, MATERIAL_NAMES, World

COUNT = len(MATERIAL_NAMES)
SENSORS = ("gelsight", "digit")
RELIEF = ("slope", "steepness", "fine relief")


@pytest.fixture(scope="module")
def scene():
    """A flat contact with a held-out object of each material."""
    world = World()
    return world.render(*flat_contacts(world), modalities=("image", "touch", "attributes"), sensors=SENSORS)


@pytest.fixture(scope="module")
def x_to_touch():
    pipe = tiny("x-to-touch")
    pipe.set_progress_bar_config(disable=True)
    return pipe


@pytest.mark.parametrize("folder", [weights.PICTURE_CLASSIFIER, weights.TOUCH_CLASSIFIER])
def test_the_classifiers_know_the_materials(folder: str):
    labels = ContactClassifier.from_pretrained(folder).config.id2label
    assert tuple(labels[number] for number in range(len(labels))) == MATERIAL_NAMES


def test_a_contact_is_found_by_another_sensor(scene):
    model, _ = joint_space()
    one, other = (F.normalize(image_embeddings(model, "touch", scene.touch[name]), dim=1) for name in SENSORS)
    found = (one @ other.T).argmax(dim=1) == torch.arange(COUNT)
    assert found.sum() >= 12  # of 17, one by chance


@pytest.mark.filterwarnings("ignore::unitouch_gen.errors.UnfamiliarInputWarning")  # of one in twenty known photos
def test_imagined_touches_have_the_relief_that_a_photo_shows(scene, x_to_touch):
    """Read by a classifier that knows nothing of the joint space; of another photo's touches it reads no such thing."""
    touches = x_to_touch(
        image=scene.image, sensor=SENSORS[0], generator=torch.Generator().manual_seed(0), output_type="pt",
        num_inference_steps=10,
    ).images  # fmt: skip
    classifier = ContactClassifier.from_pretrained(weights.TOUCH_CLASSIFIER, dtype=torch.float32)
    columns = [classifier.attributes.index(name) for name in RELIEF]
    truth = scene.attributes[SENSORS[0]][:, [ATTRIBUTES.index(name) for name in RELIEF]]
    agreed = [
        mean(attribute_agreement(classifier.observe(images).attributes[:, columns], truth, RELIEF).values())
        for images in (touches, touches.roll(1, 0))
    ]
    assert agreed[0] > 0.35 and agreed[0] > agreed[1] + 0.25


def test_text_to_touch_reads_the_text_encoder_alone():
    pipe = tiny("x-to-touch")
    pipe.set_progress_bar_config(disable=True)
    pipe(text="rough brick", num_inference_steps=2)
    assert pipe.unitouch.loaded_modalities == ("text",)


def test_a_photo_is_restyled(scene):
    pipe = tiny("stylization")
    pipe.set_progress_bar_config(disable=True)
    pictures = pipe(scene.image[:2], scene.touch[SENSORS[0]][5:7], num_inference_steps=4, output_type="pt").images
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
    files = [file for file in Path(weights.FAMILY).rglob("*.safetensors") if file.parent.name != "joint-next"]
    assert sum(file.stat().st_size for file in files) < 40e6
