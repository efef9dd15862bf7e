"""The checks that every part uses: what passes, how values are described, and how commands end on an error."""

import warnings
from fractions import Fraction
from functools import partial

import numpy as np
import pytest
import torch
import typer

from unitouch_gen import errors
from unitouch_gen.errors import InvalidInputError, NonFiniteError, UnfamiliarInputWarning

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


@pytest.mark.parametrize("error", [InvalidInputError("a\nb"), NonFiniteError("a\nb"), typer.BadParameter("a\nb")])
def test_a_mistake_is_one_line_and_exit_code_2(error, capsys):
    app = typer.Typer()

    @app.command()
    def command() -> None:
        raise error

    with pytest.raises(SystemExit) as ended:
        errors.run_commands(app, "unitouch-gen", [])
    assert ended.value.code == 2
    out, err = capsys.readouterr()
    assert not out
    assert err.count("\n") == 1
    assert err.startswith("unitouch-gen: ")
    assert "a b" in err


def test_a_working_folder_that_was_deleted_is_one_line(tmp_path, monkeypatch, capsys):
    """torch would end the process as it is imported."""
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    with pytest.raises(SystemExit, match="2"):
        errors.run_commands(typer.Typer(), "unitouch-gen", [])
    assert capsys.readouterr().err.startswith("unitouch-gen: The working folder has been deleted; ")


def test_warnings_of_ours_are_lines_and_others_are_left_out(capsys):
    app = typer.Typer()

    @app.command()
    def command() -> None:
        warnings.warn("a touch", UnfamiliarInputWarning, stacklevel=2)
        warnings.warn_explicit("theirs", UserWarning, "file", 1, module="diffusers.models")

    errors.run_commands(app, "unitouch-gen", [])
    assert capsys.readouterr().err == "unitouch-gen: a touch\n"
