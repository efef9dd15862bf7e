"""What is seen of held-out data while networks train, held to closed forms; and that training is the same without."""

import json
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers import DDPMScheduler
from diffusers.models.unets.unet_2d_condition import UNet2DConditionOutput
from PIL import Image
from safetensors.torch import load_file
from torch import Tensor, nn

from tests.training.conftest import AUDIO
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.training import image_text
from unitouch_gen.training.data.records import Record, RecordSet
from unitouch_gen.training.stages import run
from unitouch_gen.training.watching import denoised, grid, retrieval

SHORT = (
    "data.drawn={sensors: [gelsight, digit], objects: 1, contacts_per_object: 1, held_out: 1}", "trainer.steps=4",
    "trainer.batch_size=8", "trainer.trackers=[]", "trainer.warmup=1", "trainer.ema_decay=0.5",
    "trainer.learning_rate=0.01",
)  # fmt: skip
SMALL = ("model.block_out_channels=[16, 16, 16]", "model.attention_head_dim=1", "model.cross_attention_dim=16")
ALONE = ("data.image_size=32", f"data.audio={json.dumps(AUDIO)}")
"""What the other stages take from the joint space."""

STAGES: dict[str, tuple[str, ...]] = {
    "audio": (),
    "touch": (),
    "touch_vae": ALONE,
    "touch_ldm": SMALL,
    "unclip": (*SMALL, "model.projection_class_embeddings_input_dim=32"),
    "image_text": (*ALONE, "model.vision_config.image_size=32"),
}


@pytest.mark.parametrize(
    "name", [name if name in ("touch", "unclip") else pytest.param(name, marks=pytest.mark.slow) for name in STAGES]
)
def test_training_is_the_same_whether_it_is_watched_or_not(
    name: str, tmp_path: Path, joint: str, vae: str, cache: Path
) -> None:
    takes = {"audio": ("joint",), "touch": ("joint",), "touch_ldm": ("joint", "vae"), "unclip": ("joint", "vae")}
    given = [word for option in takes.get(name, ()) for word in (f"--{option}", {"joint": joint, "vae": vae}[option])]
    for every in (0, 2):
        settings = (*SHORT, *STAGES[name], f"trainer.watch_every={every}")
        words = [*given, "--output", str(tmp_path / str(every)), "--cache", str(cache)]
        main = import_module(f"unitouch_gen.training.{name}").main
        run(name, main, [*words, *(word for setting in settings for word in ("--set", setting))])
    left = {file.relative_to(tmp_path / "0") for file in (tmp_path / "0" / "model").rglob("*.safetensors")}
    for file in left:
        plain, watched = (load_file(tmp_path / every / file) for every in ("0", "2"))
        assert all(torch.equal(watched[key], value) for key, value in plain.items())
    seen = sorted(file.name[-12:] for file in (tmp_path / "2" / "watched").glob("*.png"))
    lines = (tmp_path / "2" / "log.jsonl").read_text()
    assert left and not (tmp_path / "0" / "watched").exists()
    assert seen == ["00000002.png", "00000004.png"] or lines.count("retrieval_top1") == 2


