"""What stages are trained on: contacts of the built-in world and data sets, rendered or decoded once to disk, and what
frozen models say of them.

A split's pictures and touches are uint8 arrays (N, 3, S, S) in files of their own, mapped into memory: 150 kB an image
at 224 pixels, so 120,000 touches with their pictures take 36 GB, and 3 GB at 64 pixels. `data.stream` decodes at every
step instead, which takes no disk.
"""

import hashlib
import json
import re
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field, PositiveInt, field_validator
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from tqdm.auto import tqdm

from unitouch_gen.errors import InvalidInputError, first_of
from unitouch_gen.files import allocate, complete_folder, replacing, writing_folder
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.models.images import centre_rectangle, normalise_pixels
from unitouch_gen.training.data.decoding import Computed
from unitouch_gen.training.data.drawn import GROUP, DrawnConfig, DrawnContacts, DrawnGrasps, known_sensors
from unitouch_gen.training.data.kinds import open_dataset
from unitouch_gen.training.data.records import MATERIAL, Record, RecordSet, SplitBy
from unitouch_gen.training.recipe import Settings
from unitouch_gen.world import (
    ATTRIBUTES,
    CELLS,
    MAPS,
    SAMPLE_RATE,
)

SETTINGS = "settings.json"


class SetConfig(Settings):
    """A data set to train on: the arguments of `open_dataset`, and `split`, what keeps its training split apart."""

    path: str
    kind: str = "auto"
    split: SplitBy | None = None
    sensor: str | None = None
    materials: list[str] | None = None
    bgr: bool = False
    sampling_rate: PositiveInt | None = None
    patterns: dict[str, str] | None = None

    def read(self, split: str) -> list[RecordSet]:
        """The records of a split, a part for each sensor."""
        data = open_dataset(self.path, **self.model_dump(exclude={"path", "split"}))
        return data.split(split, self.split).by_sensor()

    def held_out(self, count: int) -> list[RecordSet]:
        """At most `count` records of each sensor that are not in the training split; none where all train."""
        for split in ("val", "test") if self.split != "none" else ():
            with suppress(InvalidInputError):  # it has no such split
                parts = [part.thinned(count) for part in self.read(split)]
                return [part for part in parts if len(part) > 1]
        return []


class DataConfig(Settings):
    """What a stage is trained on: data sets, the built-in world, or both.

    Attributes:
        sets: Data sets.
        drawn: Contacts of the world; none if left out.
        grasps: Sensors by which such contacts are felt as grasps, too: with pictures and captions of what came of them.
        stream: Whether data sets are decoded at every step, in place of once to disk.
        image_size: Side of the pictures, pixels, where no joint space says it.
        touch_size: Side of the touches, pixels; `image_size` if left out.
        audio: Fields of `LogMel`, where no joint space says them; the paper's if left out.
    """

    sets: list[SetConfig] = []
    drawn: DrawnConfig | None = None
    grasps: list[str | None] = []
    stream: bool = False
    image_size: int | None = None
    touch_size: Annotated[int, Field(ge=8)] | None = None
    audio: dict[str, Any] | None = None

    @field_validator("grasps")
    @classmethod
    def _known(cls, names: list[str | None]) -> list[str | None]:
        return known_sensors("grasps", names)

    def check_named(self) -> None:
        """Refuses data that name nothing.

        Raises:
            InvalidInputError: If there are neither sets nor drawn contacts, or grasps of no drawn ones.
        """
        if not self.sets and self.drawn is None:
            raise InvalidInputError(
                "`data` names nothing to train on; give it `sets`, a list such as [{path: FOLDER}], or `drawn`, such "
                "as {sensors: [null]}."
            )
        if self.grasps and self.drawn is None:
            raise InvalidInputError(
                "`data.grasps` are of `drawn` contacts, and there are none; remove it, or add these."
            )

    def sources(self) -> "list[Source]":
        """All there is to train on, yet to be rendered or decoded: contacts and data sets of one sensor each."""
        return [*self._drawn(), *(part for one in self.sets for part in one.read("train"))]

    def held_out(self, count: int) -> "list[Source]":
        """What nothing is trained on of each source; at most `count` records of each sensor of a data set."""
        return [*self._drawn(), *(part for one in self.sets for part in one.held_out(count))]

    def _drawn(self) -> "list[DrawnContacts]":
        return [] if self.drawn is None else self.drawn.sources(self.grasps)


