"""Peak memory of a request, each time in a process of its own: `python -m tests.benchmarks.memory CASE` is one.

What is counted is the largest resident size of the process (Linux) above its size after the same request to a random
family of a few kilobytes: so weights and values count, and torch's and diffusers' code does not.
"""

import argparse
import gc
import json
import shutil
import statistics
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import torch
from diffusers import AutoencoderDC, UNet2DConditionModel

from tests.benchmarks import Figures
from tests.benchmarks.apart import in_own_process
from tests.benchmarks.turns import in_turns, seconds_of, spread_of
from unitouch_gen import weights
from unitouch_gen.conditioning import EmbeddingBank
from unitouch_gen.errors import InvalidInputError, check_choice
from unitouch_gen.memory import PeakMemory, resident
from unitouch_gen.models import UniTouchConfig, UniTouchModel
from unitouch_gen.models.joint import MODALITIES
from unitouch_gen.pipelines import XToTouchPipeline
from unitouch_gen.pipelines.tiny import tiny

REQUEST = {"text": "rough brick", "num_inference_steps": 20}

CASES: dict[str, str] = {
    "planned": "what the plan names, weights in float16",
    "planned_float32": "what the plan names",
    "everything": "the whole pipeline with all modalities",
    "family": "... and the other pipelines' networks",
}
"""What is in memory."""


def memory_figures(repeats: int = 3) -> Figures:
    """Megabytes of text-to-touch, by what is loaded, and the share of it that the plan needs; none but under Linux.

    Args:
        repeats: Processes for each case, one after the other; medians are taken.
    """
    if PeakMemory().start is None:
        return {}
    peaks: dict[str, list[float]] = {case: [] for case in CASES}
    for _ in range(repeats):
        for case in CASES:
            peaks[case].append(in_own_process(__name__, case))
    figures: Figures = {"repeats": repeats}
    for case, values in peaks.items():
        figures[case] = {"megabytes": statistics.median(values), "spread": max(values) - min(values)}
    for case in ("everything", "family"):
        shares = [low / high for low, high in zip(peaks["planned"], peaks[case], strict=True)]
        figures[f"share_of_{case}"] = spread_of(shares)
    return {**figures, "seconds_in_float16": low_memory_seconds()}


def low_memory_seconds(repeats: int = 9) -> Figures:
    """How many times as long the request takes with `low_memory`: median and spread of calls that take turns."""
    cases = ("planned", "planned_float32")
    seen = in_turns({case: partial(seconds_of, partial(load(case)[0], **REQUEST)) for case in cases}, repeats)
    ratios = [low / high for low, high in zip(*seen.values(), strict=True)]
    return {"ratio": statistics.median(ratios), "spread": max(ratios) - min(ratios)}


def load(case: str, family: Path = weights.FAMILY) -> list[Any]:
    """What a case has in memory, first of all the pipeline."""
    plan = XToTouchPipeline.plan(**REQUEST) if case.startswith("planned") else None
    pipe = tiny("x-to-touch", family=family, plan=plan, low_memory=case == "planned")
    pipe.set_progress_bar_config(disable=True)
    for modality in MODALITIES if plan is None else ():
        pipe.unitouch.load(modality)
    return [pipe, tiny("touch-to-image")] if case == "family" and family == weights.FAMILY else [pipe]


def write_small_family(folder: Path) -> None:
    """What `tiny("x-to-touch")` reads, of random weights, in the layers of the built-in family."""
    joint, x_to_touch = folder / weights.JOINT.name, folder / weights.X_TO_TOUCH.name
    shutil.copytree(weights.JOINT, joint, ignore=shutil.ignore_patterns("*.safetensors"))
    width = 16
    config = UniTouchConfig.from_pretrained(weights.JOINT).to_dict()
    for name in ("vision_config", "text_config", "touch_config", "audio_config"):
        config[name] |= {"hidden_size": width, "num_hidden_layers": 1, "projection_dim": width}
    for name in ("vision_config", "text_config"):
        config[name] |= {"intermediate_size": width}
    UniTouchModel(UniTouchConfig(**{**config, "projection_dim": width})).half().save_pretrained(joint)

    unet = UNet2DConditionModel.load_config(weights.X_TO_TOUCH / "unet")
    unet |= {"block_out_channels": [width] * 3, "attention_head_dim": 1, "cross_attention_dim": width}
    UNet2DConditionModel.from_config(unet).half().save_pretrained(x_to_touch / "unet")
    shutil.copytree(weights.X_TO_TOUCH / "scheduler", x_to_touch / "scheduler")
    shutil.copy(weights.X_TO_TOUCH / "defaults.json", x_to_touch)
    EmbeddingBank.of(torch.randn(8, width)).half().save_pretrained(x_to_touch / "embedding_bank")
    vae = AutoencoderDC.load_config(weights.TOUCH_VAE)
    vae |= dict.fromkeys(("encoder_block_out_channels", "decoder_block_out_channels"), [width] * 3)
    AutoencoderDC.from_config(vae).half().save_pretrained(folder / weights.TOUCH_VAE.name)


def measure(case: str) -> float:
    """Megabytes of a case, in this process.

    Raises:
        InvalidInputError: If there is no such case, or the system does not say.
    """
    check_choice("case", case, CASES)
    with tempfile.TemporaryDirectory() as folder:
        write_small_family(Path(folder))
        load(case, Path(folder))[0](**REQUEST)
    gc.collect()
    memory = PeakMemory()
    everything = load(case)
    loading, held = memory.extra, resident("VmRSS")
    calling = everything[0](**REQUEST, generator=torch.Generator().manual_seed(0)).report.peak_memory
    if memory.start is None or loading is None or held is None or calling is None:
        raise InvalidInputError("Peaks of memory are known under Linux alone; measure them there.")
    return max(loading, held - memory.start + calling) / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.memory", description="Megabytes of a case.")
    parser.add_argument("case", choices=CASES, help="; ".join(f"{case}: {what}" for case, what in CASES.items()))
    print(json.dumps(measure(parser.parse_args().case)))


if __name__ == "__main__":
    main()
