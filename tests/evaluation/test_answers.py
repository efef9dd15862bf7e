"""Figures of answers about touches, on answers that are right or wrong by construction."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from unitouch_gen.evaluation.answers import caption_table, measured
from unitouch_gen.training.data.contacts import Contacts
from unitouch_gen.world import MATERIAL_NAMES, World
from unitouch_gen.world.attributes import ATTRIBUTES
from unitouch_gen.world.questions import asked_of

OBJECTS = 6


@pytest.fixture(scope="module")
def contacts() -> Contacts:
    """Of every material, whose touches, embeddings and attributes are their numbers."""
    material, number = torch.cartesian_prod(torch.arange(len(MATERIAL_NAMES)), torch.arange(OBJECTS)).T
    attributes = torch.zeros(len(material), len(ATTRIBUTES))
    lying = [ATTRIBUTES.index(name) for name in ("cover", "place x", "place y")]
    attributes[:, lying] = torch.rand(len(material), 3, generator=torch.Generator().manual_seed(0))
    draws = World(0).draw(material, number, torch.zeros_like(number))
    made = Contacts(
        np.zeros((len(material), 3, 8, 8), np.uint8),
        [None] * len(material),
        number,
        {"material": material},
        {"material": MATERIAL_NAMES},
        asked=partial(list, asked_of(draws, attributes)),
    )
    made.features = {"touch": torch.eye(len(material)), "image": torch.eye(len(material))}
    return made


class Knowing:
    """Answers what is true of the contact that a one-hot embedding names, or what is true of the first."""

    def __init__(self, contacts: Contacts):
        self.asked = contacts.asked()
        self.read = iter(torch.eye(len(self.asked)))

    def encode_touch(self, pixels, sensors):
        return torch.stack([next(self.read) for _ in range(len(pixels))])

    def __call__(self, touch_embeds, question, **options):
        known = [self.asked[int(row)] for row in touch_embeds.argmax(dim=1)]
        rows = zip(known, question, strict=True)
        texts = [next(true[0] for asked, true in one.values() if asked == text) for one, text in rows]
        return SimpleNamespace(texts=texts)


def test_caption_table_tells_right_answers_from_those_of_another_contact(contacts):
    for one in contacts.asked():  # all are asked the same
        for topic, (_, answers) in one.items():
            one[topic] = (topic, answers)
    rows = caption_table(Knowing(contacts), {"train": contacts, "test": contacts}, lambda texts: torch.eye(102)[::6], 6)
    assert rows["touch"] == rows["picture"] == pytest.approx(dict.fromkeys(rows["touch"], 1.0))
    usual = rows["most frequent answer"]
    shuffled = rows["shuffled touches"]
    assert usual["grasp"] == usual["hard or soft"] == 0.5
    assert usual["material"] < 0.1
    assert shuffled["material"] < 0.2
    assert shuffled["contact place"] < 0.9
    assert shuffled["ROUGE-L"] < 1.0
    assert rows["zero-shot classifier"] == {"material": pytest.approx(22 / 102)}  # a tie is the first one


def test_a_data_set_may_have_captions_alone(contacts):
    told = [{"caption": ("caption", one["caption"][1])} for one in contacts.asked()]
    bare = replace(contacts, labels={}, classes={}, asked=lambda: told)
    rows = caption_table(Knowing(bare), {"train": bare, "test": bare}, pytest.fail, 102)
    assert rows["touch"] == pytest.approx({"ROUGE-L": 1.0})


def test_a_class_that_is_rare_counts_as_much_as_others():
    asked = [{"grasp": ("?", [answer])} for answer in ["yes, it would hold."] * 9 + ["no, it would slip."]]
    assert measured(asked, {"grasp": ["it would hold."] * 10}, ())["grasp"] == 0.5
    asked = [{"grain": ("?", [answer])} for answer in ("it is running up and down.", "it has no grain.")]
    assert measured(asked, {"grain": ["it is running up and down."] * 2}, ())["grain"] == 1.0  # of what has one
