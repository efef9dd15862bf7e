"""`python -m tests.benchmarks.files_entered`: the files of ours that one `pipe(touch)` enters, those in `models/` last.

A reader who wants to know how a picture comes about has to open these. Files that are only imported are left out.
"""

import sys
from collections import defaultdict
from pathlib import Path
from types import FrameType
from typing import Any

import unitouch_gen

PACKAGE = Path(unitouch_gen.__file__).parent


def functions_entered() -> dict[str, set[str]]:
    """Qualified names of our functions that the call enters, by file, relative to the package."""
    pipe = unitouch_gen.tiny("touch-to-image")
    entered = defaultdict[str, set[str]](set)
    pipe.set_progress_bar_config(disable=True)
    touch = unitouch_gen.example("brick")

    def note(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        if event == "call" and code.co_name != "<module>" and (path := Path(code.co_filename)).is_relative_to(PACKAGE):
            entered[str(path.relative_to(PACKAGE))].add(code.co_qualname)

    sys.setprofile(note)
    pipe(touch)
    sys.setprofile(None)
    return dict(sorted(entered.items()))


if __name__ == "__main__":
    entered = functions_entered()
    networks = [file for file in entered if file.startswith("models")]
    rest = [file for file in entered if file not in networks]
    for file in (*rest, *networks):
        print(f"{len(entered[file]):4} functions in {file}")
    print(f"{sum(len(entered[file]) for file in rest):4} in {len(rest)} files, and {len(networks)} files in models/")
