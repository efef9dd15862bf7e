"""The world's collections, rendered once to disk and read as arrays."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset
from tqdm.auto import tqdm

from unitouch_gen.encoders.processing import UniTouchProcessor
from unitouch_gen.errors import InvalidInputError, check_choice
from unitouch_gen.training.core import Batch
from unitouch_gen.training.folders import replace_folder
from unitouch_gen.world import COLLECTIONS, SAMPLE_RATE, World, contacts

CHUNK = 256
SETTINGS = "settings.json"


@dataclass
class Rendered:
    """One split of one collection, as memory-mapped arrays.

    Attributes:
        image, touch: uint8 (N, 3, S, S).
        audio: Log-mel clips, float16 (N, 1, mel_bins, frames).
        material, object: int64 (N,).
        text: N captions.
        sensor: The collection's.
    """

    image: np.ndarray
    touch: np.ndarray
    audio: np.ndarray
    material: np.ndarray
    object: np.ndarray
    text: list[str]
    sensor: str

    def __len__(self) -> int:
        return len(self.material)


def rendered(
    cache: Path,
    collection: str,
    split: str,
    contacts_per_object: int,
    processor: UniTouchProcessor,
    world_seed: int = 0,
) -> Rendered:
    """Renders a split if the cache does not hold it yet, and opens it.

    Args:
        cache: Folder of all rendered splits.
        collection: Name in `COLLECTIONS`.
        split: "train", "val" or "test".
        contacts_per_object: Contacts rendered of each object.
        processor: Its image size and log-mel settings are used.
        world_seed: Of the world.

    Raises:
        InvalidInputError: If there is no such collection, or the cache holds it rendered with other settings.
    """
    check_choice("collection", collection, COLLECTIONS)
    folder = Path(cache) / f"{collection}-{split}-{contacts_per_object}-seed{world_seed}"
    if not folder.is_dir():
        _render(folder, collection, split, contacts_per_object, processor, world_seed)
    stored = folder / SETTINGS
    if stored.is_file() and json.loads(stored.read_text()) != _settings(processor):
        raise InvalidInputError(
            f"`cache` holds {str(folder)!r}, rendered with other image or sound settings; delete it, or pass "
            "another cache."
        )
    load = partial(np.load, mmap_mode="r")
    return Rendered(
        image=load(folder / "image.npy"),
        touch=load(folder / "touch.npy"),
        audio=load(folder / "audio.npy"),
        material=np.load(folder / "material.npy"),
        object=np.load(folder / "object.npy"),
        text=json.loads((folder / "text.json").read_text()),
        sensor=COLLECTIONS[collection].sensor,
    )


def _settings(processor: UniTouchProcessor) -> dict[str, Any]:
    return {"image_size": processor.image_size, "audio": asdict(processor.audio)}


def _render(
    folder: Path, collection: str, split: str, contacts_per_object: int, processor: UniTouchProcessor, world_seed: int
) -> None:
    spec = COLLECTIONS[collection]
    size, mel = processor.image_size, processor.audio
    world = World(world_seed, image_size=size)
    material, object_, contact = contacts(spec, split, contacts_per_object)
    count = len(material)
    partial_folder = folder.with_name(folder.name + ".partial")
    partial_folder.mkdir(parents=True, exist_ok=True)

    def array(name: str, shape: tuple[int, ...], dtype: type) -> np.memmap:
        return np.lib.format.open_memmap(partial_folder / f"{name}.npy", mode="w+", dtype=dtype, shape=(count, *shape))

    image, touch = array("image", (3, size, size), np.uint8), array("touch", (3, size, size), np.uint8)
    audio = array("audio", (1, mel.mel_bins, mel.frames), np.float16)
    text: list[str] = []
    for start in tqdm(range(0, count, CHUNK), desc=folder.name, mininterval=5.0):
        rows = slice(start, min(start + CHUNK, count))
        scene = world.render(material[rows], object_[rows], contact[rows], sensors=(spec.sensor,), style=spec.style)
        assert scene.image is not None
        assert scene.audio is not None
        assert scene.text is not None
        image[rows] = (scene.image * 255).round().byte().numpy()
        touch[rows] = (scene.touch[spec.sensor] * 255).round().byte().numpy()
        # An impact is shorter than a clip, so all clips of it are the same one.
        audio[rows] = processor.sounds([(sound, SAMPLE_RATE) for sound in scene.audio])[:, 0].numpy()
        text += scene.text
    for values in (image, touch, audio):
        values.flush()
    np.save(partial_folder / "material.npy", material.numpy())
    np.save(partial_folder / "object.npy", object_.numpy())
    (partial_folder / "text.json").write_text(json.dumps(text))
    (partial_folder / SETTINGS).write_text(json.dumps(_settings(processor)))
    replace_folder(partial_folder, folder)


class ArrayDataset(Dataset):
    """Named arrays and tensors of one length, indexed together."""

    def __init__(self, **columns: np.ndarray | Tensor | Sequence[np.ndarray]):
        self.columns = {
            key: values if isinstance(values, np.ndarray | Tensor) else Stacked(values)
            for key, values in columns.items()
        }
        lengths = {key: len(values) for key, values in self.columns.items()}
        if len(set(lengths.values())) != 1:
            raise ValueError(f"`columns` have lengths {lengths}; they have to be the same.")
        self.length = next(iter(lengths.values()))

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, index: int) -> Batch:
        return {key: value[0] for key, value in self.__getitems__([index]).items()}

    def __getitems__(self, indices: list[int]) -> Batch:
        index = np.asarray(indices)
        return {
            key: values[torch.from_numpy(index)] if isinstance(values, Tensor) else torch.from_numpy(values[index])
            for key, values in self.columns.items()
        }


class Stacked:
    """Several arrays read as their concatenation, without copying them."""

    def __init__(self, parts: Sequence[np.ndarray]):
        self.parts = list(parts)
        self.starts = np.concatenate([[0], np.cumsum([len(part) for part in self.parts])])

    def __len__(self) -> int:
        return int(self.starts[-1])

    def __getitem__(self, index: np.ndarray) -> np.ndarray:
        which = np.searchsorted(self.starts, index, side="right") - 1
        rows = [self.parts[p][i - self.starts[p]] for p, i in zip(which, index, strict=True)]
        return np.stack(rows)
