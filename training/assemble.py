"""The last stage: puts the outputs of the others together into one family of weights, in fp16.

python -m unitouch_gen.training.assemble --runs runs --output my-family
"""

import json
import shutil
from pathlib import Path
from typing import Annotated, Any

import typer
from diffusers import DDPMScheduler, DEISMultistepScheduler, UniPCMultistepScheduler
from safetensors.torch import load_file, save_file

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.files import writing_folder
from unitouch_gen.models import UniTouchConfig, UniTouchProcessor
from unitouch_gen.schedule import TRAINED
from unitouch_gen.training.language_model import PROMPT
from unitouch_gen.training.stages import STAGES, command_of, run_command, weights_of

# What the tiny pipelines do where a call says nothing, chosen on the validation split. A touch says less of a picture
# than the picture's own embedding does: noise on the embedding tells the UNet so.
TOUCH_TO_IMAGE = {"default_strength": 1.0, "default_guidance_scale": 4.0, "default_num_inference_steps": 10,
                  "default_noise_level": 150}  # fmt: skip
STYLIZATION = {**TOUCH_TO_IMAGE, "default_noise_level": 250}  # best beside the embedding bank
X_TO_TOUCH = {"default_guidance_scale": 4.0, "default_num_inference_steps": 20}


def halved(sources: list[Path], target: Path) -> None:
    """Writes the weights of some files as one in fp16; integer and boolean tensors stay as they are."""
    stored = [item for source in sources for item in load_file(source).items()]
    state = {key: value.half() if value.is_floating_point() else value for key, value in stored}
    save_file(state, target, metadata={"format": "pt"})


def half_folder(source: Path, target: Path) -> None:
    """Copies a saved model, its weights in fp16."""
    shutil.copytree(source, target)
    for file in target.rglob("*.safetensors"):
        halved([file], file)
    for file in target.rglob("config.json"):
        settings = {key: value for key, value in json.loads(file.read_text()).items() if key != "_name_or_path"}
        write_json(settings, file)


def write_json(content: dict[str, Any], file: Path) -> None:
    file.write_text(json.dumps(content, indent=2) + "\n")


def write_generator(source: Path, target: Path, defaults: dict[str, Any], kind: Any, spacing: str) -> None:
    """Writes what only one pipeline has: its networks, its defaults, and a scheduler over the trained schedule."""
    for part in ("unet", "image_normalizer", "image_noising_scheduler", "backgrounds"):
        if (source / part).is_dir():
            half_folder(source / part, target / part)
    config = DDPMScheduler.from_pretrained(source / "scheduler").config
    kind(**{name: config[name] for name in TRAINED}, **{spacing: True}).save_pretrained(target / "scheduler")
    write_json(defaults, target / "defaults.json")


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
    *,
    runs: Annotated[Path, typer.Option(help="Folder of the stages' outputs.")] = Path("runs"),
    output: Annotated[Path, typer.Option(help="Folder of the family; what else it holds stays.")],
) -> None:
    """Writes a family of what all stages left, whole before anything of an earlier one is replaced.

    Its `family.json` holds the stages' records and no figures: those an earlier one held were of other weights.
    """
    records = read_records(runs)
    models = {stage: runs / stage / "model" for stage in STAGES}
    with writing_folder("output", output, replace=True) as place:
        # The sensors are those that touch was trained on; everything else is the same in all three.
        UniTouchConfig.from_pretrained(models["touch"]).save_pretrained(place / "joint")
        UniTouchProcessor.from_pretrained(models["image_text"]).save_pretrained(place / "joint")
        parts = [models[stage] / "model.safetensors" for stage in ("image_text", "audio", "touch")]
        halved(parts, place / "joint" / "model.safetensors")
        for stage in ("image_vae", "touch_vae"):
            half_folder(models[stage], place / stage.replace("_", "-"))
        # Of diffusers' multistep schedulers and spacings, these do best in the number of steps above.
        pictures = (TOUCH_TO_IMAGE, DEISMultistepScheduler, "use_karras_sigmas")
        write_generator(models["unclip"], place / "touch-to-image", *pictures)
        (place / "stylization").mkdir()
        write_json(STYLIZATION, place / "stylization" / "defaults.json")
        ldm = models["touch_ldm"]
        settings = {"sensors": json.loads((ldm / "sensors.json").read_text()), **X_TO_TOUCH}
        write_generator(ldm, place / "x-to-touch", settings, UniPCMultistepScheduler, "use_exponential_sigmas")
        half_folder(ldm / "embedding_bank", place / "embedding-bank")
        half_folder(models["touch_llm"], place / "touch-to-text")
        write_json({"prompt_template": PROMPT}, place / "touch-to-text" / "defaults.json")
        write_json({"training": records, "figures": {}}, place / "family.json")


if __name__ == "__main__":
    run_command("assemble", assemble)
