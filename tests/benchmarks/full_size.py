"""Touch to image at the published size, beside diffusers' own pipeline: `python -m tests.benchmarks.full_size`.

Both make one picture of 768 x 768 pixels by Stable Diffusion 2.1 unCLIP, in one dtype, from the same files of random
weights and with the same guidance, steps and solver. diffusers' pipeline holds all of its components, the image encoder
among them. Ours has the touch encoder in the place of the image encoder, and frees each encoder when it has done its
work (`low_memory=True`).

Each run has a process of its own, and the two take turns. Its peak is the largest resident size (Linux) above that
after the same run on networks of a few kilobytes: so weights and values count, and torch's and diffusers' code does
not.
"""

import argparse
import gc
import json
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from diffusers import StableUnCLIPImg2ImgPipeline
from PIL import Image
from transformers import CLIPImageProcessor, CLIPTokenizer, CLIPVisionConfig, CLIPVisionModelWithProjection

from tests.benchmarks import Figures
from tests.benchmarks.apart import in_own_process
from tests.benchmarks.speedup import TimedUnclip
from tests.benchmarks.throughput import throughput_figures
from tests.benchmarks.turns import spread_of
from unitouch_gen import weights
from unitouch_gen.conditioning import QUALITY_PROMPT
from unitouch_gen.errors import InvalidInputError, check_choice, check_integer
from unitouch_gen.memory import PeakMemory, trim_memory
from unitouch_gen.models import UniTouchConfig, UniTouchModel, UniTouchProcessor
from unitouch_gen.models.config import FULL_SIZES, VISION
from unitouch_gen.models.presets import embedding_noise, unclip_networks, unclip_scheduler
from unitouch_gen.models.processing import TOKENIZER_FOLDER
from unitouch_gen.pipelines import TouchToImagePipeline
from unitouch_gen.pipelines.presets import made_in

GUIDANCE, STRENGTH = 9.0, 0.75
"""The paper's."""

MODULE = "tests.benchmarks.full_size"

DTYPES = {"bfloat16": torch.bfloat16, "float32": torch.float32}


@dataclass(frozen=True)
class Size:
    """What is measured.

    Attributes:
        unclip: Arguments of `unclip_networks`.
        joint: Settings of the joint space's `UniTouchConfig`.
        vision: Settings of the image encoder.
    """

    unclip: Mapping[str, Any]
    joint: Mapping[str, Any]
    vision: Mapping[str, Any]


FULL = Size({}, FULL_SIZES["unitouch-vit-l"], VISION)

_WIDTH = 16
_BLOCKS = {"block_out_channels": (32,) * 4}
_CLIP = {"hidden_size": _WIDTH, "intermediate_size": _WIDTH, "num_hidden_layers": 1, "num_attention_heads": 1,
         "projection_dim": _WIDTH}  # fmt: skip
_VIT = {"hidden_size": _WIDTH, "num_hidden_layers": 2, "num_attention_heads": 2, "projection_dim": _WIDTH,
        "patch_size": 8, "patch_stride": 8}  # fmt: skip

SMALL = Size(
    {
        "unet": {**_BLOCKS, "sample_size": 8, "attention_head_dim": 1, "cross_attention_dim": _WIDTH,
                 "projection_class_embeddings_input_dim": 2 * _WIDTH},
        "vae": {**_BLOCKS, "sample_size": 64},
        "text_encoder": {name: value for name, value in _CLIP.items() if name != "projection_dim"},
        "embedding_dim": _WIDTH,
    },
    {
        **FULL_SIZES["unitouch-vit-l"],
        "projection_dim": _WIDTH,
        "touch_config": {**_VIT, "image_height": 32, "image_width": 32},
        "vision_config": _CLIP,
        "text_config": _CLIP,
        "audio_config": {"projection_dim": _WIDTH},
    },
    {**VISION, **_CLIP, "image_size": 32, "patch_size": 8},
)  # fmt: skip
"""The same layers, of a few kilobytes."""

