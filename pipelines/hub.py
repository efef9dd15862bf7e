"""Files that make a saved folder loadable by diffusers itself, and its model card.

`DiffusionPipeline.from_pretrained(folder, trust_remote_code=True)` looks for classes that diffusers does not have in
Python files of the folder. Those written here import them from this package, so their names must not change. Our own
`from_pretrained` runs no such file.
"""

import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from huggingface_hub import ModelCard, ModelCardData

from unitouch_gen.conditioning import EmbeddingBank, SensorBackgrounds
from unitouch_gen.errors import check_file
from unitouch_gen.models import LanguageBridge, UniTouchConfig, UniTouchModel, UniTouchProcessor

__all__ = [
    "EmbeddingBank",
    "LanguageBridge",
    "SensorBackgrounds",
    "UniTouchConfig",
    "UniTouchModel",
    "UniTouchProcessor",
]

_KINDS = (EmbeddingBank, LanguageBridge, SensorBackgrounds, UniTouchModel, UniTouchProcessor)
PARTS = {kind.__name__: kind for kind in _KINDS}
MODULE = "pipeline"  # diffusers' name for such files
CODE = '''"""The classes of this folder are in the package `unitouch_gen`, which has to be installed."""

from unitouch_gen.pipelines import *  # noqa: F403
from unitouch_gen.pipelines.hub import *  # noqa: F403
'''
CARD = "README.md"
RECORD = "record.json"
PICTURES = "pictures"
TEMPLATE = Path(__file__).with_name("card.md")


def name_classes(folder: Path) -> None:
    """Writes the Python files of a saved folder, and names them in its model_index.json."""
    file = folder / "model_index.json"
    index = json.loads(file.read_text(encoding="utf-8"))
    index["_class_name"] = [MODULE, index["_class_name"]]
    (folder / f"{MODULE}.py").write_text(CODE, encoding="utf-8")
    for name, value in index.items():
        kind = PARTS.get(value[1]) if isinstance(value, list) and value[1] else None
        if kind is not None and value[0] == kind.__module__:
            index[name] = [MODULE, kind.__name__]
            (folder / name).mkdir(exist_ok=True)
            (folder / name / f"{MODULE}.py").write_text(CODE, encoding="utf-8")
    file.write_text(json.dumps(index, indent=2, sort_keys=True) + "\n", encoding="utf-8")


def resolve_classes(index: Mapping[str, Any]) -> dict[str, Any]:
    """The entries of a model_index.json that name such files, with our modules instead."""
    resolved: dict[str, Any] = {}
    for name, value in index.items():
        if isinstance(value, list | tuple) and len(value) == 2 and value[0] == MODULE:
            if name == "_class_name":
                resolved[name] = value[1]
            elif value[1] in PARTS:
                resolved[name] = [PARTS[value[1]].__module__, value[1]]
    return resolved


@dataclass(frozen=True)
class Card:
    """A model card: the README.md saved with a model.

    Example:
        >>> card = Card(figures={"material named right": "73.8 %"}, license="apache-2.0")
        >>> card.license
        'apache-2.0'
    """

    description: str = ""  #: default: the first line of its class's docstring
    figures: Mapping[str, Any] = field(default_factory=dict)  #: measured figures by name: numbers or text
    data: str = ""  #: training data
    license: str = ""  #: its short name, such as "apache-2.0"
    limits: str = "It draws something for every input, also for one that is like nothing it was trained on."
    pictures: Mapping[str, str | Path] = field(default_factory=dict)  #: image files by caption

    def write(self, folder: Path, name: str, pipe: Any) -> None:
        """Writes README.md and its pictures; its example loads the pipeline by `name`, a folder or repository id."""
        places: dict[str, str] = {}
        for number, (caption, file) in enumerate(self.pictures.items()):
            check_file("pictures", file, "an image file")
            places[caption] = f"{PICTURES}/{number}-{Path(file).name}"
            (folder / PICTURES).mkdir(exist_ok=True)
            shutil.copyfile(file, folder / places[caption])
        data = ModelCardData(
            license=self.license.lower() or None,
            library_name="diffusers",
            pipeline_tag=pipe._task,
            tags=["unitouch_gen", "touch", "tactile"],
        )
        card = ModelCard.from_template(
            data,
            str(TEMPLATE),
            card=self,
            pipe=pipe,
            kind=type(pipe).__name__,
            name=name,
            title=Path(name).name,
            description=self.description or str(type(pipe).__doc__).splitlines()[0],
            pictures=places,
        )
        card.save(folder / CARD)