def test_image_and_text_go_on_from_a_joint_space_and_leave_behind_what_was_measured_of_it(
    tmp_path: Path, joint: str, cache: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = Path(joint) / "config.json"
    config.write_text(json.dumps({**json.loads(config.read_text()), "temperatures": {"image": 0.2}}))
    settings = (*SHORT, *STAGES["image_text"], "objective.kept=1.0", "objective.attributes=0.0", "data.grasps=[digit]")
    words = ["--output", str(tmp_path / "out"), "--cache", str(cache)]
    words += [word for setting in settings for word in ("--set", setting)]
    run("image_text", image_text.main, [*words, "--init", joint])
    made, began = (UniTouchModel.from_pretrained(folder) for folder in (tmp_path / "out" / "model", joint))
    assert began.config.temperatures == {"image": 0.2} and made.config.temperatures == {}
    words_of = [UniTouchProcessor.from_pretrained(one).tokenizer.get_vocab() for one in (joint, tmp_path / "out/model")]
    assert words_of[0] == words_of[1]
    before, after = (model.load("text")[0].state_dict() for model in (began, made))
    assert any(not torch.equal(before[key], value) for key, value in after.items())
    record = json.loads((tmp_path / "out" / "record.json").read_text())
    assert [one["name"] for one in record["sets"]][-1] == "grasps-digit"
    with pytest.raises(SystemExit, match="2"):
        run("image_text", image_text.main, [*words, "--resume"])
    assert "of a run that started from weights; pass the same `--init` again" in capsys.readouterr().err


def test_retrieval_counts_own_keys_among_the_nearest() -> None:
    found = retrieval(torch.eye(10), torch.eye(10))
    assert found == {
        "retrieval_top1": 1.0,
        "chance_top1": pytest.approx(0.1),
        "retrieval_top5": 1.0,
        "chance_top5": 0.5,
    }
    angles = torch.arange(10) * 0.1
    circle = torch.stack([angles.cos(), angles.sin()], dim=1)
    assert retrieval(circle, circle.roll(-1, 0))["retrieval_top1"] == 0.0  # own keys are the next ones' twins
    assert retrieval(circle, circle.roll(-1, 0))["retrieval_top5"] == pytest.approx(0.9)  # the last one's is the first


def test_retrieval_of_embeddings_that_say_nothing_is_by_chance() -> None:
    torch.manual_seed(0)
    runs = [retrieval(torch.randn(20, 8), torch.randn(20, 8)) for _ in range(200)]
    for k in (1, 5):
        mean = np.mean([found[f"retrieval_top{k}"] for found in runs])
        assert mean == pytest.approx(runs[0][f"chance_top{k}"], abs=0.02)
    same = retrieval(torch.ones(20, 8), torch.ones(20, 8))
    assert same["retrieval_top1"] == pytest.approx(same["chance_top1"])


class Knows(nn.Module):
    """A network that knows what the noisy latents were."""

    def __init__(self, clean: Tensor, scheduler: DDPMScheduler):
        super().__init__()
        self.clean, self.scheduler = nn.Parameter(clean), scheduler

    def forward(self, noisy: Tensor, step: Tensor) -> UNet2DConditionOutput:
        level = self.scheduler.alphas_cumprod[step]
        noise = (noisy - level.sqrt() * self.clean) / (1 - level).sqrt()
        if self.scheduler.config.prediction_type == "epsilon":
            return UNet2DConditionOutput(sample=noise)
        return UNet2DConditionOutput(sample=level.sqrt() * noise - (1 - level).sqrt() * self.clean)


@pytest.mark.parametrize("kind", ["epsilon", "v_prediction"])
def test_a_network_that_knows_the_clean_latents_draws_them(kind: str) -> None:
    scheduler = DDPMScheduler(prediction_type=kind, clip_sample=False)
    clean = torch.randn(3, 4, 8, 8, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(denoised(Knows(clean, scheduler), scheduler, clean.shape), clean, atol=0.02, rtol=0.0)


def test_a_grid_has_a_row_for_each_sample_and_a_column_for_each_image_of_it() -> None:
    colours = torch.tensor([0.0, 0.5, 1.0])
    small, large = (colours[:, None, None, None].expand(3, 3, size, size) for size in (8, 16))
    picture = grid(small, 1.0 - large)
    assert picture.size == (2 * 18, 3 * 18) and isinstance(picture, Image.Image)
    shown = np.asarray(picture)[9::18, 9::18, 0]
    np.testing.assert_allclose(shown, [[0, 255], [128, 128], [255, 0]])


def test_at_most_as_many_records_as_asked_for_are_spread_over_all() -> None:
    data = RecordSet("a", "folder", tuple(Record(str(number), touch=None) for number in range(10)))  # type: ignore[arg-type]
    assert [record.id for record in data.thinned(4).records] == ["0", "3", "6", "9"]
    assert len(data.thinned(10)) == len(data.thinned(99)) == 10
