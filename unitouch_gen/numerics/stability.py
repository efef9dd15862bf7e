"""Stiff and extreme cases: what is asked, what has to come out, within what bound, and a report of what did.

Every bound follows from the problem: a closed form, the order of a method, a number of roundings. What is worst is a
value that is not finite and comes out as if it were a result; it is counted, and is a failure whatever was expected.
The table itself is in `stability_suite`.
"""

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, check_choice, did_you_mean
from unitouch_gen.sampling import ReturnCode


@dataclass(frozen=True)
class Ended:
    """What a case came to.

    Attributes:
        output: Everything that came out as a result; of several samples (b, ...), those that are said to be finite.
        error: The largest one, in the units of the case's bound.
        codes: Return code of each sample; none where nothing is sampled.
        indicator: The largest error that the report tells of.
    """

    output: Tensor
    error: float
    codes: Sequence[ReturnCode] = ()
    indicator: float = 0.0


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
        slow: Whether it takes about a second or more.
    """

    name: str
    ask: Callable[[], Ended]
    bound: float | Callable[[], float] = math.inf
    because: str = ""
    codes: ReturnCode | Sequence[ReturnCode] = ReturnCode.SUCCESS
    raises: type[ArithmeticError] | None = None
    slow: bool = False

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
        known = "limit" in vars(self) or not callable(self.bound)
        error = f"error <= {self.limit:.2g}" if known else "error bounded"
        unbounded = known and math.isinf(self.limit)
        return ", ".join(filter(None, (code, "" if unbounded else f"{error} ({self.because})")))


Suite = Mapping[str, Sequence[Case]]
"""Cases by group; no two share a name."""


@dataclass(frozen=True)
class Outcome:
    """A row of the report.

    Attributes:
        group, name, expected: Of the case.
        seen: What came out, in words.
        value: Its error; NaN for none.
        silent: Whether something that is not finite came out as a result.
        ok: Whether it is what was expected.
        seconds: That it took.
    """

    group: str
    name: str
    expected: str
    seen: str
    value: float
    silent: bool
    ok: bool
    seconds: float

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return {**asdict(self), "value": self.value if math.isfinite(self.value) else None}


def in_words(codes: Sequence[ReturnCode]) -> str:
    """ "success", or "success x 2, non_finite x 1" where they differ."""
    counts = {code: list(codes).count(code) for code in codes}
    if len(counts) == 1:
        return next(iter(counts)).value
    return ", ".join(f"{code.value} x {count}" for code, count in counts.items())


def choose(suite: Suite, groups: Sequence[str] = (), names: Sequence[str] = ()) -> dict[str, list[Case]]:
    """The cases of some groups, or with some names; all of them where nothing is asked for.

    Raises:
        InvalidInputError: If there is no such group or case, or two cases share a name.
    """
    known = [case.name for cases in suite.values() for case in cases]
    if len(known) > len(set(known)):
        twice = next(name for name in known if known.count(name) > 1)
        raise InvalidInputError(f"`suite` holds {twice!r} twice; give every case a name of its own.")
    for group in groups:
        check_choice("group", group, suite)
    for name in names:
        if name not in known:
            hint = did_you_mean(name, known)
            raise InvalidInputError(
                f"`only` is {name!r}, which is none; --list shows them.{f' {hint}' if hint else ''}"
            )
    chosen = {
        group: [case for case in cases if not names or case.name in names]
        for group, cases in suite.items()
        if not groups or group in groups
    }
    return {group: cases for group, cases in chosen.items() if cases}


def run_cases(suite: Suite) -> Iterator[Outcome]:
    """Runs cases one after the other; one that raises what it should not has failed with that."""
    for group, cases in suite.items():
        for case in cases:
            started = time.perf_counter()
            seen, value, silent, ok = run_case(case)
            yield Outcome(group, case.name, case.expected, seen, value, silent, ok, time.perf_counter() - started)


def run_case(case: Case) -> tuple[str, float, bool, bool]:
    """What came out in words, its error, whether it is silently not finite, and whether it is as expected."""
    try:
        with torch.no_grad():
            ended = case.ask()
    except Exception as error:  # whatever it is, the other cases are to run
        expected = case.raises is not None and isinstance(error, case.raises)
        return f"{'' if expected else 'raised '}{type(error).__name__}: {error}", math.nan, False, expected
    codes, finite = list(ended.codes), bool(torch.isfinite(ended.output).all())
    wanted = [case.codes] * len(codes) if isinstance(case.codes, ReturnCode) else list(case.codes)
    whole = not codes or len(ended.output) == sum(code.finite for code in codes)
    words = in_words(codes) or "done"
    if not finite:
        words = f"{words}, but not finite"
    elif not whole:
        words = f"{words}, but {len(ended.output)} came out"
    within = math.isinf(case.limit) or ended.error <= case.limit  # no error that is not known is
    return words, ended.error, not finite, case.raises is None and finite and whole and within and codes == wanted


def summary(outcomes: Sequence[Outcome]) -> str:
    """One line."""
    wrong, silent = sum(not row.ok for row in outcomes), sum(row.silent for row in outcomes)
    seconds = sum(row.seconds for row in outcomes)
    return (
        f"{len(outcomes)} cases: {len(outcomes) - wrong} as expected, {wrong} not, {silent} silently not finite; "
        f"{seconds:.0f} s"
    )
