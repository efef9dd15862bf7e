"""What the conversion of the published checkpoints takes: `python -m tests.benchmarks.conversion --folder DIR`.

The files are of random weights in the published layout and size, 1.4 billion parameters in the two of them.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

import unitouch_gen.models  # noqa: F401  (before `convert`, which it reads from)
from tests.benchmarks import Figures
from tests.benchmarks.apart import in_own_process
from unitouch_gen.convert.unitouch import FILES, convert_published, published_name, shapes_of
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.memory import PeakMemory
from unitouch_gen.models import UniTouchConfig, UniTouchModel


def write_published(file: Path, modalities: Sequence[str], config: UniTouchConfig, seed: int = 0) -> int:
    """A file of random weights in the published layout.

    Args:
        file: To write.
        modalities: In it.
        config: Of the encoders.
        seed: Of the weights.

    Returns:
        How many parameters it has.
    """
    generator = torch.Generator().manual_seed(seed)
    state = {}
    for modality in modalities:
        for key, shape in shapes_of(config, modality).items():
            source, rule = published_name(modality, key)
            state[source] = 0.02 * torch.randn(rule.shape(shape), generator=generator)
    torch.save(state, file)
    return sum(tensor.numel() for tensor in state.values())


def convert(folder: Path, **settings: Any) -> None:
    convert_published(folder / "converted", **settings)


def read(folder: Path, **settings: Any) -> None:
    UniTouchModel.from_published(**settings)


WAYS = {"conversion": convert, "reading": read}
"""Of published files into safetensors, and into memory."""


def measure(way: str, folder: Path) -> dict[str, float]:
    """Seconds and peak megabytes of one of `WAYS` in this process, of the files in a folder.

    Raises:
        InvalidInputError: If the system does not say how much memory is held.
    """
    files = {name: folder / f"{name}.pth" for name in FILES}
    memory, started = PeakMemory(), time.perf_counter()
    WAYS[way](folder, **files, config=UniTouchConfig.from_pretrained(folder), told=lambda line: None)
    seconds = time.perf_counter() - started
    if memory.extra is None:
        raise InvalidInputError("Peaks of memory are known under Linux alone; measure them there.")
    return {"seconds": seconds, "megabytes": memory.extra / 1e6}


def conversion_figures(scratch: Path | None = None, config: UniTouchConfig | None = None) -> Figures:
    """Parameters and megabytes of the files; seconds of conversion and of reading, and peaks over the largest file.

    Args:
        scratch: Folder for files of 11 GB, on a disk; the system's for temporary files when left out.
        config: Of encoders of another size than the published one.
    """
    config = UniTouchConfig() if config is None else config
    with tempfile.TemporaryDirectory(dir=scratch) as place:
        folder = Path(place)
        config.save_pretrained(folder)
        parameters = {
            name: write_published(folder / f"{name}.pth", modalities, config) for name, modalities in FILES.items()
        }
        sizes = {name: (folder / f"{name}.pth").stat().st_size / 1e6 for name in FILES}
        found = {way: in_own_process("tests.benchmarks.conversion", "--measure", way, str(folder)) for way in WAYS}
    return {
        "parameters": parameters,
        "megabytes_of_files": sizes,
        **{way: {**seen, "share_of_largest": seen["megabytes"] / max(sizes.values())} for way, seen in found.items()},
    }


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.conversion")
    parser.add_argument("--folder", type=Path, help="for the files, on a disk with 11 GB free")
    parser.add_argument("--measure", nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    way, folder = arguments.measure or (None, arguments.folder)
    print(json.dumps(measure(way, Path(folder)) if way else conversion_figures(folder)))


if __name__ == "__main__":
    main()
