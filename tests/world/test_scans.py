"""Scanned surfaces: what ships and how it is split, where a scan is sampled, and contacts that show one."""

import math
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tests.helpers.chances import has_chance
from unitouch_gen.world import ATTRIBUTES, MATERIAL_NAMES, World
from unitouch_gen.world.captions import described
from unitouch_gen.world.draws import SHAPES
from unitouch_gen.world.questions import answered
from unitouch_gen.world.scans import (
    COLLECTION,
    COLOURS,
    HEIGHTS,
    mirrored_index,
    sampled,
    scanned_surfaces,
    split_of,
    surface_of,
    surfaces_of,
)
from unitouch_gen.world.surfaces import surfaces

WITHOUT = {"glass", "rubber"}  # nobody scans these
KNOWN = [number for number, name in enumerate(MATERIAL_NAMES) if name not in WITHOUT]


def contacts(objects: list[int], materials: list[int] = KNOWN) -> tuple[torch.Tensor, ...]:
    grid = torch.cartesian_prod(torch.tensor(materials), torch.tensor(objects))
    return grid[:, 0], grid[:, 1], torch.zeros(len(grid), dtype=torch.int64)


def test_every_surface_has_its_files_and_a_licence_that_lets_it_ship() -> None:
    expected = set()
    for one in scanned_surfaces():
        expected |= {f"{one.name}{COLOURS}"} | ({f"{one.name}{HEIGHTS}"} if one.heights != "none" else set())
        assert one.licence.startswith(("CC0", "MIT"))
        assert "3dtextures" not in one.licence + one.source
        assert one.source
        assert one.author
        assert one.material in MATERIAL_NAMES
        assert one.heights in ("measured", "computed", "none")
    assert {file.name for file in (COLLECTION / "surfaces").iterdir()} == expected
    assert sum(file.stat().st_size for file in COLLECTION.rglob("*.*")) <= 12e6


def test_every_material_but_two_is_held_out_in_part() -> None:
    felt = [one for one in scanned_surfaces() if one.heights != "none"]
    assert {one.material for one in felt} == set(MATERIAL_NAMES) - WITHOUT
    assert {one.material for one in felt if one.split == "test"} == set(MATERIAL_NAMES) - WITHOUT
    counts = Counter(one.split for one in felt)
    assert 35 <= counts["test"] <= 48
    assert 10 <= counts["val"] <= 20
    assert counts["train"] > 200
    per_material = Counter(one.material for one in felt if one.split == "test")
    assert max(per_material.values()) <= 6  # no figure is of one material


def test_twins_are_on_one_side_of_the_split() -> None:
    found = scanned_surfaces()
    splits = defaultdict[str, set[str]](set)
    for one in found:
        splits[one.group].add(one.split)
    assert all(len(names) == 1 for names in splits.values())
    builder = pytest.importorskip("build_collection", reason="there is no checkout here")
    pairs = []
    for name in MATERIAL_NAMES:
        own = [one for one in found if one.material == name]
        pictures = [Image.open(COLLECTION / "surfaces" / f"{one.name}{COLOURS}") for one in own]
        pairs += [(own[a], own[b]) for a, b in builder.same_texture(pictures, 0.72)] if own else []
    assert len(pairs) >= 4
    assert all(a.split == b.split for a, b in pairs)
    stem = builder.stem_of
    assert stem("bricks075a") == stem("Bricks_075b") != stem("bricks076a")
    assert stem("rock_01") == stem("rock01")
    assert stem("bark-001") == stem("bark_01") != stem("bark_02")
    kept = Counter(stem(one.name.partition("__")[2].partition("_")[2]) for one in found)
    assert sum(kept.values()) == len(found)


def test_normals_of_either_convention_give_the_surface_back() -> None:
    builder = pytest.importorskip("build_collection", reason="there is no checkout here")
    axis = np.arange(64) / 64 * 2 * np.pi
    height = (
        np.sin(2 * axis)[None, :] + 0.6 * np.cos(3 * axis)[:, None] + 0.4 * np.sin(axis[:, None] + 2 * axis[None, :])
    )
    slope_y, slope_x = (np.roll(height, -1, axis) - np.roll(height, 1, axis) for axis in (0, 1))
    for sign in (1.0, -1.0):
        normal = np.stack([-0.5 * slope_x, sign * 0.5 * slope_y, np.ones_like(height)], axis=-1)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        assert np.corrcoef(builder.integrated(normal).ravel(), height.ravel())[0, 1] > 0.99


