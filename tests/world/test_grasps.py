"""Grasps: Coulomb's law."""

import torch

from unitouch_gen.world import World
from unitouch_gen.world.scene import grasp_margin


def test_a_grasp_holds_by_coulombs_law_and_two_of_three_do() -> None:
    friction, weight, depth, share = torch.tensor([[0.5, 1.0], [3.0, 3.0], [1.5, 1.5], [0.4, 0.4]])
    force = 3.0 * depth * share  # of either finger, newton
    assert torch.equal(grasp_margin(friction, weight, depth, share) > 1.0, friction * force > weight / 2)
    names = torch.arange(17).repeat_interleave(30), torch.arange(30).repeat(17), torch.zeros(510, dtype=torch.int64)
    assert 0.5 < (World(1000, image_size=32).render(*names, modalities=("grasp",)).grasp > 1.0).float().mean() < 0.75
