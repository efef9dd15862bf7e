"""Touch imagined from the picture of a real surface, against the touch of its height map in the world's sensors.

    python -m tests.benchmarks --only surfaces --surfaces FOLDER

The folder holds pairs `NAME_albedo.jpg` (or .png) and `NAME_height.png`, as collections of scanned textures come.
"""

from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from tests.benchmarks import Figures
from tests.benchmarks.generation import generate, load_classifier
from tests.benchmarks.x_to_touch import SENSOR_OF
from unitouch_gen import weights
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.evaluation.consistency import named
from unitouch_gen.models.images import load_images
from unitouch_gen.pipelines.tiny import tiny
from unitouch_gen.world import MATERIAL_NAMES, SENSORS
from unitouch_gen.world.sensors import touch_images
from unitouch_gen.world.surfaces import BASE_RESOLUTION, GAMMA, pictures

RELIEF = 2.0
"""Height that the range of each height map is brought to, mm: that of the world's own. Textures do not say theirs."""

PRESS, DWELL = 1.0, 0.5
"""Depth (mm) and time (s) of the presses: the middle of the world's own."""


def pairs_in(folder: Path) -> dict[str, tuple[Path, Path]]:
    """Albedo picture and height map of each surface in a folder, by name.

    Raises:
        InvalidInputError: If the folder holds no pair, or one that `load_surface` refuses.
    """
    found = {}
    for height in sorted(folder.glob("*_height.*")):
        name = height.name.split("_height.")[0]
        albedo = sorted(folder.glob(f"{name}_albedo.*"))
        if albedo:
            found[name] = (albedo[0], height)
    if not found:
        raise InvalidInputError(
            f"`surfaces` is {str(folder)!r}, which holds no pair such as bark_albedo.jpg and bark_height.png."
        )
    for files in found.values():
        load_surface(*files)
    return found


def load_surface(albedo: Path, height: Path) -> tuple[Tensor, Tensor]:
    """Albedo (3, H, W), in [0, 1], and relief (H, W), in mm, of one surface.

    Raises:
        InvalidInputError: If a file cannot be read, is too small for a patch, or the two differ in size.
    """
    colours, map_ = (unit(load_images(what, file)[0]) for what, file in (("albedo", albedo), ("height", height)))
    for file, image in ((albedo, colours), (height, map_)):
        if min(image.shape[1:]) < BASE_RESOLUTION:
            raise InvalidInputError(
                f"`surfaces` holds {str(file)!r} of {_size(image)} pixels; both sides need at least {BASE_RESOLUTION}, "
                "as many as a patch has."
            )
    if colours.shape != map_.shape:
        raise InvalidInputError(
            f"`surfaces` holds {str(albedo)!r} of {_size(colours)} pixels and {str(height)!r} of {_size(map_)}; the "
            "two have to show the same patch, so bring them to one size."
        )
    return colours, relief_of(map_.mean(dim=0))


def _size(image: Tensor) -> str:
    return f"{image.shape[2]} x {image.shape[1]}"


def patches(image: Tensor, count: int) -> Tensor:
    """Square patches (count^2, C, R, R) of a picture (C, H, W) at the resolution of the world's surfaces, row by row.

    They lie evenly from edge to edge, and overlap where the picture is too small for them to lie side by side.
    """
    side = BASE_RESOLUTION
    tops, lefts = (torch.linspace(0, extent - side, count).round().long().tolist() for extent in image.shape[1:])
    return torch.stack([image[:, top : top + side, left : left + side] for top in tops for left in lefts])


def unit(image: Tensor) -> Tensor:
    """uint8 pixels as float32 in [0, 1]; what is float32 stays."""
    return image if image.is_floating_point() else image.float() / 255


def relief_of(height: Tensor) -> Tensor:
    """A height map (H, W) at `RELIEF`, mm, but for the half percent at either end, which is cut."""
    low, high = np.quantile(height.numpy(), (0.005, 0.995)).tolist()  # torch's takes no more than 16 million values
    return RELIEF * ((height - low) / max(high - low, 1e-6)).clamp(0.0, 1.0)


