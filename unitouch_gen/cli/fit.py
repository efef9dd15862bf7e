"""`unitouch-gen fit`."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from unitouch_gen.cli.loading import load_pipeline
from unitouch_gen.cli.options import is_quiet
from unitouch_gen.cli.work_precision import MODALITIES, Listed, values

if TYPE_CHECKING:
    from unitouch_gen.pipelines.common import UniTouchPipeline

CALIBRATED = 48
"""Contacts of the validation split that are calibrated on, at most."""


def fit(
    pipeline: Annotated[str, typer.Option(help="touch-to-image, stylization or x-to-touch.")],
    model: Annotated[Path | None, typer.Option(help="Folder of a saved pipeline, which is changed.")] = None,
    family: Annotated[Path | None, typer.Option(help="Folder of a family of weights, which is changed.")] = None,
    guidance: Annotated[
        Listed, typer.Option(help="Guidance scales by comma; what lies between is served, too.")
    ] = None,
    steps: Annotated[Listed, typer.Option(help="Numbers of steps by comma; 6 to 26 if left out.")] = None,
    contacts: Annotated[int, typer.Option(help="Contacts of the world's training objects to fit on.")] = 64,
    otherwise: Annotated[
        str | None, typer.Option(help="Solver of calls that nothing was fitted to; the one of before if left out.")
    ] = None,
    calibrate: Annotated[
        bool, typer.Option(metavar="", help="Measure what error indicators stand for, too, in minutes.")
    ] = True,
) -> None:
    """Fits steps to a checkpoint, and stores them and what its error indicators stand for with it.

    Example: unitouch-gen fit --pipeline x-to-touch --model saved/ --guidance 1,3,8 --steps 8,12,20
    """
    from unitouch_gen.errors import InvalidInputError, check_choice, check_integer
    from unitouch_gen.files import check_writable
    from unitouch_gen.numerics import fit as fitting
    from unitouch_gen.pipelines.tiny import tiny
    from unitouch_gen.schedulers.solvers import SOLVERS, name_of
    from unitouch_gen.world import FIRST_OBJECT, MATERIAL_NAMES

    modalities = MODALITIES[check_choice("pipeline", pipeline, MODALITIES)]
    if (model is None) == (family is None):
        raise InvalidInputError("Pass `--model` or `--family`, one of them: the folder that fits are stored in.")
    if model is not None and not model.is_dir():
        raise InvalidInputError(f"`--model` is {str(model)!r}, which is no folder; fits are stored in it, so name one.")
    if family is not None and not family.is_dir():
        raise InvalidInputError(f"`--family` is {str(family)!r}, which is no folder; `make weights` makes one.")
    if model is not None:
        check_writable("--model", model / "model_index.json")
    elif family is not None:
        check_writable("--family", family / "defaults.json")
    check_integer("contacts", contacts, 1, FIRST_OBJECT["val"] * len(MATERIAL_NAMES))
    numbers = values("steps", steps, int, fitting.STEPS)
    for number in numbers:
        check_integer("steps", number, 1, fitting.MOST_STEPS)
    if otherwise is not None:
        check_choice("otherwise", otherwise, SOLVERS)
    pipe = tiny(pipeline, family=family) if family else load_pipeline(pipeline, str(model), is_quiet(False), modalities)
    pipe.set_progress_bar_config(disable=True)
    usual = float(pipe.config["default_guidance_scale"])
    scales = sorted(values("guidance", guidance, float, (usual,)), key=lambda scale: abs(scale - usual))
    fits = fitting.fit_pipeline(
        fitting.contact_targets(pipe, modalities, contacts, name=pipeline), scales, numbers, typer.echo
    )
    otherwise = otherwise or pipe.scheduler.config.get("otherwise", name_of(pipe.scheduler) or "dpm++2m")
    pipe.scheduler = fitting.with_fits(pipe.scheduler, fits, otherwise)
    save_fits(pipe, pipeline, model, family)  # at once, as calibrating takes longer
    if calibrate:
        others = fitting.contact_targets(
            pipe, modalities, min(contacts, CALIBRATED), FIRST_OBJECT["val"], name=pipeline, seed=fitting.SEED + 1
        )
        pipe.register_to_config(calibration=fitting.calibrate_pipeline(others, scales, typer.echo))
        save_fits(pipe, pipeline, model, family)
    typer.echo(f"Fits are in {(model or family or Path()).resolve()}")


def save_fits(pipe: "UniTouchPipeline", name: str, model: Path | None, family: Path | None) -> None:
    """Writes the scheduler and the calibration into the folder that the pipeline came from."""
    from unitouch_gen import weights
    from unitouch_gen.files import writing_folder
    from unitouch_gen.pipelines.hub import name_classes

    if model is not None:
        folder, defaults = model, "model_index.json"
        changed = {"scheduler": [type(pipe.scheduler).__module__, type(pipe.scheduler).__name__]}
    else:
        assert family is not None
        part = weights.X_TO_TOUCH if name == "x-to-touch" else weights.TOUCH_TO_IMAGE
        folder, defaults, changed = family / part.name, "defaults.json", {}
    known = json.loads((folder / defaults).read_text(encoding="utf-8"))
    with writing_folder("--model" if model else "--family", folder) as place:
        pipe.scheduler.save_pretrained(place / "scheduler")
        settings = {**known, **changed, "calibration": pipe.config["calibration"]}
        (place / defaults).write_text(json.dumps(settings, indent=2) + "\n", encoding="utf-8")
        if model is not None:
            name_classes(place)
