"""Pieces of a benchmark in processes of their own, so that peaks of memory are of nothing else."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
"""Where the modules of the benchmarks are found."""


def in_own_process(module: str, *arguments: str) -> Any:
    """What `python -m module ...` prints as JSON on its last line; its errors are to be seen.

    Args:
        module: By its full name.
        arguments: Of its command line.

    Raises:
        CalledProcessError: If it fails.
    """
    command = [sys.executable, "-m", module, *arguments]
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])
