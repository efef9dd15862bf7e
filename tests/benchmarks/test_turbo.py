"""A student beside its teacher: where it draws as its teacher does, every figure is its teacher's."""

import pytest
from PIL import Image

from tests.benchmarks.tables import turbo_table
from tests.benchmarks.turbo import BASELINE, TOLD, draw, measured
from tests.helpers.classifiers import classifier
from tests.helpers.components import make_components
from unitouch_gen.models.distilled import student_of
from unitouch_gen.numerics.fit import with_fits
from unitouch_gen.pipelines import TouchToImagePipeline
from unitouch_gen.schedulers.fitted import Fit, FittedScheduler
from unitouch_gen.training.data.held import held_out


@pytest.mark.filterwarnings("ignore::unitouch_gen.errors.UnfamiliarInputWarning")
def test_what_is_told_of_a_student(tmp_path):
    parts, usual = make_components(), {"default_num_inference_steps": 2, "default_guidance_scale": 9.0}
    fits = [Fit(scale, (14.6, 0.8), ((), (0.0,))) for scale in (1.0, 9.0)]
    known = with_fits(parts["scheduler"], fits, "ddim")
    teacher = TouchToImagePipeline(**{**parts, "scheduler": known}, **usual)
    own = FittedScheduler.from_config(known.config, otherwise=None)
    student = TouchToImagePipeline(**{**parts, "scheduler": own, "unet": student_of(parts["unet"]).eval()}, **usual)
    for pipe in (teacher, student):
        pipe.set_progress_bar_config(disable=True)
    world = held_out(tmp_path, parts["processor"], 7, "val", None, objects=1)
    few = {"conditions": 2, "each": 1, "repeats": 1, "evaluations": 20, "baseline": 3, "fitted": [2]}
    figures = measured(teacher, student, classifier(), [world], **few)
    ways = figures["ways"]
    assert set(ways) == {BASELINE, "fitted, 2 steps", "student, 2 steps"}
    assert [(way["evaluations"], way["rows"]) for way in ways.values()] == [(3, 2), (2, 2), (2, 1)]
    assert ways[BASELINE]["faster"]["ratio"] == pytest.approx(1.0)
    assert all(set(way["pictures"]) == set(TOLD) for way in ways.values())
    draw({"turbo": figures}, tmp_path / "chart.png")
    assert Image.open(tmp_path / "chart.png").width > 500
    text = turbo_table({"turbo": {**figures, "machine": "a laptop"}})
    assert "| student, 2 steps | 2 of 1 row |" in text and text.endswith("Timings: a laptop.")
