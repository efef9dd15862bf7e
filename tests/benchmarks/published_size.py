"""What the published size takes, on random weights: `python -m tests.benchmarks --only published --scratch FOLDER`.

The conversion of the published checkpoints, and touch to image beside diffusers' own pipeline.
"""

import gc
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from diffusers import StableUnCLIPImg2ImgPipeline
from PIL import Image
from transformers import CLIPImageProcessor, CLIPTokenizer, CLIPVisionConfig, CLIPVisionModelWithProjection

from tests.benchmarks.error_and_time import TimedUnclip
from tests.benchmarks.measuring import Figures, in_own_process, spread_of
from tests.helpers.full_size import embedding_noise, made_in, touch_config, unclip_networks, unclip_scheduler
from tests.helpers.imagebind import ImageBind
from tests.helpers.published_parts import converted as converted_small
from tests.helpers.published_parts import sizes, write_unclip
from unitouch_gen import weights
from unitouch_gen.conditioning import QUALITY_PROMPT
from unitouch_gen.convert import FILES, PUBLISHED_NAMES, convert_published
from unitouch_gen.models import UniTouchConfig, UniTouchModel, UniTouchProcessor
from unitouch_gen.models.config import VISION
from unitouch_gen.pipelines import TouchToImagePipeline


def published_figures(scratch: Path) -> Figures:
    """All of them, in a quarter of an hour; `scratch` gets files of 11 GB, so it has to lie on a disk."""
    return {
        "conversion": conversion_figures(scratch),
        "touch_to_image": {dtype: touch_to_image_figures(scratch, dtype) for dtype in ("bfloat16", "float32")},
    }


class PeakMemory:
    """Largest resident size of this process under Linux, in megabytes above that at the start.

    The record of the peak is the process's: a second `PeakMemory` starts it anew (proc_pid_clear_refs(5)).
    """

    def __init__(self) -> None:
        Path("/proc/self/clear_refs").write_text("5")
        self.start = self.resident("VmRSS")

    @property
    def extra(self) -> float:
        return max(self.resident("VmHWM") - self.start, 0.0)

    @staticmethod
    def resident(field: str) -> float:
        """Megabytes of this process: "VmRSS" now, "VmHWM" at most since the last reset."""
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(1024 * int(line.split()[1]) / 1e6 for line in lines if line.startswith(f"{field}:"))


# Conversion -----------------------------------------------------------------------------------------------------------


def conversion_figures(scratch: Path, config: UniTouchConfig | None = None) -> Figures:
    """Parameters and megabytes of the files; seconds of conversion, and its peak over the largest file."""
    with TemporaryDirectory(dir=scratch) as place:
        folder = Path(place)
        (config or UniTouchConfig()).save_pretrained(folder)
        parameters = {name: in_own_process(write_published, folder, name) for name in FILES}
        found = in_own_process(converted, folder)
        sizes = {name: (folder / f"{name}.pth").stat().st_size / 1e6 for name in FILES}
    return {"parameters": parameters, "megabytes_of_files": sizes, **found,
            "share_of_largest": found["megabytes"] / max(sizes.values())}  # fmt: skip


def write_published(folder: Path, name: str) -> int:
    """Writes one of the published files, of random weights; how many parameters it has."""
    modalities = [PUBLISHED_NAMES[modality] for modality in FILES[name]]
    network = ImageBind(UniTouchConfig.from_pretrained(folder), modalities)
    torch.save(network.state_dict(), folder / f"{name}.pth")
    return sum(weight.numel() for weight in network.parameters())


def converted(folder: Path) -> dict[str, float]:
    """Seconds and peak megabytes in this process of converting published files into safetensors."""
    files = {name: folder / f"{name}.pth" for name in FILES}
    memory, started = PeakMemory(), time.perf_counter()
    config = UniTouchConfig.from_pretrained(folder)
    convert_published(folder / "converted", **files, config=config, log_fn=lambda line: None)
    return {"seconds": time.perf_counter() - started, "megabytes": memory.extra}


# Touch to image -------------------------------------------------------------------------------------------------------


