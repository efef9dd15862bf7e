"""Files that are replaced whole: whoever looks finds the old one or the new one, also after a kill."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replacing(file: Path) -> Iterator[Path]:
    """A path to write to, which takes the place of a file when the block ends, and goes where it fails.

    It is hidden, lies beside the file, has its suffix, and is this process's own: others may write the same file.

    Args:
        file: Its folder is made if it is not there.

    Raises:
        OSError: If the folder cannot be made, or the file not be replaced.
    """
    partial = file.with_name(f".{os.getpid()}.partial{file.suffix}")
    file.parent.mkdir(parents=True, exist_ok=True)
    try:
        yield partial
        partial.replace(file)
    finally:
        partial.unlink(missing_ok=True)


def write_file(file: Path, content: str | bytes) -> None:
    """Writes text, in UTF-8, or bytes.

    Raises:
        OSError: If it cannot be written; what was there stays.
    """
    with replacing(file) as partial:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)
