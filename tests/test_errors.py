"""The checks that every part uses: what passes, what is refused, and that messages name the argument."""

import math
from fractions import Fraction

import numpy as np
import pytest
import torch
import typer

from tests.helpers.odd_tensors import odd_tensors
from unitouch_gen.errors import (
    INTERRUPTED,
    InvalidInputError,
    InvalidTypeError,
    NonFiniteError,
    check_choice,
    check_choices,
    check_dense,
    check_device,
    check_dtype,
    check_finite,
    check_flag,
    check_integer,
    check_names,
    check_number,
    check_tensor,
    check_texts,
    describe,
    did_you_mean,
    run_commands,
)


def test_errors_are_the_kinds_users_catch() -> None:
    assert issubclass(InvalidInputError, ValueError)
    assert issubclass(InvalidTypeError, TypeError)
    assert issubclass(NonFiniteError, ArithmeticError)


@pytest.mark.parametrize("value", [1, 5, np.int64(3), np.uint8(2)])
def test_an_integer_within_range_passes_as_an_int(value: object) -> None:
    checked = check_integer("steps", value, 1, 5)
    assert checked == value
    assert type(checked) is int


@pytest.mark.parametrize("value", [0, 6, -(10**30)])
def test_an_integer_out_of_range_is_refused_by_name_and_range(value: int) -> None:
    with pytest.raises(InvalidInputError, match=rf"`steps` is {value}; it has to be an integer from 1 to 5\."):
        check_integer("steps", value, 1, 5)


def test_an_integer_without_an_upper_bound_may_be_any_size() -> None:
    assert check_integer("steps", 10**30, 1) == 10**30
    with pytest.raises(InvalidInputError, match="of at least 1"):
        check_integer("steps", 0, 1)


@pytest.mark.parametrize("value", [1.0, "1", None, True, [1], np.float64(2.0), np.bool_(True), torch.tensor(1)])
def test_what_is_no_integer_is_refused_by_name(value: object) -> None:
    with pytest.raises(InvalidTypeError, match=r"`steps` is .*it has to be an integer from 1 to 5"):
        check_integer("steps", value, 1, 5)


@pytest.mark.parametrize("value", [0, 0.5, 1.0, np.float32(0.25), np.int64(1)])
def test_a_number_within_range_passes_as_a_float(value: object) -> None:
    checked = check_number("strength", value, 0.0, 1.0)
    assert checked == value
    assert type(checked) is float


@pytest.mark.parametrize("value", [-1e-9, 1.0000001, 7])
def test_a_number_out_of_range_is_refused_by_name_and_range(value: float) -> None:
    with pytest.raises(InvalidInputError, match=r"`strength` is .* finite number from 0 to 1\."):
        check_number("strength", value, 0.0, 1.0)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, np.float32("nan")])
def test_a_number_that_is_not_finite_is_refused_whatever_the_range(value: float) -> None:
    with pytest.raises(InvalidInputError, match=r"`strength` is .*finite"):
        check_number("strength", value)


@pytest.mark.parametrize("value", ["0.5", None, False, 1j, [0.5], torch.tensor(0.5)])
def test_what_is_no_number_is_refused_by_name(value: object) -> None:
    with pytest.raises(InvalidTypeError, match="`strength`"):
        check_number("strength", value)


@pytest.mark.parametrize("value", [10**400, -(10**400), Fraction(10**400)])
def test_a_number_beyond_floats_is_refused_by_name(value: object) -> None:
    with pytest.raises(InvalidInputError, match=r"`strength` is .{1,90}; it has to be a finite number"):
        check_number("strength", value)


def test_a_fraction_is_a_number() -> None:
    assert check_number("strength", Fraction(3, 4), 0.0, 1.0) == 0.75


def test_an_integer_of_thousands_of_digits_is_refused_by_name() -> None:
    """Python writes none of them."""
    with pytest.raises(InvalidInputError, match=r"`steps` is a number of thousands of digits; it has to be"):
        check_integer("steps", 10**5000, 1, 5)
    with pytest.raises(InvalidInputError, match=r"`strength` is a number of thousands of digits"):
        check_number("strength", 10**5000)


def test_one_sided_ranges_are_worded() -> None:
    with pytest.raises(InvalidInputError, match="of at least 2"):
        check_number("x", 1, low=2.0)
    with pytest.raises(InvalidInputError, match="of at most 2"):
        check_number("x", 3, high=2.0)


def test_a_hint_ends_the_message() -> None:
    for check in (
        lambda: check_choice("x", "f", ("a", "b"), hint="Try 3."),
        lambda: check_integer("x", 9, 1, 5, hint="Try 3."),
        lambda: check_number("x", 9, 1, 5, hint="Try 3."),
    ):
        with pytest.raises(InvalidInputError, match=r"Try 3\.$"):
            check()


def test_a_choice_among_the_choices_passes() -> None:
    assert check_choice("solver", "heun", ("euler", "heun")) == "heun"


