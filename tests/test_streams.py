"""Standard output that is closed, full, read by `head` or in an encoding of few characters: the work is done."""

import io
import os
import subprocess
import sys
from pathlib import Path

import pytest
from rich.console import Console
from rich.table import Table

from unitouch_gen.cli.options import print_table
from unitouch_gen.streams import StandardStream

SCRIPT = r"""
import logging
import sys
from pathlib import Path

import typer

from unitouch_gen.cli.options import is_quiet, note, print_table
from unitouch_gen.commands import run_commands

app = typer.Typer()


@app.command()
def command() -> None:
    assert is_quiet(False)
    logging.getLogger("matplotlib").warning("what a library logs")
    for line in range(2000):
        note(f"{line}: h\u00f6he_\u7816.png")
    print_table(["touch"], [["h\u00f6he_\u7816.png"], ["h\udcf6he.png"]])
    typer.echo("\n".join("x" * 80 for _ in range(2000)))
    Path("made").touch()


sys.exit(run_commands(app, "command", []))
"""


def run(folder: Path, redirections: str) -> subprocess.CompletedProcess:
    """The script with its streams redirected by a shell, whose exit code is that of the first process in a pipe."""
    line = f"set -o pipefail; '{sys.executable}' -c \"$SCRIPT\" {redirections}"
    given = {"SCRIPT": SCRIPT, "PYTHONPATH": str(Path(__file__).parents[1]), "PYTHONIOENCODING": "ascii"}
    return subprocess.run(
        ["bash", "-c", line], cwd=folder, env={**os.environ, **given}, capture_output=True, timeout=600, check=False
    )


@pytest.mark.parametrize("redirections", ["<&- >&- 2>&-", "| true", "2>&1 | head -n 1"])
def test_standard_output_that_is_closed_or_read_by_head_ends_no_command(tmp_path, redirections):
    done = run(tmp_path, redirections)
    assert done.returncode == 0, done.stderr[-300:]
    assert (tmp_path / "made").exists(), done.stderr[-300:]
    assert b"rror" not in done.stderr
    assert b"what a library logs" not in done.stderr


def test_a_full_disk_behind_standard_output_is_one_line(tmp_path):
    done = run(tmp_path, ">/dev/full")
    assert done.returncode == 2
    last = done.stderr.splitlines()[-1]
    assert last == b"command: [Errno 28] No space left on device: 'standard output'"


@pytest.mark.parametrize(
    ("encoding", "printed"),
    [
        ("utf-8", "höhe_砖.png".encode()),
        ("cp1252", b"h\xf6he_?.png"),
        ("cp936", "h?he_砖.png".encode("cp936")),
        ("ascii", b"h?he_?.png"),
    ],
)
def test_characters_that_an_encoding_lacks_are_replaced(encoding, printed):
    """And file names whose bytes are no text are printed as they are."""
    written = io.BytesIO()
    stream = StandardStream(written, encoding, "as-possible")
    table = Table("touch")
    for name in ("höhe_砖.png", os.fsdecode(b"h\xf6he.png"), "\ud800"):
        table.add_row(name)
    Console(file=stream, width=80).print(table)
    assert printed in written.getvalue()
    assert b"h\xf6he.png" in written.getvalue()


def test_tables_show_names_as_they_are(capsys):
    """Brackets and colons are no markup of the terminal's."""
    names = ["gel[red].png", "[/b].png", "a:brick:b.png"]
    print_table(["touch"], [[name] for name in names])
    printed = capsys.readouterr().out
    assert all(name in printed for name in names)
