"""Training in two processes, held to one process with the joint batch."""

import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from unitouch_gen.training.batches import ArrayDataset, shuffled_indices
from unitouch_gen.training.checkpoints import checkpoints_in
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
        contrast = symmetric_info_nce(found, batch["y"], 0.1)
        error = (found - batch["y"]).square().mean()
        return {"loss": contrast + error, "contrast": contrast}


def main(output: Path, resumed: bool) -> None:
    """Trains for six steps, or from the third on; every process leaves its weights, and its noise of the last step."""
    generator = torch.Generator().manual_seed(0)
    data = ArrayDataset(x=torch.randn(32, 5, generator=generator), y=torch.randn(32, 4, generator=generator))
    times = {"steps": 6, "warmup": 1, "save_every": 3, "keep_checkpoints": 2}
    config = TrainerConfig(**times, batch_size=8, learning_rate=0.05, ema_decay=0.5)
    objective = Matching()
    trainer = Trainer(objective, data, partial(shuffled_indices, size=32, batch_size=8), config, output)
    if resumed:
        trainer.resume()
        assert trainer.step == 3
    trainer.fit()
    state = {**objective.trained.state_dict(), "noise": objective.noise}
    save_file(state, output / f"process-{trainer.accelerator.process_index}.safetensors")


def trained(output: Path, count: int, *words: str) -> list[dict[str, Tensor]]:
    """What each of so many processes on the CPU leaves."""
    launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node", str(count)]
    launch += ["-m", "tests.training.test_distributed", str(output), *words]
    env = {**os.environ, "ACCELERATE_USE_CPU": "true"}
    done = subprocess.run(launch, capture_output=True, text=True, check=False, env=env)
    assert done.returncode == 0, done.stderr[-3000:]
    return [load_file(output / f"process-{number}.safetensors") for number in range(count)]


@pytest.mark.slow
def test_two_processes_train_as_one_and_go_on_to_the_same_bits(tmp_path: Path) -> None:
    [one] = trained(tmp_path / "1", 1)
    both = first, second = trained(tmp_path / "2", 2)
    for name in ("weight", "bias"):
        assert torch.equal(first[name], second[name])
        torch.testing.assert_close(first[name], one[name], atol=1e-5, rtol=0)
    assert not torch.isclose(first["noise"], second["noise"]).any()
    (checkpoints_in(tmp_path / "2")[-1] / "progress.json").unlink()  # as if it had not been written
    for found, expected in zip(trained(tmp_path / "2", 2, "resumed"), both, strict=True):
        assert all(torch.equal(found[name], value) for name, value in expected.items())


if __name__ == "__main__":
    main(Path(sys.argv[1]), "resumed" in sys.argv)
