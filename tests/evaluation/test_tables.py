"""Tables of the paper on contacts whose answers are known by construction."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from transformers import ResNetConfig

from unitouch_gen.evaluation.generated import beside_class_means, measures_of, sample_per_class
from unitouch_gen.evaluation.tables import TEMPLATES, grasp_table, material_table, prompts_table, retrieval_table
from unitouch_gen.models.classifier import ContactClassifier
from unitouch_gen.training.data.contacts import SPLITS, Contacts
from unitouch_gen.world import ATTRIBUTES

NAMES = ("brick", "grass", "leather", "wood")
WIDTH, COUNT = 8, 64


def contacts(seed: int, **changes) -> Contacts:
    """Touches and pictures that say their class, statistics that say nothing."""
    generator = torch.Generator().manual_seed(seed)
    objects = torch.arange(COUNT) // 4
    label = objects % len(NAMES)

    def noise() -> Tensor:
        return torch.randn(COUNT, WIDTH, generator=generator)

    images = torch.rand(2, COUNT, 3, 32, 32, generator=generator).mul(255).byte().numpy()
    features = {name: torch.eye(WIDTH)[label] + 0.02 * noise() for name in ("touch", "image")} | {"statistics": noise()}
    made = Contacts(images[0], ["gelsight"] * COUNT, objects, {"material": label}, {"material": NAMES}, image=images[1])
    return replace(made, features=features, **changes)


@pytest.fixture
def splits() -> dict[str, Contacts]:
    return {split: contacts(place) for place, split in enumerate(SPLITS)}


def embed(texts):
    """The corner of the class that a text names."""
    return torch.stack([torch.eye(WIDTH)[next(i for i, name in enumerate(NAMES) if name in text)] for text in texts])


def test_a_material_table_tells_what_knows_from_what_does_not(splits):
    rows = material_table(splits, embed)
    assert rows["chance"] == rows["majority"] == 0.25
    assert rows["touch encoder, zero-shot"] == rows["touch encoder, probe"] == 1.0
    assert abs(rows["plain statistics, probe"] - 0.25) < 0.2
    assert "untouched gel, probe" not in rows  # there is none
    for split in splits.values():
        split.labels["material"][::2] = -1  # what is not known does not count
        split.features["touch"][::2] = torch.eye(WIDTH)[WIDTH - 1]
    assert material_table(splits, embed)["touch encoder, zero-shot"] == 1.0


def test_each_template_asks_for_itself(splits):
    def answer(texts):
        classes = embed(texts)
        return classes if texts[0].startswith("this feels") else classes.roll(1, 0)

    expected = {name: 1.0 if name == "this feels like {}" else 0.0 for name in TEMPLATES}
    assert prompts_table(splits, answer) == {"chance": 0.25, **expected}


def test_grasps_weigh_classes_alike(splits):
    grasp = (torch.arange(COUNT) < 16).long()
    labels = {"labels": {"grasp": grasp}, "classes": {"grasp": ("dropped", "lifted")}}
    held = {name: replace(one, **labels) for name, one in splits.items()}
    rows = grasp_table(held, lambda texts: torch.eye(WIDTH)[: len(texts)])
    assert rows["majority"] == 0.5  # 75 % of all


def test_objects_are_found_by_touches_that_know_them(splits):
    rows = retrieval_table(splits)
    assert rows["touch encoder"]["image"] > rows["chance (another contact's touch)"]["image"]
    assert rows["class mean"]["image"] == pytest.approx(rows["touch encoder"]["image"], abs=0.05)  # class is all
    assert {f"{method} of plain statistics, supervised" for method in ("CCA", "PLSCA")} < set(rows)
    splits["test"].labels["material"][0] = -1
    assert "class mean" not in retrieval_table(splits)


def sloping() -> ContactClassifier:
    """Of random weights, which reads a slope."""
    scale = {"attributes": ["slope"], "attribute_means": [0.0], "attribute_deviations": [1.0]}
    config = ResNetConfig(embedding_size=8, hidden_sizes=[8], depths=[1], layer_type="basic", **scale)
    return ContactClassifier(config).eval()


def test_measures_of_generated_images_are_best_for_real_ones(splits):
    judges = {"image": sloping(), "touch": sloping()}
    rows = torch.arange(0, COUNT, 5)
    real = torch.from_numpy(splits["test"].image[rows.numpy()]).float() / 255
    measure = measures_of(splits, judges, "image", rows)
    own, other, noise = (measure(images) for images in (real, real.roll(1, 0), torch.rand_like(real) ** 4))
    assert own["contact, among 16"] == 1.0 > other["contact, among 16"]
    assert own["distance"] == pytest.approx(other["distance"], rel=1e-4)
    assert own["distance"] < noise["distance"]
    assert own["as real"] == 1.0
    assert set(own) == {"CVTP", "as real", "contact, among 16", "distance"}


def test_pictures_agree_with_their_own_touches_alone(splits):
    """Pictures that are the touches, seen by one classifier."""
    same = {name: replace(one, image=one.touch) for name, one in splits.items()}
    judges = dict.fromkeys(("image", "touch"), sloping())
    rows = torch.arange(COUNT // 2)
    images = torch.from_numpy(same["test"].image[: COUNT // 2]).float() / 255
    measure = measures_of(same, judges, "image", rows)
    own, other = (measure(part)["CVTP"] for part in (images, images.roll(1, 0)))
    assert own > 0.95
    assert abs(other) < 0.5


def test_means_of_classes_are_as_long_as_embeddings():
    embeds = torch.randn(COUNT, 1, 4, generator=torch.Generator().manual_seed(0))
    one = contacts(0)
    rows = torch.arange(0, COUNT, 3)
    found = beside_class_means(lambda text: text, "text", embeds, one, rows)
    torch.testing.assert_close(found["value"], embeds[rows])
    torch.testing.assert_close(found["class_mean"].norm(dim=-1), embeds[rows].norm(dim=-1))
    first = found["class_mean"][0]
    twelfth = found["class_mean"][16]  # rows 0 and 48 are of one class
    assert torch.cosine_similarity(first, twelfth).item() == pytest.approx(1.0)
    one.labels["material"][0] = -1
    assert set(beside_class_means(lambda text: text, "text", embeds, one, rows)) == {"value"}


def test_a_few_of_each_class_are_spread_over_all_of_it():
    labels = torch.tensor([0] * 9 + [-1] + [2] * 2)
    one = Contacts(np.empty(12), [None] * 12, torch.arange(12), {"material": labels}, {})
    assert sample_per_class(one, 3).tolist() == [9, 0, 4, 8, 10, 11]  # of those of unknown class, too
    assert sample_per_class(one, 1).tolist() == [9, 0, 10]
    cover = torch.ones(12, 2, len(ATTRIBUTES))
    cover[9, 1, ATTRIBUTES.index("cover")] = 0.0
    assert sample_per_class(replace(one, attributes=cover), 1).tolist() == [0, 10]  # what nothing touches is left out