def surface_figures(folder: Path, family: Path = weights.FAMILY, count: int = 4, seed: int = 0) -> Figures:
    """How often a judge of touch names both touches of a real surface alike.

    One touch is generated from a picture of a patch, the other rendered from the height map of the same patch. The
    picture is the albedo alone, or the patch as the world's camera sees it: albedo and height under a lamp.

    Args:
        folder: See `pairs_in`.
        family: Folder of weights.
        count: Patches along each side of a surface, `count` squared in all.
        seed: Of the noise, in generation and in the sensors' cameras.

    Returns:
        For each picture, "albedo" and "lit", the means over sensors of `agreement`, its table `by_surface`, and its
        `floor`, the same against the touches of other surfaces; `neighbours`: rendered touches against those of the
        next patch of the same surface, which bounds what can be expected; `rendered` and those of each picture:
        what the judge most often names each surface's touches.

    Raises:
        InvalidInputError: See `pairs_in`.
    """
    surfaces = {name: load_surface(*files) for name, files in pairs_in(folder).items()}
    pairs = list(surfaces)
    classifier = load_classifier(family / weights.TOUCH_CLASSIFIER.name)
    pipe = tiny("x-to-touch", family=family)
    pipe.set_progress_bar_config(disable=True)
    albedo = torch.cat([patches(colours, count) for colours, _ in surfaces.values()])
    relief = torch.cat([patches(map_[None], count)[:, 0] for _, map_ in surfaces.values()])
    noise = torch.Generator().manual_seed(seed)
    rendered = {sensor: named(classifier, _rendered(relief, sensor, noise)) for sensor in SENSOR_OF.values()}
    others = torch.arange(len(pairs)).repeat_interleave(count**2)
    others = others[:, None] != others[None]
    figures: Figures = {"touches": len(relief) * len(SENSOR_OF), "surfaces": len(pairs)}
    for name, picture in (("albedo", albedo), ("lit", _lit(albedo, relief))):
        made = {sensor: named(classifier, generate(pipe, seed, "image", picture, sensor=sensor)) for sensor in rendered}
        alike = torch.stack([made[sensor] == rendered[sensor] for sensor in rendered]).float()
        crossed = torch.stack([made[sensor][:, None] == rendered[sensor][None] for sensor in rendered])
        figures[name] = {
            "agreement": alike.mean().item(),
            "floor": crossed[:, others].float().mean().item(),
            "by_surface": dict(
                zip(pairs, alike.view(len(rendered), len(pairs), -1).mean((0, 2)).tolist(), strict=True)
            ),
            "named": _most(made, pairs),
        }
    next_patch = [(call == call.view(len(pairs), -1).roll(1, 1).flatten()).float().mean() for call in rendered.values()]
    return {**figures, "neighbours": torch.stack(next_patch).mean().item(), "rendered": _most(rendered, pairs)}


def _rendered(relief: Tensor, sensor: str, noise: torch.Generator) -> Tensor:
    """Touches (N, 3, 64, 64) of surfaces (N, R, R) in mm, pressed in the middle of the world's range."""
    full = torch.ones(len(relief))
    clean = touch_images(relief, PRESS * full, DWELL * full, 0.0 * full, SENSORS[sensor], 64)
    return (clean + SENSORS[sensor].noise * torch.randn(clean.shape, generator=noise)).clamp(0.0, 1.0)


def _lit(albedo: Tensor, relief: Tensor) -> Tensor:
    """Surfaces as the world's camera sees them, matt and under a lamp at one side, (N, 3, 64, 64)."""
    light = F.normalize(torch.tensor([[0.5, 0.3, 0.8]]), dim=1).expand(len(relief), 3)
    return pictures(relief, albedo**GAMMA, torch.ones_like(relief), light, torch.zeros(len(relief)), 64, torch.ones(3))


def _most(calls: dict[str, Tensor], surfaces: list[str]) -> dict[str, str]:
    """What is called most over sensors and patches, by surface."""
    rows = torch.stack(list(calls.values())).view(len(calls), len(surfaces), -1).transpose(0, 1).flatten(1)
    return {name: MATERIAL_NAMES[index] for name, index in zip(surfaces, rows.mode(dim=1).values.tolist(), strict=True)}
