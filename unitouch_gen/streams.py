"""Standard streams that commands can always write to, even if closed, in a small encoding, or read by `head`."""

import codecs
import errno
import io
import os
import sys


class StandardStream(io.TextIOWrapper):
    """Standard output or error whose reader may close it. Later output is dropped, and the work goes on."""

    def write(self, text: str) -> int:
        try:
            return super().write(text)
        except OSError as error:
            self._drop_the_rest(error)
            return len(text)

    def flush(self) -> None:
        try:
            super().flush()
        except OSError as error:
            self._drop_the_rest(error)

    def _drop_the_rest(self, error: OSError) -> None:
        """Redirects further output to the null device. Raises if output is lost otherwise, as on a full disk."""
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self.fileno())
        os.close(nowhere)
        is_closed = error.errno in (errno.EPIPE, errno.EINVAL)  # the latter on Windows
        if self.fileno() == 1 and not is_closed:
            raise OSError(error.errno, error.strerror, "standard output") from error


def encode_as_possible(error: UnicodeError) -> tuple[str | bytes, int]:
    """An error handler of codecs: bytes of file names are kept, other characters that cannot be encoded become "?"."""
    try:
        return codecs.lookup_error("surrogateescape")(error)
    except UnicodeError:
        return codecs.lookup_error("replace")(error)


codecs.register_error("as-possible", encode_as_possible)


def open_standard_streams() -> None:
    """Makes the process's standard streams usable by commands; replaced streams are left as they are."""
    for name, mode in {"stdin": "r", "stdout": "w", "stderr": "w"}.items():
        stream = getattr(sys, name)
        if stream is None:  # closed; otherwise the next opened file would receive what is printed
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8", errors="as-possible"))  # noqa: SIM115
        elif mode == "w" and stream is getattr(sys, f"__{name}__"):
            stream.flush()
            binary = open(stream.fileno(), "wb", closefd=False)  # noqa: SIM115
            lines = stream.line_buffering
            setattr(sys, name, StandardStream(binary, stream.encoding, "as-possible", line_buffering=lines))
