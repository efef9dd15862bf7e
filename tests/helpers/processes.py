"""Processes that run a function of the package with everything imported already, and may be killed at any moment."""

import os
import resource
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable
from multiprocessing import get_context
from pathlib import Path
from typing import Any

CONTEXT = get_context("forkserver")
CONTEXT.set_forkserver_preload(["tests.helpers.processes", "unitouch_gen.cli", "unitouch_gen.pipelines"])

CHANGES = ("os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.truncate", "fcntl.flock")
"""What a process is about to do to files, as its audit hooks are told; "open" counts where it is for writing."""


class Child:
    """A process that calls a function in a folder.

    Args:
        function: Importable by name, as are its arguments.
        arguments: Of the function.
        folder: To be in; its output is kept beside, in files `out` and `err`.
        killed_at: Number of the change to files just before which it kills itself.
        longest: Bytes of the longest file that it may write.

    Attributes:
        out, err, changes: What it printed, and how many changes it made, when it has ended by itself.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        *arguments: Any,
        folder: Path,
        killed_at: int | None = None,
        longest: int | None = None,
    ):
        self.notes = folder.parent / f"{folder.name}.notes"
        self.notes.mkdir(exist_ok=True)
        given = (function, arguments, folder, self.notes, killed_at, longest)
        self.process = CONTEXT.Process(target=_call, args=given)
        self.process.start()

    def kill(self) -> None:
        self.process.kill()

    def wait(self) -> int:
        """Its exit code; -9 if it was killed."""
        self.process.join()
        assert self.process.exitcode is not None
        return self.process.exitcode

    @property
    def out(self) -> str:
        return (self.notes / "out").read_text()

    @property
    def err(self) -> str:
        return (self.notes / "err").read_text()

    @property
    def changes(self) -> int:
        return int((self.notes / "changes").read_text())


def finished(child: Child) -> Child:
    """The process when it has ended well."""
    assert child.wait() == 0, child.err
    return child


def _call(
    function: Callable[..., Any], arguments: Any, folder: Path, notes: Path, killed_at: int | None, longest: int | None
) -> None:
    os.chdir(folder)
    for descriptor, name in ((1, "out"), (2, "err")):
        file = os.open(notes / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(file, descriptor)
        os.close(file)
    sys.stdout, sys.stderr = (os.fdopen(descriptor, "w", closefd=False) for descriptor in (1, 2))
    changes = [0]

    def hook(event: str, args: tuple) -> None:
        if event in CHANGES or (event == "open" and args[2] & (os.O_WRONLY | os.O_RDWR)):
            changes[0] += 1
            if changes[0] == killed_at:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(hook)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # shells have what runs in the background ignore it
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    if longest is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (longest, limits[1]))
    code: Any = 1
    try:
        function(*arguments)
        code = 0
    except SystemExit as ended:
        code = ended.code or 0
    except BaseException:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)  # which holds for the file of errors as well
        traceback.print_exc()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        done = changes[0]
        sys.stdout.flush()
        sys.stderr.flush()
        (notes / "changes").write_text(str(done))
        os._exit(code)


# What they call -------------------------------------------------------------------------------------------------------


def command(*words: str) -> None:
    """`unitouch-gen ...`."""
    from unitouch_gen.cli import main

    sys.argv = ["unitouch-gen", *words]
    main()


def command_in(environment: dict[str, str], *words: str) -> None:
    """`unitouch-gen ...` with some variables of the environment."""
    os.environ.update(environment)
    tempfile.tempdir = None  # so that TMPDIR is read again
    command(*words)


def script(code: str | Path, *words: str) -> None:
    """Code, or a file of it, as a program with arguments."""
    name, text = (str(code), code.read_text()) if isinstance(code, Path) else ("script", code)
    sys.argv = [name, *words]
    exec(compile(text, name, "exec"), {"__name__": "__main__", "__file__": name})  # noqa: S102


def save_numbered(folder: str, number: int) -> None:
    """A pipeline whose weights are those of `make_components` plus a number."""
    import torch

    from tests.helpers.components import make_components
    from unitouch_gen.pipelines import TouchToImagePipeline

    pipe = TouchToImagePipeline(**make_components(), default_num_inference_steps=number)
    with torch.no_grad():
        for network in (pipe.unitouch, pipe.unet, pipe.vae, pipe.text_encoder):
            for parameter in network.parameters():
                parameter.add_(number)
    pipe.save_pretrained(folder, max_shard_size="60KB" if number == 2 else "10GB")  # that names files otherwise
