"""How many files a reader of one call has to open."""

import torch

from tests.benchmarks.files_entered import functions_entered, one_call, without_networks
from unitouch_gen.conditioning import match_norm


def test_functions_are_counted_by_file():
    assert functions_entered(lambda: match_norm(torch.ones(1, 4), 2.0)) == {"conditioning.py": {"match_norm"}}


def test_networks_are_left_out():
    assert without_networks({"models/vit.py": {"forward"}, "sampling.py": {"sample"}}) == {"sampling.py": {"sample"}}


def test_a_call_enters_few_files():
    assert len(without_networks(one_call())) <= 12
