"""The last stage: puts the outputs of the others together into one family of weights, in fp16.

python -m unitouch_gen.training.assemble --runs runs --output unitouch_gen/weights
"""

import argparse
import json
from pathlib import Path

from diffusers import DPMSolverMultistepScheduler
from safetensors.torch import load_file, save_file

from unitouch_gen.diffusion.solvers import make_scheduler
from unitouch_gen.encoders import UniTouchConfig, UniTouchProcessor
from unitouch_gen.training.folders import write_folder

DEFAULTS = {
    "default_strength": 1.0,
    "default_guidance_scale": 4.0,
    "default_num_inference_steps": 20,
    "default_noise_level": 450,
}
"""What the tiny touch-to-image pipeline does where a call says nothing, chosen on the validation split.

A touch says less of a picture than the picture's own embedding does: noise on the embedding tells the UNet so. At level
0 the judge agreed with 55 % of the pictures, at 450 with 68 %."""


def half(source: Path, target: Path) -> None:
    """Copies one safetensors file in fp16; integer and boolean tensors stay as they are."""
    state = {key: value.half() if value.is_floating_point() else value for key, value in load_file(source).items()}
    save_file(state, target, metadata={"format": "pt"})


def half_folder(source: Path, target: Path) -> None:
    """Copies a saved model: weights in fp16, everything else as it is."""
    target.mkdir(parents=True, exist_ok=True)
    for file in sorted(source.iterdir()):
        if file.is_dir():
            half_folder(file, target / file.name)
        elif file.suffix == ".safetensors":
            half(file, target / file.name)
        else:
            (target / file.name).write_bytes(file.read_bytes())


def write_joint(runs: Path, target: Path) -> None:
    """The senses of three stages as one model."""
    state = {}
    for stage in ("image_text", "audio", "touch"):
        state.update(load_file(runs / stage / "model" / "model.safetensors"))
    state = {key: value.half() if value.is_floating_point() else value for key, value in state.items()}
    save_file(state, target / "model.safetensors", metadata={"format": "pt"})
    # The sensors are those that touch was trained on; everything else is the same in all three.
    UniTouchConfig.from_pretrained(runs / "touch" / "model").save_pretrained(target)
    UniTouchProcessor.from_pretrained(runs / "image_text" / "model").save_pretrained(target)


def write_touch_to_image(runs: Path, target: Path) -> None:
    """UNet, normaliser and schedules, with the solver the pipeline uses by itself."""
    source = runs / "unclip" / "model"
    for name in ("unet", "image_normalizer", "image_noising_scheduler"):
        half_folder(source / name, target / name)
    trained = DPMSolverMultistepScheduler.from_pretrained(source / "scheduler")
    make_scheduler(trained, "dpm++2m").save_pretrained(target / "scheduler")
    (target / "defaults.json").write_text(json.dumps(DEFAULTS, indent=2) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m unitouch_gen.training.assemble")
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="folder of the stages' outputs")
    parser.add_argument("--output", type=Path, required=True, help="folder of the family")
    arguments = parser.parse_args()
    runs, output = arguments.runs, arguments.output
    output.mkdir(parents=True, exist_ok=True)
    write_folder(output / "joint", lambda folder: write_joint(runs, folder))
    write_folder(output / "image-vae", lambda folder: half_folder(runs / "image_vae" / "model", folder))
    write_folder(output / "touch-to-image", lambda folder: write_touch_to_image(runs, folder))
    write_folder(output / "picture-judge", lambda folder: half_folder(runs / "picture_judge" / "model", folder))
    stages = ("image_text", "audio", "touch", "image_vae", "unclip", "picture_judge")
    training = {stage: json.loads((runs / stage / "record.json").read_text()) for stage in stages}
    partial = output / "family.json.partial"
    partial.write_text(json.dumps({"training": training, "figures": {}}, indent=2) + "\n")
    partial.rename(output / "family.json")


if __name__ == "__main__":
    main()
