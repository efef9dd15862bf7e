"""Builds `unitouch_gen/world/collection`: the scanned surfaces and recorded sounds of the built-in world.

python samples/build_collection.py --source path/to/raw

The source holds folders `surfaces`, `textures` and `sounds_cc0`, each with an `index.csv` that names the files, their
source, author and licence. The collection is resampled and compressed, and its `index.csv` has a row for each surface
and sound. The same source gives the same collection.
"""

import argparse
import csv
import hashlib
import io
import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import soundfile
from PIL import Image
from scipy.signal import resample_poly
from tqdm import tqdm

from unitouch_gen.world.scans import COLLECTION, COLOURS, HEIGHT_RANGE, HEIGHTS

COLOUR_SIDE = 256  # pixels
HEIGHT_SIDE = 384  # pixels
KEPT_CORRELATION = 0.99  # least correlation of a height map and its compressed file
LEFT_OUT = ("3dtextures",)  # sources whose licence is stated only on their site
FINE_STEPS = 0.2  # share of its range that an 8-bit height map has to use; below it, steps could be felt
COMPUTED = ("uebergame", "nobiax", "vpython")  # sources whose heights were computed from the brightness of photographs
HEARD = 0.6  # length of each sound that is kept, s
SAMPLE_RATE = 16_000

FIELDS = ["name", "kind", "material", "heights", "split", "group", "source", "author", "licence"]


@dataclass
class Surface:
    """A raw surface: its files, origin and licence."""

    name: str
    material: str
    provider: str
    source: str
    author: str
    licence: str
    albedo: Path
    height: Path | None = None
    normal: Path | None = None
    heights: str = "none"  # measured, computed, or none
    group: str = ""
    colours: Image.Image | None = field(default=None, repr=False)
    relief: np.ndarray | None = field(default=None, repr=False)


# Reading the raw folders ----------------------------------------------------------------------------------------------


def rows_of(file: Path) -> list[dict[str, str]]:
    with file.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def surfaces_of(folder: Path) -> list[Surface]:
    """The surfaces of the folder `surfaces`, which has height maps."""
    surfaces = []
    for row in rows_of(folder / "index.csv"):
        provider = row["source_folder"]
        height = None
        heights = "none"
        if row["height"]:
            height = folder / row["height"]
            heights = "computed" if provider in COMPUTED else "measured"
        surfaces.append(
            Surface(
                name=row["surface"],
                material=row["material"].replace("_", " "),
                provider=provider.removesuffix("_albedo_only"),
                source=row["source"],
                author=row["author"],
                licence=row["licence"],
                albedo=folder / row["albedo"],
                height=height,
                heights=heights,
            )
        )
    return surfaces


def textures_of(folder: Path) -> list[Surface]:
    """The surfaces of the folder `textures`, which has a row for each of their maps; some have only normals."""
    maps = defaultdict[tuple[str, str], dict[str, dict[str, str]]](dict)
    for row in rows_of(folder / "index.csv"):
        maps[row["class"], row["item"]][row["kind"]] = row
    surfaces = []
    for (material, name), kinds in maps.items():
        albedo = kinds["albedo"]
        licence = albedo["licence"]
        provider = provider_of(licence) or albedo["source"]
        height = kinds.get("height")
        if height and "normal" in kinds and too_coarse(height["note"]):
            height = None
        surfaces.append(
            Surface(
                name=name,
                material={"sand/soil": "sand"}.get(material, material),
                provider=provider,
                source=f"{albedo['source']}:{albedo['path']}",
                author=provider,
                licence=licence,
                albedo=folder / albedo["file"],
                height=folder / height["file"] if height else None,
                normal=folder / kinds["normal"]["file"] if "normal" in kinds else None,
                heights="measured",
            )
        )
    return surfaces


def provider_of(licence: str) -> str | None:
    """The site that a licence names, if it is one of the known sites."""
    if "cc0textures.com" in licence:
        return "ambientCG"
    for site in ("ambientCG", "Poly Haven", "cgbookcase", "3dtextures"):
        if site in licence:
            return site
    return None


def too_coarse(note: str) -> bool:
    """Whether an 8-bit height map uses few of its levels, by its note: "height range 0.021 of full, 8-bit"."""
    match = re.search(r"range ([\d.]+) of full, 8-bit", note)
    return match is not None and float(match[1]) < FINE_STEPS


# Heights --------------------------------------------------------------------------------------------------------------


def heights_of(surface: Surface) -> np.ndarray:
    """Heights in units of their deviation, without their plane, at most `HEIGHT_RANGE`, (S, S)."""
    if surface.height is not None:
        values = np.asarray(Image.open(surface.height), dtype=np.float32)
    else:
        pixels = np.asarray(Image.open(surface.normal).convert("RGB"), dtype=np.float32)
        values = integrated(pixels / 127.5 - 1.0)
    if values.ndim == 3:
        values = values[..., 0]
    values = np.asarray(Image.fromarray(values).resize((HEIGHT_SIDE, HEIGHT_SIDE), Image.Resampling.LANCZOS))
    axis = np.linspace(-1.0, 1.0, HEIGHT_SIDE)
    columns = np.broadcast_arrays(np.ones((1, 1)), axis[None, :], axis[:, None])
    plane = np.stack(columns, axis=-1).reshape(-1, 3)
    coefficients, *_ = np.linalg.lstsq(plane, values.reshape(-1), rcond=None)
    values = values - (plane @ coefficients).reshape(values.shape)
    return (values / values.std().clip(1e-9)).clip(-HEIGHT_RANGE, HEIGHT_RANGE)


