"""Cases of stiff and extreme input: what has to happen in each, what does, and a report of both.

A case ends as expected, is refused by the name of the argument, or has failed. What is worst is a value that is not
finite and comes out as if it were a result; it is counted, and is a failure whatever was expected.
"""

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, NonFiniteError, NotConvergedError, check_choice, did_you_mean
from unitouch_gen.sampling import ReturnCode


@dataclass(frozen=True)
class Seen:
    """What a case did.

    Attributes:
        ok: Whether that is what was expected.
        words: What it was.
        value: The figure that says so, of a solver its error; NaN for none.
        silent: Whether something that is not finite came out as a result.
    """

    ok: bool
    words: str
    value: float = math.nan
    silent: bool = False


@dataclass(frozen=True)
class Case:
    """A case, what has to happen, and how to try it."""

    name: str
    expected: str
    run: Callable[[], Seen]


Suite = Mapping[str, Sequence[Case]]
"""Cases by group; no two share a name."""


@dataclass(frozen=True)
class Outcome:
    """A row of the report; `value` and `silent` are those of `Seen`."""

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


# What cases are made of -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Ended:
    """A run of a solver or a pipeline that came to an end.

    Attributes:
        codes: Of each sample.
        output: Of the samples that are said to be finite, (b, ...).
        error: The largest relative error of those, where the truth is known.
        indicator: The largest one that the report gives of it.
    """

    codes: Sequence[ReturnCode]
    output: Tensor
    error: float = math.nan
    indicator: float = math.nan


def ends(
    name: str,
    run: Callable[[], Ended],
    code: ReturnCode | Sequence[ReturnCode] = ReturnCode.SUCCESS,
    bound: float = math.inf,
) -> Case:
    """A run has to end with a code, or one for each sample, and with an error that is known and within a bound."""
    expected = _words([code] if isinstance(code, ReturnCode) else code)

    def judge() -> Seen:
        ended = run()
        silent = not bool(torch.isfinite(ended.output).all())
        finite = sum(code.finite for code in ended.codes)
        wanted = [code] * len(ended.codes) if isinstance(code, ReturnCode) else list(code)
        words = _words(ended.codes)
        if silent:
            words = f"{words}, but not finite"
        elif len(ended.output) != finite:
            words = f"{words}, but {len(ended.output)} came out"
        within = math.isinf(bound) or ended.error <= bound
        ok = list(ended.codes) == wanted and len(ended.output) == finite and within and not silent
        return Seen(ok, words, ended.error, silent)

    return Case(name, expected if math.isinf(bound) else f"{expected}, error <= {bound:g}", judge)


def _words(codes: Sequence[ReturnCode]) -> str:
    """ "success", or "success, non_finite x 2" where they differ."""
    counts = {code: list(codes).count(code) for code in codes}
    if len(counts) == 1:
        return next(iter(counts)).value
    return ", ".join(f"{code.value} x {count}" for code, count in counts.items())


RAISED: dict[ReturnCode, type[ArithmeticError]] = {
    ReturnCode.NON_FINITE: NonFiniteError,
    ReturnCode.MAX_EVALUATIONS: NotConvergedError,
    ReturnCode.STEP_TOO_SMALL: NotConvergedError,
    ReturnCode.DIVERGED: NotConvergedError,
}
"""What a call raises in place of a code, unless it was told not to; of `DIVERGED` where it is beyond hope."""


def raises(name: str, call: Callable[[], Any], code: ReturnCode) -> Case:
    """A call has to raise the error of a code."""
    kind = RAISED[code]

    def judge() -> Seen:
        try:
            call()
        except kind as error:
            return Seen(True, f"{kind.__name__}: {error}")
        return Seen(False, "went ahead")

    return Case(name, f"{kind.__name__} ({code.value})", judge)


def refused(name: str, call: Callable[[], Any], named: str) -> Case:
    """A call has to be refused with a message that names the argument."""

    def judge() -> Seen:
        try:
            call()
        except (ValueError, TypeError) as error:
            # Python itself quotes an argument that is not there.
            return Seen(f"`{named}`" in str(error) or f"argument '{named}'" in str(error), f"refused: {error}")
        return Seen(False, "went ahead")

    return Case(name, f"refused: `{named}`", judge)


def largest_error(values: Tensor, truth: Tensor) -> float:
    """The largest relative RMS error of rows (B, ...); NaN of none."""
    if not len(values):
        return math.nan
    values, truth = values.double().flatten(1), truth.double().flatten(1)
    return ((values - truth).norm(dim=1) / truth.norm(dim=1)).max().item()


# Running them ---------------------------------------------------------------------------------------------------------


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
            try:
                with torch.no_grad():
                    seen = case.run()
            except Exception as error:  # whatever it is, the other cases are to run
                seen = Seen(False, f"raised {type(error).__name__}: {error}")
            seconds = time.perf_counter() - started
            ok = seen.ok and not seen.silent
            yield Outcome(group, case.name, case.expected, seen.words, seen.value, seen.silent, ok, seconds)


def summary(outcomes: Sequence[Outcome]) -> str:
    """One line."""
    wrong, silent = sum(not row.ok for row in outcomes), sum(row.silent for row in outcomes)
    seconds = sum(row.seconds for row in outcomes)
    return (
        f"{len(outcomes)} cases: {len(outcomes) - wrong} as expected, {wrong} not, {silent} silently not finite; "
        f"{seconds:.0f} s"
    )
