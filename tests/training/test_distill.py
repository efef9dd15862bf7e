"""LCM-LoRA: what the student is held to, how its run goes on, and how its weights are loaded."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from diffusers import DDIMScheduler, DDPMScheduler, LCMScheduler
from diffusers.models.unets.unet_2d_condition import UNet2DConditionOutput
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.testing import assert_close

from tests.helpers.calls import quiet
from tests.helpers.components import make_components, make_pipelines
from tests.helpers.data_sets import write_image
from tests.helpers.small_family import write_small_family
from unitouch_gen import tiny
from unitouch_gen.cli import commands
from unitouch_gen.errors import run_commands
from unitouch_gen.training.distill import DistillObjective, DistillRecipe, DistillSettings, add_layers, ddim_step, main
from unitouch_gen.training.stages import run
from unitouch_gen.training.trainer import checkpoints_in

pytest.importorskip("peft", reason="LoRA needs peft")
SETTINGS = DistillSettings(guidance_spread=0.0, levels=50, solver_steps=1, target_decay=0.5, huber=1e-3)
SCHEDULE = {"beta_schedule": "scaled_linear", "beta_start": 0.00085, "beta_end": 0.012, "clip_sample": False}
LORA = {"r": 2, "target_modules": ["to_q", "to_v", "conv1"]}


class Known(nn.Module):
    """What a perfect network says where the data are zeros: the velocity of the state's own noise."""

    def __init__(self, scheduler: DDPMScheduler):
        super().__init__()
        self.alphas = scheduler.alphas_cumprod

    def forward(self, z: Tensor, t: Tensor, **conditions: Tensor) -> Any:
        abar = self.alphas[t.long()][:, None, None, None]
        return UNet2DConditionOutput(sample=z * (abar / (1 - abar)).sqrt())

    def set_adapter(self, name: str) -> None:
        """It has no layers to choose from."""

    disable_adapters = enable_adapters = lambda self: None


NOTHING = SimpleNamespace(conditions=lambda batch, kept: {})
"""Conditions of a network that takes none."""


def make(unet: Any, kind: str = "v_prediction", **settings: int) -> DistillObjective:
    scheduler = DDPMScheduler(**SCHEDULE, prediction_type=kind)
    asked: Any = (NOTHING, SETTINGS.model_copy(update=settings))
    return DistillObjective(unet, scheduler, *asked, guidance_scale=3.0)


@pytest.mark.parametrize(("levels", "solver_steps"), [(50, 1), (8, 3)])
def test_a_network_that_arrives_where_its_solver_does_has_nothing_to_learn(levels: int, solver_steps: int) -> None:
    objective = make(Known(DDPMScheduler(**SCHEDULE)), levels=levels, solver_steps=solver_steps)
    torch.manual_seed(0)
    batch = {"latents": torch.zeros(1024, 4, 4, 4)}
    assert objective(batch)["loss"] > 1e-4  # beside the data, noise of the lowest level is left as it is
    objective.timesteps = objective.timesteps[1:]
    assert objective(batch)["loss"] < 1e-7


@pytest.mark.parametrize("kind", ["epsilon", "v_prediction", "sample"])
def test_steps_and_what_is_held_to_are_those_of_diffusers(kind: str) -> None:
    unet = make_components()["unet"]
    objective, options = make(unet, kind), {**SCHEDULE, "prediction_type": kind}
    z, states = torch.randn(2, 4, 8, 8), torch.randn(2, 3, 16)
    conditions = {"encoder_hidden_states": states, "class_labels": torch.randn(2, 32)}
    ddim, lcm = DDIMScheduler(**options, set_alpha_to_one=False, timestep_spacing="trailing"), LCMScheduler(**options)
    ddim.set_timesteps(50)
    lcm.set_timesteps(50)
    assert objective.timesteps[1:].flip(0).tolist() == ddim.timesteps.tolist() == lcm.timesteps.tolist()
    with torch.no_grad():
        for place in (1, 20, 50):
            levels = (objective.timesteps[[at, at]] for at in (place, place - 1))
            (t, sigma), (_, sigma_next) = (objective._levels(level, torch.device("cpu")) for level in levels)
            prediction = unet(z, t, **conditions).sample
            step = ddim.step(prediction, t[0].long(), z)
            assert_close(
                ddim_step(step.pred_original_sample, z, sigma, sigma_next), step.prev_sample, atol=1e-4, rtol=0
            )
            lcm._step_index = None
            found = lcm.step(prediction, t[0].long(), z).denoised
            assert_close(objective._consistency(z, t, sigma, conditions), found, atol=1e-4, rtol=1e-4)
            assert not torch.allclose(found, z, atol=0.1)
        t, sigma = objective._levels(torch.zeros(2), torch.device("cpu"))
        assert torch.equal(objective._consistency(z, t, sigma, conditions), z)  # at t = 0


def test_the_teacher_goes_where_guided_ddim_of_diffusers_leads() -> None:
    unet, ddim = make_components()["unet"], DDIMScheduler(**SCHEDULE, prediction_type="epsilon", set_alpha_to_one=False)
    ddim.set_timesteps(50)
    z, scale = torch.randn(2, 4, 8, 8), torch.tensor([2.0, 5.0])[:, None, None, None]
    both = {"encoder_hidden_states": torch.randn(4, 3, 16), "class_labels": torch.randn(4, 32)}
    first, last = torch.full((2,), 499.0), torch.full((2,), 459.0)
    with torch.no_grad():
        found, expected = make(unet, "epsilon", solver_steps=2)._guided_ddim(z, first, last, both, scale), z
        for timestep in (499, 479):
            without, given = unet(torch.cat([expected] * 2), timestep, **both).sample.chunk(2)
            expected = ddim.step(without + scale * (given - without), timestep, expected).prev_sample
    assert_close(found, expected, atol=1e-4, rtol=1e-4)


