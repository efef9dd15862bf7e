"""`unitouch-gen classify`, on a tiny random joint space and on the built-in one."""

import json

import pytest

from unitouch_gen import example
from unitouch_gen.conditioning import EmbeddingBank
from unitouch_gen.evaluation.zero_shot import ZeroShotTouchClassifier
from unitouch_gen.pipelines.tiny import joint_space
from unitouch_gen.weights import EMBEDDING_BANK


@pytest.fixture
def run(command):
    """Runs `unitouch-gen classify ...`."""
    return lambda *args: command("classify", *args)


def test_it_says_what_the_library_says(run):
    labels = ["brick", "soft cloth", "a metal grid"]
    code, out, err = run("example:brick", "example:wood", "--labels", ",".join(labels), "--top", 2, "--json")
    assert code == 0, err
    classifier = ZeroShotTouchClassifier(*joint_space(), EmbeddingBank.from_pretrained(EMBEDDING_BANK))
    for name, row in zip(("brick", "wood"), json.loads(out)["touches"], strict=True):
        [named] = classifier(example(name), labels, top=2)
        assert row["labels"] == pytest.approx(named) and row["unknown"] == named.unknown


def test_a_table_names_each_touch(run, models, here):
    code, out, _ = run("in/dark.png", "in/bright.png", "--model", models["touch-to-image"], "--sensor", "gelsight")
    assert code == 0 and "dark.png" in out and "bright.png" in out and "A percentage is how sure" in out


@pytest.mark.parametrize(("words", "said"), [
    (("--labels", "wood"), "`labels`"),
    (("--labels", "wood,,brick"), "blank"),
    (("--template", "feels"), "`template`"),
    (("--top", "0"), "`--top` is 0"),
    (("--sensor", "skin"), "'skin'"),
    (("--model", "nowhere"), "nowhere"),
    (("--model", "."), "holds no joint space"),
    (("--device", "abacus"), "abacus"),
    (("missing.png",), "missing.png"),
])  # fmt: skip
def test_mistakes_are_one_line(run, refused, here, words, said):
    refused(run("in/dark.png", *words), said)
