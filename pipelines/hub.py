"""What a folder needs for diffusers' own loader, and for people: where its classes are, and a model card.

`DiffusionPipeline.from_pretrained(folder, trust_remote_code=True)` looks for classes that diffusers does not have in
Python files of the folder. The ones written here import them from this package. Our own `from_pretrained` reads no such
file and needs no trust. Saved folders name `unitouch_gen.pipelines` and this module, so both names stay.
"""

import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from huggingface_hub import ModelCardData

from unitouch_gen.conditioning import EmbeddingBank, SensorBackgrounds
from unitouch_gen.errors import InvalidInputError, InvalidTypeError, check_kind, describe
from unitouch_gen.files import as_path
from unitouch_gen.models import UniTouchConfig, UniTouchModel, UniTouchProcessor
from unitouch_gen.schedulers.solvers import SOLVERS

SCHEDULERS: tuple[type, ...] = tuple(solver.scheduler for solver in SOLVERS.values())
PARTS: dict[str, type] = {
    kind.__name__: kind for kind in (EmbeddingBank, SensorBackgrounds, UniTouchModel, UniTouchProcessor, *SCHEDULERS)
}
"""Classes of ours that parts of pipelines may be of, by name."""

globals().update(PARTS)
__all__ = ["UniTouchConfig", *PARTS]

MODULE = "pipeline"
"""Name of the Python files, as diffusers calls its own."""

CODE = '''"""The classes of this folder are in the package `unitouch_gen`, which has to be installed."""

from unitouch_gen.pipelines import *  # noqa: F403
from unitouch_gen.pipelines.hub import *  # noqa: F403
'''
"""The same in every folder, as diffusers copies all of them to one place."""

AUTO: dict[str, tuple[str, dict[str, type]]] = {
    UniTouchModel.__name__: ("config.json", {"AutoConfig": UniTouchConfig, "AutoModel": UniTouchModel}),
    UniTouchProcessor.__name__: ("preprocessor_config.json", {"AutoProcessor": UniTouchProcessor}),
}
"""Where transformers looks for its Auto classes' own, and what they are, by the class of a part."""

CARD, PICTURES = "README.md", "pictures"


# Classes --------------------------------------------------------------------------------------------------------------


def class_of(index: Mapping[str, Any]) -> Any:
    """Name of the class that a model_index.json is of."""
    named = index.get("_class_name")
    return named[1] if isinstance(named, list | tuple) and len(named) == 2 else named


def name_classes(folder: Path) -> None:
    """Makes a folder that diffusers wrote one that its own loader takes: the index names Python files beside it."""
    file = folder / "model_index.json"
    index = json.loads(file.read_text(encoding="utf-8"))
    for name, value in index.items():
        if not isinstance(value, list) or len(value) != 2:
            continue
        kind = PARTS.get(value[1])
        if kind is not None and value[0] == kind.__module__:
            index[name] = [MODULE, value[1]]
            (folder / name).mkdir(exist_ok=True)
            (folder / name / f"{MODULE}.py").write_text(CODE, encoding="utf-8")
            if value[1] in AUTO:
                settings, named = AUTO[value[1]]
                known = json.loads((folder / name / settings).read_text(encoding="utf-8"))
                known["auto_map"] = {auto: f"{MODULE}.{of.__name__}" for auto, of in named.items()}
                (folder / name / settings).write_text(json.dumps(known, indent=2, sort_keys=True) + "\n", "utf-8")
    index["_class_name"] = [MODULE, class_of(index)]
    (folder / f"{MODULE}.py").write_text(CODE, encoding="utf-8")
    file.write_text(json.dumps(index, indent=2, sort_keys=True) + "\n", encoding="utf-8")


def located(index: Mapping[str, Any]) -> dict[str, Any]:
    """The entries of a model_index.json that name such files, as diffusers has them without: modules of ours."""
    found: dict[str, Any] = {}
    for name, value in index.items():
        if isinstance(value, list | tuple) and len(value) == 2 and value[0] == MODULE:
            if name == "_class_name":
                found[name] = value[1]
            elif value[1] in PARTS:
                found[name] = [PARTS[value[1]].__module__, value[1]]
    return found


