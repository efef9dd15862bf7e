"""Stiff and extreme cases: what is asked, what has to come out, within what bound, and a report of what did.

Every bound follows from the problem: a closed form, the order of a method, a number of roundings. What is worst is a
value that is not finite and comes out as if it were a result; it is counted, and is a failure whatever was expected.
The table itself is in `stability_suite`.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, check_choice, did_you_mean
from unitouch_gen.sampling import ReturnCode


@dataclass(frozen=True)
class Ended:
    """What a case came to: all that came out as a result, of several samples (b, ...) those that are said to be finite;
    the largest error, in the units of the case's bound; and return codes, where something is sampled."""

    output: Tensor
    error: float
    codes: Sequence[ReturnCode] = ()


@dataclass(frozen=True)
class Case:
    """What is asked, what has to come out, and within what bound.

    Attributes:
        name: What it is found by; no other case has it.
        ask: Function that does it.
        bound: Largest error, or a function that tells it; none where a code or an error says it all.
        because: Where the bound comes from.
        codes: That every sample has to end with, or one for each.
        raises: Error that has to be raised instead.
    """

    name: str
    ask: Callable[[], Ended]
    bound: float | Callable[[], float] = math.inf
    because: str = ""
    codes: ReturnCode | Sequence[ReturnCode] = ReturnCode.SUCCESS
    raises: type[ArithmeticError] | None = None

    @cached_property
    def limit(self) -> float:
        """The bound as a number."""
        return self.bound() if callable(self.bound) else self.bound

    @property
    def expected(self) -> str:
        """What has to come out: "success, error <= 0.002 (order 2)", without the number until it is known."""
        if self.raises is not None:
            return self.raises.__name__
        code = in_words([self.codes] if isinstance(self.codes, ReturnCode) else self.codes)
        if callable(self.bound) and "limit" not in vars(self):
            error = f"error bounded ({self.because})"
        else:
            error = "" if math.isinf(self.limit) else f"error <= {self.limit:.2g} ({self.because})"
        return ", ".join(filter(None, (code, error))) or "finite"


@dataclass(frozen=True)
class Outcome:
    """A row of the report: group, name and expectation of the case, what was seen, in words, its error (NaN for none),
    whether something that is not finite came out as a result, whether it is what was expected, and the seconds."""

    group: str
    name: str
    expected: str
    seen: str
    value: float
    silent: bool
    ok: bool
    seconds: float


def in_words(codes: Sequence[ReturnCode]) -> str:
    """ "success", or "success x 2, non_finite x 1" where they differ."""
    counts = {code: list(codes).count(code) for code in codes}
    if len(counts) == 1:
        return next(iter(counts)).value
    return ", ".join(f"{code.value} x {count}" for code, count in counts.items())


def choose(
    suite: Mapping[str, Sequence[Case]], groups: Sequence[str] = (), names: Sequence[str] = ()
) -> list[tuple[str, Case]]:
    """The cases of some groups, or with some names, each with its group; all of them where nothing is asked for.

    Raises:
        InvalidInputError: If there is no such group or case.
    """
    for group in groups:
        check_choice("group", group, suite)
    known = [case.name for cases in suite.values() for case in cases]
    for name in names:
        if name not in known:
            hint = did_you_mean(name, known)
            raise InvalidInputError(
                f"`only` is {name!r}, which is none; --list shows them.{f' {hint}' if hint else ''}"
            )
    return [
        (group, case)
        for group, cases in suite.items()
        for case in cases
        if (not groups or group in groups) and (not names or case.name in names)
    ]


def run_case(case: Case, group: str = "") -> Outcome:
    """Runs one case; one that raises what it should not has failed with that."""
    started = time.perf_counter()
    value, silent = math.nan, False
    try:
        with torch.no_grad():
            ended = case.ask()
    except Exception as error:  # whatever it is, the other cases are to run
        ok = case.raises is not None and isinstance(error, case.raises)
        seen = f"{'' if ok else 'raised '}{type(error).__name__}: {error}"
    else:
        codes, silent = list(ended.codes), not bool(torch.isfinite(ended.output).all())
        wanted = [case.codes] * len(codes) if isinstance(case.codes, ReturnCode) else list(case.codes)
        whole = not codes or len(ended.output) == sum(code.finite for code in codes)
        seen = in_words(codes) or "done"
        if silent:
            seen += ", but not finite"
        elif not whole:
            seen += f", but {len(ended.output)} came out"
        within = math.isinf(case.limit) or ended.error <= case.limit  # no error that is not known is
        ok = case.raises is None and not silent and whole and within and codes == wanted
        value = ended.error
    return Outcome(group, case.name, case.expected, seen, value, silent, ok, time.perf_counter() - started)


def summary(outcomes: Sequence[Outcome]) -> str:
    """One line."""
    wrong, silent = sum(not row.ok for row in outcomes), sum(row.silent for row in outcomes)
    seconds = sum(row.seconds for row in outcomes)
    return (
        f"{len(outcomes)} cases: {len(outcomes) - wrong} as expected, {wrong} not, {silent} silently not finite; "
        f"{seconds:.0f} s"
    )
