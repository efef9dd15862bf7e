"""Work that is done once: columns that are decoded or rendered to files, and what frozen models say of them."""

import hashlib
import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from tqdm.auto import tqdm
from tqdm.contrib.concurrent import thread_map

from unitouch_gen.errors import first_line
from unitouch_gen.files import natural, replacing, writing_folder
from unitouch_gen.models import UniTouchModel
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.training.data.sets import RecordSet


def for_each(call: Callable[[int], object], data: RecordSet, quiet: bool = False) -> dict[int, str]:
    """Calls with the number of each record, in threads, and returns why some cannot be read.

    They go in the order of their files, and neighbours to one thread, as a video is read forwards.
    """
    order = sorted(range(len(data)), key=lambda row: natural(str(data.records[row].touch)))
    broken: dict[int, str] = {}

    def call_some(rows: list[int]) -> None:
        for row in rows:
            try:
                call(row)
            except (OSError, ValueError) as error:
                broken[row] = first_line(error)

    blocks = [order[start : start + 64] for start in range(0, len(order), 64)]
    thread_map(call_some, blocks, desc=str(data), unit="64 records", disable=quiet)
    return dict(sorted(broken.items()))


Arrays = dict[str, np.memmap]


def mapped(
    folder: Path, count: int, columns: Mapping[str, tuple[Any, ...]], write: Callable[[Arrays, Path], None]
) -> Arrays:
    """Arrays of `count` rows in the .npy files of a folder; `write` fills them where there is no such folder yet.

    `columns` gives dtype and shape of a row by name. What `write` puts beside the arrays is kept with them.
    """
    if not folder.is_dir():
        with writing_folder("cache", folder) as place:
            arrays: Arrays = {}
            for name, (dtype, *shape) in columns.items():
                file = place / f"{name}.npy"
                arrays[name] = np.lib.format.open_memmap(file, mode="w+", dtype=dtype, shape=(count, *shape))
                if hasattr(os, "posix_fallocate"):  # a disk that is found to be full later would end the process
                    with file.open("r+b") as stream:
                        os.posix_fallocate(stream.fileno(), 0, arrays[name].offset + arrays[name].nbytes)
            write(arrays, place)
            for array in arrays.values():
                array.flush()
    return {name: np.load(folder / f"{name}.npy", mmap_mode="r") for name in columns}


def computed_once(
    file: Path, compute: Callable[[Tensor], Tensor], images: Iterable[np.ndarray], batch_size: int
) -> Tensor:
    """What `compute` makes of uint8 pictures, batch by batch; read from the file if it is there, else written to it."""
    if file.is_file():
        return load_file(file)["values"]
    parts = (array[start : start + batch_size] for array in images for start in range(0, len(array), batch_size))
    bar = tqdm(parts, desc=file.stem, mininterval=5.0, leave=False)
    values = torch.cat([compute(torch.from_numpy(np.array(part))) for part in bar])
    with replacing("cache", file) as partial:
        save_file({"values": values.contiguous()}, partial)
    return values


@torch.no_grad()
def image_embeddings(
    model: UniTouchModel, images: list[np.ndarray], key: str, cache: Path, batch_size: int = 256
) -> Tensor:
    """Frozen embeddings (N, D) of uint8 pictures (n, 3, S, S), named by `key`, once for each state of the encoder."""
    model.load("image")
    model.eval()

    def embed(pixels: Tensor) -> Tensor:
        return model.get_image_features(normalise_pixels(pixels.float() / 255).to(model.device)).cpu()

    file = Path(cache) / f"image-embeddings-{key}-{weights_hash(model.vision_model)}.safetensors"
    return computed_once(file, embed, images, batch_size)


def weights_hash(module: nn.Module) -> str:
    """Sixteen hexadecimal digits that change whenever a weight does."""
    digest = hashlib.sha256()
    for name, tensor in sorted(module.state_dict().items()):
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().contiguous().float().numpy().tobytes())
    return digest.hexdigest()[:16]