# Files ----------------------------------------------------------------------------------------------------------------


def write_checkpoint(folder: Path, size: Size, dtype: torch.dtype) -> None:
    """Random weights as both sides read them: `unclip`, in diffusers' layout, and beside it `unitouch`.

    Args:
        folder: To write into; 4.5 GB in the full size in bfloat16, 9 GB in float32.
        size: Of the networks.
        dtype: Of their weights.
    """
    with made_in("cpu", dtype, seed=0):
        networks = unclip_networks(**size.unclip)
        image_encoder = CLIPVisionModelWithProjection(CLIPVisionConfig(**size.vision)).eval()
        joint = UniTouchModel(UniTouchConfig(**size.joint), modalities=("touch",)).eval()
    text: Any = networks["text_encoder"].config
    touch: Any = joint.config.touch_config
    side = image_encoder.config.image_size
    StableUnCLIPImg2ImgPipeline(
        feature_extractor=CLIPImageProcessor(size={"shortest_edge": side}, crop_size={"height": side, "width": side}),
        image_encoder=image_encoder,
        image_noising_scheduler=embedding_noise(),
        tokenizer=CLIPTokenizer.from_pretrained(
            weights.JOINT / TOKENIZER_FOLDER, model_max_length=text.max_position_embeddings
        ),
        scheduler=unclip_scheduler(),
        **networks,
    ).save_pretrained(folder / "unclip")
    joint.save_pretrained(folder / "unitouch")
    UniTouchProcessor(image_size=touch.image_height).save_pretrained(folder / "unitouch")


# Runs -----------------------------------------------------------------------------------------------------------------


class Peak:
    """The most bytes held since this was made, above what was held then, over calls that start the record anew.

    Raises:
        InvalidInputError: If the system does not say.
    """

    def __init__(self) -> None:
        self._memory = PeakMemory()
        if self._memory.start is None:
            raise InvalidInputError("Peaks of memory are known under Linux alone; measure them there.")
        self.most = 0

    def note(self) -> None:
        """Has to come before each call of a pipeline of ours, and at the end."""
        self.most = max(self.most, self._memory.extra or 0)


def picture() -> Image.Image:
    """What stands for a touch."""
    return Image.fromarray(np.random.default_rng(0).integers(0, 256, (224, 224, 3), dtype=np.uint8))


def ours(folder: Path, dtype: torch.dtype, steps: int, peak: Peak) -> float:
    """Seconds a step of our pipeline, which frees its encoders before it denoises."""
    pipe = TouchToImagePipeline.from_published(folder / "unclip", folder / "unitouch", low_memory=True, dtype=dtype)
    pipe.set_progress_bar_config(disable=True)
    peak.note()
    output = pipe(
        picture(),
        sensor=pipe.unitouch.config.sensors[0],  # named, as no prototypes are there
        strength=STRENGTH,
        guidance_scale=GUIDANCE,
        num_inference_steps=steps,
        generator=torch.Generator().manual_seed(0),
    )
    return output.report.seconds["denoising"] / steps


def diffusers_own(folder: Path, dtype: torch.dtype, steps: int, peak: Peak) -> float:
    """Seconds a step of diffusers' pipeline with all of its components."""
    pipe = TimedUnclip.from_pretrained(folder / "unclip", dtype=dtype)
    pipe(
        picture(),
        QUALITY_PROMPT,
        guidance_scale=GUIDANCE,
        num_inference_steps=steps,
        generator=torch.Generator().manual_seed(0),
    )
    return pipe.denoising / steps


SIDES: dict[str, Callable[[Path, torch.dtype, int, Peak], float]] = {"ours": ours, "diffusers": diffusers_own}


