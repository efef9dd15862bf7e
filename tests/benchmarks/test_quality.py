"""What is measured of a family: real images get the ceiling, linear relations are found, scans are held out."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from tests.benchmarks import quality
from tests.benchmarks.quality import Scans, cross_predicted, held_out, main, over_seeds
from tests.helpers.classifiers import classifier
from tests.helpers.components import make_components, make_x_to_touch
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.evaluation.controls import Controlled
from unitouch_gen.pipelines import TactileStylizationPipeline, TouchToImagePipeline, XToTouchPipeline
from unitouch_gen.training.data import drawn
from unitouch_gen.world import MATERIAL_NAMES, Texture, TextureLibrary

RANDOM = torch.Generator().manual_seed(0)

pytestmark = pytest.mark.filterwarnings("ignore::unitouch_gen.errors.UnfamiliarInputWarning")  # networks are random


def test_a_linear_relation_is_found_in_groups_that_it_was_not_fitted_to() -> None:
    features = torch.randn(60, 5, generator=RANDOM)
    targets = features @ torch.randn(5, 2, generator=RANDOM) + 3.0
    groups = torch.arange(60) % 6
    assert (cross_predicted(features, targets, groups) - targets).abs().max() < 0.1 * targets.std()
    noise = torch.randn(60, 2, generator=RANDOM)
    assert (cross_predicted(features, noise, groups) - noise).square().mean() > 0.8 * noise.var()


def test_seeds_give_a_mean_and_a_spread() -> None:
    rows = [{"touch": Controlled(value, 0.1, None, 1.0)} for value in (0.2, 0.3, 0.7)]
    expected = {"value": 0.4, "class_mean": 0.1, "shuffled": None, "ceiling": 1.0, "spread": 0.5}
    assert over_seeds(rows) == {"touch": pytest.approx(expected)}


def test_untrained_encoders_are_told_as_one_with_their_bounds() -> None:
    figures = {"touch encoder": {"mean": 0.9}, **{f"untrained {seed}": {"mean": 0.1 * seed} for seed in range(4)}}
    told = quality.of_untrained(figures, "mean")
    assert told == {
        "touch encoder": {"mean": 0.9},
        "untrained": pytest.approx({"mean": 0.15, "least": 0.0, "most": 0.3}),
    }


def test_a_picture_keeps_its_own_layout_whatever_its_colours() -> None:
    photos = torch.rand(4, 3, 32, 32, generator=RANDOM)
    assert quality.layout_kept(0.5 * photos + 0.2, photos) == pytest.approx(1.0, abs=1e-5)
    assert quality.layout_kept(1.0 - photos, photos) == pytest.approx(-1.0, abs=1e-5)
    assert abs(quality.layout_kept(photos.roll(1, 0), photos)) < 0.5


def scans(count: int) -> TextureLibrary:
    maps = torch.rand(3, 32, 32).half(), torch.randn(32, 32).half()
    return TextureLibrary([Texture(f"wood/{number}", "wood", *maps, {}) for number in range(count)])


def test_patches_are_of_scans_held_out() -> None:
    library = scans(12)
    world = Scans(7, textures=library)
    draws = world.draw(*world.names())
    assert set(draws.texture.tolist()) <= {number for group in library.by_split["test"].values() for number in group}
    assert len(set(draws.texture.tolist())) == 2
    assert {MATERIAL_NAMES[number] for number in draws.material.tolist()} == {"wood"}


def test_too_few_scans_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="holds no material of the split 'test'"):
        Scans(7, textures=scans(2))


def test_pictures_and_touches_that_are_generated_are_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quality, "SCAN_OBJECTS", 4)
    parts, options = make_components(), {"default_num_inference_steps": 2, "default_guidance_scale": 2.0}
    shared = {name: parts[name] for name in ("unitouch", "processor", "scheduler")}
    to_touch = XToTouchPipeline(**shared, **make_x_to_touch(), sensors=["gelsight", "digit"], **options)
    to_picture, restyle = (kind(**parts, **options) for kind in (TouchToImagePipeline, TactileStylizationPipeline))
    held = held_out(tmp_path, parts["processor"], 7, "val", None, "digit", objects=1)
    rows = quality.touch_to_image_rows(to_picture, classifier(), held, 1, height=16, width=16)
    rows |= quality.restyled_rows(restyle, classifier("fine relief"), held, 1, height=16, width=16)
    rows |= quality.x_to_touch_rows(to_touch, classifier(), held, 1)
    monkeypatch.setattr(drawn, "library", lambda folder: scans(12))
    monkeypatch.setattr(quality, "library", lambda folder: scans(12))
    shown = quality.patches(held.source, 32, ["digit"])
    rows |= quality.photo_rows(to_touch, classifier(), shown, "digit", 1, seed=7)
    made = ("touch to picture", "photo to touch", "caption to touch", "sound to touch")
    assert {f"{name}: {key}" for name in made for key in ("material", "contact within material", "cover")} <= set(rows)
    assert {"scan, photo to touch: named as its touch", "scan, photo to touch: grain degrees"} <= set(rows)
    assert rows["photo as it was: layout kept"].value == pytest.approx(1.0)
    assert {f"restyled {name}: relief of the touch" for name in ("photo", "from noise")} <= set(rows)
    assert all(rows[f"{name}: Frechet distance"].value > rows[f"{name}: Frechet distance"].ceiling for name in made)


def test_the_joint_space_alone_is_measured(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    parts = make_components()
    for part in ("unitouch", "processor"):
        parts[part].save_pretrained(tmp_path / "joint")
    words = [
        "--joint",
        str(tmp_path / "joint"),
        "--split",
        "val",
        "--objects",
        "2",
        "--seeds",
        "1",
        "-o",
        str(tmp_path / "quality.json"),
    ]
    main([*words, "--cache", str(tmp_path / "cache")])
    rows = json.loads((tmp_path / "quality.json").read_text())["rows"]
    found = rows["touch to its touch by another sensor, within material"]
    assert found["class_mean"] == pytest.approx(1 / 4) and found["ceiling"] > 0.5
    assert {"touch: material", "image: material", "audio: material"} <= set(rows)
    assert not [name for name in rows if name.startswith(("scan", "touch to picture"))]
    assert "touch to its picture, within material: 0." in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (lambda folder: [], "name `--joint` or `--family`"),
        (lambda folder: ["--joint", folder, "--recordings", folder], "holds no gelsight_objects.zip"),
    ],
)
def test_what_cannot_be_measured_is_said_at_once(
    words: Callable[[str], list[str]], message: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(words(str(tmp_path)))
    assert message in capsys.readouterr().err
