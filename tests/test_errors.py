"""The checks that every part uses: what passes, and that messages name the argument, what came and what to do."""

import math
import warnings
from fractions import Fraction
from functools import partial

import numpy as np
import pytest
import torch
import typer

from unitouch_gen.errors import (
    InvalidInputError,
    InvalidTypeError,
    NonFiniteError,
    UnfamiliarInputWarning,
    check_choice,
    check_dtype,
    check_integer,
    check_kind,
    check_number,
    check_tensor,
    check_texts,
    describe,
    needed,
    run_commands,
)

integer = partial(check_integer, "x", low=1, high=5)
number = partial(check_number, "x", low=0.0, high=1.0)
wide = torch.zeros(2, 3)


def test_what_can_be_used_passes():
    for check, value, expected in (
        (integer, np.int64(3), 3),
        (number, np.float32(0.25), 0.25),
        (number, Fraction(3, 4), 0.75),
        (number, np.int64(1), 1.0),
        (lambda value: check_kind("x", value, int), 3, 3),
        (partial(check_texts, "x"), ("a", "b"), ["a", "b"]),
        (partial(check_choice, "x", choices=("a", "b")), "b", "b"),
        (partial(check_dtype, "x"), torch.float16, torch.float16),
    ):
        checked = check(value)
        assert checked == expected and type(checked) is type(expected)


def test_what_cannot_be_used_is_refused_by_name():
    for check, value, error, words in (
        (integer, 0, InvalidInputError, "is 0; it has to be a number from 1 to 5"),
        *((integer, value, InvalidTypeError, "an integer") for value in (1.0, "1", None, True)),
        (number, 1.0000001, InvalidInputError, "a number from 0 to 1"),
        *((number, value, InvalidInputError, "a number") for value in (math.nan, -math.inf, 10**400)),
        *((number, value, InvalidTypeError, "a number") for value in ("0.5", None, False, 1j)),
        (partial(check_texts, "x"), ["a", 3], InvalidTypeError, "a string or a list of strings"),
        (partial(check_texts, "x"), [], InvalidInputError, "at least one string"),
        (partial(check_texts, "x"), "a\ud800", InvalidInputError, "UTF-8"),
        (partial(check_choice, "x", choices=("heun", "ddim")), "huen", InvalidInputError, "Did you mean 'heun'"),
        (partial(check_dtype, "x"), torch.int8, InvalidInputError, "one of 'float32'"),
        (partial(check_dtype, "x"), "float8", InvalidInputError, "one of 'float32'"),
    ):
        with pytest.raises(error, match=rf"^`x` .*{words}"):
            check(value)


def test_tensors_of_other_shapes_kinds_and_values():
    for value, shape, error in (
        *((value, ("B", 3), InvalidTypeError) for value in (np.zeros((2, 3)), wide.int(), wide.to_sparse())),
        (wide.to("meta"), ("B", 3), InvalidTypeError),
        *((wide, shape, InvalidInputError) for shape in (("B", 4), ("B", 3, 1), ("B",))),
        *((value, ("B", 3), InvalidInputError) for value in (wide[:0], wide.log(), wide / 0)),
    ):
        with pytest.raises(error, match=r"^`x` "):
            check_tensor("x", value, *shape)


def test_letters_of_a_shape_stand_for_any_size():
    assert check_tensor("x", wide, "B", 3) is wide
    assert check_tensor("x", wide.log(), "B", "D", finite=False).isinf().all()


def test_descriptions_are_short():
    for value in ("a" * 500, wide, np.zeros(3), [1, 2], object(), int, None, 10**200):
        assert 0 < len(describe(value)) <= 80


def test_a_missing_extra_is_named():
    with pytest.raises(InvalidInputError, match=r"pip install 'unitouch_gen\[train\]'"):
        needed("no_such_module")


@pytest.mark.parametrize("error", [InvalidInputError("a\nb"), NonFiniteError("a\nb"), typer.BadParameter("a\nb")])
def test_a_mistake_is_one_line_and_exit_code_2(error, capsys):
    app = typer.Typer()

    @app.command()
    def command() -> None:
        raise error

    with pytest.raises(SystemExit) as ended:
        run_commands(app, "unitouch-gen", [])
    assert ended.value.code == 2
    out, err = capsys.readouterr()
    assert not out and err.count("\n") == 1 and err.startswith("unitouch-gen: ") and "a b" in err


def test_warnings_of_ours_are_lines_and_others_are_left_out(capsys):
    app = typer.Typer()

    @app.command()
    def command() -> None:
        warnings.warn("a touch", UnfamiliarInputWarning, stacklevel=2)
        warnings.warn_explicit("theirs", UserWarning, "file", 1, module="diffusers.models")

    run_commands(app, "unitouch-gen", [])
    assert capsys.readouterr().err == "unitouch-gen: a touch\n"