def touch_to_image_figures(scratch: Path, dtype: str, repeats: int = 3, steps: int = 2) -> Figures:
    """Peak memory and seconds of ours and of diffusers' pipeline, and ours as shares of theirs.

    Both make one picture of 768 x 768 pixels by Stable Diffusion 2.1 unCLIP, in one dtype, from the same files of
    random weights and with the same guidance, steps and solver. diffusers' pipeline holds all of its components, the
    image encoder among them. Ours has the touch encoder in the place of the image encoder, and frees each encoder when
    it has done its work (`low_memory=True`). Each run has a process of its own, and the two sides take turns.
    """
    with TemporaryDirectory(dir=scratch) as place:
        folder = Path(place)
        in_own_process(write_small, folder / "small")
        in_own_process(write_full, folder / "measured", dtype)
        runs = [{side: in_own_process(measure, side, folder, dtype, steps) for side in SIDES} for _ in range(repeats)]
    figures: Figures = {"dtype": dtype, "steps": steps, "repeats": repeats}
    for side in SIDES:
        figures[side] = {name: spread_of([run[side][name] for run in runs]) for name in runs[0][side]}
    for name in runs[0]["ours"]:
        figures[f"share_of_{name}"] = spread_of([run["ours"][name] / run["diffusers"][name] for run in runs])
    return figures


def write_full(folder: Path, dtype: str) -> None:
    """Random weights as both sides read them, 4.5 GB in bfloat16: `unclip`, in diffusers' layout, and `unitouch`."""
    with made_in(getattr(torch, dtype), seed=0):
        networks = unclip_networks()
        image_encoder = CLIPVisionModelWithProjection(CLIPVisionConfig(**VISION)).eval()
        unitouch = UniTouchModel(touch_config(), modalities=("touch",)).eval()
    side, length = image_encoder.config.image_size, networks["text_encoder"].config.max_position_embeddings
    StableUnCLIPImg2ImgPipeline(
        feature_extractor=CLIPImageProcessor(size={"shortest_edge": side}, crop_size={"height": side, "width": side}),
        image_encoder=image_encoder,
        image_noising_scheduler=embedding_noise(),
        tokenizer=CLIPTokenizer.from_pretrained(weights.JOINT, model_max_length=length),
        scheduler=unclip_scheduler(),
        **networks,
    ).save_pretrained(folder / "unclip")
    unitouch.save_pretrained(folder / "unitouch")
    UniTouchProcessor(image_size=unitouch.config.touch_config.image_height).save_pretrained(folder / "unitouch")


def write_small(folder: Path) -> None:
    """The same of a few kilobytes, read in any dtype: what the code of both sides takes."""
    folder.mkdir()
    write_unclip(folder / "unclip", CLIPVisionModelWithProjection(sizes().vision_config))
    converted_small(folder, imagebind=False)


def ours(folder: Path, dtype: torch.dtype, touch: Image.Image, **settings: Any) -> float:
    """Seconds of the denoising."""
    pipe = TouchToImagePipeline.from_published(folder / "unclip", folder / "unitouch", low_memory=True, dtype=dtype)
    pipe.set_progress_bar_config(disable=True)
    sensor = next(iter(pipe.unitouch.config.sensors), None)  # named, as no prototypes are there
    return pipe(touch, sensor=sensor, strength=0.75, **settings).report.seconds["denoising"]


def theirs(folder: Path, dtype: torch.dtype, touch: Image.Image, **settings: Any) -> float:
    """Seconds of the denoising."""
    pipe = TimedUnclip.from_pretrained(folder / "unclip", dtype=dtype)
    pipe(touch, QUALITY_PROMPT, **settings)
    return pipe.denoising


SIDES: dict[str, Callable[..., float]] = {"ours": ours, "diffusers": theirs}


def measure(side: str, folder: Path, dtype: str, steps: int) -> dict[str, float]:
    """Peak megabytes, seconds a step and seconds of the whole, from the files to the picture, in this process.

    The peak is above what is held after the same run on the small networks, so weights and values count, and torch's
    and diffusers' code does not.
    """
    touch = Image.fromarray(np.random.default_rng(0).integers(0, 256, (224, 224, 3), dtype=np.uint8))
    for place in ("small", "measured"):
        gc.collect()
        memory, started, generator = PeakMemory(), time.perf_counter(), torch.Generator().manual_seed(0)
        settings = {"guidance_scale": 9.0, "num_inference_steps": steps, "generator": generator}
        denoising = SIDES[side](folder / place, getattr(torch, dtype), touch, **settings)
    seconds = time.perf_counter() - started
    return {"megabytes": memory.extra, "seconds_a_step": denoising / steps, "seconds": seconds}
