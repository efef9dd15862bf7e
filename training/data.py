"""What stages are trained on: the world's collections, rendered once to disk, and what frozen models say of them."""

import hashlib
import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field, NonNegativeInt, PositiveInt, field_validator
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from tqdm.auto import tqdm

from unitouch_gen.errors import InvalidInputError, check_choice, describe
from unitouch_gen.files import allocate, complete_folder, replacing, writing_folder
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.training.recipe import Settings
from unitouch_gen.world import (
    COLLECTIONS,
    MATERIAL_NAMES,
    SAMPLE_RATE,
    TRAINING_COLLECTIONS,
    Collection,
    World,
    contacts,
)
from unitouch_gen.world.surfaces import BASE_RESOLUTION

Names = tuple[Tensor, Tensor, Tensor]
"""Material, object and contact, int64 (N,) each."""

CHUNK = 256
SETTINGS = "settings.json"


class DataConfig(Settings):
    """What a stage is trained on.

    Attributes:
        contacts_per_object: Contacts rendered of each object.
        collections: Names in `COLLECTIONS`; null stands for the four training collections.
        world_seed: Seed of the world.
        image_size: Side of the pictures, pixels, where no joint space says it.
        touch_size: Side of the touches, pixels; `image_size` if left out.
        audio: Fields of `LogMel`, where no joint space says them; the paper's if left out.
    """

    contacts_per_object: PositiveInt
    collections: tuple[str, ...] = TRAINING_COLLECTIONS
    world_seed: NonNegativeInt = 0
    image_size: int | None = None
    touch_size: Annotated[int, Field(ge=8)] | None = None
    audio: dict[str, Any] | None = None

    @field_validator("collections", mode="before")
    @classmethod
    def _known(cls, names: Any) -> tuple[str, ...]:
        names = TRAINING_COLLECTIONS if names is None else names
        if not isinstance(names, list | tuple) or not names:
            raise InvalidInputError(
                f"`collections` is {describe(names)}; it has to be a list of names, such as [world_digit], or null."
            )
        return tuple(check_choice("collections", name, COLLECTIONS) for name in names)


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
        fingerprint: That of the world it shows.
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


def rendered(cache: Path, collection: str, split: str, data: DataConfig, processor: UniTouchProcessor) -> Rendered:
    """Renders a split if the cache does not hold it yet, and opens it.

    Args:
        cache: Folder of all rendered splits; touches of another size than the pictures have a folder of their own.
        collection: Name in `COLLECTIONS`.
        split: "train", "val" or "test".
        data: Says how many contacts of which world, and the size of the touches.
        processor: Its image size and log-mel settings are used.

    Raises:
        InvalidInputError: If the cache holds it rendered with other settings or from another world.
    """
    spec, size, seed = COLLECTIONS[collection], processor.image_size, data.world_seed
    names = contacts(spec, split, data.contacts_per_object)
    world = fingerprint(spec, names, seed)
    render = partial(_render, spec, names, seed)
    folder = touches = Path(cache) / f"{collection}-{split}-{data.contacts_per_object}-seed{seed}"
    settings = {"world": world, "image_size": size, "audio": asdict(processor.audio)}
    _render_once(folder, settings, partial(render, size, processor))
    if data.touch_size not in (None, size):
        touches = folder.with_name(f"{folder.name}-touch{data.touch_size}")
        _render_once(touches, {"world": world, "touch_size": data.touch_size}, partial(render, data.touch_size, None))
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
    assert scene.image is not None and scene.audio is not None and scene.text is not None
    digest = hashlib.sha256("\n".join(scene.text).encode())
    for part in names:
        digest.update(part.numpy().tobytes())
    for values, levels in ((scene.image, 255), (scene.touch[spec.sensor], 255), (scene.audio, 32767)):
        digest.update((values * levels).round().short().numpy().tobytes())
    return digest.hexdigest()[:16]


def _render_once(folder: Path, settings: dict[str, Any], render: Callable[[Path], None]) -> None:
    """Renders into a folder that is not there; refuses one that holds something else."""
    complete_folder(folder)
    if not folder.is_dir():
        with writing_folder("cache", folder.parent, replace=True) as place:
            (place / folder.name).mkdir()
            render(place / folder.name)
            (place / folder.name / SETTINGS).write_text(json.dumps(settings))
    stored = folder / SETTINGS
    if not stored.is_file() or json.loads(stored.read_text()) != settings:
        raise InvalidInputError(
            f"`cache` holds {str(folder)!r}, rendered with other image or sound settings or from another world; delete "
            "it, or pass another cache."
        )


