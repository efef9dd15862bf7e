"""Distillation: what the student is held to, how its run goes on, and how its weights are loaded."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from diffusers import DDPMScheduler, LCMScheduler
from diffusers.models.unets.unet_2d_condition import UNet2DConditionOutput
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.testing import assert_close

from tests.helpers.calls import quiet
from tests.helpers.components import make_components, make_pipelines
from tests.helpers.small_family import write_small_family
from unitouch_gen import tiny
from unitouch_gen.cli import commands
from unitouch_gen.commands import run_commands
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.training.checkpoints import checkpoints_in
from unitouch_gen.training.commands import app
from unitouch_gen.training.distill import DistillObjective, DistillSettings, add_layers, teacher_objective
from unitouch_gen.training.recipe import read_recipe

pytest.importorskip("peft", reason="LoRA needs peft")
SETTINGS = DistillSettings(timesteps=[999, 619, 299, 79], margin=0.02, critic_rank=2)
SCHEDULE = {"beta_schedule": "scaled_linear", "beta_start": 0.00085, "beta_end": 0.012, "clip_sample": False}
LORA = {"r": 2, "target_modules": ["to_q", "to_v", "conv1"]}


class Gaussians(nn.Module):
    """What perfect networks say where the data are normal, of deviation 1 around a mean for each set of layers."""

    def __init__(self, scheduler: DDPMScheduler, **means: float):
        super().__init__()
        self.alphas, self.means, self.layers = scheduler.alphas_cumprod, means, "student"

    def forward(self, z: Tensor, t: Tensor) -> Any:
        a = self.alphas[t.long()][:, None, None, None].sqrt()
        return UNet2DConditionOutput(sample=(1 - a * a) * self.means[self.layers] + a * z)

    def set_adapter(self, name: str) -> None:
        self.layers = name

    def disable_adapters(self) -> None:
        self.layers = "teacher"

    def enable_adapters(self) -> None:
        """What follows takes layers by name."""


def make(unet: Any, kind: str = "v_prediction") -> DistillObjective:
    scheduler = DDPMScheduler(**SCHEDULE, prediction_type=kind)
    conditioned: Any = SimpleNamespace(conditions=lambda batch, kept: {})  # of a network that takes none
    return DistillObjective(unet, scheduler, conditioned, SETTINGS, guidance_scale=3.0)


@pytest.mark.parametrize("mean", [-2.0, 0.0, 2.0])
def test_distillation_moves_latents_from_the_critics_prediction_to_the_teachers(mean: float) -> None:
    objective = make(Gaussians(DDPMScheduler(**SCHEDULE), teacher=mean, critic=0.0), "sample")
    drawn = torch.randn(64, 1, 8, 8)
    moved = objective.moved(drawn, {}, {}) - drawn
    # Both expect the data at a mean of the state and their own: Their difference is constant, of the means' sign.
    assert_close(moved, moved[:, :, :1, :1].expand_as(moved), atol=1e-5, rtol=0)
    assert bool((moved.sign() == mean).all()) if mean == 0.0 else bool((moved * mean > 0.0).all())
    # Its size is its own over how far what is drawn is from what the teacher expects: 2 over about 2 where noise hides
    # the data, and nothing where it does not.
    assert 0.3 * abs(mean) / 2 < moved.abs().mean() < 2.0 * abs(mean) / 2 or mean == 0.0


@pytest.mark.parametrize("kind", ["epsilon", "v_prediction", "sample"])
def test_the_student_draws_as_the_scheduler_of_diffusers_does(kind: str) -> None:
    unet = make_components()["unet"]
    add_layers(unet, LORA, 3)
    objective = make(unet, kind)
    lcm = LCMScheduler(**{**SCHEDULE, "prediction_type": kind})
    noise = torch.randn(2, 4, 8, 8)
    conditions = {"encoder_hidden_states": torch.randn(2, 3, 16), "class_labels": torch.randn(2, 32)}
    seen = set()
    for seed in range(8):
        torch.manual_seed(seed)
        found = objective.drawn(noise, conditions)
        torch.manual_seed(seed)
        last = int(torch.randint(4, ()))
        z = noise
        lcm.set_timesteps(timesteps=objective.timesteps)
        with torch.no_grad():
            for t in lcm.timesteps[: last + 1]:
                z, denoised = lcm.step(unet(z, t, **conditions).sample, t, z, return_dict=False)
        assert_close(found, denoised, atol=1e-4, rtol=1e-4)
        assert found.requires_grad
        seen.add(last)
    assert len(seen) > 2


def test_layers_alone_are_trained_each_set_by_its_own_loss() -> None:
    unet = make_components()["unet"]
    add_layers(unet, LORA, 3)
    objective = make(unet)
    latents = torch.randn(8, 4, 8, 8)
    conditions = {"encoder_hidden_states": torch.randn(8, 3, 16), "class_labels": torch.randn(8, 32)}
    nothing = {name: torch.zeros_like(values) for name, values in conditions.items()}
    objective.frozen[0].conditions = lambda batch, kept: conditions if kept.all() else nothing
    parameters = {name: one for name, one in unet.named_parameters() if one.requires_grad}
    assert {name.split(".")[-2] for name in parameters} == {"student", "critic"}
    losses = objective({"latents": latents})
    assert all(one.requires_grad for one in parameters.values())
    losses["loss"].backward()
    learnt = {name.split(".")[-2] for name, one in parameters.items() if one.grad is not None and one.grad.any()}
    assert learnt == {"student", "critic"}
    assert not any(one.grad is not None for name, one in unet.named_parameters() if "lora_" not in name)
    with torch.no_grad():  # other layers of the critic: what the student is drawn by stays
        for name, one in parameters.items():
            one.add_(0.5 * ("critic" in name))
    states = []
    for _ in range(2):
        torch.manual_seed(0)
        states.append(objective.drawn(latents, conditions))
        with torch.no_grad():
            for name, one in parameters.items():
                one.add_("critic" in name)
    assert torch.equal(*states)


PIPELINES = {"touch-to-image": "touch", "x-to-touch": "image"}
RECIPE = (
    "data.drawn={sensors: [digit], objects: 1, contacts_per_object: 1}",
    "trainer.steps=2",
    "trainer.batch_size=8",
    "trainer.warmup=1",
    "trainer.save_every=1",
    "trainer.keep_checkpoints=2",
    "trainer.learning_rate=0.1",
    "lora.r=2",
    "objective.critic_rank=2",
)


def words_of(teacher: Path, output: Path, cache: Path, *words: str) -> list[str]:
    overrides = [word for setting in RECIPE for word in ("--set", setting)]
    return ["--model", str(teacher), "--output", str(output), "--cache", str(cache), *overrides, *words]


def run(words: list[str]) -> None:
    run_commands(app, "unitouch_gen.training", ["distill", *words])


STORED = "model/pytorch_lora_weights.safetensors"


@pytest.mark.slow
def test_a_distillation_is_resumed_to_the_same_bits_and_begun_from_its_own_weights(cache: Path, tmp_path: Path) -> None:
    make_pipelines()["touch-to-image"].save_pretrained(tmp_path / "teacher")
    run(words_of(tmp_path / "teacher", tmp_path / "run", cache))
    shutil.copytree(tmp_path / "run", tmp_path / "again")
    (checkpoints_in(tmp_path / "again")[-1] / "progress.json").unlink()
    words = words_of(tmp_path / "teacher", tmp_path / "again", cache, "--resume")
    assert not run_commands(commands, "unitouch-gen", ["distill", *words])
    further = ["--init", str(tmp_path / "run" / "model"), "--set", "trainer.learning_rate=1e-9"]
    run(words_of(tmp_path / "teacher", tmp_path / "further", cache, *further))
    layers, again, still = (load_file(tmp_path / run / STORED) for run in ("run", "again", "further"))
    assert layers.keys() == again.keys()
    assert all(torch.equal(again[key], value) for key, value in layers.items())
    assert_close(still, layers, atol=1e-6, rtol=1e-3)
    assert json.loads((tmp_path / "further" / "record.json").read_text())["started_from"]["stage"] == "distill"
    wide = words_of(tmp_path / "teacher", tmp_path / "wide", cache, *further, "--set", "lora.r=3")
    with pytest.raises(SystemExit, match="2"):
        run(wide)


@pytest.mark.parametrize("name", PIPELINES)
def test_a_pipeline_becomes_weights_that_are_loaded_as_anybody_loads_them(
    name: str, cache: Path, tmp_path: Path
) -> None:
    pipe = quiet(make_pipelines()[name])
    pipe.save_pretrained(tmp_path / "teacher")
    run(words_of(tmp_path / "teacher", tmp_path / "run", cache))
    layers = load_file(tmp_path / "run" / STORED)
    assert {value.dtype for value in layers.values()} == {torch.float16}
    assert any(bool(value.abs().max() > 0) for key, value in layers.items() if "lora_B" in key or ".up." in key)

    pipe.scheduler = LCMScheduler.from_config(pipe.scheduler.config)
    shape = (1, pipe.unet.config.out_channels, 8, 8)
    noise = {"latents": torch.randn(shape), "num_inference_steps": 4, "guidance_scale": 1.0, "output_type": "latent"}
    given = {PIPELINES[name]: torch.rand(1, 3, 32, 32)}

    def draw() -> Tensor:
        return pipe(**given, **noise, generator=torch.Generator().manual_seed(0)).images

    plain = draw()
    pipe.load_lora_weights(tmp_path / "run" / "model")
    assert not torch.allclose(draw(), plain, atol=1e-3)
    if name == "touch-to-image":
        known = quiet(pipe.to_diffusers())
        known.unet, known.scheduler = make_pipelines()[name].unet, LCMScheduler.from_config(pipe.scheduler.config)
        known.load_lora_weights(tmp_path / "run" / "model")
        embeds = {"image_embeds": torch.randn(1, 16), "prompt": "high quality"}
        ours = {"touch_embeds": embeds["image_embeds"], "prompt": "high quality"}
        pictures = [
            one(**call, **noise, generator=torch.Generator().manual_seed(0)).images
            for one, call in ((known, embeds), (pipe, ours))
        ]
        assert_close(*pictures, atol=1e-5, rtol=1e-4)


def test_conditions_are_drawn_as_in_the_teachers_own_training(tmp_path: Path) -> None:
    """By the record of its family, which is saved with a pipeline also after it was read again."""
    family = tmp_path / "family"
    write_small_family(family)
    objective = {**read_recipe("touch_ldm")["objective"], "condition_noise": 0.9}
    record = {"stage": "touch_ldm", "recipe": {"objective": objective}}
    (family / "family.json").write_text(json.dumps({"training": {"touch_ldm": record}}))
    pipe = quiet(tiny("x-to-touch", family=family))
    pipe.save_pretrained(tmp_path / "saved")
    quiet(type(pipe).from_pretrained(tmp_path / "saved")).save_pretrained(tmp_path / "again")
    assert teacher_objective(tmp_path / "again", "touch_ldm") == objective
    with pytest.raises(InvalidInputError, match=r"`model: record\.json: stage` is 'touch_ldm'"):
        teacher_objective(tmp_path / "again", "unclip")
    (tmp_path / "again" / "record.json").unlink()
    assert teacher_objective(tmp_path / "again", "touch_ldm") == read_recipe("touch_ldm")["objective"]
