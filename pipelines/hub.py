"""What a saved folder needs for diffusers' own loader, and for people: where its classes are, and a model card.

`DiffusionPipeline.from_pretrained(folder, trust_remote_code=True)` looks for classes that diffusers does not have in
Python files of the folder. Those written here import them from this package. Our own `from_pretrained` runs no such
file. Saved folders name `unitouch_gen.pipelines` and this module, so both names stay.
"""

import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from huggingface_hub import ModelCard, ModelCardData

from unitouch_gen.conditioning import EmbeddingBank, SensorBackgrounds
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import UniTouchConfig, UniTouchModel, UniTouchProcessor

__all__ = ["EmbeddingBank", "SensorBackgrounds", "UniTouchConfig", "UniTouchModel", "UniTouchProcessor"]

PARTS = {kind.__name__: kind for kind in (EmbeddingBank, SensorBackgrounds, UniTouchModel, UniTouchProcessor)}
MODULE = "pipeline"  # the name that diffusers gives such files
CODE = '''"""The classes of this folder are in the package `unitouch_gen`, which has to be installed."""

from unitouch_gen.pipelines import *  # noqa: F403
from unitouch_gen.pipelines.hub import *  # noqa: F403
'''
# Where transformers' Auto classes look for ours: (settings file, Auto classes), by the class of a part.
AUTO = {
    "UniTouchModel": ("config.json", {"AutoConfig": "UniTouchConfig", "AutoModel": "UniTouchModel"}),
    "UniTouchProcessor": ("preprocessor_config.json", {"AutoProcessor": "UniTouchProcessor"}),
}
CARD, PICTURES = "README.md", "pictures"


def name_classes(folder: Path) -> None:
    """Makes the model_index.json of a saved folder name Python files beside it, which it writes."""
    file = folder / "model_index.json"
    index = json.loads(file.read_text(encoding="utf-8"))
    for name, value in index.items():
        module, kind = value if isinstance(value, list) and len(value) == 2 else (None, None)
        if kind in PARTS and module == PARTS[kind].__module__:
            index[name] = [MODULE, kind]
            (folder / name).mkdir(exist_ok=True)
            (folder / name / f"{MODULE}.py").write_text(CODE, encoding="utf-8")
            if kind in AUTO:
                settings, named = AUTO[kind]
                known = json.loads((folder / name / settings).read_text(encoding="utf-8"))
                known["auto_map"] = {auto: f"{MODULE}.{of}" for auto, of in named.items()}
                _write_json(folder / name / settings, known)
        elif kind == "AutoencoderTiny":  # diffusers writes this setting, and warns of it when it reads it
            settings = json.loads((folder / name / "config.json").read_text(encoding="utf-8"))
            settings.pop("block_out_channels", None)
            _write_json(folder / name / "config.json", settings)
    named = index["_class_name"]
    index["_class_name"] = [MODULE, named[1] if isinstance(named, list) else named]
    (folder / f"{MODULE}.py").write_text(CODE, encoding="utf-8")
    _write_json(file, index)


def _write_json(file: Path, values: Any) -> None:
    file.write_text(json.dumps(values, indent=2, sort_keys=True) + "\n", encoding="utf-8")


def located(index: Mapping[str, Any]) -> dict[str, Any]:
    """The entries of a model_index.json that name such files, with our modules in their place."""
    found: dict[str, Any] = {}
    for name, value in index.items():
        if isinstance(value, list | tuple) and len(value) == 2 and value[0] == MODULE:
            if name == "_class_name":
                found[name] = value[1]
            elif value[1] in PARTS:
                found[name] = [PARTS[value[1]].__module__, value[1]]
    return found


@dataclass(frozen=True)
class Card:
    """What people should know of a model, for the README.md that is saved with it.

    Args:
        description: What it is; the first line of its class's docstring when left out.
        figures: What was measured: numbers or words, by name.
        data: What it was trained on.
        license: Its short name, such as "apache-2.0".
        limits: What it cannot do.
        pictures: Image files by their captions.

    Raises:
        InvalidInputError: If a picture is not there.

    Example:
        >>> card = Card(figures={"material named right": "73.8 %"}, license="apache-2.0")
        >>> card.license
        'apache-2.0'
    """

    description: str = ""
    figures: Mapping[str, Any] = field(default_factory=dict)
    data: str = ""
    license: str = ""
    limits: str = "It draws something for every input, also for one that is like nothing it was trained on."
    pictures: Mapping[str, str | Path] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for caption, file in self.pictures.items():
            if not Path(file).is_file():
                raise InvalidInputError(f"`pictures` has {str(file)!r} for {caption!r}, which is no file.")

    def write(self, folder: Path, name: str, pipe: Any) -> None:
        """Writes README.md and its pictures for a pipeline that its example loads by a name or repository id."""
        kind = type(pipe).__name__
        data = ModelCardData(
            license=self.license.lower() or None,
            library_name="diffusers",
            pipeline_tag="image-to-image",
            tags=["unitouch_gen", "touch", "tactile"],
        )
        images = ""
        for number, (caption, file) in enumerate(self.pictures.items()):
            place = f"{PICTURES}/{number}-{Path(file).name}"
            (folder / PICTURES).mkdir(exist_ok=True)
            shutil.copyfile(file, folder / place)
            images += f"![{caption}]({place})\n\n*{caption}*\n\n"
        figures = "\n".join(f"| {key} | {value} |" for key, value in self.figures.items())
        networks = {part: network for part, network in pipe.components.items() if hasattr(network, "parameters")}
        sizes = {part: sum(one.numel() for one in network.parameters()) for part, network in networks.items()}
        content = TEMPLATE.format(
            data=data.to_yaml(),
            title=Path(name).name or kind,
            description=self.description or (type(pipe).__doc__ or kind).strip().splitlines()[0],
            images=images,
            kind=kind,
            name=name,
            call=pipe._example_call,
            figures=f"| figure | measured |\n|---|---|\n{figures}" if figures else "Not stated.",
            trained_on=self.data or "Not stated.",
            limits=self.limits,
            license=self.license or "Not stated: ask who made it before you use it.",
            parts="\n".join(f"| `{part}` | {size:,} |" for part, size in sizes.items()),
        )
        ModelCard(content).save(folder / CARD)


TEMPLATE = """---
{data}
---

# {title}

{description}

A `{kind}` of `unitouch_gen`, in the manner of diffusers.

{images}## How to use it

```python
from unitouch_gen import {kind}, example  # pip install unitouch_gen

pipe = {kind}.from_pretrained("{name}")
output = {call}  # or paths of your own
output.images[0].save("output.png")
print(output.report)
```

diffusers loads it, too: `DiffusionPipeline.from_pretrained("{name}", trust_remote_code=True)`. The code to be trusted
is `pipeline.py`, which imports `unitouch_gen`.

## How good it is

{figures}

## What it was trained on

{trained_on}

## What it cannot do

{limits}

## Licence

{license}

## Parts

| part | parameters |
|---|---|
{parts}
"""


def copy_card(source: Path, folder: Path) -> None:
    """Copies the model card of another folder, with its pictures."""
    if source.resolve() == folder.resolve() or not (source / CARD).is_file():
        return
    shutil.copyfile(source / CARD, folder / CARD)
    if (source / PICTURES).is_dir():
        shutil.copytree(source / PICTURES, folder / PICTURES, dirs_exist_ok=True)
