"""Many pictures: each as if it was made alone, once, whatever ends the run, and nothing that was there is lost."""

import io
import json
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
import torch
from PIL import Image

from tests.helpers.components import make_components, make_x_to_touch
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.files import appending
from unitouch_gen.pipelines import TactileStylizationPipeline, TouchToImagePipeline, XToTouchPipeline
from unitouch_gen.pipelines.batch import call_together, load_item, run_batch
from unitouch_gen.pipelines.manifest import Manifest, read_manifest

COUNT = 7


@pytest.fixture(scope="module")
def pipes() -> dict[str, Any]:
    parts, few = make_components(), {"default_num_inference_steps": 3, "default_guidance_scale": 2.0}
    shared = {name: parts[name] for name in ("unitouch", "processor", "scheduler")}
    made = {
        "touch-to-image": TouchToImagePipeline(**parts, **few),
        "stylization": TactileStylizationPipeline(**parts, **few),
        "x-to-touch": XToTouchPipeline(**shared, **make_x_to_touch(), **few, sensors=["gelsight", "digit"]),
    }
    for pipe in made.values():
        pipe.set_progress_bar_config(disable=True)
    return made


@pytest.fixture
def touches(tmp_path: Path) -> Path:
    """A folder of touches of several shapes."""
    (tmp_path / "in").mkdir()
    for number in range(COUNT):
        pixels = np.random.default_rng(number).integers(20, 80, (32 + number, 40, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(tmp_path / "in" / f"{number}.png")
    return tmp_path / "in"


def bytes_in(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def lines(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "ledger.jsonl").read_text().splitlines()]


class Killed(BaseException):
    """What ends a run where a test wants it."""


def ended_after(calls: int) -> Callable[[int, int], None]:
    """What ends a run after a number of calls."""
    left = [calls]

    def progress(done: int, whole: int) -> None:
        left[0] -= 1
        if not left[0]:
            raise Killed

    return progress


# The same pictures ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("pipeline", "cells"),
    [
        ("touch-to-image", {"touch": "{n}.png", "prompt": "brick {n}", "seed": "{n}"}),
        (
            "touch-to-image",
            {"touch": "{n}.png", "sensor": "digit", "background": "6.png", "steps": 10, "seed": "{n}"},
        ),
        ("stylization", {"touch": "{n}.png", "image": "0.png", "init_strength": 0.5, "negative_prompt": "metal {n}"}),
        ("x-to-touch", {"text": "brick {n}", "image": "{n}.png", "sensor": "digit", "bridge": True, "seed": "{n}"}),
        ("x-to-touch", {"audio": "{n}.wav", "bridge": False, "candidates": 2}),
    ],
)
def test_a_picture_is_the_same_alone_and_among_others(
    pipes: dict[str, Any], touches: Path, pipeline: str, cells: dict[str, Any]
) -> None:
    for number in range(3):
        soundfile.write(touches / f"{number}.wav", np.random.default_rng(number).normal(0, 0.1, 4000), 16000)
    rows = ({key: str(value).format(n=number) for key, value in cells.items()} for number in range(3))
    (touches / "table.jsonl").write_text("\n".join(json.dumps(row) for row in rows))
    manifest = read_manifest(touches / "table.jsonl", pipeline)
    loaded = {item.name: {**load_item(manifest, item), "output_type": "pt"} for item in manifest.items}
    together = call_together(pipes[pipeline], manifest.items, loaded)
    for item, picture, _ in together:
        [(_, alone, _)] = call_together(pipes[pipeline], [item], loaded)
        torch.testing.assert_close(picture, alone, rtol=0, atol=1e-5)
    assert not [said for _, _, said in together if "error" in said]
    assert not torch.allclose(together[0][1], together[1][1], atol=1e-3)


def test_a_picture_is_that_of_a_call_with_its_seed(pipes: dict[str, Any], touches: Path, tmp_path: Path) -> None:
    result = run_batch(pipes, read_manifest(touches, defaults={"seed": 5, "steps": 4}), tmp_path / "out")
    assert result is not None and not result.failed
    for number in range(COUNT):
        seed = torch.Generator().manual_seed(5)
        alone = pipes["touch-to-image"](touches / f"{number}.png", num_inference_steps=4, generator=seed).images[0]
        made = Image.open(tmp_path / "out" / f"{number}.png")
        assert np.abs(np.asarray(alone, dtype=int) - np.asarray(made, dtype=int)).max() <= 1  # of 255


def test_items_to_a_tolerance_are_alone_in_their_calls(pipes: dict[str, Any], touches: Path, tmp_path: Path) -> None:
    """Or the steps of one would depend on the others."""
    calls: list[tuple[int, int]] = []
    defaults = {"guidance": 1, "tolerance": 0.5}
    run_batch(
        pipes, read_manifest(touches, defaults=defaults), tmp_path / "out", progress=lambda *done: calls.append(done)
    )
    assert calls == [(number + 1, COUNT) for number in range(COUNT)]


@pytest.mark.parametrize("shard_size", [None, 3])
def test_processes_and_ends_change_nothing(
    pipes: dict[str, Any], touches: Path, tmp_path: Path, shard_size: int | None
) -> None:
    options: dict[str, Any] = {"batch_size": 2, "shard_size": shard_size}
    manifest = read_manifest(touches)
    result = run_batch(pipes, manifest, tmp_path / "whole", **options)
    assert result is not None and (result.made, result.failed) == (COUNT, {})
    assert [line["name"] for line in lines(tmp_path / "whole")] == [str(number) for number in range(COUNT)]
    for process in ((1, 3), (0, 3), (2, 3)):
        last = run_batch(pipes, manifest, tmp_path / "three", process=process, **options)
        assert (last is None) == (process != (2, 3))
    assert bytes_in(tmp_path / "three") == bytes_in(tmp_path / "whole")
    for process in ((0, 1), (0, 2), (0, 1), (1, 2)):
        with pytest.raises(Killed):
            run_batch(pipes, manifest, tmp_path / "ended", process=process, progress=ended_after(2), **options)
    run_batch(pipes, manifest, tmp_path / "ended", **options)
    assert bytes_in(tmp_path / "ended") == bytes_in(tmp_path / "whole")


def test_what_is_made_is_not_made_again(pipes: dict[str, Any], touches: Path, tmp_path: Path) -> None:
    out, manifest = tmp_path / "out", read_manifest(touches)
    with pytest.raises(Killed):
        run_batch(pipes, manifest, out, batch_size=2, progress=ended_after(2))
    before = {file: file.stat().st_ino for file in out.glob("*.png")}
    with (out / "ledger.00000.jsonl").open("a") as ledger:
        ledger.write('{"item": 4, "na')  # what a kill may leave
    run_batch(pipes, manifest, out, batch_size=3)
    assert len(before) == 4 and {file: file.stat().st_ino for file in before} == before
    assert [line["item"] for line in lines(out)] == [*range(COUNT)]
    (out / "3.png").unlink()
    run_batch(pipes, manifest, out, batch_size=3)
    assert (out / "3.png").is_file() and [line["item"] for line in lines(out)] == [*range(COUNT)]


# Shards ---------------------------------------------------------------------------------------------------------------


def test_shards_hold_each_picture_with_its_line(pipes: dict[str, Any], touches: Path, tmp_path: Path) -> None:
    manifest = read_manifest(touches)
    run_batch(pipes, manifest, tmp_path / "files", batch_size=2)
    run_batch(pipes, manifest, tmp_path / "out", batch_size=2, shard_size=4)
    assert sorted(bytes_in(tmp_path / "out")) == ["ledger.jsonl", "run.json", "shard-00000.tar", "shard-00001.tar"]
    with tarfile.open(tmp_path / "out" / "shard-00001.tar") as tar:
        members = {member.name: tar.extractfile(member).read() for member in tar}  # type: ignore[union-attr]
    assert [*members] == [f"{number}.{suffix}" for number in (4, 5, 6) for suffix in ("png", "json")]
    assert json.loads(members["5.json"]) == lines(tmp_path / "out")[5]
    picture = np.asarray(Image.open(io.BytesIO(members["5.png"])), dtype=int)
    alone = np.asarray(Image.open(tmp_path / "files" / "5.png"), dtype=int)
    assert np.abs(picture - alone).max() <= 1  # of 255: they are of other calls


# What goes wrong ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shard_size", [None, 3])
def test_items_that_cannot_be_used_are_noted_and_tried_again(
    pipes: dict[str, Any], touches: Path, tmp_path: Path, shard_size: int | None
) -> None:
    whole = (touches / "1.png").read_bytes()
    (touches / "1.png").write_bytes(whole[:100])
    (touches / "table.csv").write_text("touch,sensor\n0.png,\n1.png,\n2.png,\ngone.png,\n3.png,digit\n4.png,digti\n")
    out, manifest = tmp_path / "out", read_manifest(touches / "table.csv")
    result = run_batch(pipes, manifest, out, shard_size=shard_size)
    assert result is not None and result.made == 3
    assert [*result.failed] == ["1", "gone", "4"]
    for name, word in {"1": "1.png", "gone": "does not exist", "4": "'digti'"}.items():
        assert word in result.failed[name] and "\n" not in result.failed[name]
    assert [line["name"] for line in lines(out) if "error" in line] == ["1", "gone", "4"]

    (touches / "1.png").write_bytes(whole)
    again = run_batch(pipes, manifest, out, shard_size=shard_size)
    assert again is not None and [*again.failed] == ["gone", "4"]
    if shard_size:
        with tarfile.open(out / "shard-00000.tar") as tar:
            assert tar.getnames() == ["0.png", "0.json", "1.png", "1.json", "2.png", "2.json"]


def test_a_sample_that_breaks_fails_alone(pipes: dict[str, Any], touches: Path, tmp_path: Path) -> None:
    (touches / "table.csv").write_text("touch,strength\n0.png,\n1.png,1000000\n2.png,\n")
    broken = make_components()
    pipe = TouchToImagePipeline(**broken, default_num_inference_steps=2, default_guidance_scale=1e6)
    pipe.set_progress_bar_config(disable=True)
    result = run_batch({"touch-to-image": pipe}, read_manifest(touches / "table.csv"), tmp_path / "out")
    assert result is not None and result.failed
    assert {why.split(":")[0] for why in result.failed.values()} <= {"diverged", "non_finite"}


def test_nothing_that_was_there_is_replaced(pipes: dict[str, Any], touches: Path, tmp_path: Path) -> None:
    manifest, out = read_manifest(touches), tmp_path / "out"
    out.mkdir()
    (out / "3.png").write_text("mine")
    with pytest.raises(InvalidInputError, match=r"`output` .* holds another '3.png'"):
        run_batch(pipes, manifest, out)
    assert bytes_in(out) == {"3.png": b"mine"}
    (out / "3.png").unlink()
    run_batch(pipes, manifest, out)
    before = bytes_in(out)
    others: list[tuple[Manifest, dict[str, Any], str]] = [
        (read_manifest(touches, defaults={"seed": 1}), {}, "other items"),
        (manifest, {"shard_size": 2}, "another `shard_size`"),
        (manifest, {"settings": {"model": "other"}}, "another `model`"),
    ]
    for other, options, words in others:
        with pytest.raises(InvalidInputError, match=f"`output` .* holds a run of {words}"):
            run_batch(pipes, other, out, **options)
    assert bytes_in(out) == before


def test_two_runs_do_not_write_to_one_ledger(pipes: dict[str, Any], touches: Path, tmp_path: Path) -> None:
    with (
        appending("output", tmp_path / "out" / "ledger.00000.jsonl"),
        pytest.raises(InvalidInputError, match="which another process writes to"),
    ):
        run_batch(pipes, read_manifest(touches), tmp_path / "out")


def test_a_pipeline_that_is_missing_is_told(pipes: dict[str, Any], touches: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="`pipes` holds no 'touch-to-image'"):
        run_batch({}, read_manifest(touches), tmp_path / "out")
    assert not (tmp_path / "out").exists()