Source = DrawnContacts | RecordSet


DRAWN = ("image", "touch", "second", "audio", "attributes", "maps")
"""Columns of drawn contacts that are rendered to files."""

ARRAYS = ("image", "touch", "audio", "material", "object", "second", "attributes", "maps", "untouched")
"""Columns of what is rendered that are arrays."""


@dataclass
class Rendered:
    """One split of drawn contacts, or of one sensor of a data set, as memory-mapped arrays.

    Attributes:
        image: uint8 (N, 3, S, S).
        touch: uint8 (N, 3, T, T).
        audio: Log-mel clips, float16 (N, 1, mel_bins, frames).
        material, object: int64 (N,); -1 where the material is not known.
        text: N captions.
        sensor: Its only one; `None` where each contact has drawn ones.
        fingerprint: That of the world it shows and the size of its images, or of the data set's records.
        second: Of drawn contacts, the touches by the second sensor of each, as `touch`.
        attributes: Of drawn contacts, what can be measured by either sensor, float32 (N, 2, 13); see `ATTRIBUTES`.
        maps: Of drawn contacts, the same in each part of the view, float16 (N, 2, 4, 8, 8); see `MAPS`.
        untouched: Of drawn contacts, what either sensor sees before, uint8 (N, 2, 3, S, S), the same for `GROUP` in a
            row; rendered when it is asked for.
    """

    image: np.ndarray
    touch: np.ndarray
    audio: np.ndarray
    material: np.ndarray
    object: np.ndarray
    text: list[str]
    sensor: str | None
    fingerprint: str
    second: np.ndarray | None = None
    attributes: np.ndarray | None = None
    maps: np.ndarray | None = None
    untouched: "np.ndarray | Computed | None" = None

    def __len__(self) -> int:
        return len(self.material)

    def thinned(self, count: int) -> "Rendered":
        """At most `count` of its samples, spread over all, in memory."""
        rows = np.unique(np.linspace(0, len(self) - 1, count).astype(int))
        columns = {name: getattr(self, name) for name in ARRAYS}
        taken: dict[str, Any] = {name: values[rows] for name, values in columns.items() if values is not None}
        return replace(self, **taken, text=[self.text[row] for row in rows])


