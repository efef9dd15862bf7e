"""Records of touches, and helpers with which layouts of data sets find and read them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from PIL import Image
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, first_line, import_optional
from unitouch_gen.files import files_below, is_hidden, natural
from unitouch_gen.models.images import load_images

IMAGES = frozenset(Image.registered_extensions()) - {".pdf", ".mpg", ".mpeg", ".h5", ".hdf"}  # suffixes


@dataclass(frozen=True, slots=True)
class Frame:
    """An image in a file."""

    path: str
    key: str | None = None  # in an HDF5 file, the name of the array (H, W, 3)

    def read(self) -> Tensor:
        """Pixels (3, H, W), uint8 or float32 in [0, 1]; raises an `InvalidInputError` if they cannot be read."""
        source: Any = self.path
        try:
            if self.key is not None:
                with import_optional("h5py").File(self.path) as file:
                    source = file[self.key][()]
        except (OSError, LookupError, ValueError) as error:  # h5py raises these
            raise InvalidInputError(f"{self.path!r} cannot be read: {first_line(error)}.") from error
        return load_images("image", source)[0]


@dataclass(frozen=True, slots=True)
class Record:
    """A touch, and whatever its data set has beside it."""

    id: str  # unique in its data set
    touch: Frame
    picture: Frame | None = None
    background: Frame | None = None  # the gel before the contact
    sensor: str | None = None
    object: str | None = None  # splits share no object
    recording: str | None = None  # nor, where there are no objects, a recording
    labels: Mapping[str, Any] = field(default_factory=dict)  # names of classes from layouts, numbers by `open_dataset`
    caption: str | None = None
    sound: str | None = None  # a sound file, or a .npy file of samples
    split: str | None = None  # "train", "val" or "test", if the data set has splits

    @property
    def files(self) -> set[str]:
        """Paths of all its files."""
        frames = [getattr(self, name) for name in FRAMES]
        paths = {frame.path for frame in frames if frame}
        if self.sound:
            paths.add(self.sound)
        return paths


FRAMES = tuple(field.name for field in fields(Record) if field.type in (Frame, Frame | None))
"""Fields of a record that are images in files."""


def abbreviate(names: Sequence[str]) -> str:
    """The first five names, and the number of the others."""
    if len(names) <= 5:
        return "; ".join(names)
    return "; ".join([*names[:5], f"and {len(names) - 5} more"])


def find_paths(folder: Path, *patterns: str) -> list[Path]:
    """Paths below a folder that match one of the patterns, in natural order, without hidden files and folders."""
    paths = set[Path]()
    for pattern in patterns:
        paths.update(files_below(folder) if pattern == "**/*" else folder.glob(pattern))
    visible = [path for path in paths if not is_hidden(path.relative_to(folder))]
    return sorted(visible, key=natural)


def images_in(folder: Path, pattern: str = "*") -> list[Path]:
    """The images in a folder, in natural order; none if there is no folder."""
    return [file for file in find_paths(folder, pattern) if file.suffix.lower() in IMAGES]


def frame_at(file: Path) -> Frame | None:
    """The image in a file, if it is there."""
    return Frame(str(file)) if file.is_file() else None


def column_of(file: Path, columns: Iterable[str], names: Sequence[str]) -> str:
    """The first of `names` that is a column of a table."""
    for name in names:
        if name in columns:
            return name
    raise InvalidInputError(f"{str(file)!r} has the columns {list(columns)}, and none of {', '.join(names)}.")
