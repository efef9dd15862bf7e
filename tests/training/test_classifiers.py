"""Classifiers trained on drawn contacts: which attributes, in which units, of which image, and mirrored with it."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import UniTouchProcessor
from unitouch_gen.models.classifier import ContactClassifier, ContactClassifierOutput
from unitouch_gen.training import picture_classifier, touch_classifier
from unitouch_gen.training.data import DataConfig, DrawnConfig, Rendered, columns_of
from unitouch_gen.training.picture_classifier import SHOWN, ClassifierAugmentation, ClassifierObjective, columns
from unitouch_gen.training.stages import run
from unitouch_gen.world import ATTRIBUTES, MATERIAL_NAMES

CONFIG = DataConfig(drawn=DrawnConfig(sensors=[None], objects=1, contacts_per_object=1), image_size=32)
SMALL = {
    "data": "{image_size: 32, drawn: {sensors: [null], objects: 1, contacts_per_object: 1}}",
    "model": "{embedding_size: 8, hidden_sizes: [8], depths: [1], layer_type: basic}",
    "trainer": "{steps: 2, batch_size: 8, learning_rate: 1.0e-3}",
}


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory, _processor: UniTouchProcessor) -> list[Rendered]:
    cache = tmp_path_factory.mktemp("drawn")
    return columns_of(CONFIG.sources(), cache, CONFIG, _processor, ("image", "touch", "material"))


def test_touches_of_both_sensors_have_their_own_attributes(drawn: list[Rendered]) -> None:
    (split,), data = drawn, columns(drawn, "touch", ATTRIBUTES)
    batch, count = data[range(len(data))], len(split)
    for first, touch, column in ((0, split.touch, 0), (count, split.second, 1)):
        rows = slice(first, first + count)
        np.testing.assert_array_equal(batch["pixels"][rows], touch)
        np.testing.assert_array_equal(batch["attributes"][rows], split.attributes[:, column])
        np.testing.assert_array_equal(batch["material"][rows], split.material)


def test_pictures_have_those_that_they_show(drawn: list[Rendered]) -> None:
    batch = columns(drawn, "image", ("cover", "compliance"))[range(len(MATERIAL_NAMES))]
    expected = np.asarray(drawn[0].attributes)[:, :, [0, -1]].mean(axis=1)
    np.testing.assert_allclose(batch["attributes"], expected, rtol=1e-6)
    assert set(ATTRIBUTES) - set(SHOWN["image"]) == {"depth", "load"}


def test_attributes_of_sources_without_any_are_refused(split: Rendered) -> None:
    with pytest.raises(InvalidInputError, match=r"which only `data\.drawn` has; set `objective\.attributes` to 0"):
        columns([replace(split, attributes=None)], "touch", ATTRIBUTES)


class Brightest(nn.Module):
    """Reads where an image is brightest, from -1, left, to 1."""

    attributes = ("place x", "place y")

    def scale_of_attributes(self, device: torch.device) -> tuple[Tensor, Tensor]:
        return torch.tensor([0.1, -0.2]), torch.tensor([0.5, 2.0])

    def forward(self, pixels: Tensor) -> ContactClassifierOutput:
        row, column = np.unravel_index(pixels.mean(dim=1).flatten(1).argmax(dim=1), (16, 16))
        place = torch.from_numpy((np.stack([column, row], axis=1) + 0.5) / 8 - 1.0).float()
        return ContactClassifierOutput(logits=torch.zeros(len(place), 2), attributes=place)


@pytest.mark.parametrize("mirror", [0.0, 0.5, 1.0])
def test_what_changes_in_a_mirror_changes_with_the_image(mirror: float) -> None:
    pixels = torch.zeros(8, 3, 16, 16, dtype=torch.uint8)
    pixels[:, :, 3, 13] = 250
    truth = torch.tensor([[13.5 / 8 - 1.0, 3.5 / 8 - 1.0]]).expand(8, 2)
    augment = ClassifierAugmentation(mirror=mirror, blur=0.0, noise=0.0, shift=0)
    objective = ClassifierObjective(Brightest(), augment, 1.0)
    losses = objective({"pixels": pixels, "material": torch.zeros(8, dtype=torch.int64), "attributes": truth})
    assert losses["attributes"] < 1e-6


@pytest.mark.parametrize(("name", "module"), [("picture", picture_classifier), ("touch", touch_classifier)])
def test_a_stage_leaves_a_classifier_that_reads(name: str, module: object, tmp_path: Path, capsys) -> None:
    recipe = tmp_path / "wide.yaml"
    recipe.write_text("\n".join(f"{key}: {value}" for key, value in SMALL.items()))
    recipe.write_text(f"{recipe.read_text()}\naugment: {{mirror: 0.5, blur: 0.4, noise: 0.05, shift: 2}}\n"
                      "objective: {attributes: 1.0}\n")  # fmt: skip
    words = ["--recipe", str(recipe), "--output", str(tmp_path / "run"), "--cache", str(tmp_path / "cache")]
    run(f"{name}_classifier", module.main, words)
    classifier = ContactClassifier.from_pretrained(tmp_path / "run" / "model").eval()
    assert classifier.attributes == SHOWN["image" if name == "picture" else "touch"]
    assert list(classifier.config.id2label.values()) == list(MATERIAL_NAMES)
    with torch.no_grad():
        seen = classifier(torch.zeros(2, 3, 64, 64))
    mean, deviation = classifier.scale_of_attributes()
    assert bool((((seen.attributes - mean) / deviation).abs() < 10).all())
    record = json.loads((tmp_path / "run" / "record.json").read_text())
    assert record["sets"] == [{"name": "drawn-any", "objects": 1, "contacts_per_object": 1}]
    assert "Trained on the world alone" in capsys.readouterr().err
