"""How good an answer is for the time it takes: exact problems, references, work-precision, stability."""

from unitouch_gen.numerics.cache import fingerprint
from unitouch_gen.numerics.exact import ExactNetwork, GaussianMixture
from unitouch_gen.numerics.flow import Flow, network_flow
from unitouch_gen.numerics.gaussian_flow import gaussian_flow
from unitouch_gen.numerics.problems import PROBLEMS, Problem, all_problems, make_problem
from unitouch_gen.numerics.reference import Reference, relative_rms, solve_reference

__all__ = [
    "PROBLEMS",
    "ExactNetwork",
    "Flow",
    "GaussianMixture",
    "Problem",
    "Reference",
    "all_problems",
    "fingerprint",
    "gaussian_flow",
    "make_problem",
    "network_flow",
    "relative_rms",
    "solve_reference",
]
