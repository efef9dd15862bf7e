"""Figures of X-to-touch: by modality, by sensor, raw and bridged, with ceilings and floors."""

import statistics
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from tests.benchmarks import Figures
from tests.benchmarks.generation import generate, load_classifier, shuffled
from tests.benchmarks.held_out import held_out, some_of_each
from unitouch_gen import weights
from unitouch_gen.evaluation.consistency import agreement, consistency
from unitouch_gen.models.autoencoders import decode, encode
from unitouch_gen.pipelines.tiny import tiny
from unitouch_gen.pipelines.x_to_touch import XToTouchPipeline
from unitouch_gen.world import SAMPLE_RATE

SENSOR_OF = {"world_gelsight": "gelsight", "world_digit": "digit", "world_taxim": "taxim"}
"""A collection for each sensor that is drawn, and the sensor that took it."""


@torch.no_grad()
def psnr(pipe: XToTouchPipeline, touches: Tensor) -> float:
    """Of the autoencoder on touches (N, 3, H, W) in [0, 1], dB."""
    restored = torch.cat([decode(pipe.vae, encode(pipe.vae, 2 * part - 1)) for part in touches.split(128)])
    return -10 * torch.log10(F.mse_loss((restored / 2 + 0.5).clamp(0, 1), touches)).item()


def x_to_touch_figures(
    split: str, family: Path = weights.FAMILY, seeds: int = 3, per_material: int = 8, **options: Any
) -> Figures:
    """Material consistency of generated touches, judged by a classifier of touches.

    Args:
        split: "val" or "test".
        family: Folder of weights.
        seeds: Of the noise; the spread is over them.
        per_material: Inputs of each material and sensor.
        options: Of the pipeline's call.

    Returns:
        Tables by sensor with their means: `image`, `caption` and `audio`, each raw and `_bridged`, `translation` to the
        sensor from the other two, `agreement` of touches from a picture and from its caption, `ceiling` on real
        touches, `floor` on shuffled labels, `deviation` of pixels relative to real ones, and the autoencoder's `psnr`.
    """
    classifier = load_classifier(family / weights.TOUCH_CLASSIFIER.name)
    pipe = tiny("x-to-touch", family=family)
    pipe.set_progress_bar_config(disable=True)
    tables: dict[str, dict[str, float]] = {}
    spreads = []

    def put(table: str, sensor: str, value: float) -> None:
        tables.setdefault(table, {})[sensor] = value

    for name, sensor in SENSOR_OF.items():
        scene = held_out(name, split, ("image", "touch", "audio", "text"), tuple(SENSOR_OF.values()))
        assert scene.image is not None
        assert scene.audio is not None
        assert scene.text is not None
        rows = some_of_each(scene.material, per_material)
        material, real = scene.material[rows], {key: touches[rows] for key, touches in scene.touch.items()}
        modalities: dict[str, Any] = {
            "image": scene.image[rows],
            "caption": [scene.text[row] for row in rows.tolist()],
            "audio": [(scene.audio[row], SAMPLE_RATE) for row in rows.tolist()],
        }
        made = {}
        for modality, values in modalities.items():
            for bridge in (None, "nearest") if modality != "image" else (None,):
                name_of = "text" if modality == "caption" else modality
                drawn = [
                    generate(pipe, seed, name_of, values, sensor=sensor, bridge=bridge, **options)
                    for seed in range(seeds)
                ]
                scores = [consistency(classifier, images, material) for images in drawn]
                spreads.append(max(scores) - min(scores))
                table = modality if bridge is None else f"{modality}_bridged"
                put(table, sensor, statistics.mean(scores))
                made[table] = drawn[0]
        translated = [
            consistency(classifier, generate(pipe, 0, "touch", real[other], sensor=sensor, **options), material)
            for other in SENSOR_OF.values()
            if other != sensor
        ]
        put("translation", sensor, statistics.mean(translated))
        put("agreement", sensor, agreement(classifier, made["image"], made["caption_bridged"]))
        put("agreement_raw", sensor, agreement(classifier, made["image"], made["caption"]))
        put("ceiling", sensor, consistency(classifier, real[sensor], material))
        put("floor", sensor, consistency(classifier, made["image"], shuffled(material)))
        put("deviation", sensor, (made["image"].std() / real[sensor].std()).item())
        put("psnr", sensor, psnr(pipe, real[sensor]))
    averages = {f"{table}_mean": statistics.mean(values.values()) for table, values in tables.items()}
    return {**tables, **averages, "spread": max(spreads), "seeds": seeds, "touches_each": len(material)}
