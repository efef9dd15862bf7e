"""Processes that are killed at random moments, some of them just before a change to files: what is there is whole, and
whoever comes next goes on as if nothing had been.
"""

import random
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from PIL import Image

from tests.helpers.processes import Child, command, finished, ranked, save_numbered, short_stage, stage
from tests.soak.conftest import TOUCHES
from unitouch_gen.pipelines import TouchToImagePipeline
from unitouch_gen.training.trainer import checkpoints_in

pytestmark = pytest.mark.slow

KILLED = -9
STAGE = short_stage(400)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def seen(folder: Path) -> dict[str, bytes]:
    """What is not hidden."""
    return {name: data for name, data in contents(folder).items() if not name.startswith(".")}


class Killer:
    """Starts processes and kills them, in turns after a random time and just before a random change to files.

    Args:
        start: Starts one; takes `killed_at`.
        seed: Of what is random.
        seconds, changes: That it lives at most, the seconds from when it is under way.
        state: What is another thing when a process is under way; at once if left out.
    """

    def __init__(
        self,
        start: Callable[..., Child],
        seed: int,
        seconds: float,
        changes: int,
        state: Callable[[], object] = object,
    ):
        self.start, self.random, self.seconds, self.changes = start, random.Random(seed), seconds, changes
        self.state, self.kills, self.ended = state, 0, 0

    def __call__(self) -> None:
        if (self.kills + self.ended) % 2:
            before = self.state()
            child = self.start()
            while child.process.is_alive() and self.state() == before:
                time.sleep(0.01)
            time.sleep(self.random.uniform(0.0, self.seconds))  # any moment will do
            child.kill()
        else:
            child = self.start(killed_at=self.random.randint(1, self.changes))
        code = child.wait()
        assert code in (KILLED, 0), child.err
        self.kills, self.ended = self.kills + (code == KILLED), self.ended + (code == 0)


def test_pictures_are_whole_after_kills(
    given: Path, pictures: list[str], tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    out, whole = tmp_path / "out", dict[int, dict[str, bytes]]()

    def start(folder: Path, seed: int, **options: int) -> Child:
        return Child(command, *pictures, "-o", str(folder), "--seed", str(seed), folder=given, **options)

    for seed in (0, 1):
        begun = time.monotonic()
        child = finished(start(tmp_path / str(seed), seed))
        seconds, whole[seed] = time.monotonic() - begun, contents(tmp_path / str(seed))
    assert len(whole[0]) == TOUCHES and not set(whole[0].values()) & set(whole[1].values())

    killer = Killer(lambda **options: start(out, killer.kills % 2, **options), 1, seconds, child.changes)
    while killer.kills < 30:
        killer()
        for name, data in seen(out).items():
            assert data in (whole[0][name], whole[1][name])
            Image.open(out / name).load()
    finished(start(out, 0))
    assert contents(out) == whole[0] and len(list(out.iterdir())) == TOUCHES
    record_property("kills", killer.kills)
    record_property("runs that came to their end", killer.ended)


def test_training_goes_on_to_the_same_bits_after_kills(
    tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    def start(folder: Path, **options: int) -> Child:
        folder.mkdir(exist_ok=True)
        going_on = checkpoints_in(folder / "runs" / STAGE[0])
        return Child(stage, *STAGE, *(["--resume"] if going_on else []), folder=folder, **options)

    def checkpoint() -> object:
        return checkpoints_in(tmp_path / "killed" / "runs" / STAGE[0])[-1:] or object()  # first the cache is rendered

    whole = finished(start(tmp_path / "whole"))
    killer = Killer(lambda **options: start(tmp_path / "killed", **options), 2, 0.5, whole.changes // 40, checkpoint)
    while killer.kills < 50:
        killer()
    assert killer.ended == 0  # or it was not killed often enough to say something
    finished(start(tmp_path / "killed"))
    expected, found = contents(tmp_path / "whole"), contents(tmp_path / "killed")
    weights, log = f"runs/{STAGE[0]}/model/model.safetensors", f"runs/{STAGE[0]}/log/"  # each sitting logs for itself
    assert found[weights] == expected[weights]
    assert {name for name in found if log not in name} == {name for name in expected if log not in name}
    record_property("kills", killer.kills)


def test_a_pipeline_is_the_old_or_the_new_one_after_kills(
    tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    def start(folder: Path, number: int, **options: int) -> Child:
        return Child(save_numbered, str(folder), number, folder=tmp_path, **options)

    whole = {}
    for number in (1, 2):
        begun = time.monotonic()
        alone = tmp_path / str(number) / "there"  # the card that is saved names the folder
        child = finished(start(alone, number))
        seconds, whole[number] = time.monotonic() - begun, contents(alone)
    folder, found = tmp_path / "there", []
    finished(start(folder, 1))
    killer = Killer(lambda **options: start(folder, 1 + killer.kills % 2, **options), 3, seconds, child.changes)
    while killer.kills < 40:
        killer()
        pipe = TouchToImagePipeline.from_pretrained(folder)
        assert seen(folder) in (whole[1], whole[2])
        found.append(pipe.config["default_num_inference_steps"])
    assert {*found} == {1, 2}
    finished(start(folder, 1))
    assert contents(folder) == whole[1]
    record_property("kills", killer.kills)
    record_property("times the first of two pipelines was there", found.count(1))


@pytest.mark.parametrize("shards", [[], ["--shard-size", "6"]], ids=["pictures", "shards"])
def test_a_batch_is_the_same_after_kills_in_two_processes(
    given: Path, tmp_path: Path, record_property: Callable[[str, object], None], shards: list[str]
) -> None:
    """Each of the two is killed half of the times; its items are made once, by whoever comes next."""
    rows = [f"touches/{seed % TOUCHES}.png,{seed},{2 + seed % 2}" for seed in range(24)]
    (given / "table.csv").write_text("\n".join(["touch,seed,steps", *rows, "gone.png,0,2", "model,0,2"]))
    words = ["batch", str(given / "table.csv"), "--batch-size", "2", "--model", str(given / "model"), *shards]

    def start(folder: Path, number: int = 0, count: int = 1, **options: int) -> Child:
        return Child(ranked, number, count, *words, "-o", str(folder), folder=given, **options)

    begun = time.monotonic()
    whole = start(tmp_path / "whole")
    assert whole.wait() == 1 and "gone failed" in whole.err
    seconds, drawn, kills, ended = time.monotonic() - begun, random.Random(4), 0, 0
    while kills < 30:
        number = drawn.randrange(2)
        if drawn.random() < 0.5:
            child = start(tmp_path / "killed", number, 2)
            time.sleep(drawn.uniform(0.0, seconds))
            child.kill()
        else:
            child = start(tmp_path / "killed", number, 2, killed_at=drawn.randint(1, whole.changes // 4))
        code = child.wait()
        assert code in (KILLED, 0, 1), child.err
        kills, ended = kills + (code == KILLED), ended + (code != KILLED)
        if (tmp_path / "killed" / "ledger.jsonl").exists():  # it has come to its end
            assert contents(tmp_path / "killed") == contents(tmp_path / "whole")
            shutil.rmtree(tmp_path / "killed")
    for number in range(2):
        last = start(tmp_path / "killed", number, 2)
        assert last.wait() in (0, 1), last.err
    assert contents(tmp_path / "killed") == contents(tmp_path / "whole")
    record_property("kills", kills)
    record_property("processes that came to their end", ended)
