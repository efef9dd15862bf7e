"""What a sweep of error against run time has measured so far, in a folder: it can be gone on with, and extended.

`results.json` holds all of it and is written after every row; `results.csv` is made of its rows. Rows go with one
subject, its references and one machine, so a folder takes no others.
"""

import csv
import io
import json
import platform
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import torch

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.files import write_file
from unitouch_gen.numerics.reference import Reference
from unitouch_gen.numerics.subjects import Subject
from unitouch_gen.numerics.work_precision import Order, Row, own_error

VERSION = 1
"""Of the file; others are not read."""


def machine(device: str = "cpu") -> str:
    """What timings depend on, in words."""
    name = torch.cuda.get_device_name() if device.startswith("cuda") else _processor()
    threads = torch.get_num_threads()
    return f"{name}, {threads} thread{'s' * (threads > 1)}, torch {torch.__version__}"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())


class Results:
    """The rows of one subject in a folder.

    Args:
        folder: Made when the first row is written. What is there already is read.
        subject: Whose rows they are.
        rtol: Of its references; `None` is the subject's own.
        device: That runs are on.

    Attributes:
        rows: By the key of their configuration.
        references: Figures of the reference by guidance scale.

    Raises:
        InvalidInputError: If the folder holds results of something else, or what is there cannot be read.
    """

    def __init__(self, folder: Path, subject: Subject, *, rtol: float | None = None, device: str = "cpu"):
        self.folder, self.file = folder, folder / "results.json"
        self.subject = {
            "name": subject.name,
            "identity": subject.identity,
            "samples": subject.samples,
            "batch_size": subject.batch_size,
            "rtol": rtol,
        }
        self.machine = machine(device)
        self.rows: dict[str, Row] = {}
        self.references: dict[float, dict[str, Any]] = {}
        if self.file.exists():
            self._read()

    def _read(self) -> None:
        try:
            found = json.loads(self.file.read_text(encoding="utf-8"))
            version, subject, where = found["version"], found["subject"], found["machine"]
            rows = {values["key"]: Row(**values) for values in found["rows"]} if version == VERSION else {}
            references = {float(scale): figures for scale, figures in found["references"].items()}
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise InvalidInputError(
                f"`output` holds {str(self.file)!r}, which cannot be read ({type(error).__name__}: {error}); name "
                "another folder."
            ) from error
        for what, theirs, ours in (
            ("in another format", version, VERSION),
            (f"of {subject.get('name')!r} with other inputs, weights or settings", subject, self.subject),
            (f"from another machine ({where})", where, self.machine),
        ):
            if theirs != ours:
                raise InvalidInputError(
                    f"`output` holds results {what}, which do not go on one chart with these; name another folder."
                )
        self.rows, self.references = rows, references

    def note(self, guidance_scale: float, reference: Reference) -> None:
        """Keeps the figures of a reference."""
        self.references[guidance_scale] = {
            "own_error": own_error(reference),
            "own_error_largest": reference.disagreement.max().item(),
            "evaluations": reference.evaluations,
            "seconds": reference.seconds,
        }

    @property
    def own_errors(self) -> dict[float, float]:
        """Of the references, by guidance scale."""
        return {scale: figures["own_error"] for scale, figures in self.references.items()}

    def add(self, row: Row) -> None:
        """Keeps a row, in the file as well."""
        self.rows[row.key] = row
        self.save()

    def save(self, orders: list[Order] | None = None) -> None:
        """Writes `results.json`.

        Raises:
            InvalidInputError: If it cannot be written.
        """
        whole = {
            "version": VERSION,
            "subject": self.subject,
            "machine": self.machine,
            "references": {str(scale): figures for scale, figures in self.references.items()},
            "orders": [asdict(order) for order in orders or ()],
            "rows": [asdict(row) for row in self.rows.values()],
        }
        write_whole(self.file, json.dumps(whole, indent=1).encode())

    def save_csv(self) -> Path:
        """Writes `results.csv`, a line for each row; options are JSON.

        Raises:
            InvalidInputError: If it cannot be written.
        """
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, [field.name for field in fields(Row)])
        writer.writeheader()
        for row in self.rows.values():
            writer.writerow({**asdict(row), "options": json.dumps(row.options)})
        file = self.folder / "results.csv"
        write_whole(file, text.getvalue().encode())
        return file


def write_whole(file: Path, data: bytes) -> None:
    """Writes a part of the output whole, or leaves what was there.

    Raises:
        InvalidInputError: If it cannot be written.
    """
    try:
        write_file(file, data)
    except OSError as error:
        raise InvalidInputError(f"`output` cannot be written to {str(file)!r}: {error.strerror or error}.") from error
