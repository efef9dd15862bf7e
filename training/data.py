"""The world's collections, rendered once to disk and read as arrays."""

import hashlib
import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset
from tqdm.auto import tqdm

from unitouch_gen.errors import InvalidInputError, check_choice
from unitouch_gen.files import replacing_folder, restore_folder
from unitouch_gen.models.processing import UniTouchProcessor
from unitouch_gen.world import COLLECTIONS, MATERIAL_NAMES, SAMPLE_RATE, Collection, Scene, World, contacts
from unitouch_gen.world.fields import BASE_RESOLUTION

Batch = dict[str, Tensor]
Names = tuple[Tensor, Tensor, Tensor]
"""Material, object and contact, int64 (N,) each."""

CHUNK = 256
SETTINGS = "settings.json"


@dataclass
class Rendered:
    """One split of one collection, as memory-mapped arrays.

    Attributes:
        image: uint8 (N, 3, S, S).
        touch: uint8 (N, 3, T, T).
        audio: Log-mel clips, float16 (N, 1, mel_bins, frames).
        material, object: int64 (N,).
        text: N captions.
        sensor: The collection's.
        fingerprint: Of the world it shows.
    """

    image: np.ndarray
    touch: np.ndarray
    audio: np.ndarray
    material: np.ndarray
    object: np.ndarray
    text: list[str]
    sensor: str
    fingerprint: str

    def __len__(self) -> int:
        return len(self.material)


def rendered(
    cache: Path,
    collection: str,
    split: str,
    contacts_per_object: int,
    processor: UniTouchProcessor,
    world_seed: int = 0,
    touch_size: int | None = None,
) -> Rendered:
    """Renders a split if the cache does not hold it yet, and opens it.

    Args:
        cache: Folder of all rendered splits.
        collection: Name in `COLLECTIONS`.
        split: "train", "val" or "test".
        contacts_per_object: Contacts rendered of each object.
        processor: Its image size and log-mel settings are used.
        world_seed: Of the world.
        touch_size: Side T of the touches, pixels; those of another size than the pictures have a folder of their own.

    Raises:
        InvalidInputError: If there is no such collection, or the cache holds it rendered with other settings or from
            another world.
    """
    check_choice("collection", collection, COLLECTIONS)
    spec, names = COLLECTIONS[collection], contacts(COLLECTIONS[collection], split, contacts_per_object)
    world = fingerprint(spec, names, world_seed)
    folder = Path(cache) / f"{collection}-{split}-{contacts_per_object}-seed{world_seed}"
    settings = {"world": world, "image_size": processor.image_size, "audio": asdict(processor.audio)}
    _render_once(folder, settings, partial(_render, spec, names, processor, world_seed))
    touches = folder
    if touch_size not in (None, processor.image_size):
        touches = folder.with_name(f"{folder.name}-touch{touch_size}")
        settings = {"world": world, "touch_size": touch_size}
        _render_once(touches, settings, partial(_render_touches, spec, names, touch_size, world_seed))
    load = partial(np.load, mmap_mode="r")
    return Rendered(
        image=load(folder / "image.npy"),
        touch=load(touches / "touch.npy"),
        audio=load(folder / "audio.npy"),
        material=np.load(folder / "material.npy"),
        object=np.load(folder / "object.npy"),
        text=json.loads((folder / "text.json").read_text()),
        sensor=spec.sensor,
        fingerprint=world,
    )


def fingerprint(spec: Collection, names: Names, world_seed: int) -> str:
    """Sixteen hexadecimal digits that change when the world does: of the names, and of a contact of each material."""
    count = len(names[0])
    rows = torch.arange(0, count, max(count // len(MATERIAL_NAMES), 1))
    scene = World(world_seed).render(*(part[rows] for part in names), sensors=(spec.sensor,), style=spec.style)
    assert scene.image is not None
    assert scene.audio is not None
    assert scene.text is not None
    digest = hashlib.sha256("\n".join(scene.text).encode())
    for part in names:
        digest.update(part.numpy().tobytes())
    for values, levels in ((scene.image, 255), (scene.touch[spec.sensor], 255), (scene.audio, 32767)):
        digest.update((values * levels).round().short().numpy().tobytes())
    return digest.hexdigest()[:16]


def _render_once(folder: Path, settings: dict[str, Any], render: Callable[[Path], None]) -> None:
    """Renders into a folder that is not there; refuses one that holds something else."""
    restore_folder(folder)
    if not folder.is_dir():
        with replacing_folder(folder) as partial:
            render(partial)
            (partial / SETTINGS).write_text(json.dumps(settings))
    stored = folder / SETTINGS
    if not stored.is_file() or json.loads(stored.read_text()) != settings:
        raise InvalidInputError(
            f"`cache` holds {str(folder)!r}, rendered with other image or sound settings or from another world; delete "
            "it, or pass another cache."
        )


def _render(spec: Collection, names: Names, processor: UniTouchProcessor, world_seed: int, folder: Path) -> None:
    size, mel, count = processor.image_size, processor.audio, len(names[0])
    image, touch = (_array(folder / f"{name}.npy", (count, 3, size, size), np.uint8) for name in ("image", "touch"))
    audio = _array(folder / "audio.npy", (count, 1, mel.mel_bins, mel.frames), np.float16)
    text: list[str] = []
    for rows, scene in _scenes(spec, names, size, world_seed, ("image", "touch", "audio", "text"), folder.stem):
        assert scene.image is not None
        assert scene.audio is not None
        assert scene.text is not None
        image[rows] = _bytes(scene.image)
        touch[rows] = _bytes(scene.touch[spec.sensor])
        # An impact is shorter than a clip, so all clips of it are the same one.
        audio[rows] = processor.sounds([(sound, SAMPLE_RATE) for sound in scene.audio])[:, 0].numpy()
        text += scene.text
    for values in (image, touch, audio):
        values.flush()
    np.save(folder / "material.npy", names[0].numpy())
    np.save(folder / "object.npy", names[1].numpy())
    (folder / "text.json").write_text(json.dumps(text))


def _render_touches(spec: Collection, names: Names, size: int, world_seed: int, folder: Path) -> None:
    touch = _array(folder / "touch.npy", (len(names[0]), 3, size, size), np.uint8)
    for rows, scene in _scenes(spec, names, size, world_seed, ("touch",), folder.stem):
        touch[rows] = _bytes(scene.touch[spec.sensor])
    touch.flush()


def _scenes(
    spec: Collection, names: Names, size: int, world_seed: int, modalities: tuple[str, ...], label: str
) -> Iterator[tuple[slice, Scene]]:
    """The contacts in chunks, with the rows each is of."""
    resolution = size * math.ceil(BASE_RESOLUTION / size)  # the least that the world can render at this size
    world = World(world_seed, image_size=size, resolution=resolution)
    for start in tqdm(range(0, len(names[0]), CHUNK), desc=label, mininterval=5.0):
        rows = slice(start, start + CHUNK)
        chunk = (part[rows] for part in names)
        yield rows, world.render(*chunk, modalities=modalities, sensors=(spec.sensor,), style=spec.style)


def _array(file: Path, shape: tuple[int, ...], dtype: type) -> np.memmap:
    return np.lib.format.open_memmap(file, mode="w+", dtype=dtype, shape=shape)


def _bytes(pixels: Tensor) -> np.ndarray:
    return (pixels * 255).round().byte().numpy()


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
