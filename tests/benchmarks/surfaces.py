"""Touches imagined from pictures of real surfaces, against those of their height maps in the world's sensors.

    python -m tests.benchmarks --only surfaces --surfaces FOLDER

The folder holds pairs `NAME_albedo.jpg` (or .png) and `NAME_height.png`, as collections of scanned textures come.
"""

from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from tests.benchmarks.measuring import Figures, quiet
from tests.benchmarks.quality import SENSOR_OF, generate, load_classifier
from unitouch_gen import weights
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.evaluation.consistency import named
from unitouch_gen.models.images import load_images
from unitouch_gen.world import COLLECTION_MATERIALS, SENSORS
from unitouch_gen.world.sensors import touch_images
from unitouch_gen.world.surfaces import BASE_RESOLUTION, GAMMA, pictures

RELIEF = 2.0
"""Height that the range of each height map is brought to, mm: that of the world's own. Textures do not say theirs."""

DEPTH, DWELL = 1.0, 0.5
"""Depth (mm) and time (s) of the contacts: the middle of the world's own."""


def pairs_in(folder: Path) -> dict[str, tuple[Path, Path]]:
    """Albedo picture and height map of each surface in a folder, by name; refused if one cannot be used."""
    found = {}
    for height in sorted(folder.glob("*_height.*")):
        name = height.name.split("_height.")[0]
        for albedo in sorted(folder.glob(f"{name}_albedo.*"))[:1]:
            found[name] = (albedo, height)
    if not found:
        raise InvalidInputError(
            f"`surfaces` is {str(folder)!r}, which holds no pair such as bark_albedo.jpg and bark_height.png."
        )
    for files in found.values():
        load_surface(*files)
    return found


def load_surface(albedo: Path, height: Path) -> tuple[Tensor, Tensor]:
    """Albedo (3, H, W), in [0, 1], and relief (H, W), in mm, of one surface."""
    images = {file: load_images(what, file)[0] for what, file in (("albedo", albedo), ("height", height))}
    sizes = {file: f"{image.shape[2]} x {image.shape[1]}" for file, image in images.items()}
    for file, image in images.items():
        if min(image.shape[1:]) < BASE_RESOLUTION:
            raise InvalidInputError(
                f"`surfaces` holds {str(file)!r} of {sizes[file]} pixels; both sides need at least {BASE_RESOLUTION}, "
                "as many as a patch has."
            )
    if sizes[albedo] != sizes[height]:
        raise InvalidInputError(
            f"`surfaces` holds {str(albedo)!r} of {sizes[albedo]} pixels and {str(height)!r} of {sizes[height]}; the "
            "two have to show the same patch, so bring them to one size."
        )
    colours, map_ = (image if image.is_floating_point() else image.float() / 255 for image in images.values())
    return colours, relief_of(map_.mean(dim=0))


def relief_of(height: Tensor) -> Tensor:
    """A height map (H, W) at `RELIEF`, mm, but for the half percent at either end, which is cut."""
    low, high = np.quantile(height.numpy(), (0.005, 0.995)).tolist()  # torch's takes no more than 16 million values
    return RELIEF * ((height - low) / max(high - low, 1e-6)).clamp(0.0, 1.0)


def patches(image: Tensor, count: int) -> Tensor:
    """Square patches (count^2, C, R, R) of a picture (C, H, W) at the resolution of the world's surfaces, row by row.

    They lie evenly from edge to edge, and overlap where the picture is too small for them to lie side by side.
    """
    side = BASE_RESOLUTION
    tops, lefts = (torch.linspace(0, extent - side, count).round().long().tolist() for extent in image.shape[1:])
    return torch.stack([image[:, top : top + side, left : left + side] for top in tops for left in lefts])


def surface_figures(folder: Path, count: int = 4, seed: int = 0) -> Figures:
    """How often a classifier of touch names both touches of a real surface alike.

    One touch is generated from a picture of a patch, the other rendered from the height map of the same patch. The
    picture is the `albedo` alone, or the patch as the world's camera sees it: albedo and height under a lamp (`lit`).
    The `floor` is the same against the touches of other surfaces; `neighbours` are rendered touches against those of
    the next of a surface's `count` x `count` patches, which bounds what can be expected.
    """
    surfaces = {name: load_surface(*files) for name, files in pairs_in(folder).items()}
    names, pipe, classifier = list(surfaces), quiet("x-to-touch"), load_classifier(weights.TOUCH_CLASSIFIER)
    albedo = torch.cat([patches(colours, count) for colours, _ in surfaces.values()])
    relief = torch.cat([patches(map_[None], count)[:, 0] for _, map_ in surfaces.values()])
    noise = torch.Generator().manual_seed(seed)
    sensors = list(SENSOR_OF.values())
    rendered = torch.stack([named(classifier, _rendered(relief, sensor, noise)) for sensor in sensors])
    by_surface = (len(sensors), len(names), count**2)
    owner = torch.arange(len(names)).repeat_interleave(count**2)
    others = owner[:, None] != owner[None]
    figures: Figures = {"touches": len(relief) * len(sensors), "surfaces": len(names)}
    for key, picture in (("albedo", albedo), ("lit", _lit(albedo, relief))):
        made = torch.stack(
            [named(classifier, generate(pipe, seed, {"image": picture}, sensor=sensor)) for sensor in sensors]
        )
        alike, crossed = (made == rendered).float(), made[:, :, None] == rendered[:, None, :]
        figures[key] = {
            "agreement": alike.mean().item(),
            "floor": crossed[:, others].float().mean().item(),
            "by_surface": dict(zip(names, alike.view(by_surface).mean((0, 2)).tolist(), strict=True)),
            "named": _most(made.view(by_surface), names),
        }
    rows = rendered.view(by_surface)
    neighbours = (rows == rows.roll(1, 2)).float().mean().item()
    return {**figures, "neighbours": neighbours, "rendered": _most(rows, names)}


def _rendered(relief: Tensor, sensor: str, noise: torch.Generator) -> Tensor:
    """Touches (N, 3, 64, 64) of surfaces (N, R, R) in mm, indented in the middle of the world's range."""
    full = torch.ones(len(relief))
    clean = touch_images(relief, DEPTH * full, DWELL * full, 0.0 * full, SENSORS[sensor], 64)
    return (clean + SENSORS[sensor].noise * torch.randn(clean.shape, generator=noise)).clamp(0.0, 1.0)


def _lit(albedo: Tensor, relief: Tensor) -> Tensor:
    """Surfaces as the world's camera sees them, matt and under a lamp at one side, (N, 3, 64, 64)."""
    light = F.normalize(torch.tensor([[0.5, 0.3, 0.8]]), dim=1).expand(len(relief), 3)
    return pictures(relief, albedo**GAMMA, torch.ones_like(relief), light, torch.zeros(len(relief)), 64, torch.ones(3))


def _most(calls: Tensor, names: list[str]) -> dict[str, str]:
    """What (sensors, surfaces, patches) calls name most, by surface."""
    rows = calls.transpose(0, 1).flatten(1)
    return {
        name: COLLECTION_MATERIALS[index] for name, index in zip(names, rows.mode(dim=1).values.tolist(), strict=True)
    }
