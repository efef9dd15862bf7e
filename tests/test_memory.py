"""Peak memory of a piece of work, against allocations of known size."""

import pytest
import torch

from unitouch_gen import memory
from unitouch_gen.memory import PeakMemory, resident, trim_memory

MEGABYTE = 1_000_000

linux = pytest.mark.skipif(resident("VmHWM") is None, reason="the system does not say")


@linux
def test_the_peak_is_what_was_allocated_and_freed_again():
    trim_memory()  # or what lies free in this process already is taken
    peak = PeakMemory()
    values = torch.ones(64 * MEGABYTE // 4)
    del values
    assert 60 * MEGABYTE < peak.extra < 80 * MEGABYTE


@linux
def test_what_was_held_before_does_not_count():
    values = torch.ones(64 * MEGABYTE // 4)
    assert PeakMemory().extra < 8 * MEGABYTE
    del values


@linux
def test_the_peak_before_does_not_count():
    values = torch.ones(64 * MEGABYTE // 4)
    del values
    assert PeakMemory().extra < 8 * MEGABYTE


def test_a_system_that_does_not_say_gives_none(monkeypatch, tmp_path):
    monkeypatch.setattr(memory, "STATUS", tmp_path / "status")
    monkeypatch.setattr(memory, "RESET", tmp_path / "nowhere" / "clear_refs")
    assert PeakMemory().extra is None


def test_a_device_of_another_kind_gives_none():
    assert PeakMemory("meta").extra is None


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_on_a_gpu_the_peak_is_what_torch_allocated():
    peak = PeakMemory("cuda")
    values = torch.ones(64 * MEGABYTE // 4, device="cuda")
    del values
    assert 64 * MEGABYTE <= peak.extra < 70 * MEGABYTE


@linux
def test_what_was_freed_in_pieces_goes_back_to_the_system():
    """The second time, as glibc then takes pieces of such a size from its heap, and what lies above them holds it."""
    held, above = resident("VmRSS"), []
    for _ in range(2):
        pieces = [torch.ones(2 * MEGABYTE // 4) for _ in range(64)]
        above.append(torch.ones(MEGABYTE // 40))
        del pieces
    trim_memory()
    assert resident("VmRSS") - held < 16 * MEGABYTE
