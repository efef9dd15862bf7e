"""The last stage: puts the outputs of the others together into one family of weights, in fp16.

python -m unitouch_gen.training.assemble --runs runs --output my-family
"""

import argparse
import json
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from diffusers import DDPMScheduler
from safetensors.torch import load_file, save_file
from torch import Tensor

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.files import replacing, replacing_folder, restore_folder
from unitouch_gen.models import UniTouchConfig, UniTouchProcessor
from unitouch_gen.schedulers.solvers import make_scheduler
from unitouch_gen.training.inputs import changed
from unitouch_gen.training.stages import STAGES, command, command_of

COPIED = {
    "image-vae": "image_vae",
    "picture-classifier": "picture_classifier",
    "touch-vae": "touch_vae",
    "touch-classifier": "touch_classifier",
}
"""Folders of the family that are one stage's model."""

TOUCH_TO_IMAGE = {
    "default_strength": 1.0,
    "default_guidance_scale": 4.0,
    "default_num_inference_steps": 20,
    "default_noise_level": 450,
}
"""What the tiny touch-to-image pipeline does where a call says nothing, chosen on the validation split.

A touch says less of a picture than the picture's own embedding does: noise on the embedding tells the UNet so."""

X_TO_TOUCH = {"default_guidance_scale": 3.0, "default_num_inference_steps": 20}
"""What the tiny X-to-touch pipeline does where a call says nothing, chosen on the validation split."""


def halved(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """Weights in fp16; integer and boolean tensors stay as they are."""
    return {key: value.half() if value.is_floating_point() else value for key, value in state.items()}


def half_folder(source: Path, target: Path) -> None:
    """Copies a saved model: weights in fp16, everything else as it is."""
    target.mkdir(parents=True, exist_ok=True)
    for file in sorted(source.iterdir()):
        if file.is_dir():
            half_folder(file, target / file.name)
        elif file.suffix == ".safetensors":
            save_file(halved(load_file(file)), target / file.name, metadata={"format": "pt"})
        else:
            (target / file.name).write_bytes(file.read_bytes())


def write_joint(runs: Path, target: Path) -> None:
    """The modalities of three stages as one model."""
    target.mkdir(exist_ok=True)
    state = {}
    for stage in ("image_text", "audio", "touch"):
        state.update(load_file(runs / stage / "model" / "model.safetensors"))
    save_file(halved(state), target / "model.safetensors", metadata={"format": "pt"})
    # The sensors are those that touch was trained on; everything else is the same in all three.
    UniTouchConfig.from_pretrained(runs / "touch" / "model").save_pretrained(target)
    UniTouchProcessor.from_pretrained(runs / "image_text" / "model").save_pretrained(target)


def write_touch_to_image(runs: Path, target: Path) -> None:
    """UNet, normaliser and schedules, with the solver the pipeline uses by itself."""
    source = runs / "unclip" / "model"
    for name in ("unet", "image_normalizer", "image_noising_scheduler"):
        half_folder(source / name, target / name)
    write_solver(source / "scheduler", target / "scheduler", "dpm++2m")
    write_json(TOUCH_TO_IMAGE, target / "defaults.json")


def write_x_to_touch(runs: Path, target: Path) -> None:
    """UNet and bank of image embeddings, with the solver the pipeline uses by itself and the sensors it draws."""
    source = runs / "touch_ldm" / "model"
    for name in ("unet", "embedding_bank"):
        half_folder(source / name, target / name)
    write_solver(source / "scheduler", target / "scheduler", "unipc")
    sensors = json.loads((source / "sensors.json").read_text())
    write_json({"sensors": sensors, **X_TO_TOUCH}, target / "defaults.json")


def write_solver(source: Path, target: Path, solver: str) -> None:
    """The pipeline's own solver over the schedule that was trained with; `unitouch-gen fit` puts its steps over it."""
    make_scheduler(DDPMScheduler.from_pretrained(source), solver).save_pretrained(target)


def write_json(content: dict[str, Any], file: Path) -> None:
    file.write_text(json.dumps(content, indent=2) + "\n")


def check_runs(runs: Path) -> None:
    """Checks that every stage has run.

    Raises:
        InvalidInputError: If one has not; the message names the command that does.
    """
    for stage in STAGES:
        restore_folder(runs / stage / "model")
        for part in (runs / stage / "model", runs / stage / "record.json"):
            if not part.exists():
                raise InvalidInputError(f"`runs` lacks {str(part)!r}; make it with: {command_of(stage, runs)}")


def check_inputs(runs: Path) -> None:
    """Checks that every stage was built on what those before it hold now; records without hashes pass.

    Raises:
        InvalidInputError: If one was not; the message says which, and what to remove.
    """
    stale = {}
    for stage, needs in STAGES.items():
        recorded = json.loads((runs / stage / "record.json").read_text()).get("inputs", {})
        options = changed(recorded, {option: runs / before / "model" for option, before in needs.items()})
        if options:
            stale[stage] = " and ".join(needs[option] for option in options)
    if stale:
        listed = ", ".join(f"{stage} (of {before})" for stage, before in stale.items())
        raise InvalidInputError(
            f"`runs` is {str(runs)!r}, where stages were built on other weights than those before them hold now: "
            f"{listed}. Remove {', '.join(str(runs / stage) for stage in stale)}, and train them anew."
        )


def assemble(runs: Path, output: Path) -> None:
    """Writes a family of what all stages left, whole before anything of an earlier one is replaced.

    Its `family.json` holds the stages' records, and no figures: those an earlier one held were of other weights.

    Args:
        runs: Folder of the stages' outputs.
        output: Folder of the family; what it holds beside that stays.

    Raises:
        InvalidInputError: If a stage has not run, or was built on other weights than those before it left.
    """
    check_runs(runs)
    check_inputs(runs)
    records = {stage: json.loads((runs / stage / "record.json").read_text()) for stage in STAGES}
    with ExitStack() as parts:  # they take their places when all are written, family.json as the last
        write_json({"training": records, "figures": {}}, parts.enter_context(replacing(output / "family.json")))

        def part(name: str) -> Path:
            return parts.enter_context(replacing_folder(output / name))

        write_joint(runs, part("joint"))
        for name, stage in COPIED.items():
            half_folder(runs / stage / "model", part(name))
        write_touch_to_image(runs, part("touch-to-image"))
        write_x_to_touch(runs, part("x-to-touch"))


@command
def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m unitouch_gen.training.assemble")
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="folder of the stages' outputs")
    parser.add_argument("--output", type=Path, required=True, help="folder of the family")
    arguments = parser.parse_args()
    assemble(arguments.runs, arguments.output)


if __name__ == "__main__":
    main()
