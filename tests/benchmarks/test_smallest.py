"""Each benchmark at its smallest size."""

import json
import shutil
from typing import Any

import pytest
import torch
from accelerate.state import AcceleratorState
from diffusers import DDIMScheduler
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_iter

from tests.benchmarks import judges, quality
from tests.benchmarks.error_and_time import cost_figures, usual_way
from tests.benchmarks.files_entered import functions_entered
from tests.benchmarks.tables import MARKS, ROOT, card_settings, write_pages
from tests.benchmarks.world import physics_figures
from tests.helpers.components import AUDIO, make_components
from unitouch_gen import weights
from unitouch_gen.models.classifier import ContactClassifier
from unitouch_gen.pipelines import TouchToImagePipeline
from unitouch_gen.training.data import DataConfig
from unitouch_gen.training.trainer import TrainerConfig
from unitouch_gen.world import MATERIAL_NAMES, SENSORS, World
from unitouch_gen.world.scene import SCENE_MODALITIES

pytestmark = pytest.mark.filterwarnings("ignore::unitouch_gen.errors.UnfamiliarInputWarning")  # networks are random


@pytest.fixture(scope="module")
def pipe():
    made = TouchToImagePipeline(**make_components(), default_num_inference_steps=3, default_guidance_scale=2.0)
    # Of few levels: a network of random weights changes with every one of them.
    made.scheduler = DDIMScheduler(num_train_timesteps=20, beta_start=0.02, beta_end=0.2)
    made.set_progress_bar_config(disable=True)
    return made


INPUTS = {"touch_embeds": torch.randn(2, 16, generator=torch.Generator().manual_seed(0))}


def test_the_usual_way_makes_the_same_latents_from_the_same_start(pipe):
    noise = torch.randn(2, 4, 8, 8, generator=torch.Generator().manual_seed(0))
    call = {"num_inference_steps": 4, "guidance_scale": 3.0, "output_type": "latent", "latents": noise}
    latents = usual_way(pipe)(**INPUTS, generator=torch.Generator().manual_seed(1), **call).images
    settings = {"timestep_spacing": "leading", "steps_offset": 1, "set_alpha_to_one": False, "clip_sample": False}
    own = pipe.scheduler
    pipe.scheduler = DDIMScheduler.from_config(pipe.scheduler.config, **settings)
    expected = pipe(**INPUTS, generator=torch.Generator().manual_seed(1), **call).images
    pipe.scheduler = own
    torch.testing.assert_close(latents, expected, rtol=1e-4, atol=1e-4)


def test_costs_are_the_fewest_evaluations_within_an_error(pipe):
    costs = cost_figures(pipe, INPUTS, (2.0, 1e-9), steps=(4, 8), seeds=1)["cost_at_error"]
    assert {error: row["steps"] for error, row in costs.items()} == {"2": 4}


@pytest.mark.slow
def test_finer_touches_are_nearer_to_the_finest() -> None:
    for settings in physics_figures(2, 1).values():
        errors = [figures["error"] for figures in settings.values()]
        assert errors == sorted(errors, reverse=True)
        assert errors[0] < 1.0
        assert all(figures["seconds"] > 0.0 and figures["order"] > 1.0 for figures in settings.values())


class Elements(TorchDispatchMode):
    """Counts the elements that operations write."""

    count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **kwargs or {})
        self.count += sum(part.numel() for part in tree_iter(result) if isinstance(part, torch.Tensor))
        return result


def test_each_request_does_less_than_everything() -> None:
    index = torch.arange(2)
    counts = {}
    for names in (MODALITIES, ("image",), ("touch",), ("audio",), ("text",), ("grasp",)):
        with Elements() as elements:
            World().render(index, 0 * index, 0 * index, modalities=names, sensors=tuple(SENSORS))
        counts[names] = elements.count
    everything = counts.pop(MODALITIES)
    assert max(counts.values()) < 0.9 * everything
    assert counts["text",] < 0.01 * everything


@pytest.mark.slow
def test_the_built_in_joint_space_is_beside_its_controls(tmp_path):
    words = ["--joint", str(weights.JOINT), "--seeds", "1", "--objects", "2"]
    rows = quality.measure(quality.arguments(words), tmp_path)["rows"]
    assert rows["touch: material"]["value"] > rows["touch: material"]["shuffled"]


def test_classifiers_learn_materials_and_attributes(tmp_path, monkeypatch):
    AcceleratorState._reset_state()  # as a process of its own would find it
    monkeypatch.setattr(judges, "SIZES", {"embedding_size": 8, "hidden_sizes": [8], "depths": [1]})
    drawn = {"sensors": ["digit"], "objects": 1, "contacts_per_object": 1}
    trainer = TrainerConfig(steps=2, batch_size=8, learning_rate=1e-3, ema_decay=0.5)
    for kind, count in (("picture", 11), ("touch", 13)):
        data = DataConfig(image_size=32, audio=AUDIO, drawn=drawn)
        judges.train(kind, data, trainer, tmp_path / kind, tmp_path / "cache")
        classifier = ContactClassifier.from_pretrained(tmp_path / kind, dtype=torch.float32)
        seen = classifier.observe(torch.rand(2, 3, 32, 32))
        assert seen.attributes.shape == (2, count)
        assert [*classifier.config.id2label.values()] == [*MATERIAL_NAMES]


def test_stored_figures_fill_the_marks_of_all_pages_and_the_cards(tmp_path):
    shutil.copytree(ROOT / "docs", tmp_path / "docs", ignore=shutil.ignore_patterns("_build"))
    shutil.copy(ROOT / "README.md", tmp_path)
    family = json.loads(weights.FIGURES.read_text())
    assert family["cards"] == card_settings(family["figures"])
    write_pages(family["figures"], tmp_path)
    pages = "".join(page.read_text() for page in [tmp_path / "README.md", *(tmp_path / "docs").rglob("*.md")])
    assert all(pages.count(f"<!-- {mark} -->") == 2 for mark in MARKS)


@pytest.mark.slow
def test_a_picture_enters_few_files():
    files = functions_entered()
    assert {"pipelines/touch_to_image.py", "sampling.py"} <= set(files)
    assert len([file for file in files if not file.startswith("models")]) <= 10
