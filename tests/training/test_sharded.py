"""Weights that FSDP shards over two processes, held to those of one process that keeps them whole.

accelerate shards on GPUs alone, though torch does so on a CPU, too; so accelerate is told here that there are GPUs.
"""

import faulthandler
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch.distributed.tensor import DTensor

pytestmark = pytest.mark.slow


def main(folder: Path, sharded: bool, resume: bool) -> None:
    """Trains for ten steps, or goes on to the last one; leaves the weights, and those that were watched."""
    from accelerate import DistributedType, PartialState

    from tests.training.test_trainer import ROWS, Regression, changed, data
    from unitouch_gen.training.batches import ShuffledSampler
    from unitouch_gen.training.trainer import Trainer

    if sharded:
        PartialState(cpu=True)
        PartialState._shared_state["distributed_type"] = DistributedType.MULTI_GPU
        os.environ |= {"ACCELERATE_USE_FSDP": "true", "FSDP_VERSION": "2", "FSDP_RESHARD_AFTER_FORWARD": "true"}
    seen: list[torch.Tensor] = []
    config = changed(ema_decay=0.9, watch_every=10, grad_clip=0.1)
    objective, sampler = Regression(noise=0.1), ShuffledSampler(ROWS, config.batch_size, config.seed)
    is_main = PartialState().is_main_process
    watch = (lambda: seen.extend(objective.weights()) or {}) if is_main else None
    trainer = Trainer(objective, data(), sampler, config, folder / "run", watch=watch)
    assert all(isinstance(weight, DTensor) == sharded for weight in trainer.trained.parameters())
    if resume:
        trainer.resume()
    else:
        trainer.steps = 10
    trainer.fit()
    if is_main:
        named = {f"seen{place}": tensor for place, tensor in enumerate(seen)}
        save_file({**objective.trained.state_dict(), **named}, folder / f"weights-{resume}.safetensors")


def start(folder: Path, count: int, resume: bool) -> dict[str, torch.Tensor]:
    """Runs it in so many processes."""
    folder.mkdir(exist_ok=True)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port, runs = str(free.getsockname()[1]), []
    for rank in range(count):
        world = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": count, "LOCAL_WORLD_SIZE": count}
        places = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "ACCELERATE_USE_CPU": "true"}
        env = {**os.environ, **places, **({name: str(value) for name, value in world.items()} if count > 1 else {})}
        command = [sys.executable, "-m", "tests.training.test_sharded", str(folder), str(count > 1), str(resume)]
        runs.append(subprocess.Popen(command, env=env, stderr=subprocess.PIPE, text=True))
    for process in runs:
        _, error = process.communicate(timeout=120)
        assert process.returncode == 0, error[-3000:]
    return load_file(folder / f"weights-{resume}.safetensors")


def test_sharded_weights_are_averaged_watched_saved_and_gone_on_with_as_whole_ones(tmp_path: Path) -> None:
    for resume in (False, True):
        whole, sharded = (start(tmp_path / str(count), count, resume) for count in (1, 2))
        assert whole.keys() == sharded.keys() and len(whole) == 4
        for name, tensor in whole.items():
            torch.testing.assert_close(sharded[name], tensor, atol=1e-5, rtol=0.0)


if __name__ == "__main__":
    faulthandler.dump_traceback_later(90, exit=True)
    main(Path(sys.argv[1]), *(word == "True" for word in sys.argv[2:]))