def drawn(cache: Path, source: DrawnContacts, split: str, data: DataConfig, processor: UniTouchProcessor) -> Rendered:
    """Renders a split of the world if the cache does not hold it yet, and opens it.

    Raises:
        InvalidInputError: If the cache holds it rendered otherwise, or touches are to have a size of their own.
    """
    size = processor.image_size
    if data.touch_size not in (None, size):
        raise InvalidInputError(f"`touch_size` is {data.touch_size}; with drawn sensors it is that of the pictures.")
    shown = f"{source.fingerprint(split)}-{size}"
    names = source.contacts(split)
    folder = Path(cache) / f"{source.name}-{split}-{shown}"
    _render_once(folder, {"audio": asdict(processor.audio)}, partial(_render_drawn, source, split, size, processor))
    load = partial(np.load, mmap_mode="r")
    arrays = {name: load(folder / f"{name}.npy") for name in DRAWN}
    text = json.loads((folder / "text.json").read_text())
    behind = Computed(
        len(names[0]), (2, 3, size, size), np.uint8, lambda row: _bytes(source.untouched(split, size, row // GROUP))
    )
    return Rendered(
        **arrays,
        untouched=behind,
        material=names[0].numpy(),
        object=names[1].numpy(),
        text=text,
        sensor=source.sensor,
        fingerprint=shown,
    )


def _render_drawn(source: DrawnContacts, split: str, size: int, processor: UniTouchProcessor, folder: Path) -> None:
    count, mel = len(source.contacts(split)[0]), processor.audio
    create = partial(_create, folder, count)
    arrays = {name: create(name, np.uint8, 3, size, size) for name in ("image", "touch", "second")}
    arrays["audio"] = create("audio", np.float16, 1, mel.mel_bins, mel.frames)
    arrays["attributes"] = create("attributes", np.float32, 2, len(ATTRIBUTES))
    arrays["maps"] = create("maps", np.float16, 2, len(MAPS), CELLS, CELLS)
    text = list[str]()
    with tqdm(total=count, desc=source.name, mininterval=5.0) as bar:
        for rows, scene, seen in source.scenes(split, size):
            assert scene.image is not None and scene.audio is not None and scene.text is not None
            arrays["image"][rows] = _bytes(scene.image)
            arrays["touch"][rows], arrays["second"][rows] = (_bytes(touch) for touch in seen["touch"].unbind(dim=1))
            arrays["audio"][rows] = processor.sounds([(sound, SAMPLE_RATE) for sound in scene.audio])[:, 0].numpy()
            arrays["attributes"][rows], arrays["maps"][rows] = seen["attributes"].numpy(), seen["maps"].numpy()
            text += scene.text
            bar.update(len(scene.text))
    for values in arrays.values():
        values.flush()
    (folder / "text.json").write_text(json.dumps(text))


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


def _create(folder: Path, count: int, name: str, dtype: type, *shape: int) -> np.memmap:
    array = np.lib.format.open_memmap(folder / f"{name}.npy", mode="w+", dtype=dtype, shape=(count, *shape))
    allocate(folder / f"{name}.npy", array.offset + array.nbytes)
    return array


def _bytes(pixels: Tensor) -> np.ndarray:
    return (pixels * 255).round().byte().numpy()


# Data sets ------------------------------------------------------------------------------------------------------------

NEEDS: dict[str, Callable[[Record], Any]] = {
    "image": attrgetter("picture"),
    "touch": attrgetter("touch"),
    "audio": attrgetter("sound"),
    "text": attrgetter("caption"),
    "material": lambda record: record.labels.get(MATERIAL),
    "sensor": attrgetter("sensor"),
}
"""What a record has for each thing that a stage may need."""

LOOKED_AT = 8
"""Records whose files are read before a stage begins: the first, the last, and some between them."""


def columns_of(
    sources: Sequence[Source],
    cache: Path,
    config: DataConfig,
    processor: UniTouchProcessor,
    needs: Sequence[str],
    split: str = "train",
) -> list[Rendered]:
    """The columns of each source, after a look at what there is to be decoded.

    Args:
        sources: Of `DataConfig.sources`.
        cache: Folder of what is rendered and decoded.
        config: Says the sizes.
        processor: Its image size and log-mel settings are used.
        needs: Of `NEEDS`, what is going to be used; other columns of data sets stay empty.
        split: Of drawn contacts; data sets are of the records that they hold.

    Raises:
        InvalidInputError: If a data set lacks one of them, some file cannot be read, or the cache not be used.
    """
    names = material_names(sources) if "material" in needs else ()
    for data in (source for source in sources if isinstance(source, RecordSet)):
        lacking = [f"{need} for {r.id!r}" for need in needs for r in data.records if NEEDS[need](r) is None]
        if lacking or len(data) < 2:
            wrong = f"no {first_of(lacking, ', ')}" if lacking else "a single record, where two are the least"
            raise InvalidInputError(f"{data} has {wrong}; this stage needs {', '.join(needs)} of every record.")
        for row in np.unique(np.linspace(0, len(data) - 1, LOOKED_AT).astype(int)).tolist():
            for need, frame in (("image", "picture"), ("touch", "touch")):
                if need in needs:
                    data.read(row, frame)
    return [
        decoded(cache, source, config, processor, needs, names)
        if isinstance(source, RecordSet)
        else drawn(cache, source, split, config, processor)
        for source in sources
    ]


def decoded(
    cache: Path,
    data: RecordSet,
    config: DataConfig,
    processor: UniTouchProcessor,
    needs: Sequence[str],
    materials: Sequence[str] = (),
) -> Rendered:
    """Decodes what is needed of the records of one sensor, if the cache does not hold it yet, and opens it.

    Its materials are numbered by their places in `materials`; see `columns_of` for the other arguments.
    """

    prints: list[str] = []

    def column(name: str, files: Sequence[Any], row: Callable[[int], np.ndarray], dtype: type, *shape: int) -> Any:
        computed = Computed(len(data), shape, dtype, row)
        paths = [str(getattr(file, "path", file)) for file in files]
        sizes = {path: Path(path).stat().st_size for path in set(paths)}
        listed = [f"{file} {sizes[path]}" for file, path in zip(files, paths, strict=True)]
        prints.append(_digest([name, str(shape), *listed]))
        if config.stream:
            return computed
        folder = Path(cache) / f"{re.sub(r'[^A-Za-z0-9_-]+', '_', data.name)}-{name}-{prints[-1]}"

        def fill(place: Path) -> None:
            array = _create(place, len(data), "values", dtype, *shape)
            computed.fill(array, files, folder.name)
            array.flush()

        _render_once(folder, {}, fill)
        return np.load(folder / "values.npy", mmap_mode="r")

    def pixels(frame: str, size: int) -> Any:
        files = [getattr(record, frame) for record in data.records]
        return column(frame, files, partial(pixels_of, data, frame, size), np.uint8, 3, size, size)

    size, mel = processor.image_size, processor.audio
    columns: dict[str, Any] = dict.fromkeys(("image", "touch", "audio"))
    if "image" in needs:
        columns["image"] = pixels("picture", size)
    if "touch" in needs:
        columns["touch"] = pixels("touch", config.touch_size or size)
    if "audio" in needs:
        sounds, clip = [record.sound for record in data.records], partial(_clip, data, processor)
        columns["audio"] = column(f"sound{_digest([str(mel)])}", sounds, clip, np.float16, 1, mel.mel_bins, mel.frames)
    places = [materials.index(name) if name in materials else -1 for name in data.materials]
    return Rendered(
        **columns,
        material=np.array([places[r.labels[MATERIAL]] if MATERIAL in r.labels else -1 for r in data.records]),
        object=object_numbers(data),
        text=[record.caption or "" for record in data.records],
        sensor=data.sensor or "",
        fingerprint=_digest([*map(str, data.records), *prints]),
    )


def object_numbers(data: RecordSet) -> np.ndarray:
    """A number for the object of each record, int64 (N,); records that name none are objects of their own."""
    return np.unique([record.object or record.id for record in data.records], return_inverse=True)[1]


def pixels_of(data: RecordSet, frame: str, size: int, row: int) -> np.ndarray:
    """A frame of a record, uint8 (3, S, S)."""
    return _bytes(centre_rectangle(data.read(row, frame), size, size))


def _clip(data: RecordSet, processor: UniTouchProcessor, row: int) -> np.ndarray:
    """The first log-mel clip of a record's sound."""
    return processor.sounds([sound_of(data[row], data)], name=f"sound of {data[row].id!r}")[0, 0].numpy()


def sound_of(record: Record, data: RecordSet) -> Any:
    """A record's sound as processors take it: its file, or samples and their rate."""
    file = Path(str(record.sound))
    return str(file) if file.suffix != ".npy" else (np.load(file, allow_pickle=False), data.sampling_rate)


def _digest(lines: Iterable[str]) -> str:
    """Sixteen hexadecimal digits that change with any line."""
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]


def shown(sources: Sequence[Source], splits: Sequence[Rendered]) -> np.ndarray:
    """1 for each sample whose picture shows what is touched, and 0 for grasps, whose shows what came of it, (N,)."""
    near = [float(not isinstance(source, DrawnGrasps)) for source in sources]
    return np.repeat(np.array(near, dtype=np.float32), [len(split) for split in splits])


def sensor_numbers(splits: Sequence[Rendered], names: Sequence[str | None]) -> np.ndarray:
    """The place of each sample's sensor in `names`, int64 (N,): -1 where it has none, 0 where there are no names."""
    numbers = [0 if not names else -1 if split.sensor is None else names.index(split.sensor) for split in splits]
    return np.concatenate([np.full(len(split), number) for split, number in zip(splits, numbers, strict=True)])


def material_names(sources: Sequence[Source]) -> tuple[str, ...]:
    """The materials of all sources, those of one name as one.

    Raises:
        InvalidInputError: If one of several has numbers for names.
    """
    known = [source.materials for source in sources]
    if any(name.isdecimal() for names in known for name in names) and len(set(known)) > 1:
        raise InvalidInputError(
            "Data sets with numbers for materials cannot be mixed with others; name these by `materials`."
        )
    return tuple(dict.fromkeys(name for names in known for name in names))


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


def computed_once(
    file: Path, compute: Callable[[Tensor], Tensor], images: Sequence[np.ndarray | Computed], batch_size: int
) -> Tensor:
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
