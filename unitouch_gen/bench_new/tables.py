"""`python -m unitouch_gen.bench`: every figure the README quotes, measured on the held-out split.

    python -m unitouch_gen.bench --write   also stores them in unitouch_gen/weights/family.json and in README.md

Timings are of this machine and say so; everything else depends on the weights and the seeds alone.
"""

import argparse
import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from torch import Tensor
from transformers import ResNetForImageClassification

from unitouch_gen import weights
from unitouch_gen.encoders import UniTouchModel, UniTouchProcessor
from unitouch_gen.encoders.pixels import normalise_pixels
from unitouch_gen.evaluation.zero_shot import PROMPTS, accuracy, class_embeddings, zero_shot_scores
from unitouch_gen.pipelines.tiny import joint_space, tiny
from unitouch_gen.pipelines.touch_to_image import TouchToImagePipeline
from unitouch_gen.world import COLLECTIONS, MATERIAL_NAMES, SAMPLE_RATE, SENSORS, Scene, World, contacts

CONTACTS = 4
"""Contacts of each held-out object: 16 materials x 16 objects x 4 = 1,024 a collection."""

CONSOLE = Console(width=110)
Figures = dict[str, Any]


def batches(scene: Scene, size: int = 256) -> list[slice]:
    return [slice(start, start + size) for start in range(0, len(scene.material), size)]


def held_out(name: str, split: str, senses: tuple[str, ...] = ("image", "touch", "audio")) -> Scene:
    """The held-out contacts of one collection."""
    collection = COLLECTIONS[name]
    material, object_, contact = contacts(collection, split, CONTACTS)
    return World().render(
        material, object_, contact, senses=senses, sensors=(collection.sensor,), style=collection.style
    )


@torch.no_grad()
def features(model: UniTouchModel, processor: UniTouchProcessor, scene: Scene, sense: str) -> tuple[Tensor, list]:
    """Features of one sense (N, D), and the sensor matched to each touch."""
    rows, matches = [], []
    for part in batches(scene):
        if sense == "audio":
            assert scene.audio is not None
            sounds = [(sound, SAMPLE_RATE) for sound in scene.audio[part]]
            rows.append(model.get_audio_features(processor.sounds(sounds)))
        elif sense == "image":
            assert scene.image is not None
            rows.append(model.get_image_features(normalise_pixels(scene.image[part])))
        else:
            (images,) = scene.touch.values()
            pixels = normalise_pixels(images[part])
            found = model.match_sensors(pixels)
            matches += found
            rows.append(model.get_touch_features(pixels, model.sensor_ids(found)))
    return torch.cat(rows), matches


def joint_figures(split: str, family: Path = weights.FAMILY) -> Figures:
    """Zero-shot accuracy of every sense and collection, and sensor retrieval."""
    model, processor = joint_space(family)
    classes = {
        sense: class_embeddings(model, processor, MATERIAL_NAMES, template) for sense, template in PROMPTS.items()
    }
    figures: Figures = {"image": {}, "audio": {}, "touch": {}, "sensor_retrieval": {}, "touch_image_cosine": {}}
    for name, collection in COLLECTIONS.items():
        scene = held_out(name, split)
        embeddings = {}
        for sense in ("image", "audio", "touch"):
            embeddings[sense], matches = features(model, processor, scene, sense)
            figures[sense][name] = accuracy(zero_shot_scores(embeddings[sense], classes[sense]), scene.material)
        cosine = torch.nn.functional.cosine_similarity(embeddings["touch"], embeddings["image"]).mean().item()
        figures["touch_image_cosine"][name] = cosine
        if collection.sensor in model.sensor_bank.names:
            figures["sensor_retrieval"][name] = sum(m.name == collection.sensor for m in matches) / len(matches)
    trained = [name for name, collection in COLLECTIONS.items() if collection.training]
    for sense in ("image", "audio"):
        figures[f"{sense}_mean"] = statistics.mean(figures[sense].values())
    figures["touch_in_domain_mean"] = statistics.mean(figures["touch"][name] for name in trained)
    figures["sensor_retrieval_mean"] = statistics.mean(figures["sensor_retrieval"].values())
    return figures


