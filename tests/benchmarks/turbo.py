"""Students beside their teachers: seconds, distance from the exact flow, and what is seen of a contact."""

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, ScalarFormatter

from tests.benchmarks.error_and_time import (
    CLOSE,
    diffusers_pictures,
    drawn,
    picture_target,
    plain_touches,
    touch_target,
)
from tests.benchmarks.measuring import Figures, in_turns, quiet, ratio_of, seconds_of
from tests.benchmarks.quality import held_out, over_seeds, touch_to_image_rows, x_to_touch_rows
from unitouch_gen import weights
from unitouch_gen.evaluation.generated import load_classifier
from unitouch_gen.models import UniTouchProcessor
from unitouch_gen.models.classifier import ContactClassifier
from unitouch_gen.numerics.fit import close_reference
from unitouch_gen.numerics.targets import PipelineTarget, errors_of
from unitouch_gen.training.data.embedded import FIRST_SEED
from unitouch_gen.training.data.held import Held
from unitouch_gen.world import MATERIAL_NAMES

BASELINE = "DDIM, 50 steps"

TOLD = ("material", "contact within material", "grain within 20", "Frechet distance")
"""Figures of what is drawn, as `quality` names them."""

FITTED_STEPS = (20, 9)
"""Numbers of steps that the teacher is measured at."""

CONDITIONS, EACH, OBJECTS = 17, 8, 8
"""Contacts that errors are medians over; of each material that images are judged by; and its objects in a world."""


@dataclass(frozen=True)
class Task:
    """What a teacher and its student draw, and how that is judged.

    Attributes:
        guidance_scale: Of every call; `None` is the pipelines' own.
        target: Contacts that errors are medians over.
        usual: What draws rows of a target in the usual way.
        judged: Figures of what a pipeline draws of a world, which begin with `beginning`.
        beginning: Of their names.
        classifier: Folder of what reads the images.
        sensor: By which the world is felt; `None` draws sensors that nobody knows.
    """

    guidance_scale: float | None
    target: Callable[..., PipelineTarget]
    usual: Callable[..., Any]
    judged: Callable[..., Any]
    beginning: str
    classifier: Path
    sensor: str | None = None


TASKS = {
    "touch-to-image": Task(
        9.0, picture_target, diffusers_pictures, touch_to_image_rows, "touch to picture", weights.PICTURE_CLASSIFIER
    ),
    "x-to-touch": Task(
        None, touch_target, plain_touches, partial(x_to_touch_rows, modalities=("image",)), "photo to touch",
        weights.TOUCH_CLASSIFIER, "gelsight",
    ),
}  # fmt: skip
"""By the teacher's name."""


def turbo_figures(seeds: int = 3) -> Figures:
    """Figures of the built-in students, on worlds that nothing was trained on."""
    processor, figures = UniTouchProcessor.from_pretrained(weights.JOINT), {}
    with TemporaryDirectory() as scratch:
        for name, task in TASKS.items():
            worlds = [
                held_out(Path(scratch), processor, FIRST_SEED + number, "test", None, task.sensor, OBJECTS)
                for number in range(seeds)
            ]
            pipes = quiet(name), quiet(f"{name}-turbo")
            figures[name] = measured(task, *pipes, load_classifier(task.classifier), worlds)
    return figures


