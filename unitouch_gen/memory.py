"""Peak memory of a piece of work, what is left for it, calls that need more, and the size of weights on disk."""

import ctypes
import math
import os
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

from unitouch_gen.errors import InvalidInputError, describe
from unitouch_gen.files import open_weights

RESET = Path("/proc/self/clear_refs")
"""Linux resets its record of the largest resident size on a 5 (proc_pid_clear_refs(5))."""

STATUS, MEMORY = Path("/proc/self/status"), Path("/proc/meminfo")


class PeakMemory:
    """The most memory held since this was made, above what was held then.

    On a GPU, what torch has allocated there; on a CPU under Linux, the resident size of the process, so what other
    threads allocate counts too. Both keep one record of their peak, which starts anew here: of two such measurements
    one inside the other, the outer one sees no more than the inner one and what comes after it.

    Args:
        device: Whose memory.
    """

    def __init__(self, device: torch.device | str = "cpu") -> None:
        self.device = torch.device(device)
        self.start: int | None = None
        if self.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self.device)
            self.start = torch.cuda.memory_allocated(self.device)
        elif self.device.type == "cpu":
            self.start = resident("VmRSS") if _reset() else None

    @property
    def extra(self) -> int | None:
        """Bytes; `None` where the system does not say."""
        if self.start is None:
            return None
        if self.device.type == "cuda":
            return max(torch.cuda.max_memory_allocated(self.device) - self.start, 0)
        peak = resident("VmHWM")
        return None if peak is None else max(peak - self.start, 0)


def resident(field: str) -> int | None:
    """Bytes of this process: "VmRSS" now, "VmHWM" at most since the last reset; `None` if the system does not say."""
    return _bytes(STATUS, field)


def free_memory(device: torch.device) -> int | None:
    """Bytes that a device may still give to this process; `None` if the system does not say.

    That of a CPU is the machine's: of a smaller bound that a container sets, nothing is known.
    """
    if device.type == "cuda":
        free, _ = torch.cuda.mem_get_info(device)
        return free + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return _bytes(MEMORY, "MemAvailable") if device.type == "cpu" else None


LEAST_MAPS = 8
"""Feature maps of full size and first width that a UNet holds at once, at least; of the built-in ones 10 to 20."""


def check_memory(unet: Any, rows: int, sides: tuple[int, int], device: torch.device) -> None:
    """Refuses latents that no memory can hold, before it is filled.

    Args:
        unet: Whose feature maps are what takes memory.
        rows: Samples, twice where guidance is on.
        sides: Of the latents.
        device: Where they go.

    Raises:
        InvalidInputError: If more is needed than the device has left.
    """
    width = unet.config.get("block_out_channels", (1,))[0]
    needed = LEAST_MAPS * rows * width * sides[0] * sides[1] * unet.dtype.itemsize
    free = free_memory(device)
    if free is not None and needed > free:
        raise InvalidInputError(
            f"This call needs {describe(-(-needed // 10**9))} GB of memory at least, and {free / 1e9:.3g} GB are free; "
            "ask for fewer or smaller pictures: `num_images_per_prompt`, `height`, `width`, or the inputs."
        )


def _bytes(file: Path, field: str) -> int | None:
    try:
        lines = file.read_text().splitlines()
    except OSError:
        return None
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith(f"{field}:")), None)


def _reset() -> bool:
    """Whether the record of the largest resident size starts anew."""
    try:
        RESET.write_text("5")
    except OSError:
        return False
    return True


def trim_memory() -> None:
    """Gives freed memory back to the system; glibc keeps what lay in pieces of up to 32 MB, as weights do."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None
    if trim is not None:
        trim(0)


@lru_cache
def values_in(folder: Path, prefix: str = "") -> int:
    """How many numbers the safetensors files of a folder hold under names that start with a prefix; reads none."""
    counts: dict[str, int] = {}  # a variant holds the same ones
    for path in sorted(folder.glob("*.safetensors")):
        with open_weights(path) as file:
            names = [name for name in file.keys() if name.startswith(prefix)]  # noqa: SIM118 - not a dict
            counts |= {name: math.prod(file.get_slice(name).get_shape()) for name in names}
    return sum(counts.values())
