"""Records, each a touch with all that is known of it; and what layouts of data sets find and read them with."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from PIL import Image
from torch import Tensor

from unitouch_gen.errors import InvalidInputError, first_line, needed
from unitouch_gen.files import files_below, is_hidden, natural
from unitouch_gen.models.images import load_images

IMAGES = frozenset(Image.registered_extensions()) - {".pdf", ".mpg", ".mpeg", ".h5", ".hdf"}  # suffixes


@dataclass(frozen=True, slots=True)
class Frame:
    """An image in a file."""

    path: str
    key: str | None = None  # in an HDF5 file, the name of the array (H, W, 3)

    def read(self) -> Tensor:
        """Pixels (3, H, W): uint8, or float32 in [0, 1]; raises an `InvalidInputError` if they cannot be read."""
        source: Any = self.path
        try:
            if self.key is not None:
                with needed("h5py").File(self.path) as file:
                    source = file[self.key][()]
        except (OSError, LookupError, ValueError) as error:  # h5py's are among these
            raise InvalidInputError(f"{self.path!r} cannot be read: {first_line(error)}.") from error
        return load_images("image", source)[0]


@dataclass(frozen=True, slots=True)
class Record:
    """One touch with all that is known of it."""

    id: str  # unique in its data set
    touch: Frame
    picture: Frame | None = None
    background: Frame | None = None  # the gel before the contact
    sensor: str | None = None  # what took the touch
    object: str | None = None  # which records of several splits may not share
    recording: str | None = None  # nor this, where there are no objects
    labels: Mapping[str, Any] = field(default_factory=dict)  # classes: layouts name them, `open_dataset` numbers them
    caption: str | None = None
    sound: str | None = None  # a sound file, or a .npy file of samples
    split: str | None = None  # "train", "val" or "test", where the data set says

    @property
    def files(self) -> set[str]:
        """Paths of all its files."""
        frames = (self.touch, self.picture, self.background)
        return {frame.path for frame in frames if frame} | ({self.sound} if self.sound else set())


def few(names: Sequence[str]) -> str:
    """The first five of many, and how many more there are."""
    return "; ".join([*names[:5], f"and {len(names) - 5} more"] if len(names) > 5 else names)


def found(folder: Path, *patterns: str) -> list[Path]:
    """What patterns find in a folder, in natural order, without hidden files and those in hidden folders."""
    paths = {path for one in patterns for path in (files_below(folder) if one == "**/*" else folder.glob(one))}
    return sorted((path for path in paths if not is_hidden(path.relative_to(folder))), key=natural)


def images_in(folder: Path, pattern: str = "*") -> list[Path]:
    """The images in a folder, in natural order; none where there is no folder."""
    return [file for file in found(folder, pattern) if file.suffix.lower() in IMAGES]


def frame_at(file: Path) -> Frame | None:
    """The image in a file, if it is there."""
    return Frame(str(file)) if file.is_file() else None


def column_of(file: Path, columns: Iterable[str], known: Sequence[str]) -> str:
    """The first of `known` that is a column of a table."""
    for name in known:
        if name in columns:
            return name
    raise InvalidInputError(f"{str(file)!r} has the columns {list(columns)}, and none of {', '.join(known)}.")
