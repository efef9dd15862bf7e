"""Assembles the outputs of all stages of training into one family of weights, in fp16, for `tiny(family=)`.

python samples/assemble_family.py runs my-family
"""

import json
import shlex
import shutil
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from diffusers import DDPMScheduler, DEISMultistepScheduler, EulerAncestralDiscreteScheduler
from safetensors.torch import load_file, save_file

from unitouch_gen.commands import run_commands
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.saving import filling
from unitouch_gen.schedule import TRAINED
from unitouch_gen.training.family import FINAL_RUNS, STAGES
from unitouch_gen.training.stages import hash_weights
from unitouch_gen.training.touch_llm import PROMPT

# Defaults of the tiny pipelines, chosen on the validation split. A touch determines a picture less than the picture's
# own embedding does, so noise is added to the embedding.
TOUCH_TO_IMAGE = {
    "default_strength": 1.0,
    "default_guidance_scale": 4.0,
    "default_num_inference_steps": 10,
    "default_noise_level": 150,
}
STYLIZATION = {**TOUCH_TO_IMAGE, "default_noise_level": 250}  # best with the embedding bank
X_TO_TOUCH = {"default_guidance_scale": 4.0, "default_num_inference_steps": 20}
# The best schedulers for those numbers of steps. Noise between steps makes touches more varied.
SCHEDULERS: dict[str, tuple[Any, dict[str, Any]]] = {
    "touch-to-image": (DEISMultistepScheduler, {"use_karras_sigmas": True}),
    "x-to-touch": (EulerAncestralDiscreteScheduler, {}),
}


def halve(folder: Path) -> None:
    """Converts all weights below a folder to fp16; integer and boolean tensors are kept."""
    for file in folder.rglob("*.safetensors"):
        tensors = load_file(file)  # mapped into memory, so kept tensors are copied before the file is replaced
        state = {key: value.half() if value.is_floating_point() else value.clone() for key, value in tensors.items()}
        save_file(state, file, metadata={"format": "pt"})
    for file in folder.rglob("config.json"):
        settings = {key: value for key, value in json.loads(file.read_text()).items() if key != "_name_or_path"}
        write_json(settings, file)


def write_json(content: dict[str, Any], file: Path) -> None:
    file.write_text(json.dumps(content, indent=2) + "\n")


def read_records(runs: Path) -> dict[str, dict[str, Any]]:
    """The record of each stage; raises if one has not run, or was built on other weights than are there now."""
    records = {}
    for run in FINAL_RUNS:
        folder = runs / run.name
        file = folder / "record.json"
        if not file.is_file() or not (folder / "model").is_dir():
            command = shlex.join(["python", "-m", "unitouch_gen.training", "family", "--runs", str(runs)])
            raise InvalidInputError(f"`runs` lacks {str(file)!r}; make it with: {command}")
        records[run.name] = json.loads(file.read_text())
        for option, before in STAGES[run.name].takes.items():
            if records[run.name]["inputs"][option] != hash_weights(runs / before / "model"):
                why = f"which was built on other weights than {before} holds now; remove it, and train it anew."
                raise InvalidInputError(f"`runs` holds {str(folder)!r}, {why}")
    return records


def assemble(
    runs: Annotated[Path, typer.Argument(help="Folder of the stages' outputs.")],
    output: Annotated[Path, typer.Argument(help="Folder of the family; other files in it are kept.")],
) -> None:
    """Writes a family from the outputs of all stages. An earlier family is replaced after all of it is written.

    Its `family.json` has the stages' records and no figures, since earlier figures were of other weights.
    """
    records = read_records(runs)
    with filling("output", output) as folder:
        for run in FINAL_RUNS:
            if run.place is not None:
                shutil.copytree(runs / run.name / "model", folder / run.place)
        (folder / "x-to-touch" / "embedding_bank").rename(folder / "embedding-bank")
        (folder / "stylization").mkdir()
        sensors = folder / "x-to-touch" / "sensors.json"
        defaults = {
            "touch-to-image": TOUCH_TO_IMAGE,
            "stylization": STYLIZATION,
            "x-to-touch": {"sensors": json.loads(sensors.read_text()), **X_TO_TOUCH},
            "touch-to-text": {"prompt_template": PROMPT},
        }
        sensors.unlink()
        for name, settings in defaults.items():
            write_json(settings, folder / name / "defaults.json")
        for name, (kind, options) in SCHEDULERS.items():
            config = DDPMScheduler.from_pretrained(folder / name / "scheduler").config
            scheduler = kind(**{key: config[key] for key in TRAINED}, **options)
            scheduler.save_pretrained(folder / name / "scheduler")
        halve(folder)
        write_json({"training": records, "figures": {}}, folder / "family.json")


if __name__ == "__main__":
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command()(assemble)
    sys.exit(run_commands(app, "assemble_family"))
