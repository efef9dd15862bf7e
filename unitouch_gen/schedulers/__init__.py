"""Conditioning, solvers and the one guided sampling loop."""

from unitouch_gen.report import ReturnCode, RunReport
from unitouch_gen.schedulers.solvers import SOLVERS, Solver

__all__ = ["SOLVERS", "ReturnCode", "RunReport", "Solver"]
