"""Every case on pipelines ends as expected, on random weights: it is the code that is tried, not a checkpoint."""

import warnings
from functools import cache

import pytest
import torch
from diffusers import DDIMScheduler

from tests.helpers.components import make_components, make_x_to_touch
from unitouch_gen.numerics.stability import Case, run_cases
from unitouch_gen.numerics.stability_parts import DEFECTIVE, pipeline_suite, spoiled
from unitouch_gen.numerics.stability_pipelines import NUMBERS, Trial
from unitouch_gen.pipelines import TactileStylizationPipeline, TouchToImagePipeline, XToTouchPipeline
from unitouch_gen.schedulers.defects import DEFECTS
from unitouch_gen.schedulers.solvers import make_scheduler

KINDS = {
    "touch-to-image": TouchToImagePipeline,
    "stylization": TactileStylizationPipeline,
    "x-to-touch": XToTouchPipeline,
}


@cache
def make(name: str, dtype: torch.dtype):
    parts = make_components()
    # Random weights say no noise, which would be left in; taken for velocities, they leave none.
    own = DDIMScheduler.from_config(parts["scheduler"].config, prediction_type="v_prediction")
    parts["scheduler"] = make_scheduler(own, "unipc")
    if name == "x-to-touch":
        shared = {key: parts[key] for key in ("unitouch", "processor", "scheduler")}
        parts = {**shared, **make_x_to_touch(), "sensors": ["gelsight", "digit"]}
    pipe = KINDS[name](**parts, default_num_inference_steps=2, default_guidance_scale=2.0)
    pipe.set_progress_bar_config(disable=True)
    return pipe.to(dtype)


SUITE = pipeline_suite(make)
LONG = ("1000 steps", "float16", "bfloat16", "DPM++ of beta")


CASES = [
    pytest.param(case, id=case.name, marks=pytest.mark.slow if case.name.startswith(LONG) else ())
    for cases in SUITE.values()
    for case in cases
]


@pytest.mark.parametrize("case", CASES)
def test_case(case: Case):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of libraries, on input that is meant to be odd
        (outcome,) = run_cases({"": [case]})
    assert outcome.ok, f"{outcome.expected}; {outcome.seen}; {outcome.value}"


def test_cases_are_made_without_a_pipeline():
    """So that they can be listed at once."""

    def unwanted(name: str, dtype: torch.dtype) -> None:
        raise AssertionError("a pipeline was made")

    assert {group: len(cases) for group, cases in pipeline_suite(unwanted).items()} == {
        group: len(cases) for group, cases in SUITE.items()
    }


def test_every_number_is_tried_beyond_its_ends():
    assert all(fine and wrong for fine, wrong in NUMBERS.values())


def test_every_defect_of_a_scheduler_is_tried():
    """But for those of a schedule itself, which are tried on exact problems."""
    from unitouch_gen.numerics.problems import STABLE_DIFFUSION

    found = set()
    for name, scheduler, settings, steps in DEFECTIVE:
        own = scheduler(**{**STABLE_DIFFUSION, "prediction_type": "v_prediction", **settings})
        own.set_timesteps(steps)
        occurring = [defect for defect, entry in DEFECTS.items() if entry.occurs(own, steps)]
        assert occurring, name
        found.add(occurring[0])
    assert found == set(DEFECTS) - {"is undefined", "has other levels"}


def test_a_spoiled_network_is_whole_again():
    pipe, trial = make("touch-to-image", torch.float32), Trial(make)
    before = trial.call("touch-to-image").images
    with spoiled(pipe.unet, float("nan")):
        assert not len(trial.call("touch-to-image").images)
    assert torch.equal(trial.call("touch-to-image").images, before)