def measured(
    task: Task,
    teacher: Any,
    student: Any,
    judge: ContactClassifier,
    worlds: Sequence[Held],
    *,
    conditions: int = CONDITIONS,
    each: int = EACH,
    repeats: int = 7,
    evaluations: int = CLOSE,
    baseline: int = 50,
    fitted: Sequence[int] = FITTED_STEPS,
) -> Figures:
    """For each way of drawing its evaluations, median error, and that at the pipelines' own guidance, seconds of an
    image, how many times fewer these are than those of DDIM in the usual way, and `TOLD` over worlds."""
    ways: dict[str, tuple[Any, dict[str, Any]]] = {
        BASELINE: (teacher, {"solver": "ddim", "num_inference_steps": baseline})
    }
    ways |= {f"fitted, {steps} steps": (teacher, {"num_inference_steps": steps}) for steps in fitted}
    ways |= {
        f"student, {steps} step{'s' * (steps > 1)}": (student, {"num_inference_steps": steps})
        for steps in sorted({fit.steps for fit in student.scheduler.fits}, reverse=True)
    }
    own = teacher.config["default_guidance_scale"]
    asked = own if task.guidance_scale is None else task.guidance_scale
    target, guidance = task.target(teacher, conditions), {"guidance_scale": asked}
    truths = {scale: close_reference(target, scale, evaluations) for scale in {asked, own}}

    def error_at(scale: float, pipe: Any, settings: dict[str, Any]) -> tuple[float, Any]:
        """Median error, and the report of what was drawn for it."""
        output = drawn(target, pipe, range(conditions), output_type="latent", guidance_scale=scale, **settings)
        return errors_of(output.images, truths[scale]).median().item(), output.report

    calls = {
        name: partial(drawn, target, pipe, [0], output_type="pt", **settings, **guidance)
        for name, (pipe, settings) in ways.items()
    }
    calls[BASELINE] = partial(task.usual, target, [0], "pt", num_inference_steps=baseline, **guidance)
    seconds = in_turns({name: partial(seconds_of, call) for name, call in calls.items()}, repeats)
    figures: Figures = {}
    for name, (pipe, settings) in ways.items():
        error, report = error_at(asked, pipe, settings)
        known = over_seeds([task.judged(pipe, judge, held, each, **settings, **guidance) for held in worlds])
        figures[name] = {
            "evaluations": report.evaluations,
            "rows": 1 + (report.guided > 0),
            "error": error,
            "own_error": error if own == asked else error_at(own, pipe, settings)[0],
            "seconds": statistics.median(seconds[name]),
            "faster": ratio_of(seconds[BASELINE], seconds[name]),
            "images": {told: known[f"{task.beginning}: {told}"] for told in TOLD},
        }
    return {
        **guidance,
        "own_guidance_scale": own,
        "conditions": conditions,
        "images": each * len(MATERIAL_NAMES),
        "ways": figures,
    }


LABELS = {
    "student, 4 steps": ("fast: --turbo", 12),
    "fitted, 20 steps": ("usual: no --turbo", -20),
    BASELINE: ("as in the paper", 12),
}
"""Which settings to take, on the chart, and how many points above they are written."""


def draw(figures: Figures, file: Path) -> None:
    """Error against seconds of a picture: one curve of the student, one of its teacher, and three labels."""
    task = figures["turbo"]["touch-to-image"]
    ways, scale = task["ways"], task["guidance_scale"]
    drawing = Figure(figsize=(7.0, 4.2), layout="constrained")
    axes = drawing.subplots()
    curves = {"student": "tab:orange", "fitted": "tab:blue"}
    for beginning, colour in curves.items():
        points = sorted(
            (way["seconds"], 100 * way["error"]) for name, way in ways.items() if name.startswith(beginning)
        )
        name = "the student, 1 to 8 evaluations" if beginning == "student" else "its teacher, 9 and 20 steps"
        axes.plot(*zip(*points, strict=True), "o-", color=colour, label=name)
    axes.plot(ways[BASELINE]["seconds"], 100 * ways[BASELINE]["error"], "s", color="tab:gray")
    for name, (label, above) in LABELS.items():
        if name not in ways:
            continue
        axes.annotate(
            label, (ways[name]["seconds"], 100 * ways[name]["error"]), xytext=(0, above), textcoords="offset points",
            ha="center", fontweight="bold",
        )  # fmt: skip
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="seconds a picture, on one core",
        ylabel=f"error of the latents at guidance {scale:g}, %",
    )
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(ScalarFormatter())
        axis.set_minor_formatter(NullFormatter())
    axes.set_xticks([0.1, 0.2, 0.5, 1.0, 2.0])
    axes.set_yticks([2, 5, 10, 20, 50])
    axes.margins(0.15)
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    drawing.savefig(file, dpi=120)
