"""Zero-shot classification against numpy, and the names it gives."""

import numpy as np
import pytest
import torch
from scipy.special import softmax

from tests.helpers.components import make_components
from unitouch_gen.evaluation.zero_shot import PROMPTS, Named, ZeroShotTouchClassifier, text_embeddings
from unitouch_gen.world import MATERIAL_NAMES

NAMES = ("brick", "glass", "grass", "wood", "leather")


@pytest.fixture(scope="module")
def classifier() -> ZeroShotTouchClassifier:
    """Of random weights; the prototypes of its sensors are 0.2 and 0.8."""
    parts = make_components()
    with torch.no_grad():
        for parameter in parts["unitouch"].parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    return ZeroShotTouchClassifier(parts["unitouch"], parts["processor"])


@pytest.fixture
def images() -> torch.Tensor:
    return torch.rand(3, 3, 32, 32, generator=torch.Generator().manual_seed(1))


def test_embeddings_of_texts_are_at_unit_length(classifier):
    model = classifier.model
    processor = classifier.processor
    classes = text_embeddings(model, processor, [f"this feels like {name}" for name in NAMES])
    with torch.no_grad():
        text = model.get_text_features(processor.text("this feels like grass")["input_ids"])[0]
    torch.testing.assert_close(classes[NAMES.index("grass")], text / text.norm())
    torch.testing.assert_close(classes.norm(dim=1), torch.ones(len(NAMES)))


@pytest.mark.parametrize("template", [None, "looks {}"])
def test_shares_are_a_softmax_at_the_temperature_of_training(template, classifier, images):
    asked = [(template or PROMPTS["touch"]).format(name) for name in NAMES]
    classes = text_embeddings(classifier.model, classifier.processor, asked).double().numpy()
    model = classifier.model
    pixels = classifier.processor.touch(images)
    with torch.no_grad():
        embeds = model.get_touch_features(pixels, model.sensor_ids(model.match_sensors(pixels))).double().numpy()
    cosines = embeds @ classes.T / np.linalg.norm(embeds, axis=1, keepdims=True)
    found = classifier(images, NAMES, template)
    for named, shares in zip(found, softmax(cosines / 0.07, axis=1), strict=True):
        assert named == pytest.approx(dict(zip(NAMES, shares.tolist(), strict=True)), abs=1e-5)
        assert list(named.values()) == sorted(named.values(), reverse=True)


def test_named_prints_shares_or_that_a_touch_is_unknown():
    shares = {"brick": 0.8, "tile": 0.12}
    unlike = "unlike anything known"
    assert str(Named(shares, None)) == "brick 80%, tile 12%"
    assert str(Named(shares, unlike)) == f"{unlike} (nearest: brick)"
    assert str(Named(shares, "nothing is touched")) == "nothing is touched"


def test_top_keeps_the_best_labels(classifier, images):
    whole = classifier(images, NAMES, top=99)
    best = classifier(images, NAMES, top=2)
    assert [list(one.items())[:2] for one in whole] == [list(one.items()) for one in best]
    assert {name for named in classifier(images) for name in named} == set(MATERIAL_NAMES)
