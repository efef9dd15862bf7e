"""What the published size takes, on random weights: `python -m tests.benchmarks --only published --scratch FOLDER`.

The conversion of the published checkpoints; the touch encoder beside ImageBind in plain PyTorch; and touch to image
beside diffusers' own pipeline.
"""

import copy
import gc
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from diffusers import StableUnCLIPImg2ImgPipeline
from PIL import Image
from torch import Tensor
from transformers import CLIPImageProcessor, CLIPTokenizer, CLIPVisionConfig, CLIPVisionModelWithProjection

from tests.benchmarks.error_and_time import TimedUnclip
from tests.benchmarks.measuring import Figures, PeakMemory, in_own_process, in_turns, ratio_of, seconds_of, spread_of
from tests.helpers.full_size import embedding_noise, made_in, touch_config, unclip_networks, unclip_scheduler
from tests.helpers.imagebind import ImageBind
from tests.helpers.published_parts import converted as converted_small
from tests.helpers.published_parts import sizes, write_unclip
from unitouch_gen import weights
from unitouch_gen.conditioning import QUALITY_PROMPT
from unitouch_gen.convert import FILES, PUBLISHED_NAMES, convert_published, published_name, read_published
from unitouch_gen.models import UniTouchConfig, UniTouchModel, UniTouchProcessor, UniTouchViT
from unitouch_gen.models.config import VISION
from unitouch_gen.models.processing import tokenizer_in
from unitouch_gen.pipelines import TouchToImagePipeline


def published_figures(scratch: Path) -> Figures:
    """All of them, in a quarter of an hour; `scratch` gets files of 11 GB, so it has to lie on a disk."""
    return {
        "conversion": conversion_figures(scratch),
        "touch_encoder": encoder_figures(),
        "touch_to_image": {dtype: touch_to_image_figures(scratch, dtype) for dtype in ("bfloat16", "float32")},
    }


# Conversion -----------------------------------------------------------------------------------------------------------


def conversion_figures(scratch: Path, config: UniTouchConfig | None = None) -> Figures:
    """Parameters and megabytes of the files; seconds of conversion and of reading, and peaks over the largest file."""
    config = UniTouchConfig() if config is None else config
    with TemporaryDirectory(dir=scratch) as place:
        folder = Path(place)
        config.save_pretrained(folder)
        parameters = {name: in_own_process(write_published, folder, name) for name in FILES}
        sizes = {name: (folder / f"{name}.pth").stat().st_size / 1e6 for name in FILES}
        found = {way: in_own_process(converted, folder, way) for way in ("conversion", "reading")}
    figures: Figures = {"parameters": parameters, "megabytes_of_files": sizes}
    for way, seen in found.items():
        figures[way] = {**seen, "share_of_largest": seen["megabytes"] / max(sizes.values())}
    return figures


def write_published(folder: Path, name: str) -> int:
    """Writes one of the published files, of random weights; how many parameters it has."""
    modalities = [PUBLISHED_NAMES[modality] for modality in FILES[name]]
    network = ImageBind(UniTouchConfig.from_pretrained(folder), modalities)
    torch.save(network.state_dict(), folder / f"{name}.pth")
    return sum(weight.numel() for weight in network.parameters())


def converted(folder: Path, way: str) -> dict[str, float]:
    """Seconds and peak megabytes in this process: published files into safetensors, or into memory."""
    files = {name: folder / f"{name}.pth" for name in FILES}
    settings = {"config": UniTouchConfig.from_pretrained(folder), "log_fn": lambda line: None}
    memory, started = PeakMemory(), time.perf_counter()
    if way == "conversion":
        convert_published(folder / "converted", **files, **settings)
    else:
        read_published(**files, **settings)
    return {"seconds": time.perf_counter() - started, "megabytes": memory.extra / 1e6}


# The touch encoder ----------------------------------------------------------------------------------------------------


def encoder_figures(repeats: int = 7, batch: int = 8, config: UniTouchConfig | None = None) -> Figures:
    """Touches a second of the touch encoder and of ImageBind's in plain PyTorch, and how many times as fast it is.

    Weights are random, so the error of bfloat16 is that of such weights; it is relative to the plain network in
    float32, over the batch.
    """
    config = touch_config() if config is None else config
    touch: Any = config.touch_config
    with made_in(torch.float32, seed=0):
        ours = UniTouchModel(config, modalities=("touch",)).eval().touch_model
        pixels = torch.randn(batch, touch.num_channels, touch.image_height, touch.image_width)
    plain = plain_encoder(ours, config)

    def embed_plain(network: ImageBind, pixels: Tensor) -> Tensor:
        return network.embed("touch", pixels[:, :, None].expand(-1, -1, 2, -1, -1))[0]

    calls: dict[str, Callable[[], Tensor]] = {}
    for dtype in (torch.float32, torch.bfloat16):
        name = str(dtype).removeprefix("torch.")
        calls[f"plain_{name}"] = partial(embed_plain, copy.deepcopy(plain).to(dtype), pixels.to(dtype))
        calls[f"ours_{name}"] = partial(copy.deepcopy(ours).to(dtype), pixels.to(dtype))
    with torch.no_grad():
        exact = calls["plain_float32"]()
        errors = {name: ((call().float() - exact).norm() / exact.norm()).item() for name, call in calls.items()}
        seen = in_turns({name: partial(seconds_of, call) for name, call in calls.items()}, repeats)
    return {
        "batch": batch,
        "repeats": repeats,
        "parameters": sum(weight.numel() for weight in ours.parameters()),
        "touches_per_second": {
            name: {"median": batch / statistics.median(times), "low": batch / max(times), "high": batch / min(times)}
            for name, times in seen.items()
        },
        "times_as_fast": {
            "float32": ratio_of(seen["plain_float32"], seen["ours_float32"]),
            "bfloat16": ratio_of(seen["plain_float32"], seen["ours_bfloat16"]),
            "bfloat16_of_plain_bfloat16": ratio_of(seen["plain_bfloat16"], seen["ours_bfloat16"]),
        },
        "relative_error": errors,
    }


