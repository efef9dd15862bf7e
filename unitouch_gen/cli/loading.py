"""The pipeline a command runs on."""

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from unitouch_gen.cli.options import dtype_of

if TYPE_CHECKING:
    import torch

    from unitouch_gen.pipelines.common import Plan

CLASSES = {
    "touch-to-image": "TouchToImagePipeline",
    "x-to-touch": "XToTouchPipeline",
    "stylization": "TactileStylizationPipeline",
}
"""Of `unitouch_gen.pipelines`, by the names of the built-in ones."""


def load_for(name: str, request: Mapping[str, Any], model: str | None, quiet: bool, dtype: str | None) -> Any:
    """The pipeline without the parts that a request leaves out.

    Args:
        name, model, quiet: See `load_pipeline`.
        request: Arguments of the call to come that its plan depends on.
        dtype: Of the networks, by name; float32 if left out.

    Raises:
        InvalidInputError: If it cannot be loaded, or there is no such dtype.
    """
    of_networks = dtype_of(dtype)
    import torch

    from unitouch_gen import pipelines

    if model is None and "OMP_NUM_THREADS" not in os.environ:
        # The built-in networks are so small that more threads gain a tenth where the machine is idle; where it is busy,
        # they wait for each other in every layer and take forty times as long.
        torch.set_num_threads(1)
    plan = getattr(pipelines, CLASSES[name]).plan(**request)
    return load_pipeline(name, plan.modalities, model, quiet, plan, of_networks)


def load_pipeline(
    name: str,
    modalities: Iterable[str],
    model: str | None,
    quiet: bool,
    plan: "Plan | None" = None,
    dtype: "torch.dtype | None" = None,
) -> Any:
    """The pipeline saved in a folder or repository, or the built-in one.

    Args:
        name: Of the built-in pipeline; a saved one is of the same class.
        modalities: Read now rather than when they are first used.
        model: Folder or repository id, or `None`.
        quiet: Whether to show no bars while it loads.
        plan: Of the calls to come; all of it is loaded if there is none.
        dtype: Of the networks; float32 if left out.

    Raises:
        InvalidInputError: If it cannot be loaded.
    """
    import diffusers.utils.logging
    import torch
    import transformers.utils.logging

    from unitouch_gen import pipelines
    from unitouch_gen.errors import InvalidInputError, first_line
    from unitouch_gen.pipelines.tiny import tiny

    if quiet:
        diffusers.utils.logging.disable_progress_bar()
        transformers.utils.logging.disable_progress_bar()
    if model is None:
        return tiny(name, plan=plan, dtype=dtype or torch.float32)
    folder = saved_pipeline(model)
    try:
        pipe = getattr(pipelines, CLASSES[name]).from_pretrained(folder, plan=plan, dtype=dtype or torch.float32)
        for modality in modalities if pipe.unitouch is not None else ():
            pipe.unitouch.load(modality)
    except Exception as error:  # a broken folder makes its many readers raise as many kinds of errors
        raise InvalidInputError(f"`--model` is {model!r}, which cannot be loaded: {first_line(error)}") from error
    return pipe


def saved_pipeline(model: str) -> Path:
    """The folder of a saved pipeline; a repository id is fetched first.

    Raises:
        InvalidInputError: If it is neither.
    """
    from unitouch_gen.errors import InvalidInputError
    from unitouch_gen.files import local_folder

    if not Path(model).is_dir() and model.count("/") != 1:  # names without an owner are mistyped folders
        raise InvalidInputError(f"`--model` is {model!r}, which is no folder; name a folder or a repository id.")
    folder = local_folder("--model", model)
    if not (folder / "model_index.json").is_file():
        raise InvalidInputError(f"`--model` is {model!r}, which holds no model_index.json; name a saved pipeline.")
    return folder