def test_a_weave_survives_compression() -> None:
    builder = pytest.importorskip("build_collection", reason="there is no checkout here")
    axis = np.arange(builder.HEIGHT_SIDE)
    weave = np.sin(axis / 2.5)[None, :] * np.sin(axis / 2.5)[:, None]
    relief = (weave + 0.03 * np.random.default_rng(0).standard_normal(weave.shape)) / weave.std()
    file = builder.io.BytesIO(builder.compressed_height(relief.clip(-3.2, 3.2)))
    again = np.asarray(Image.open(file).convert("L"), dtype=np.float32)
    assert np.corrcoef(again.ravel(), relief.ravel())[0, 1] > 0.98
    assert np.corrcoef(np.diff(again).ravel(), np.diff(weave).ravel())[0, 1] > 0.9


@pytest.mark.parametrize("mode", ["bilinear", "bicubic"])
def test_a_scan_is_read_where_it_is_asked_for(mode: str) -> None:
    size = 64
    image = (torch.arange(size, dtype=torch.uint8) * 2).expand(2, size, size).clone()
    image[1] = image[0].T
    values = torch.arange(256.0).expand(2, 256)
    angle = 0.7
    u, v = torch.meshgrid(torch.linspace(-0.2, 0.2, 33), torch.linspace(-0.2, 0.2, 33), indexing="xy")
    x = 0.5 + math.cos(angle) * u - math.sin(angle) * v
    y = 0.5 + math.sin(angle) * u + math.cos(angle) * v
    found = sampled(image, values, torch.stack([x, y], dim=-1), mode)
    expected = 2 * (torch.stack([x, y]) * size - 0.5)  # a level is that of its pixel's centre
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-3 if mode == "bilinear" else 0.15)  # its kernel's own
    coarse = sampled(image, values, torch.stack([x, y], dim=-1)[::4, ::4], mode)  # which averages pixels
    torch.testing.assert_close(coarse[:, 2:-2, 2:-2], expected[:, ::4, ::4][:, 2:-2, 2:-2], rtol=0, atol=1.5)
    assert mirrored_index(-3, 66, 64).tolist() == [2, 1, 0, *range(64), 63, 62, 61]


def test_objects_show_the_surfaces_of_their_split_and_all_of_them() -> None:
    seen = defaultdict[str, set[int]](set)
    for material in KNOWN:
        for object_ in (*range(60), *range(500, 504), *range(600, 606), *range(800, 806), *range(1000, 1060)):
            if (number := surface_of(0, material, object_, 1.0)) >= 0:
                seen[split_of(object_)].add(number)
                assert scanned_surfaces()[number].material == MATERIAL_NAMES[material]
    for split, kept in (("train", "train"), ("val", "val"), ("test", "test"), ("beyond", "test")):
        assert {scanned_surfaces()[number].split for number in seen[split]} == {kept}
        assert seen[split] == {one for material in KNOWN for one in surfaces_of(material, split)}
    assert all(scanned_surfaces()[number].heights != "none" for numbers in seen.values() for number in numbers)
    shares = [sum(surface_of(0, material, one, 0.5) >= 0 for one in range(100)) for material in range(17)]
    assert shares[MATERIAL_NAMES.index("concrete")] == 50
    assert shares[MATERIAL_NAMES.index("glass")] == 0
    assert shares[MATERIAL_NAMES.index("paper")] == 20  # two surfaces: few objects, or they would be learnt by heart
    computed = [scanned_surfaces()[surface_of(0, KNOWN[0], one, 1.0)].heights for one in range(55)]
    assert computed.count("computed") < 0.5 * len(computed)  # of concrete, two of three are


def test_drawn_objects_stay_as_they_are_beside_scanned_ones() -> None:
    names = contacts([0, 1, 2, 3], KNOWN[::3])
    every = {"modalities": ("image", "touch", "audio", "text"), "sensors": ("digit",)}
    plain = World(image_size=32).render(*names, **every)
    mixed = World(image_size=32, scanned=0.5).render(*names, **every)
    drawn = torch.tensor([name is None for name in mixed.surface])
    assert 0 < drawn.sum() < len(drawn)
    assert plain.surface == [None] * len(drawn)
    assert torch.equal(plain.image[drawn], mixed.image[drawn])
    assert torch.equal(plain.touch["digit"][drawn], mixed.touch["digit"][drawn])
    assert not torch.isclose(plain.image[~drawn], mixed.image[~drawn]).flatten(1).all(dim=1).any()
    assert torch.equal(plain.audio, mixed.audio)
    alone = World(image_size=32, scanned=0.5).render(*(part[9:10] for part in names), **every)
    torch.testing.assert_close(alone.touch["digit"][0], mixed.touch["digit"][9], rtol=0, atol=1e-4)
    assert (alone.text[0], alone.surface[0]) == (mixed.text[9], mixed.surface[9])