def integrated(normals: np.ndarray) -> np.ndarray:
    """Heights from a map of normals (S, S, 3), by Frankot and Chellappa (1988).

    Green points up in some maps and down in others. The direction with the smaller curl is taken, since slopes of a
    surface have none.
    """
    slope_x = -normals[..., 0] / normals[..., 2].clip(0.2)
    slope_y = normals[..., 1] / normals[..., 2].clip(0.2)
    wave_y = 2j * np.pi * np.fft.fftfreq(slope_x.shape[0])[:, None]
    wave_x = 2j * np.pi * np.fft.fftfreq(slope_x.shape[1])[None, :]
    along_x = np.fft.fft2(slope_x)
    along_y = np.fft.fft2(slope_y)

    def curl(sign: float) -> float:
        return np.abs(wave_x * sign * along_y - wave_y * along_x).sum()

    sign = min((1.0, -1.0), key=curl)
    power = np.abs(wave_x) ** 2 + np.abs(wave_y) ** 2
    power[0, 0] = 1.0
    spectrum = (np.conj(wave_x) * along_x + np.conj(wave_y) * sign * along_y) / power
    spectrum[0, 0] = 0.0
    return np.fft.ifft2(spectrum).real.astype(np.float32)


# Twins and splits -----------------------------------------------------------------------------------------------------


def stem_of(name: str) -> str:
    """A name without separators, leading zeros and the letter of a variant: bricks75 for bricks_075b."""
    letters = re.sub(r"[^a-z0-9]", "", name.lower())
    letters = re.sub(r"(?<=\d)[a-d]$", "", letters)
    return re.sub(r"0+(?=\d)", "", letters)


def same_texture(pictures: Sequence[Image.Image], least: float = 0.7) -> list[tuple[int, int]]:
    """Pairs of pictures of one texture: those with a correlation of `least` or more at some shift, in grey at 64 px."""
    grey = np.stack([np.asarray(picture.convert("L").resize((64, 64)), dtype=np.float32) for picture in pictures])
    grey = grey - grey.mean(axis=(1, 2), keepdims=True)
    grey = grey / np.linalg.norm(grey, axis=(1, 2), keepdims=True).clip(1e-6)
    spectra = np.fft.rfft2(grey).astype(np.complex64)
    pairs = []
    for row, spectrum in enumerate(spectra[:-1]):
        others = np.fft.irfft2(spectra[row + 1 :] * spectrum.conj(), s=(64, 64)).max(axis=(1, 2))
        pairs += [(row, row + 1 + int(other)) for other in np.flatnonzero(others >= least)]
    return pairs


def grouped(surfaces: list[Surface]) -> None:
    """Sets the group of each surface; surfaces with the same stem or the same texture are in one group."""
    parent = list(range(len(surfaces)))

    def root(row: int) -> int:
        while parent[row] != row:
            row = parent[row]
        return row

    stems = defaultdict[str, list[int]](list)
    for row, surface in enumerate(surfaces):
        stems[stem_of(surface.name)].append(row)
    pairs = [(rows[0], row) for rows in stems.values() for row in rows[1:]]
    pairs += same_texture([surface.colours for surface in surfaces])
    for row, twin in pairs:
        roots = sorted([root(row), root(twin)])
        parent[roots[1]] = roots[0]
    for row, surface in enumerate(surfaces):
        surface.group = surfaces[root(row)].name


def in_order(names: Iterable[str]) -> list[str]:
    """Names in a pseudo-random order that is the same every time."""
    return sorted(names, key=lambda name: hashlib.sha256(name.encode()).digest())


def splits_of(surfaces: list[Surface]) -> dict[str, str]:
    """The split of each group: of each material a fifth, one to four, for testing, and one for validation.

    Held-out groups have measured heights, if a material has enough of them.
    """
    splits = {surface.group: "train" for surface in surfaces}
    for material in sorted({surface.material for surface in surfaces}):
        own = [surface for surface in surfaces if surface.material == material and surface.relief is not None]
        groups = in_order({surface.group for surface in own})
        free = [group for group in groups if splits[group] == "train"]
        measured = {surface.group for surface in own if surface.heights == "measured"}
        candidates = [group for group in free if group in measured] or free
        count = min(max(round(len(groups) / 5), 1), 4)
        for group in candidates[:count]:
            splits[group] = "test"
        if len(groups) >= 5 and len(candidates) > count:
            splits[candidates[count]] = "val"
    return splits


# Writing --------------------------------------------------------------------------------------------------------------