def measure(side: str, folder: Path, dtype: torch.dtype, steps: int) -> dict[str, float]:
    """Peak megabytes, seconds a step and seconds of the whole, from the files to the picture, in this process.

    Args:
        side: "ours" or "diffusers".
        folder: With the checkpoints `small`, which goes first, and `measured`.
        dtype: Of the weights in it.
        steps: Of the solver.

    Raises:
        InvalidInputError: If there is no such side, or the system does not say how much memory is held.
    """
    run = SIDES[check_choice("side", side, SIDES)]
    run(folder / "small", dtype, steps, Peak())
    gc.collect()
    trim_memory()
    peak, started = Peak(), time.perf_counter()
    seconds_a_step = run(folder / "measured", dtype, steps, peak)
    seconds = time.perf_counter() - started
    peak.note()
    return {"megabytes": peak.most / 1e6, "seconds_a_step": seconds_a_step, "seconds": seconds}


# Figures --------------------------------------------------------------------------------------------------------------


def full_size_figures(
    repeats: int = 3, steps: int = 2, dtype: str = "bfloat16", small: bool = False, scratch: Path | None = None
) -> Figures:
    """Peak memory and seconds of both sides, and ours as shares of diffusers'; none but under Linux.

    Args:
        repeats: Processes for each side; the two take turns. Medians are taken, and spreads are of the turns.
        steps: Of the solver, at least 2; each evaluates both branches of guidance.
        dtype: Of both sides' weights, "bfloat16" or "float32".
        small: Measure networks of a few kilobytes, to see that it runs.
        scratch: Folder for the files, on a disk and not in memory; the system's for temporary files when left out.

    Raises:
        InvalidInputError: If a setting cannot be used.
    """
    check_integer("repeats", repeats, 1)
    check_integer("steps", steps, 2, hint="One step of DDIM starts far from noise.")
    check_choice("dtype", dtype, DTYPES)
    if PeakMemory().start is None:
        return {}
    seen: dict[str, list[dict[str, float]]] = {side: [] for side in SIDES}
    with tempfile.TemporaryDirectory(dir=scratch) as folder:
        arguments = ["--folder", folder, "--dtype", dtype, "--steps", str(steps)]
        in_own_process(MODULE, "write", *arguments, *(["--small"] if small else []))
        for _ in range(repeats):
            for side in SIDES:
                seen[side].append(in_own_process(MODULE, side, *arguments))
    figures: Figures = {"dtype": dtype, "steps": steps, "repeats": repeats}
    for side, runs in seen.items():
        figures[side] = {name: spread_of([run[name] for run in runs]) for name in runs[0]}
    for name in seen["ours"][0]:
        turns = zip(*(seen[side] for side in ("ours", "diffusers")), strict=True)
        figures[f"share_of_{name}"] = spread_of([own[name] / theirs[name] for own, theirs in turns])
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.full_size", description=__doc__.splitlines()[0])
    parser.add_argument(
        "part", nargs="?", choices=("memory", "throughput", "write", *SIDES), help="alone; all figures when left out"
    )
    parser.add_argument("--repeats", type=int, default=3, help="processes for each side")
    parser.add_argument("--steps", type=int, default=2, help="of the solver")
    parser.add_argument("--dtype", choices=DTYPES, default="bfloat16", help="of both sides' weights")
    parser.add_argument("--small", action="store_true", help="networks of a few kilobytes")
    parser.add_argument("--folder", type=Path, help="for files; of the checkpoints, for `write` and one side")
    arguments = parser.parse_args()
    part, folder, dtype, steps = arguments.part, arguments.folder, DTYPES[arguments.dtype], arguments.steps
    if part in ("write", *SIDES) and folder is None:
        parser.error(f"`{part}` needs a `--folder`.")
    figures: Figures = {}
    if part == "write":
        for name, size in (("small", SMALL), ("measured", SMALL if arguments.small else FULL)):
            write_checkpoint(folder / name, size, dtype)
    elif part in SIDES:
        figures = measure(part, folder, dtype, steps)
    if part in (None, "memory"):
        figures["memory"] = full_size_figures(arguments.repeats, steps, arguments.dtype, arguments.small, folder)
    if part in (None, "throughput"):
        figures["throughput"] = throughput_figures(settings=SMALL.joint if arguments.small else None)
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