def test_choices_may_be_any_iterable() -> None:
    assert check_choice("solver", "heun", iter({"euler": 1, "heun": 2})) == "heun"


def test_another_choice_is_refused_with_all_and_the_nearest() -> None:
    with pytest.raises(InvalidInputError, match=r"`solver` is 'huen'.*'euler', 'heun'.*Did you mean 'heun'\?"):
        check_choice("solver", "huen", ("euler", "heun"))


@pytest.mark.parametrize(
    ("value", "meant"),
    [
        ("huen", "heun"),
        ("heum", "heun"),
        ("HEUN", "heun"),
        ("eular", "euler"),
        ("gelsigt", "gelsight"),
        ("GelSight", "gelsight"),
        ("gelsite", "gelsight"),
    ],
)
def test_a_typing_mistake_gets_a_suggestion(value: str, meant: str) -> None:
    assert did_you_mean(value, ("euler", "heun", "gelsight")) == f"Did you mean {meant!r}?"


@pytest.mark.parametrize("value", ["xyz", "gelslim", "duragel", "", None, 3])
def test_what_is_no_typing_mistake_gets_none(value: object) -> None:
    """A GelSlim is another sensor than a GelSight, however alike their names are."""
    assert did_you_mean(value, ("euler", "heun", "gelsight", "digit")) == ""
    with pytest.raises(InvalidInputError) as caught:
        check_choice("sensor", value, ("gelsight", "digit"))
    assert "Did you mean" not in str(caught.value)


@pytest.mark.parametrize("value", [None, 3, ["heun"], torch.zeros(2), np.zeros(2), {}])
def test_a_choice_that_is_no_string_is_refused_by_name(value: object) -> None:
    with pytest.raises(InvalidInputError, match=r"`solver` is .*one of"):
        check_choice("solver", value, ("euler", "heun"))


def test_finite_tensors_pass_untouched() -> None:
    tensor = torch.rand(3, 4)
    assert check_finite("latents", tensor) is tensor


@pytest.mark.parametrize(
    "tensor", [torch.zeros(0), torch.arange(3), torch.zeros(2, dtype=torch.bool), torch.rand(2).half()]
)
def test_finite_tensors_of_any_kind_pass(tensor: torch.Tensor) -> None:
    check_finite("latents", tensor)


ODD = odd_tensors(torch.rand(2, 5))


@pytest.mark.parametrize("kind", ODD)
def test_tensors_that_hold_no_numbers_one_by_one_are_refused_by_name(kind: str) -> None:
    with pytest.raises(InvalidTypeError, match=r"`latents` is a .*tensor.*; it has to be dense and hold real numbers"):
        check_dense("latents", ODD[kind])
    with pytest.raises(InvalidTypeError, match=r"`latents` is .*it has to be dense and hold floating-point numbers"):
        check_tensor("latents", ODD[kind], 2, 5)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_a_tensor_of_the_shape_wanted_passes_untouched(dtype: torch.dtype) -> None:
    tensor = torch.rand(2, 5).to(dtype).requires_grad_()
    assert check_tensor("latents", tensor, "B", 5) is tensor
    assert check_tensor("latents", tensor.T, 5, "B").shape == (5, 2)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int32, torch.uint64])
def test_integers_pass_where_they_are_wanted(dtype: torch.dtype) -> None:
    check_tensor("ids", torch.arange(3).to(dtype), 3, integers=True)


@pytest.mark.parametrize(
    "value", [None, 3, "x", [[1.0]], np.zeros((2, 5), np.float32), torch.zeros(2, 5).long(), torch.zeros(2, 5) > 0]
)
def test_what_is_no_tensor_of_floats_is_refused_by_name(value: object) -> None:
    with pytest.raises(InvalidTypeError, match=r"`latents` is .*; it has to be .* Try 3\."):
        check_tensor("latents", value, "B", 5, hint="Try 3.")


@pytest.mark.parametrize("shape", [(2, 6), (0, 5), (5,), (1, 2, 5), ()])
def test_another_shape_is_refused_with_the_one_wanted(shape: tuple[int, ...]) -> None:
    with pytest.raises(InvalidInputError, match=r"`latents` is .*; it has to be a tensor \(B, 5\)\. Try 3\."):
        check_tensor("latents", torch.zeros(shape), "B", 5, hint="Try 3.")


def test_values_are_looked_at_unless_told_otherwise() -> None:
    tensor = torch.full((2,), math.nan)
    assert check_tensor("latents", tensor, 2, finite=False) is tensor
    with pytest.raises(InvalidInputError, match=r"`latents` holds 2 of 2 values that are NaN"):
        check_tensor("latents", tensor, 2)


@pytest.mark.parametrize(("texts", "listed"), [("brick", ["brick"]), (("a", "粗い"), ["a", "粗い"])])
def test_texts_are_listed(texts: object, listed: list[str]) -> None:
    assert check_texts("text", texts) == listed


