"""Grasps: whether two fingers lift an object by a contact."""

from torch import Tensor


def grasp_margin(friction: Tensor, weight: Tensor, indentation_depth: Tensor, share: Tensor) -> Tensor:
    """Carried over needed force of grasps (N,), at a depth in mm and a share of the gel in contact.

    Coulomb: two fingers carry 2 mu F, with a normal force F that grows with depth and share. Above 1 they lift, as
    about two of three do at 3 N for each mm.
    """
    return 2.0 * friction * (3.0 * indentation_depth * share) / weight
