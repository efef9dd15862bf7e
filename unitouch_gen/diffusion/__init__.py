"""Conditioning, solvers and the one guided sampling loop."""

from unitouch_gen.diffusion.report import ReturnCode, RunReport
from unitouch_gen.diffusion.solvers import SOLVERS, Solver

__all__ = ["SOLVERS", "ReturnCode", "RunReport", "Solver"]
