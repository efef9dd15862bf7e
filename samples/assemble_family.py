"""Puts the outputs of all stages of training together into one family of weights, in fp16, as `tiny(family=)` takes it.

python samples/assemble_family.py runs my-family
"""

import json
import shutil
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from diffusers import DDPMScheduler, DEISMultistepScheduler, EulerAncestralDiscreteScheduler
from safetensors.torch import load_file, save_file

from unitouch_gen.errors import InvalidInputError, run_commands
from unitouch_gen.saving import filling
from unitouch_gen.schedule import TRAINED
from unitouch_gen.training.stages import STAGES, weights_of
from unitouch_gen.training.touch_llm import PROMPT

# What the tiny pipelines do where a call says nothing, chosen on the validation split. A touch says less of a picture
# than the picture's own embedding does: noise on the embedding tells the UNet so.
TOUCH_TO_IMAGE = {
    "default_strength": 1.0,
    "default_guidance_scale": 4.0,
    "default_num_inference_steps": 10,
    "default_noise_level": 150,
}
STYLIZATION = {**TOUCH_TO_IMAGE, "default_noise_level": 250}  # best beside the embedding bank
X_TO_TOUCH = {"default_guidance_scale": 4.0, "default_num_inference_steps": 20}
# These do best in those numbers of steps. Noise that is added between steps brings touches' variety back.
SCHEDULERS: dict[str, tuple[Any, dict[str, Any]]] = {
    "touch-to-image": (DEISMultistepScheduler, {"use_karras_sigmas": True}),
    "x-to-touch": (EulerAncestralDiscreteScheduler, {}),
}

PLACES = {
    "audio": "joint",
    "image_vae": "image-vae",
    "unclip": "touch-to-image",
    "touch_vae": "touch-vae",
    "touch_ldm": "x-to-touch",
    "touch_llm": "touch-to-text",
}
"""Folders of a family, by the stages whose models they hold."""


def halve(folder: Path) -> None:
    """Turns all weights below a folder into fp16; integer and boolean tensors stay as they are."""
    for file in folder.rglob("*.safetensors"):
        tensors = load_file(file).items()  # mapped into memory: what stays is copied before its file is replaced
        state = {key: value.half() if value.is_floating_point() else value.clone() for key, value in tensors}
        save_file(state, file, metadata={"format": "pt"})
    for file in folder.rglob("config.json"):
        settings = {key: value for key, value in json.loads(file.read_text()).items() if key != "_name_or_path"}
        write_json(settings, file)


def write_json(content: dict[str, Any], file: Path) -> None:
    file.write_text(json.dumps(content, indent=2) + "\n")


def command_of(stage: str, runs: Path) -> str:
    """What runs a stage, with all outputs in one folder."""
    needs = [f"--{option} {runs / before / 'model'}" for option, before in STAGES[stage].items()]
    return " ".join([f"python -m unitouch_gen.training {stage}", *needs, f"--output {runs / stage}"])


def read_records(runs: Path) -> dict[str, dict[str, Any]]:
    """The record of each stage; refuses if one has not run, or was built on other weights than those before it hold."""
    records = {}
    for stage, needs in STAGES.items():
        file = runs / stage / "record.json"
        if not file.is_file() or not (runs / stage / "model").is_dir():
            raise InvalidInputError(f"`runs` lacks {str(file)!r}; make it with: {command_of(stage, runs)}")
        records[stage] = json.loads(file.read_text())
        for option, before in needs.items():
            if records[stage]["inputs"][option] != weights_of(runs / before / "model"):
                why = f"which was built on other weights than {before} holds now; remove it, and train it anew."
                raise InvalidInputError(f"`runs` holds {str(runs / stage)!r}, {why}")
    return records


def assemble(
    runs: Annotated[Path, typer.Argument(help="Folder of the stages' outputs.")],
    output: Annotated[Path, typer.Argument(help="Folder of the family; what else it holds stays.")],
) -> None:
    """Writes a family of what all stages left; nothing of an earlier one is replaced before all of it is written.

    Its `family.json` holds the stages' records and no figures: those an earlier one held were of other weights.
    """
    records = read_records(runs)
    with filling("output", output) as place:
        for stage, name in PLACES.items():
            shutil.copytree(runs / stage / "model", place / name)
        (place / "x-to-touch" / "embedding_bank").rename(place / "embedding-bank")
        (place / "stylization").mkdir()
        sensors = place / "x-to-touch" / "sensors.json"
        defaults = {
            "touch-to-image": TOUCH_TO_IMAGE,
            "stylization": STYLIZATION,
            "x-to-touch": {"sensors": json.loads(sensors.read_text()), **X_TO_TOUCH},
            "touch-to-text": {"prompt_template": PROMPT},
        }
        sensors.unlink()
        for name, settings in defaults.items():
            write_json(settings, place / name / "defaults.json")
        for name, (kind, options) in SCHEDULERS.items():
            config = DDPMScheduler.from_pretrained(place / name / "scheduler").config
            scheduler = kind(**{key: config[key] for key in TRAINED}, **options)
            scheduler.save_pretrained(place / name / "scheduler")
        halve(place)
        write_json({"training": records, "figures": {}}, place / "family.json")


if __name__ == "__main__":
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command()(assemble)
    sys.exit(run_commands(app, "assemble_family"))
