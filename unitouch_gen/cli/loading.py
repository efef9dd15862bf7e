"""The models that commands run on: built in, a folder, or a repository by its id."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from unitouch_gen.cli.options import device_of
from unitouch_gen.errors import InvalidInputError, check_dtype

if TYPE_CHECKING:
    from unitouch_gen.models import UniTouchModel, UniTouchProcessor

CLASSES = {
    "touch-to-image": "TouchToImagePipeline",
    "x-to-touch": "XToTouchPipeline",
    "stylization": "TactileStylizationPipeline",
}
"""Classes of `unitouch_gen.pipelines` by the names of the built-in pipelines."""


def load_pipeline(
    name: str, model: str | None, quiet: bool, *, dtype: str | None = None, device: str = "cpu",
    sensors: Sequence[Path | str] | None = None,
) -> Any:  # fmt: skip
    """The pipeline saved in a folder or repository, or the built-in one if `model` is `None`.

    Args:
        name: One of `CLASSES`; a saved pipeline has to be of that class.
        model, dtype, device: As options have them.
        quiet: Whether to show no progress bars.
        sensors: Files of sensors to add.
    """
    of_networks, place = check_dtype("--dtype", dtype or "float32"), device_of(device)
    import diffusers.utils.logging
    import transformers.utils.logging

    from unitouch_gen import pipelines
    from unitouch_gen.files import reading
    from unitouch_gen.pipelines.tiny import tiny

    if quiet:
        diffusers.utils.logging.disable_progress_bar()
        transformers.utils.logging.disable_progress_bar()
    if model is None:
        pipe: Any = tiny(name, dtype=of_networks)
    else:
        folder = folder_of(model)
        with reading("--model", model):
            pipe = getattr(pipelines, CLASSES[name]).from_pretrained(folder, dtype=of_networks)
    for file in sensors or ():
        pipe.load_sensor(file)
    pipe.set_progress_bar_config(disable=quiet)
    return pipe.to(place)


def load_joint_space(
    model: str | None, device: str = "cpu", option: str = "--model"
) -> "tuple[UniTouchModel, UniTouchProcessor]":
    """The joint space of a folder, repository or saved pipeline, or the built-in one, with its processor."""
    place = device_of(device)
    import transformers.utils.logging

    from unitouch_gen.files import reading
    from unitouch_gen.models import UniTouchModel, UniTouchProcessor
    from unitouch_gen.weights import JOINT

    transformers.utils.logging.disable_progress_bar()
    folder = joint = processor = JOINT if model is None else folder_of(model, option)
    if (folder / "model_index.json").is_file():
        joint, processor = folder / "unitouch", folder / "processor"
    with reading(option, folder):
        return UniTouchModel.from_pretrained(joint).to(place), UniTouchProcessor.from_pretrained(processor)


def folder_of(model: str, option: str = "--model") -> Path:
    """The folder of a model; a repository is fetched first. A name without an owner is a folder that is mistyped."""
    from unitouch_gen.files import as_path, local_folder

    if not as_path(option, model).is_dir() and model.count("/") != 1:
        raise InvalidInputError(f"`{option}` is {model!r}, which is no folder; name a folder or a repository id.")
    return local_folder(option, model)


def kind_of(model: str) -> str:
    """The name among `CLASSES` of a saved pipeline."""
    from unitouch_gen.files import read_json

    named = read_json("--model", folder_of(model) / "model_index.json").get("_class_name")
    name = named[-1] if isinstance(named, list) and named else named  # [module, class] where code lies beside it
    for kind, known in CLASSES.items():
        if known == name:
            return kind
    raise InvalidInputError(
        f"`--model` is {model!r}, which holds a {name}; name a saved {', '.join(CLASSES.values())}."
    )