def test_layers_alone_are_trained_and_the_target_follows_the_student() -> None:
    unet = make_components()["unet"]
    add_layers(unet, LORA)
    objective, latents = make(unet), torch.randn(8, 4, 8, 8)
    conditions = {"encoder_hidden_states": torch.randn(8, 3, 16), "class_labels": torch.randn(8, 32)}
    objective.frozen[0].conditions = lambda batch, kept: conditions
    assert {name.split(".")[-2] for name, one in unet.named_parameters() if one.requires_grad} == {"student"}
    objective({"latents": latents})["loss"].backward()
    parameters = dict(unet.named_parameters())
    learnt = [name for name, one in parameters.items() if one.grad is not None]
    assert learnt and all(".student." in name for name in learnt)
    with torch.no_grad():
        for name in learnt:
            parameters[name].add_(1.0)
    before = {name: parameters[name.replace("student", "target")].clone() for name in learnt}
    objective({"latents": latents})
    for name in learnt:
        assert_close(parameters[name.replace("student", "target")], (before[name] + parameters[name]) / 2)


PIPELINES = {"touch-to-image": "touch", "x-to-touch": "image"}
RECIPE = (
    "data.drawn={sensors: [digit], objects: 1, contacts_per_object: 1}", "trainer.steps=2", "trainer.batch_size=8",
    "trainer.warmup=1", "trainer.save_every=1", "trainer.keep_checkpoints=2", "trainer.learning_rate=0.1",
    "lora.r=2",
)  # fmt: skip


def words_of(teacher: Path, output: Path, cache: Path, *words: str) -> list[str]:
    overrides = [word for setting in RECIPE for word in ("--set", setting)]
    return ["--model", str(teacher), "--output", str(output), "--cache", str(cache), *overrides, *words]


@pytest.mark.parametrize("name", PIPELINES)
def test_a_pipeline_becomes_weights_that_are_loaded_as_anybody_loads_them(
    name: str, cache: Path, tmp_path: Path
) -> None:
    pipe = quiet(make_pipelines()[name])
    pipe.save_pretrained(tmp_path / "teacher")
    run("distill", DistillRecipe, main, words_of(tmp_path / "teacher", tmp_path / "run", cache))
    shutil.copytree(tmp_path / "run", tmp_path / "again")
    (checkpoints_in(tmp_path / "again")[-1] / "progress.json").unlink()
    words = words_of(tmp_path / "teacher", tmp_path / "again", cache, "--resume")
    assert not run_commands(commands, "unitouch-gen", ["distill", *words])
    layers, again = (
        load_file(tmp_path / run / "model" / "pytorch_lora_weights.safetensors") for run in ("run", "again")
    )
    assert layers.keys() == again.keys() and all(torch.equal(again[key], value) for key, value in layers.items())
    assert {value.dtype for value in layers.values()} == {torch.float16}
    assert any(bool(value.abs().max() > 0) for key, value in layers.items() if "lora_B" in key or ".up." in key)
    assert json.loads((tmp_path / "run" / "record.json").read_text())["stage"] == "distill"

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


def test_a_folder_that_is_no_pipeline_and_layers_that_do_not_fit_end_with_a_line(
    cache: Path, tmp_path: Path, capsys: Any
) -> None:
    (tmp_path / "empty").mkdir()
    write_small_family(tmp_path / "family")
    quiet(tiny("x-to-touch", family=tmp_path / "family")).save_pretrained(tmp_path / "gels")
    for file in ("mine/touch/0.png", "mine/picture/0.png", "mine/touch/1.png", "mine/picture/1.png"):
        write_image(tmp_path / file, (200, 100, len(file)))
    mine = f"{{path: {tmp_path / 'mine'}, sensor: digit}}"
    make_pipelines()["touch-to-image"].save_pretrained(tmp_path / "teacher")
    other = shutil.copytree(tmp_path / "teacher", tmp_path / "other")
    (other / "model_index.json").write_text('{"_class_name": "StableDiffusionPipeline"}')
    broken = shutil.copytree(tmp_path / "teacher", tmp_path / "broken")
    shutil.rmtree(broken / "unet")
    for folder, words, message in (
        ("gone", "", "'--model'"),
        ("empty", "", "`model` names "),
        ("other", "", "is 'StableDiffusionPipeline'; it has to be one of"),
        ("broken", "", "`model` is "),
        ("teacher", "--set lora.target_modules=[to_p]", "`lora` does not fit the network"),
        ("teacher", "--set lora.rank=3", "In `lora`, `rank` is unknown"),
        ("gels", f"--set data.sets=[{mine}]", "`data.sets` have no untouched gels"),
    ):
        given = words_of(tmp_path / folder, tmp_path / "run", cache, *words.split(maxsplit=1))
        with pytest.raises(SystemExit, match="2"):
            run("distill", DistillRecipe, main, given)
        (line,) = capsys.readouterr().err.strip().splitlines()[-1:]
        assert message in line and not (tmp_path / "run").exists()