def plain_encoder(ours: UniTouchViT, config: UniTouchConfig) -> ImageBind:
    """The same network with the same weights, as ImageBind writes it; its stem sees a touch as two equal frames."""
    plain = ImageBind(config, ("touch",))
    state = plain.state_dict()
    for key, tensor in ours.state_dict().items():
        name, _ = published_name("touch", f"touch_model.{key}")
        state[name] = torch.stack([tensor / 2] * 2, dim=2) if key == "stem.weight" else tensor
    plain.load_state_dict(state)
    return plain


# Touch to image -------------------------------------------------------------------------------------------------------

GUIDANCE, STRENGTH = 9.0, 0.75
"""The paper's."""


def touch_to_image_figures(
    scratch: Path, dtype: str, write: Callable[[Path, str], None] | None = None, repeats: int = 3, steps: int = 2
) -> Figures:
    """Peak memory and seconds of ours and of diffusers' pipeline, and ours as shares of theirs; none but under Linux.

    Both make one picture of 768 x 768 pixels by Stable Diffusion 2.1 unCLIP, in one dtype, from the same files of
    random weights and with the same guidance, steps and solver. diffusers' pipeline holds all of its components, the
    image encoder among them. Ours has the touch encoder in the place of the image encoder, and frees each encoder when
    it has done its work (`low_memory=True`). Each run has a process of its own, and the two sides take turns.
    """
    if PeakMemory().start is None:
        return {}
    with TemporaryDirectory(dir=scratch) as place:
        folder = Path(place)
        in_own_process(write_small, folder / "small", dtype)
        in_own_process(write or write_full, folder / "measured", dtype)
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
        tokenizer=CLIPTokenizer.from_pretrained(tokenizer_in(weights.JOINT), model_max_length=length),
        scheduler=unclip_scheduler(),
        **networks,
    ).save_pretrained(folder / "unclip")
    unitouch.save_pretrained(folder / "unitouch")
    UniTouchProcessor(image_size=unitouch.config.touch_config.image_height).save_pretrained(folder / "unitouch")


def write_small(folder: Path, dtype: str) -> None:
    """The same of a few kilobytes, read in any dtype: what the code of both sides takes."""
    folder.mkdir()
    write_unclip(folder / "unclip", CLIPVisionModelWithProjection(sizes().vision_config))
    converted_small(folder, imagebind=False)


def picture() -> Image.Image:
    """What stands for a touch."""
    return Image.fromarray(np.random.default_rng(0).integers(0, 256, (224, 224, 3), dtype=np.uint8))


def load_ours(folder: Path, dtype: torch.dtype) -> TouchToImagePipeline:
    pipe = TouchToImagePipeline.from_published(folder / "unclip", folder / "unitouch", low_memory=True, dtype=dtype)
    pipe.set_progress_bar_config(disable=True)
    return pipe


def call_ours(pipe: TouchToImagePipeline, **settings: Any) -> float:
    """Seconds of the denoising."""
    sensor = next(iter(pipe.unitouch.config.sensors), None)  # named, as no prototypes are there
    return pipe(picture(), sensor=sensor, strength=STRENGTH, **settings).report.seconds["denoising"]


def load_diffusers(folder: Path, dtype: torch.dtype) -> TimedUnclip:
    return TimedUnclip.from_pretrained(folder / "unclip", dtype=dtype)


def call_diffusers(pipe: TimedUnclip, **settings: Any) -> float:
    """Seconds of the denoising."""
    pipe(picture(), QUALITY_PROMPT, **settings)
    return pipe.denoising


SIDES: dict[str, tuple[Callable[..., Any], Callable[..., float]]] = {
    "ours": (load_ours, call_ours),
    "diffusers": (load_diffusers, call_diffusers),
}


def measure(side: str, folder: Path, dtype: str, steps: int) -> dict[str, float]:
    """Peak megabytes, seconds a step and seconds of the whole, from the files to the picture, in this process.

    The peak is above what is held after the same run on the small networks, so weights and values count, and torch's
    and diffusers' code does not.
    """
    one_picture(side, folder / "small", dtype, steps)
    gc.collect()
    return one_picture(side, folder / "measured", dtype, steps)


def one_picture(side: str, folder: Path, dtype: str, steps: int) -> dict[str, float]:
    load, call = SIDES[side]
    memory, started = PeakMemory(), time.perf_counter()
    pipe = load(folder, getattr(torch, dtype))
    generator = torch.Generator().manual_seed(0)
    denoising = call(pipe, guidance_scale=GUIDANCE, num_inference_steps=steps, generator=generator)
    return {
        "megabytes": memory.extra / 1e6,
        "seconds_a_step": denoising / steps,
        "seconds": time.perf_counter() - started,
    }
