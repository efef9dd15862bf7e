"""The pipeline that a command runs on."""

import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from unitouch_gen.cli.options import device_of
from unitouch_gen.errors import InvalidInputError, check_dtype

if TYPE_CHECKING:
    from unitouch_gen.evaluation.zero_shot import ZeroShotTouchClassifier
    from unitouch_gen.models import UniTouchModel, UniTouchProcessor
    from unitouch_gen.pipelines.common import Plan

CLASSES = {
    "touch-to-image": "TouchToImagePipeline",
    "x-to-touch": "XToTouchPipeline",
    "stylization": "TactileStylizationPipeline",
}
"""Classes of `unitouch_gen.pipelines` by the names of the built-in pipelines."""


def load_pipeline(
    name: str,
    model: str | None,
    quiet: bool,
    modalities: Iterable[str] = (),
    *,
    arguments: Mapping[str, Any] | None = None,
    plan: "Plan | None" = None,
    dtype: str | None = None,
    device: str = "cpu",
    sensors: Sequence[Path] | None = None,
) -> Any:
    """The pipeline saved in a folder, or in a repository, which is fetched first; or the built-in one.

    Args:
        name: Name of the built-in pipeline; a saved one is of the same class.
        model: Folder or repository id, or `None`.
        quiet: Whether to show no bars while it loads.
        modalities: Read now rather than when they are first used.
        arguments: Arguments of the one call to come: what it leaves out is not loaded, what it needs is read now.
        plan: Of the calls to come, in place of `arguments`.
        dtype: Dtype of the networks, by name; float32 if left out.
        device: Where the networks go, by name, or "auto".
        sensors: Files of sensors to add.
    """
    of_networks = check_dtype("dtype", "float32" if dtype is None else dtype)
    place = device_of(device)
    import diffusers.utils.logging
    import torch
    import transformers.utils.logging

    from unitouch_gen import pipelines
    from unitouch_gen.files import reading
    from unitouch_gen.pipelines.tiny import tiny

    pipeline = getattr(pipelines, CLASSES[name])
    if arguments is not None:
        plan = pipeline.plan(**arguments)
    if plan is not None:
        modalities = plan.modalities
        if model is None and "OMP_NUM_THREADS" not in os.environ:
            # The built-in networks are so small that more threads gain a tenth where the machine is idle; where it is
            # busy, they wait for each other in every layer and take forty times as long.
            torch.set_num_threads(1)
    if quiet:
        diffusers.utils.logging.disable_progress_bar()
        transformers.utils.logging.disable_progress_bar()
    if model is None:
        pipe = tiny(name, plan=plan, dtype=of_networks)
    else:
        folder = saved_pipeline(model)
        with reading("--model", model):
            pipe = pipeline.from_pretrained(folder, plan=plan, dtype=of_networks)
            for modality in modalities if pipe.unitouch is not None else ():
                pipe.unitouch.load(modality)
    for file in sensors or ():
        pipe.load_sensor(file)
    return pipe if place.type == "cpu" else pipe.to(place)


def load_joint_space(
    model: str | None, device: str = "cpu", option: str = "--model"
) -> "tuple[UniTouchModel, UniTouchProcessor]":
    """The joint space of a folder or repository, or of the pipeline that is saved there, with its processor.

    The built-in one if `model` is `None`; `option` is what named it.
    """
    place = device_of(device)
    import transformers.utils.logging

    from unitouch_gen.files import reading
    from unitouch_gen.models import UniTouchModel, UniTouchProcessor

    transformers.utils.logging.disable_progress_bar()
    folder, joint, processor, _ = _folders_of(model, option)
    if not (joint / "config.json").is_file():
        raise InvalidInputError(
            f"`{option}` is {str(model)!r}, which holds no joint space; name one, or a pipeline of one."
        )
    with reading(option, folder):
        return UniTouchModel.from_pretrained(joint).to(place), UniTouchProcessor.from_pretrained(processor)


def load_classifier(model: str | None, device: str = "cpu") -> "ZeroShotTouchClassifier":
    """What names touches by `load_joint_space`, and by the bank of image embeddings of its pipeline or family."""
    from unitouch_gen.conditioning import EmbeddingBank
    from unitouch_gen.evaluation.zero_shot import ZeroShotTouchClassifier
    from unitouch_gen.files import reading

    joint, processor = load_joint_space(model, device)
    folder, *_, bank = _folders_of(model, "--model")
    with reading("--model", folder):
        found = EmbeddingBank.from_pretrained(bank) if bank.is_dir() else None
    return ZeroShotTouchClassifier(joint, processor, found)


def _folders_of(model: str | None, option: str) -> tuple[Path, Path, Path, Path]:
    """Where a model is, its joint space, its processor, and its bank of image embeddings if it has one."""
    from unitouch_gen.files import as_path, local_folder
    from unitouch_gen.weights import EMBEDDING_BANK, JOINT

    folder = JOINT if model is None else local_folder(option, as_path(option, model))
    if (folder / "model_index.json").is_file():
        return folder, folder / "unitouch", folder / "processor", folder / "embedding_bank"
    return folder, folder, folder, folder.parent / EMBEDDING_BANK.name  # as a family holds it


def kind_of(model: str) -> str:
    """The name among `CLASSES` of a saved pipeline."""
    from unitouch_gen.files import read_json
    from unitouch_gen.pipelines.hub import class_of

    name = class_of(read_json("--model", saved_pipeline(model) / "model_index.json"))
    kind = next((kind for kind, known in CLASSES.items() if known == name), None)
    if kind is None:
        raise InvalidInputError(
            f"`--model` is {model!r}, which holds a {name}; name a saved {', '.join(CLASSES.values())}."
        )
    return kind


def saved_pipeline(model: str) -> Path:
    """The folder of a saved pipeline; a repository is fetched first."""
    from unitouch_gen.files import as_path, local_folder

    if not as_path("--model", model).is_dir() and model.count("/") != 1:  # names without an owner are mistyped folders
        raise InvalidInputError(f"`--model` is {model!r}, which is no folder; name a folder or a repository id.")
    folder = local_folder("--model", model)
    if not (folder / "model_index.json").is_file():
        raise InvalidInputError(f"`--model` is {model!r}, which holds no model_index.json; name a saved pipeline.")
    return folder
