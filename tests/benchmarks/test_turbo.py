"""A student beside its teacher: where it draws as its teacher does, every figure is its teacher's."""

import pytest
from PIL import Image

from tests.benchmarks.quality import held_out
from tests.benchmarks.tables import turbo_table
from tests.benchmarks.turbo import BASELINE, TASKS, TOLD, draw, measured
from tests.helpers.classifiers import classifier
from tests.helpers.components import make_components, make_x_to_touch
from unitouch_gen.models.distilled import student_of
from unitouch_gen.numerics.fit import with_fits
from unitouch_gen.pipelines import TouchToImagePipeline, XToTouchPipeline
from unitouch_gen.schedulers.fitted import Fit, FittedScheduler

GUIDANCE = {"touch-to-image": 4.0, "x-to-touch": 5.0}
"""Of calls that say nothing; students are judged at 9 and 5."""


def teacher_and_student(task: str) -> tuple:
    """Pipelines of one network, the student's with conditions that it does not heed yet."""
    parts = make_components()
    kind, usual = TouchToImagePipeline, {"default_num_inference_steps": 2, "default_guidance_scale": GUIDANCE[task]}
    if task == "x-to-touch":
        shared = {name: parts[name] for name in ("unitouch", "processor", "scheduler")}
        kind, parts, usual = (
            XToTouchPipeline,
            {**shared, **make_x_to_touch()},
            {**usual, "sensors": ["gelsight", "digit"]},
        )
    fits = [Fit(scale, (14.6, 0.8), ((), (0.0,))) for scale in (1.0, 9.0)]
    known = with_fits(parts["scheduler"], fits, "ddim")
    teacher = kind(**{**parts, "scheduler": known}, **usual)
    own = FittedScheduler.from_config(known.config, otherwise=None)
    student = kind(**{**parts, "scheduler": own, "unet": student_of(parts["unet"]).eval()}, **usual)
    for pipe in (teacher, student):
        pipe.set_progress_bar_config(disable=True)
    return teacher, student


@pytest.mark.filterwarnings("ignore::unitouch_gen.errors.UnfamiliarInputWarning")
@pytest.mark.parametrize("name", TASKS)
def test_what_is_told_of_a_student(name, tmp_path):
    task, (teacher, student) = TASKS[name], teacher_and_student(name)
    world = held_out(tmp_path, teacher.processor, 7, "val", None, task.sensor, objects=1)
    few = {"conditions": 2, "each": 1, "repeats": 1, "evaluations": 20, "baseline": 3, "fitted": [2]}
    figures = {name: measured(task, teacher, student, classifier(), [world], **few), "machine": "a laptop"}
    ways = figures[name]["ways"]
    assert set(ways) == {BASELINE, "fitted, 2 steps", "student, 2 steps"}
    assert [(way["evaluations"], way["rows"]) for way in ways.values()] == [(3, 2), (2, 2), (2, 1)]
    assert ways[BASELINE]["faster"]["ratio"] == pytest.approx(1.0)
    assert all(set(way["images"]) == set(TOLD) for way in ways.values())
    text = turbo_table({"turbo": figures}, name)
    assert "| student, 2 steps | 2 of 1 row |" in text and text.endswith("Timings: a laptop.")
    scales = {"touch-to-image": (4, 9), "x-to-touch": (5,)}[name]
    heads = " | ".join(f"error at guidance {scale}" for scale in scales)
    assert f"evaluations | {heads} | seconds" in text
    apart = {way["own_error"] != way["error"] for way in ways.values()}
    assert apart == {len(scales) == 2}
    if name == "touch-to-image":
        draw({"turbo": figures}, tmp_path / "chart.png")
        assert Image.open(tmp_path / "chart.png").width > 500
