"""Arguments of sampling: what numbers of other libraries become, what is refused, and calls that share them."""

from fractions import Fraction
from inspect import signature

import numpy as np

from unitouch_gen.arguments import SamplingArguments
from unitouch_gen.errors import check_fields
from unitouch_gen.pipelines import TactileStylizationPipeline, TouchToImagePipeline, XToTouchPipeline


def test_numbers_of_other_libraries_become_pythons():
    arguments = check_fields(
        SamplingArguments,
        {"num_inference_steps": np.int64(3), "timesteps": (9, np.int32(2)), "eta": 1, "tolerance": Fraction(1, 2)},
    )
    numbers = (arguments.num_inference_steps, *arguments.timesteps, arguments.eta, arguments.tolerance)
    assert numbers == (3, 9, 2, 1.0, 0.5)
    assert [type(number) for number in numbers] == [int, int, int, float, float]


def test_defaults_of_calls_are_those_of_the_arguments():
    """Except for those of which each checkpoint has its own, `None` in a call."""
    calls = [
        signature(kind.__call__).parameters
        for kind in (TactileStylizationPipeline, TouchToImagePipeline, XToTouchPipeline)
    ]
    for name, field in SamplingArguments.model_fields.items():
        defaults = {call[name].default for call in calls if name in call}
        assert defaults
        assert defaults <= {field.default, None}
