"""`unitouch-gen ask`, `classify`, `convert` and `doctor`: what they write and print."""

import json
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pytest
import torch

from tests.helpers.components import make_components, make_language_parts
from tests.helpers.published import published, sizes
from tests.helpers.touch_llm import files_of as touch_llm_files
from unitouch_gen import example, weights
from unitouch_gen.evaluation.zero_shot import ZeroShotTouchClassifier
from unitouch_gen.models import UniTouchModel
from unitouch_gen.pipelines import TouchToTextPipeline
from unitouch_gen.pipelines.tiny import joint_space


def test_classify_says_what_the_library_says(command):
    labels = ["brick", "soft cloth", "a metal grid"]
    words = ("classify", "example:brick", "example:wood", "--labels", ",".join(labels), "--top", 2)
    code, out, err = command(*words, "--json")
    assert (code, err) == (0, "")
    classifier = ZeroShotTouchClassifier(*joint_space())
    for name, row in zip(("brick", "wood"), json.loads(out)["touches"], strict=True):
        [named] = classifier(example(name), labels, top=2)
        assert row["labels"] == pytest.approx(named)
        assert row["unknown"] == named.unknown
    assert "gelsight_brick.png" in command(*words)[1]


def test_published_files_become_a_folder(command, tmp_path):
    encoders, _ = published(tmp_path, sizes())
    sizes().save_pretrained(tmp_path)
    files = [word for name, file in encoders.items() for word in (f"--{name}", file)]
    words = ("convert", "unitouch", *files, "--config", tmp_path / "config.json", "--dtype", "bfloat16")
    code, out, err = command(*words, "-o", tmp_path / "model")
    assert (code, err) == (0, "")
    assert "CC-BY-NC-4.0" in out
    model = UniTouchModel.from_pretrained(tmp_path / "model", dtype=torch.bfloat16)
    assert model.known_modalities == ("image", "text", "audio", "touch")


def test_doctor_says_what_a_picture_takes(command, models):
    code, out, err = command("doctor", "--model", models["x-to-touch"], "--device", "cpu")
    assert (code, err) == (0, "")
    assert all(word in out for word in (version("torch"), "Runs on cpu", str(Path(weights.__file__).parent), "2 steps"))


def test_doctor_runs_in_a_clone_that_is_not_installed(command, models, monkeypatch):
    def unknown(name):
        raise PackageNotFoundError(name)

    monkeypatch.setattr(import_module("unitouch_gen.cli.doctor"), "requires", unknown)
    code, out, err = command("doctor", "--model", models["x-to-touch"], "--device", "cpu")
    assert (code, err) == (0, "")
    assert "2 steps" in out


def test_questions_are_answered_about_every_touch(command, refused, here, capsys):
    parts = make_components()
    language = make_language_parts()
    joint = {name: parts[name] for name in ("unitouch", "processor")}
    TouchToTextPipeline(**language, **joint).save_pretrained(here / "ask")
    capsys.readouterr()
    words = ("ask", "in", "How does it feel?", "--model", here / "ask", "--max-new-tokens", 4)
    code, out, err = command(*words, "--json")
    answers = [row["answer"] for row in json.loads(out)["touches"]]
    assert (code, err, len(answers)) == (0, "", 2)
    printed = command(*words)[1]
    assert "bright.png: " in printed
    assert all(answer in printed for answer in answers)
    assert command("ask", "in/bright.png", *words[2:])[1] == f"{answers[0]}\n"
    refused(command(*words[:2], " ", *words[3:]), "`question` is ' '")


def test_touch_llm_becomes_a_pipeline(command, tmp_path):
    tokenizer = make_language_parts()["tokenizer"]
    tokenizer.save_pretrained(tmp_path / "llama")
    touch_llm_files(tmp_path / "llama", len(tokenizer), legacy=False)
    words = ("--bridge", tmp_path / "llama.pth", "--llama", tmp_path / "llama", "-o", tmp_path / "out")
    code, out, _ = command("convert", "touch-llm", *words)
    assert code == 0
    assert "CC-BY-NC-4.0" in out
    assert TouchToTextPipeline.from_pretrained(tmp_path / "out").embedding_dim == 16
