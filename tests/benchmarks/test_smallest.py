"""Benchmarks where their answer is known, and pages that quote them."""

import json
import shutil

import numpy as np
import pytest
import torch
from accelerate.state import AcceleratorState
from diffusers import DDIMScheduler

from tests.benchmarks import judges, quality
from tests.benchmarks.error_and_time import usual_way
from tests.benchmarks.files_entered import functions_entered
from tests.benchmarks.tables import MARKS, ROOT, card_settings, write_pages
from tests.benchmarks.world import physics_figures
from tests.helpers.components import AUDIO, make_components
from unitouch_gen import weights
from unitouch_gen.models.classifier import ContactClassifier
from unitouch_gen.pipelines import TouchToImagePipeline
from unitouch_gen.training.data import DataConfig
from unitouch_gen.training.trainer import TrainerConfig
from unitouch_gen.world import ATTRIBUTES, MATERIAL_NAMES

pytestmark = pytest.mark.filterwarnings("ignore::unitouch_gen.errors.UnfamiliarInputWarning")  # networks are random


@pytest.fixture(scope="module")
def pipe():
    made = TouchToImagePipeline(**make_components(), default_num_inference_steps=3, default_guidance_scale=2.0)
    # Of few levels: a network of random weights changes with every one of them.
    made.scheduler = DDIMScheduler(num_train_timesteps=20, beta_start=0.02, beta_end=0.2)
    made.set_progress_bar_config(disable=True)
    return made


INPUTS = {"touch_embeds": torch.randn(2, 16, generator=torch.Generator().manual_seed(0))}


def test_the_usual_way_of_ddim_makes_the_same_latents_from_the_same_start(pipe):
    noise = torch.randn(2, 4, 8, 8, generator=torch.Generator().manual_seed(0))
    call = {"num_inference_steps": 4, "guidance_scale": 3.0, "output_type": "latent", "latents": noise}
    latents = usual_way(pipe)(**INPUTS, generator=torch.Generator().manual_seed(1), **call).images
    settings = {"timestep_spacing": "leading", "steps_offset": 1, "set_alpha_to_one": False, "clip_sample": False}
    own = pipe.scheduler
    pipe.scheduler = DDIMScheduler.from_config(pipe.scheduler.config, **settings)
    expected = pipe(**INPUTS, generator=torch.Generator().manual_seed(1), **call).images
    pipe.scheduler = own
    torch.testing.assert_close(latents, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_the_physics_of_finer_touches_are_nearer_to_the_finest() -> None:
    for settings in physics_figures(2, 1).values():
        errors = [figures["error"] for figures in settings.values()]
        assert errors == sorted(errors, reverse=True)
        assert errors[0] < 1.0
        assert all(figures["seconds"] > 0.0 and figures["order"] > 1.0 for figures in settings.values())


@pytest.mark.slow
def test_the_quality_of_the_built_in_joint_space_is_above_shuffled(tmp_path):
    words = ["--joint", str(weights.JOINT), "--seeds", "1", "--objects", "2"]
    rows = quality.measure(quality.arguments(words), tmp_path)["rows"]
    assert rows["touch: material"]["value"] > rows["touch: material"]["shuffled"]


@pytest.mark.parametrize("kind", ["picture", "touch"])
def test_a_classifier_reads_attributes_in_the_units_of_what_it_was_trained_on(kind, tmp_path, monkeypatch):
    AcceleratorState._reset_state()  # as a process of its own would find it
    monkeypatch.setattr(judges, "SIZES", {"embedding_size": 8, "hidden_sizes": [8], "depths": [1]})
    trainer = TrainerConfig(steps=2, batch_size=8, learning_rate=1e-3, ema_decay=0.5)
    drawn = {"sensors": ["digit"], "objects": 1, "contacts_per_object": 1}
    data = DataConfig(image_size=32, audio=AUDIO, drawn=drawn)
    judges.train(kind, data, trainer, tmp_path / kind, tmp_path / "cache")
    config = ContactClassifier.from_pretrained(tmp_path / kind, dtype=torch.float32).config
    assert [*config.id2label.values()] == [*MATERIAL_NAMES]
    (source,) = data.sources()
    measured = torch.cat([by_sensor["attributes"] for _, by_sensor in source.scenes("train", 32)])  # (N, 2, K)
    chosen = measured[..., [ATTRIBUTES.index(name) for name in config.attributes]]
    values = chosen.flatten(0, 1) if kind == "touch" else chosen.mean(dim=1)
    np.testing.assert_allclose(config.attribute_means, values.mean(dim=0), rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(config.attribute_deviations, values.std(dim=0, correction=0), rtol=1e-3, atol=1e-3)


def test_pages_and_model_cards_quote_the_stored_figures(tmp_path):
    shutil.copytree(ROOT / "docs", tmp_path / "docs", ignore=shutil.ignore_patterns("_build"))
    shutil.copy(ROOT / "README.md", tmp_path)
    family = json.loads(weights.FIGURES.read_text())
    assert family["cards"] == card_settings(family["figures"])
    write_pages(family["figures"], tmp_path)
    pages = [tmp_path / "README.md", *(tmp_path / "docs").rglob("*.md")]
    for page in pages:
        assert page.read_text() == (ROOT / page.relative_to(tmp_path)).read_text(), page.name
    text = "".join(page.read_text() for page in pages)
    assert all(text.count(f"<!-- {mark} -->") == 2 for mark in MARKS)


@pytest.mark.slow
def test_a_picture_enters_few_files():
    files = functions_entered()
    assert {"pipelines/touch_to_image.py", "sampling.py"} <= set(files)
    assert len([file for file in files if not file.startswith("models")]) <= 10
