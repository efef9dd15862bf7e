"""Training in two processes, held to one process with the joint batch."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.training.batches import ArrayDataset, ShuffledSampler
from unitouch_gen.training.distributed import rows_of
from unitouch_gen.training.losses import symmetric_info_nce
from unitouch_gen.training.trainer import Trainer, TrainerConfig


class Matching(nn.Module):
    """InfoNCE and squared error of a linear map and its targets, with noise of no weight that is kept."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.trained, self.noise = nn.Linear(5, 4), Tensor()

    def forward(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        self.noise = torch.randn(len(batch["x"]))
        found = self.trained(batch["x"])
        contrast, error = symmetric_info_nce(found, batch["y"], 0.1), (found - batch["y"]).square().mean()
        return {"loss": contrast + error, "contrast": contrast}


def main(output: Path, accumulation: int) -> None:
    """Trains for some steps; every process leaves its weights, and its noise of the last step."""
    generator = torch.Generator().manual_seed(0)
    data = ArrayDataset(x=torch.randn(32, 5, generator=generator), y=torch.randn(32, 4, generator=generator))
    config = TrainerConfig(
        steps=6, batch_size=8, accumulation=accumulation, learning_rate=0.05, warmup=1, ema_decay=0.5, trackers=[]
    )
    objective = Matching()
    trainer = Trainer(objective, data, ShuffledSampler(32, 8), config, output, quiet=True)
    trainer.fit()
    state = {**objective.trained.state_dict(), "noise": objective.noise}
    save_file(state, output / f"process-{trainer.accelerator.process_index}.safetensors")


def trained(output: Path, count: int, accumulation: int) -> list[dict[str, Tensor]]:
    """What each of so many processes on the CPU leaves."""
    launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node", str(count)]
    words = ["-m", "tests.training.test_distributed", str(output), str(accumulation)]
    env = {**os.environ, "ACCELERATE_USE_CPU": "true"}
    done = subprocess.run([*launch, *words], capture_output=True, text=True, check=False, env=env)
    assert done.returncode == 0, done.stderr[-3000:]
    return [load_file(output / f"process-{number}.safetensors") for number in range(count)]


@pytest.mark.slow
@pytest.mark.parametrize("accumulation", [1, 2])
def test_two_processes_train_as_one(tmp_path: Path, accumulation: int) -> None:
    [one] = trained(tmp_path / "1", 1, accumulation)
    first, second = trained(tmp_path / "2", 2, accumulation)
    for name in ("weight", "bias"):
        assert torch.equal(first[name], second[name])
        torch.testing.assert_close(first[name], one[name], atol=1e-5, rtol=0)
    assert not torch.isclose(first["noise"], second["noise"]).any()


def test_a_batch_that_cannot_be_shared_evenly_is_refused() -> None:
    assert [rows_of(8, process, 4) for process in range(4)] == [slice(0, 2), slice(2, 4), slice(4, 6), slice(6, 8)]
    with pytest.raises(InvalidInputError, match="`batch_size` is 8, which 3 processes cannot share evenly"):
        rows_of(8, 0, 3)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