def _render(
    spec: Collection, names: Names, world_seed: int, size: int, processor: UniTouchProcessor | None, folder: Path
) -> None:
    """Writes touches, and with a processor all that goes with them, in chunks."""
    count = len(names[0])
    world = World(world_seed, image_size=size, resolution=size * math.ceil(BASE_RESOLUTION / size))  # the least it can

    def create(name: str, dtype: type, *shape: int) -> np.memmap:
        array = np.lib.format.open_memmap(folder / f"{name}.npy", mode="w+", dtype=dtype, shape=(count, *shape))
        allocate(folder / f"{name}.npy", array.offset + array.nbytes)
        return array

    arrays, text = {"touch": create("touch", np.uint8, 3, size, size)}, list[str]()
    if processor is not None:
        arrays["image"] = create("image", np.uint8, 3, size, size)
        arrays["audio"] = create("audio", np.float16, 1, processor.audio.mel_bins, processor.audio.frames)
    wanted = ("touch",) if processor is None else (*arrays, "text")
    for start in tqdm(range(0, count, CHUNK), desc=folder.stem, mininterval=5.0):
        rows = slice(start, start + CHUNK)
        chunk = (part[rows] for part in names)
        scene = world.render(*chunk, modalities=wanted, sensors=(spec.sensor,), style=spec.style)
        arrays["touch"][rows] = _bytes(scene.touch[spec.sensor])
        if processor is not None:
            assert scene.image is not None and scene.audio is not None and scene.text is not None
            arrays["image"][rows] = _bytes(scene.image)
            # An impact is shorter than a clip, so all clips of it are the same one.
            arrays["audio"][rows] = processor.sounds([(sound, SAMPLE_RATE) for sound in scene.audio])[:, 0].numpy()
            text += scene.text
    for values in arrays.values():
        values.flush()
    if processor is not None:
        np.save(folder / "material.npy", names[0].numpy())
        np.save(folder / "object.npy", names[1].numpy())
        (folder / "text.json").write_text(json.dumps(text))


def _bytes(pixels: Tensor) -> np.ndarray:
    return (pixels * 255).round().byte().numpy()


# What frozen models say of the data -----------------------------------------------------------------------------------


@torch.no_grad()
def image_embeddings(
    model: UniTouchModel, images: list[np.ndarray], key: str, cache: Path, batch_size: int = 256
) -> Tensor:
    """Frozen image embeddings (N, D) of uint8 pictures (n, 3, S, S), computed once for each state of the encoder.

    The file in `cache` is named by `key`, for the pictures, and by the encoder's weights.
    """
    model.load("image")
    model.eval()

    def embed(pixels: Tensor) -> Tensor:
        return model.get_image_features(normalise_pixels(pixels.float() / 255).to(model.device)).cpu()

    file = Path(cache) / f"image-embeddings-{key}-{weights_hash(model.vision_model)}.safetensors"
    return computed_once(file, embed, images, batch_size)


def computed_once(file: Path, compute: Callable[[Tensor], Tensor], images: list[np.ndarray], batch_size: int) -> Tensor:
    """What `compute` makes of uint8 pictures, batch by batch; read from the file if it is there, else written to it."""
    if file.is_file():
        return load_file(file)["values"]
    rows = []
    for array in images:
        for start in tqdm(range(0, len(array), batch_size), desc=file.stem, mininterval=5.0, leave=False):
            rows.append(compute(torch.from_numpy(np.array(array[start : start + batch_size]))))
    values = torch.cat(rows)
    with replacing("cache", file) as partial:
        save_file({"values": values.contiguous()}, partial)
    return values


def weights_hash(module: nn.Module) -> str:
    """Sixteen hexadecimal digits that change whenever a weight does."""
    digest = hashlib.sha256()
    for name, tensor in sorted(module.state_dict().items()):
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().contiguous().float().numpy().tobytes())
    return digest.hexdigest()[:16]
