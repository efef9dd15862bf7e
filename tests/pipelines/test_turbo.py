"""The built-in pipelines in four evaluations: LoRA weights under diffusers' `LCMScheduler`."""

from pathlib import Path
from typing import Any

import pytest
import torch
from diffusers import LCMScheduler
from torch.testing import assert_close

import unitouch_gen
from tests.helpers.calls import quiet, seeded
from tests.helpers.small_family import write_small_family
from unitouch_gen.pipelines.tiny import TURBO

peft = pytest.importorskip("peft", reason="LoRA needs peft")
INPUTS = {"touch-to-image": "touch", "x-to-touch": "image"}
FINE = {"atol": 1e-4, "rtol": 1e-3}


@pytest.fixture(scope="module")
def family(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("family")
    torch.manual_seed(0)
    write_small_family(folder)
    for name in TURBO.values():
        pipe: Any = unitouch_gen.tiny(name, family=folder)
        pipe.unet.add_adapter(peft.LoraConfig(r=2, target_modules=["to_q", "conv1"], init_lora_weights=False))
        layers = peft.get_peft_model_state_dict(pipe.unet, adapter_name="default")
        pipe.save_lora_weights(folder / name / "turbo", unet_lora_layers=layers)
    return folder


@pytest.fixture(params=TURBO)
def name(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def turbo(name: str, family: Path) -> Any:
    return quiet(unitouch_gen.tiny(name, family=family))


def draw(pipe: Any, name: str, count: int = 1, **options: Any) -> Any:
    pixels = torch.rand(2, 3, 128, 128, generator=seeded())[:count]
    given = {INPUTS[TURBO[name]]: pixels, "sensor": "digit", "generator": seeded(), "output_type": "latent"}
    return pipe(**{**given, **options})


def test_it_draws_in_four_evaluations_of_one_branch_unless_told_otherwise(turbo: Any, name: str) -> None:
    output = draw(turbo, name)
    assert (output.report.evaluations, output.report.guided) == (4, 0)
    assert "unconditional branch" in output.report.left_out
    for steps in (2, 8):
        assert draw(turbo, name, num_inference_steps=steps).report.evaluations == steps
    assert draw(turbo, name, guidance_scale=2.0).report.guided == 4


def test_it_is_the_other_pipeline_with_weights_that_anybody_can_load(turbo: Any, name: str, family: Path) -> None:
    pipe = quiet(unitouch_gen.tiny(TURBO[name], family=family))
    pipe.scheduler = LCMScheduler.from_config(pipe.scheduler.config)
    plain = draw(pipe, name, num_inference_steps=4, guidance_scale=1.0).images
    pipe.load_lora_weights(family / TURBO[name] / "turbo")
    expected = draw(pipe, name, num_inference_steps=4, guidance_scale=1.0).images
    assert_close(draw(turbo, name).images, expected, **FINE)
    assert not torch.allclose(expected, plain, atol=1e-2)


def test_the_noise_of_each_step_is_of_each_pictures_own_generator(turbo: Any, name: str) -> None:
    both = draw(turbo, name, 2, generator=[seeded(0), seeded(1)]).images
    assert_close(both[:1], draw(turbo, name, generator=seeded(0)).images, **FINE)
    noise = {"latents": torch.randn(1, *both.shape[1:])}
    first, second = (draw(turbo, name, **noise, generator=seeded(seed)).images for seed in (0, 1))
    assert not torch.allclose(first, second, atol=1e-2)