def test_the_grain_that_is_said_is_the_grain_that_is_felt() -> None:
    world = World(image_size=64, scanned=1.0)
    names = contacts(list(range(600, 612)), [MATERIAL_NAMES.index(name) for name in ("wood", "tree", "natural fabric")])
    draws = world.draw(*names)
    felt = world.render(*names, modalities=("attributes",)).attributes["gelsight"]
    across = torch.atan2(
        felt[:, ATTRIBUTES.index("grain y")], felt[:, ATTRIBUTES.index("grain x")]
    )  # of twice the angle
    clear = felt[:, ATTRIBUTES.index("grain x")].hypot(felt[:, ATTRIBUTES.index("grain y")]) > 0.5
    kept = draws.grained & clear & (draws.shape == list(SHAPES).index("flat"))
    assert kept.sum() >= 8
    agreement = -torch.cos(across - 2 * draws.angle)[kept]  # slopes are steepest across a grain
    assert agreement.median() > 0.8
    assert (agreement > 0.0).float().mean() > 0.85


def test_lengths_are_in_the_range_that_is_told() -> None:
    world = World(image_size=32, scanned=1.0)
    draws = world.draw(*contacts([0, 1, 600]))
    assert draws.scan_side.min() >= 25.0
    assert draws.scan_side.max() <= 150.0
    flat = draws.shape == list(SHAPES).index("flat")
    height = surfaces(0, draws, 64, coloured=False).height[flat]
    relief = height.flatten(1).std(dim=1)
    assert relief.median() > 0.05
    assert relief.max() < 1.2
    assert draws.colour.min() >= 0.02
    assert draws.colour.max() <= 0.98


def test_captions_and_answers_of_a_scan_are_measured_of_it() -> None:
    draws = World(scanned=1.0).draw(*contacts([0, 601]))
    names = [MATERIAL_NAMES[number] for number in draws.material.tolist()]
    for variant in range(4):
        for text, name in zip(described(draws, variant), names, strict=True):
            assert name in text
            assert "regular" not in text
            assert "coarse " not in text
    told = answered(draws, torch.ones(len(draws), len(ATTRIBUTES)))
    for one, grained in zip(told, draws.grained.tolist(), strict=True):
        assert ("running" in one["grain"][1]) == grained
        assert "bumps" not in one["feel"][1]


def test_photos_are_of_the_same_contacts_under_a_light_of_their_own() -> None:
    names = contacts([600, 601], KNOWN[::2])
    worlds = [World(image_size=32, scanned=1.0, photographic=share) for share in (0.0, 0.5, 1.0, 1.0)]
    plain, some, photos, again = (world.render(*names, modalities=("image",)).image for world in worlds)
    changed = (some != plain).flatten(1).any(dim=1)
    assert has_chance(changed.sum(), len(changed), 0.5)
    assert torch.equal(photos, again)
    assert (photos != plain).flatten(1).any(dim=1).all()
    assert photos.min() >= 0.0
    assert photos.max() <= 1.0
    alike = [
        np.corrcoef(a.mean(dim=0).ravel(), b.mean(dim=0).ravel())[0, 1] for a, b in zip(plain, photos, strict=True)
    ]
    assert np.median(alike) > 0.75
    assert (photos.mean(dim=(2, 3)) - plain.mean(dim=(2, 3))).abs().mean() > 0.02


def test_colours_alone_are_pictures_of_flat_surfaces() -> None:
    names = contacts(list(range(40)), [MATERIAL_NAMES.index("brick")])
    world = World(image_size=32, scanned=1.0, colours_alone=True)
    draws = world.draw(*names)
    alone = torch.tensor([scanned_surfaces()[number].heights == "none" for number in draws.surface.tolist()])
    assert alone.any()
    assert not alone.all()
    flat = alone & (draws.shape == list(SHAPES).index("flat"))
    height = surfaces(0, draws.but(tilt=0 * draws.tilt), 64, coloured=False).height
    assert height[flat].std(dim=(1, 2)).max() < 1e-5
    image = world.render(*names, modalities=("image",)).image
    assert image[flat].flatten(2).std(dim=2).mean(dim=1).median() > 0.02


def test_the_collection_is_named_in_the_notice() -> None:
    notice = Path(__file__).resolve().parents[2] / "NOTICE"
    if not notice.is_file():
        pytest.skip("there is no checkout here")
    text = notice.read_text()
    for author in {one.author for one in scanned_surfaces()}:
        assert author.split(" (")[0].split("/")[0].strip() in text, author
