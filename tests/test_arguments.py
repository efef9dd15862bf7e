"""Arguments of sampling: what numbers of other libraries become, what is refused, and calls that share them."""

from fractions import Fraction
from inspect import signature

import numpy as np
import pytest

from unitouch_gen.arguments import SamplingArguments
from unitouch_gen.errors import InvalidInputError, InvalidTypeError, check_fields
from unitouch_gen.pipelines import TactileStylizationPipeline, TouchToImagePipeline, XToTouchPipeline


def test_numbers_of_other_libraries_become_pythons():
    arguments = check_fields(
        SamplingArguments,
        {"num_inference_steps": np.int64(3), "timesteps": (9, np.int32(2)), "eta": 1, "tolerance": Fraction(1, 2)},
    )
    numbers = (arguments.num_inference_steps, *arguments.timesteps, arguments.eta, arguments.tolerance)
    assert numbers == (3, 9, 2, 1.0, 0.5)
    assert [type(number) for number in numbers] == [int, int, int, float, float]


@pytest.mark.parametrize(
    ("values", "error", "message"),
    [
        ({"eta": 2}, InvalidInputError, "`eta` is 2; it has to be at most 1."),
        ({"height": 0}, InvalidInputError, "`height` is 0; it has to be at least 1."),
        ({"timesteps": [9, 2.5]}, InvalidTypeError, "`timesteps.1` is 2.5; it has to be a valid integer."),
        ({"width": 2.5}, InvalidTypeError, "`width` is 2.5; it has to be a valid integer."),
        (
            {"mix": "papre"},
            InvalidInputError,
            "`mix` is 'papre'; it has to be 'linear' or 'paper'. Did you mean 'paper'?",
        ),
    ],
)
def test_a_message_says_what_came_and_what_is_wanted(values, error, message):
    with pytest.raises(error) as caught:
        check_fields(SamplingArguments, values)
    assert str(caught.value) == message


def test_defaults_of_calls_are_those_of_the_arguments():
    """Except for those of which each checkpoint has its own, `None` in a call."""
    calls = [
        signature(kind.__call__).parameters
        for kind in (TactileStylizationPipeline, TouchToImagePipeline, XToTouchPipeline)
    ]
    for name, field in SamplingArguments.model_fields.items():
        defaults = {call[name].default for call in calls if name in call}
        assert defaults and defaults <= {field.default, None}
