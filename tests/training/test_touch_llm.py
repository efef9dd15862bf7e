"""What Touch-LLM's two stages are trained on: questions about the world, and their answers."""

import torch

from tests.helpers.components import make_language_parts
from unitouch_gen.training import touch_llm
from unitouch_gen.world import ATTRIBUTES, MATERIALS, World
from unitouch_gen.world.questions import TOPICS, answered


def test_labels_are_the_answers_and_their_end(processor) -> None:
    tokenizer = make_language_parts()["tokenizer"]
    pairs = touch_llm.encoded(tokenizer, [[("How is it?", "rough."), ("ä?", "é")]])
    for row, (prompt, answer) in enumerate((("How is it?\n", "rough."), ("ä?\n", "é"))):
        ids = pairs["input_ids"][0, row]
        labels = pairs["labels"][0, row]
        assert tokenizer.decode(labels[labels >= 0].tolist()) == answer + "</s>"
        assert tokenizer.decode(ids.tolist(), skip_special_tokens=True) == prompt + answer


def test_answers_are_true_of_the_world() -> None:
    world = World(3, image_size=64)
    names = torch.cartesian_prod(torch.arange(17), torch.arange(6), torch.arange(1)).T
    scene = world.render(*names, modalities=("attributes", "grasp", "text"))
    draws = world.draw(*names)
    attributes = scene.attributes["gelsight"]
    for variant in range(2):
        for row, told in enumerate(answered(draws, attributes, variant)):
            spec = MATERIALS[int(names[0][row])]
            measured = dict(zip(ATTRIBUTES, attributes[row].tolist(), strict=True))
            assert all(question in TOPICS[topic].questions for topic, (question, _) in told.items())
            known = told["material"][1] == f"it is {spec.name}."
            assert known != (measured["cover"] < 0.12)
            assert told["feel"][1].count(spec.feel[0]) == 1
            holds = told["grasp"][1] in ("yes, it would hold.", "no, it would hold.")
            assert holds == bool(scene.grasp[row] > 1)
            assert (told["grasp"][1][:3] == "yes") == (holds != ("slip" in told["grasp"][0]))
            assert (told["grain"][1] == "it has no grain.") != spec.grained
            if variant == 0:
                assert told["caption"][1] == f"{scene.text[row]}."
    flat = attributes[:1].expand(5, -1).clone()
    contacts = [[0.95, 0.0, 0.0], [0.3, -0.5, 0.1], [0.3, 0.5, 0.1], [0.3, 0.1, -0.5], [0.3, 0.0, 0.0]]
    flat[:, [ATTRIBUTES.index(name) for name in ("cover", "place x", "place y")]] = torch.tensor(contacts)
    places = [told["place"][1] for told in answered(world.draw(*(part[:5] for part in names)), flat)]
    assert places == ["all over the view.", "to the left.", "to the right.", "above.", "in the centre."]