@torch.no_grad()
def judged(judge: ResNetForImageClassification, pictures: Tensor, material: Tensor) -> float:
    """Share of pictures (N, 3, H, W) in [0, 1] whose material the judge names as `material` (N,)."""
    hits = [
        judge(normalise_pixels(pictures[i : i + 256])).logits.argmax(dim=1) == material[i : i + 256]
        for i in range(0, len(pictures), 256)
    ]
    return torch.cat(hits).float().mean().item()


def generate(pipe: TouchToImagePipeline, touches: Tensor, seed: int, **options: Any) -> Tensor:
    """A picture (N, 3, H, W) for each touch image, in batches."""
    pictures = []
    for start in range(0, len(touches), 64):
        generator = torch.Generator().manual_seed(seed * 1_000 + start)
        pictures.append(pipe(touches[start : start + 64], generator=generator, output_type="pt", **options).images)
    return torch.cat(pictures)


def generation_figures(
    split: str, family: Path = weights.FAMILY, seeds: int = 3, per_material: int = 8, **options: Any
) -> Figures:
    """Material consistency of generated pictures, with its ceiling on real ones and its floor on shuffled touches."""
    judge = ResNetForImageClassification.from_pretrained(
        family / weights.PICTURE_JUDGE.name, dtype=torch.float32
    ).eval()
    pipe = tiny("touch-to-image", family=family)
    pipe.set_progress_bar_config(disable=True)
    figures: Figures = {"consistency": {}, "spread": {}, "ceiling": {}, "floor": {}, "pictures_each": 16 * per_material}
    for name in ("touch_and_go", "ycb_slide", "object_folder_2", "object_folder_1"):
        scene = held_out(name, split, senses=("image", "touch"))
        assert scene.image is not None
        figures["ceiling"][name] = judged(judge, scene.image, scene.material)
        rows = torch.arange(len(scene.material)).view(len(MATERIAL_NAMES), -1)[:, :: 64 // per_material].flatten()
        (touches,), material = scene.touch.values(), scene.material[rows]
        scores = []
        for seed in range(seeds):
            pictures = generate(pipe, touches[rows], seed, **options)
            scores.append(judged(judge, pictures, material))
        shuffled = material[torch.randperm(len(material), generator=torch.Generator().manual_seed(0))]
        figures["consistency"][name] = statistics.mean(scores)
        figures["spread"][name] = max(scores) - min(scores)
        figures["floor"][name] = judged(judge, pictures, shuffled)
    for key in ("consistency", "ceiling", "floor"):
        figures[f"{key}_mean"] = statistics.mean(figures[key].values())
    return figures


def _render_many(first: int) -> int:
    torch.set_num_threads(1)
    rows = torch.arange(first, first + 32)
    World().render(rows % 16, rows // 16, rows * 0, sensors=tuple(SENSORS))
    return 32


def world_figures(samples: int = 1024) -> Figures:
    """Full samples (picture, touch of five sensors, sound, caption) a second on two cores, and the cost of parts."""
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        list(pool.map(_render_many, [0, 32]))  # start-up is not counted
        started = time.perf_counter()
        count = sum(pool.map(_render_many, range(0, samples, 32)))
        rate = count / (time.perf_counter() - started)
    rows = torch.arange(64)
    world = World()

    def seconds(**request: Any) -> float:
        return fastest(lambda: world.render(rows % 16, rows // 16, rows * 0, **request))

    full = seconds(sensors=tuple(SENSORS))
    parts = {
        "picture": seconds(senses=("image",)),
        "touch of one sensor": seconds(senses=("touch",)),
        "sound": seconds(senses=("audio",)),
        "caption": seconds(senses=("text",)),
    }
    return {"samples_per_second": rate, "share_of_full": {key: value / full for key, value in parts.items()}}


def fastest(call: Callable[[], Any], repeats: int = 3) -> float:
    """Shortest wall-clock time of a call, after one warm-up, s."""
    call()
    times = []
    for _ in range(repeats):
        started = time.perf_counter()
        call()
        times.append(time.perf_counter() - started)
    return min(times)


def speed_figures() -> Figures:
    """Seconds for one 64 x 64 picture with default settings, after loading."""
    pipe = tiny("touch-to-image")
    pipe.set_progress_bar_config(disable=True)
    touch = World().render([5], [600], [0], senses=("touch",)).touch["gelsight"]
    return {"seconds_per_picture": fastest(lambda: pipe(touch, generator=torch.Generator().manual_seed(0)))}


def markdown(figures: Figures) -> str:
    """The README's table of figures."""
    joint, pictures = figures["joint"], figures["touch_to_image"]

    def percent(share: float) -> str:
        return f"{100 * share:.1f} %"

    touch = joint["touch"]
    spread = 100 * max(pictures["spread"].values())
    rows = [
        ("material from a picture, zero-shot, mean of seven collections", percent(joint["image_mean"])),
        ("material from a sound, zero-shot, mean of seven collections", percent(joint["audio_mean"])),
        ("material from a touch, zero-shot, the four collections trained on", percent(joint["touch_in_domain_mean"])),
        ("... GelSight (two collections)", f"{percent(touch['touch_and_go'])}, {percent(touch['feeling_of_success'])}"),
        ("... DIGIT, Taxim", f"{percent(touch['ycb_slide'])}, {percent(touch['object_folder_2'])}"),
        ("... DIGIT, a collection never trained on", percent(touch["ssvtp"])),
        ("... TACTO, a sensor never trained on", percent(touch["object_folder_1"])),
        ("... GelSlim, a sensor never trained on", percent(touch["object_folder_real"])),
        ("sensor retrieved right, a sample", percent(joint["sensor_retrieval_mean"])),
        (
            "material of pictures generated from touch, by an independent judge (three seeds, largest spread "
            f"{spread:.1f} points)",
            percent(pictures["consistency_mean"]),
        ),
        ("... the judge on real pictures (ceiling) and on pictures of shuffled touches (floor)",
         f"{percent(pictures['ceiling_mean'])}, {percent(pictures['floor_mean'])}"),
        ("seconds for one picture after loading", f"{figures['speed']['seconds_per_picture']:.2f}"),
        ("full samples of the world a second (five sensors)", f"{figures['world']['samples_per_second']:.0f}"),
    ]  # fmt: skip
    lines = ["| figure | measured |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows)]
    chance = f"Chance is 6.2 %. Held-out split: 16 materials x 16 objects x {CONTACTS} contacts a collection."
    return "\n".join([*lines, "", f"{chance} Timings: {figures['machine']}."])


def write_between(text: str, mark: str, content: str) -> str:
    """`text` with what stands between two `<!-- mark -->` comments replaced."""
    comment = f"<!-- {mark} -->"
    before, _, after = text.split(comment)
    return f"{before}{comment}\n{content}\n{comment}{after}"


def write_text(file: Path, text: str) -> None:
    """Writes under a temporary name and renames."""
    partial = file.with_name(file.name + ".partial")
    partial.write_text(text)
    partial.rename(file)


def show(title: str, figures: Figures) -> None:
    CONSOLE.rule(title)
    CONSOLE.print_json(json.dumps(figures, default=lambda value: round(value, 4)))


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m unitouch_gen.bench")
    parser.add_argument("--split", default="test", choices=("val", "test"))
    parser.add_argument("--write", action="store_true", help="store the figures beside the weights")
    arguments = parser.parse_args()
    measures = {
        "joint": lambda: joint_figures(arguments.split),
        "touch_to_image": lambda: generation_figures(arguments.split),
        "world": world_figures,
        "speed": speed_figures,
    }
    figures: Figures = {"split": arguments.split, "machine": f"{platform.machine()}, {os.cpu_count()} cores"}
    for name, measure in measures.items():
        figures[name] = measure()
        show(name, figures[name])
    if arguments.write:
        family = json.loads(weights.FIGURES.read_text())
        write_text(weights.FIGURES, json.dumps({**family, "figures": figures}, indent=2) + "\n")
        readme = Path("README.md")
        write_text(readme, write_between(readme.read_text(), "figures", markdown(figures)))


if __name__ == "__main__":
    main()