def compressed(image: Image.Image, quality: int) -> bytes:
    content = io.BytesIO()
    image.save(content, "WEBP", quality=quality, method=6)
    return content.getvalue()


def compressed_height(relief: np.ndarray) -> bytes:
    """The smallest file whose heights have a correlation of `KEPT_CORRELATION` with `relief`."""
    levels = np.round((relief / HEIGHT_RANGE + 1.0) * 127.5).astype(np.uint8)
    for quality in (40, 50, 60, 70, 80, 90, 97):
        content = compressed(Image.fromarray(levels), quality)
        decoded = np.asarray(Image.open(io.BytesIO(content)).convert("L"), dtype=np.float32)
        if np.corrcoef(decoded.ravel(), relief.ravel())[0, 1] >= KEPT_CORRELATION:
            break
    return content


def write_surfaces(surfaces: list[Surface], place: Path) -> list[dict[str, str]]:
    place.mkdir(parents=True, exist_ok=True)
    splits = splits_of(surfaces)
    rows = []
    for surface in tqdm(surfaces, "surfaces"):
        material = surface.material.replace(" ", "_")
        provider = surface.provider.split("/")[0]
        name = re.sub(r"[^a-z0-9_]+", "_", f"{material}__{provider}_{surface.name}".lower())
        (place / f"{name}{COLOURS}").write_bytes(compressed(surface.colours, 80))
        if surface.relief is not None:
            (place / f"{name}{HEIGHTS}").write_bytes(compressed_height(surface.relief))
        rows.append(
            {
                "name": name,
                "kind": "surface",
                "material": surface.material,
                "heights": surface.heights,
                "split": splits[surface.group],
                "group": surface.group,
                "source": surface.source,
                "author": surface.author,
                "licence": surface.licence,
            }
        )
    assert len({row["name"] for row in rows}) == len(rows)
    return rows


def sound_kind(name: str) -> str:
    """The kind of hit, a name without the number of the take."""
    return re.sub(r"[._]\d+$", "", name)


def write_sounds(folder: Path, place: Path) -> list[dict[str, str]]:
    """Writes sounds at 16 kHz from their onset; all takes of one kind of hit are in one split.

    Of a material with two kinds or more, one is for testing; with four or more, another one is for validation.
    """
    place.mkdir(parents=True, exist_ok=True)
    raw = rows_of(folder / "index.csv")
    splits = {sound_kind(row["surface"]): "train" for row in raw}
    for material in sorted({row["material"] for row in raw}):
        kinds = in_order({sound_kind(row["surface"]) for row in raw if row["material"] == material})
        if len(kinds) >= 2:
            splits[kinds[0]] = "test"
        if len(kinds) >= 4:
            splits[kinds[1]] = "val"
    rows = []
    for row in tqdm(raw, "sounds"):
        samples, rate = soundfile.read(folder / row["file"], dtype="float32", always_2d=True)
        sound = resample_poly(samples.mean(axis=1), SAMPLE_RATE, rate)
        start = int(np.argmax(np.abs(sound) > 0.03 * np.abs(sound).max()))
        sound = sound[start : start + round(HEARD * SAMPLE_RATE)]
        name = f"{row['material']}__{row['surface']}".lower().replace(".", "_")
        soundfile.write(place / f"{name}.flac", 0.9 * sound / np.abs(sound).max(), SAMPLE_RATE, subtype="PCM_16")
        kind = sound_kind(row["surface"])
        rows.append(
            {
                "name": name,
                "kind": "sound",
                "material": row["material"].replace("_", " "),
                "split": splits[kind],
                "group": kind,
                "source": row["source"],
                "author": row["author"],
                "licence": row["licence"],
            }
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", type=Path, required=True, help="folder of the raw surfaces and sounds")
    parser.add_argument("--output", type=Path, default=COLLECTION)
    arguments = parser.parse_args()

    raw = [*surfaces_of(arguments.source / "surfaces"), *textures_of(arguments.source / "textures")]
    surfaces = [surface for surface in raw if not any(name in surface.provider for name in LEFT_OUT)]
    for surface in tqdm(surfaces, "reading"):
        picture = Image.open(surface.albedo).convert("RGB")
        surface.colours = picture.resize((COLOUR_SIDE, COLOUR_SIDE), Image.Resampling.LANCZOS)
        if surface.height is not None or surface.normal is not None:
            surface.relief = heights_of(surface)
    grouped(surfaces)
    rows = write_surfaces(surfaces, arguments.output / "surfaces")
    rows += write_sounds(arguments.source / "sounds_cc0", arguments.output / "sounds")
    with (arguments.output / "index.csv").open("w", encoding="utf-8", newline="") as stream:
        table = csv.DictWriter(stream, FIELDS, restval="", lineterminator="\n")
        table.writeheader()
        table.writerows(rows)
    size = sum(file.stat().st_size for file in arguments.output.rglob("*") if file.is_file())
    print(f"{len(rows)} surfaces and sounds, {size / 1e6:.1f} MB, in {arguments.output}")


if __name__ == "__main__":
    main()
