"""The checks that every part uses: what passes, and how values are described."""

from fractions import Fraction
from functools import partial

import numpy as np
import torch

from unitouch_gen import errors

integer = partial(errors.check_integer, "x", low=1, high=5)
number = partial(errors.check_number, "x", low=0.0, high=1.0)
wide = torch.zeros(2, 3)


def test_numbers_on_the_edge_pass_as_plain_numbers():
    for check, value, expected in (
        (integer, np.int64(5), 5),
        (number, np.float32(1), 1.0),
        (number, Fraction(3, 4), 0.75),
    ):
        checked = check(value)
        assert checked == expected
        assert type(checked) is type(expected)


def test_tensors_that_fit_pass_as_they_are():
    assert errors.check_tensor("x", wide, "B", 3) is wide
    assert errors.check_tensor("x", wide.log(), "B", 3, finite=False).isinf().all()


def test_describe_is_short():
    for value in ("a" * 500, wide, np.zeros(3), [1, 2], object(), int, None, 10**200):
        assert 0 < len(errors.describe(value)) <= 80