@pytest.mark.parametrize("texts", [None, 3, b"brick", ["a", 3], {"a"}, np.array(["a"])])
def test_what_is_no_text_is_refused_by_name(texts: object) -> None:
    with pytest.raises(InvalidTypeError, match=r"`text` is .*a string or a list of strings"):
        check_texts("text", texts)


@pytest.mark.parametrize("texts", ["rough \ud800 brick", ["a", b"brick \xff".decode(errors="surrogateescape")]])
def test_half_a_character_is_refused_by_name(texts: object) -> None:
    with pytest.raises(InvalidInputError, match=r"`text` is '.*\\u.*whose character 6 "):
        check_texts("text", texts)


@pytest.mark.parametrize("value", [0, 1, "no", None, [], np.bool_(True)])
def test_a_flag_is_a_boolean(value: object) -> None:
    assert check_flag("throw", True) is True
    with pytest.raises(InvalidTypeError, match=r"`throw` is .*True or False"):
        check_flag("throw", value)


@pytest.mark.parametrize("value", ["bfloat16", "torch.bfloat16", torch.bfloat16])
def test_a_dtype_may_be_a_word(value: object) -> None:
    assert check_dtype("dtype", value) is torch.bfloat16


@pytest.mark.parametrize(
    ("value", "error"),
    [("float3", InvalidInputError), ("int8", InvalidInputError), ("", InvalidInputError), (None, InvalidTypeError),
     (torch.int8, InvalidTypeError), (torch.float8_e4m3fn, InvalidTypeError), (np.float32, InvalidTypeError)],
)  # fmt: skip
def test_what_is_no_dtype_of_weights_is_refused_by_name(value: object, error: type[Exception]) -> None:
    with pytest.raises(error, match="`dtype` is"):
        check_dtype("dtype", value)


def test_values_that_are_not_finite_are_counted() -> None:
    tensor = torch.zeros(2, 5)
    tensor[0, 1], tensor[1, 2], tensor[1, 4] = math.nan, math.inf, -math.inf
    with pytest.raises(InvalidInputError, match="`latents` holds 3 of 10 values that are NaN or infinite"):
        check_finite("latents", tensor)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (torch.zeros(2, 3), "a tensor of shape (2, 3) and dtype float32"),
        (torch.zeros(2, 3, device="meta"), "a meta tensor of shape (2, 3) and dtype float32"),
        (torch.zeros(2, 3).to_sparse(), "a sparse_coo tensor of shape (2, 3) and dtype float32"),
        (ODD["nested"], "a nested tensor"),
        (np.zeros((4,), np.uint8), "an array of shape (4,) and dtype uint8"),
        (torch.nn.Linear(1, 1), "a Linear"),
        (np.float32, "the class float32"),
        (np.float32(1.5), "1.5"),
        (True, "True"),
        ("a", "'a'"),
        (None, "None"),
        (1.5, "1.5"),
        ([1, 2], "a list of 2"),
        ((1,), "a tuple of 1"),
        ({}, "a dict"),
    ],
)
def test_descriptions_say_what_came(value: object, text: str) -> None:
    assert describe(value) == text


def test_long_strings_are_cut_in_descriptions() -> None:
    assert len(describe("x" * 10_000)) <= 80


@pytest.mark.parametrize("value", [None, 3, "touch", [3], ["touch", None], np.array(["touch"]), torch.zeros(2)])
def test_what_is_no_list_of_strings_is_refused_by_name(value: object) -> None:
    with pytest.raises(InvalidTypeError, match=r"`set` is .*; it has to be a list of strings"):
        check_names("set", value)


def test_a_list_of_strings_may_be_empty() -> None:
    assert (check_names("set", ()), check_names("set", ("a", "b"))) == ([], ["a", "b"])


@pytest.mark.parametrize("value", [torch.tensor(2.0), torch.zeros(1).expand(10**12), ODD["mkldnn"]])
def test_tensors_are_no_list_of_names(value: torch.Tensor) -> None:
    """Some have no end, and others cannot be gone through."""
    with pytest.raises(InvalidTypeError, match=r"`modalities` is a .*tensor"):
        check_choices("modalities", value, ["touch"])


@pytest.mark.parametrize("value", ["brick", 2**63, 10**400, torch.zeros(2), None, [1]])
def test_what_is_no_device_is_refused_by_name(value: object) -> None:
    with pytest.raises(InvalidInputError, match="`device` is"):
        check_device("device", value)


def test_a_tensor_in_the_place_of_a_dtype_is_one_line() -> None:
    with pytest.raises(InvalidTypeError, match=r"`dtype` is a tensor of shape \(2, 16\)") as caught:
        check_dtype("dtype", torch.zeros(2, 16))
    assert "\n" not in str(caught.value)


def test_an_interrupted_command_says_that_it_was(capsys: pytest.CaptureFixture[str]) -> None:
    commands = typer.Typer()

    @commands.command()
    def work() -> None:
        raise KeyboardInterrupt

    assert run_commands(commands, "tool", []) == INTERRUPTED
    assert capsys.readouterr().err.strip() == "tool: stopped; what is written is whole."
