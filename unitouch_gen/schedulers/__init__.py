"""The noise schedule as one continuous curve, solvers by name and steps to a tolerance."""

from unitouch_gen.schedulers.solvers import SOLVERS, Solver

__all__ = ["SOLVERS", "Solver"]