# The model card -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Card:
    """What people should know of a model, for the README.md that is saved with it.

    Args:
        description: What it is; what its class says of itself when left out.
        figures: What was measured, by what it is of: numbers or words.
        data: What it was trained on.
        license: Its short name, such as "apache-2.0".
        limits: What it cannot do.
        pictures: Image files by their captions.

    Raises:
        InvalidInputError, InvalidTypeError: If one of these is of another kind, or a picture is no file.

    Example:
        >>> card = Card(figures={"material named right": "73.8 %"}, license="apache-2.0")
        >>> card.license
        'apache-2.0'
    """

    description: str = ""
    figures: Mapping[str, Any] = field(default_factory=dict)
    data: str = ""
    license: str = ""
    limits: str = ""
    pictures: Mapping[str, str | os.PathLike] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for item in fields(self):
            check_kind(item.name, getattr(self, item.name), Mapping if item.name in ("figures", "pictures") else str)
        for name in ("figures", "pictures"):
            for key in getattr(self, name):
                if not isinstance(key, str):
                    raise InvalidTypeError(f"`{name}` has the key {describe(key)}; keys have to be strings.")
        for caption, file in self.pictures.items():
            if not as_path("pictures", file).is_file():
                raise InvalidInputError(f"`pictures` has {str(file)!r} for {caption!r}, which is no file.")

    def write(self, folder: Path, name: str, pipe: Any) -> None:
        """Writes README.md and the pictures that it shows.

        Args:
            folder: To write to.
            name: That the example loads the pipeline by: a folder's, or a repository's.
            pipe: The pipeline, with all of its parts.
        """
        kind = type(pipe).__name__
        head = ModelCardData(
            license=self.license.lower() or None,
            library_name="diffusers",
            pipeline_tag="image-to-image",
            tags=["unitouch_gen", "touch", "tactile"],
        )
        shown = []
        for number, (caption, file) in enumerate(self.pictures.items()):
            place = Path(PICTURES) / f"{number}-{Path(file).name}"
            (folder / PICTURES).mkdir(exist_ok=True)
            shutil.copyfile(file, folder / place)
            shown.append(f"![{caption}]({place.as_posix()})\n\n*{caption}*\n")
        described = self.description or (type(pipe).__doc__ or kind).strip().splitlines()[0]
        figures = [f"| {of} | {value:.4g} |" if isinstance(value, float) else f"| {of} | {value} |"
                   for of, value in self.figures.items()]  # fmt: skip
        sections = {
            f"# {Path(name).name or kind}": [described, "", f"A `{kind}` of `unitouch_gen`, in the manner of "
                                             "diffusers.", "", *shown],
            "## How to use it": [EXAMPLE.format(kind=kind, name=name, call=pipe._example_call)],
            "## How good it is": ["| of | measured |", "|---|---|", *figures] if figures else ["Not stated."],
            "## What it was trained on": [self.data or "Not stated."],
            "## What it cannot do": [self.limits or LIMITS],
            "## Licence": [self.license or "Not stated: ask who made it before you use it."],
            "## Parts": ["| part | class | numbers |", "|---|---|---|", *_rows(pipe)],
        }  # fmt: skip
        body = "\n\n".join(f"{title}\n\n" + "\n".join(lines).strip() for title, lines in sections.items())
        (folder / CARD).write_text(f"---\n{head.to_yaml()}\n---\n\n{body}\n", encoding="utf-8")


LIMITS = (
    "It draws something for every input, also for one that is like nothing it was trained on. Where it knows its "
    "sensors' touches, a warning tells of those that are unlike them."
)

EXAMPLE = """```python
from unitouch_gen import {kind}, example  # pip install unitouch_gen

pipe = {kind}.from_pretrained("{name}")
output = {call}  # or paths of your own
output.images[0].save("output.png")
print(output.report)
```

diffusers loads it, too: `DiffusionPipeline.from_pretrained("{name}", trust_remote_code=True)`. The code that is to be
trusted is `pipeline.py`, which imports `unitouch_gen`."""


def _rows(pipe: Any) -> list[str]:
    """What the parts of a pipeline are, one line of a table each."""
    rows = []
    for name, part in pipe.components.items():
        if part is not None:
            held = sum(tensor.numel() for tensor in part.parameters()) if hasattr(part, "parameters") else 0
            rows.append(f"| `{name}` | {type(part).__name__} | {f'{held:,}' if held else ''} |")
    return rows


def copy_card(source: Path, folder: Path) -> None:
    """Takes the model card of another folder along, with its pictures, as far as they are there."""
    shutil.copyfile(source / CARD, folder / CARD)
    if (source / PICTURES).is_dir():
        shutil.copytree(source / PICTURES, folder / PICTURES, dirs_exist_ok=True)
