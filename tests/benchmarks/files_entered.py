"""`python -m tests.benchmarks.files_entered`: the files of ours that one `pipe(touch)` enters, without networks.

A reader who wants to know how a picture comes about has to open these. The networks in `models/` are left out, as are
files that are only imported.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import unitouch_gen

PACKAGE = Path(unitouch_gen.__file__).parent
TOUCH = Path(__file__).resolve().parents[2] / "samples" / "inputs" / "gelsight_brick.png"


def functions_entered(call: Callable[[], Any]) -> dict[str, set[str]]:
    """Qualified names of the functions of ours that `call` enters, by file, relative to the package."""
    entered: dict[str, set[str]] = {}

    def note(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        path = Path(code.co_filename)
        if event == "call" and code.co_name != "<module>" and path.is_relative_to(PACKAGE):
            entered.setdefault(str(path.relative_to(PACKAGE)), set()).add(code.co_qualname)

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        call()
    finally:
        sys.setprofile(before)
    return entered


def one_call() -> dict[str, set[str]]:
    """What one call of the pipeline enters that draws the picture of a touch."""
    entered = {}
    for _ in range(2):  # the first imports what is imported late
        pipe = unitouch_gen.tiny("touch-to-image")
        pipe.set_progress_bar_config(disable=True)
        entered = functions_entered(lambda pipe=pipe: pipe(TOUCH))
    return dict(sorted(entered.items()))


def without_networks(entered: dict[str, set[str]]) -> dict[str, set[str]]:
    """All but the files in `models/`."""
    return {file: names for file, names in entered.items() if Path(file).parts[0] != "models"}


def main() -> None:
    entered = one_call()
    files = without_networks(entered)
    for file, names in files.items():
        print(f"{len(names):4} functions in {file}")
    print(
        f"{sum(map(len, files.values())):4} functions in {len(files)} files, and {len(entered) - len(files)} in models/"
    )


if __name__ == "__main__":
    main()
