"""Pipelines as targets: the flow that is solved for reference is the one their solvers follow."""

import pytest
import torch
from diffusers import DDIMScheduler

from tests.helpers.components import make_components, make_x_to_touch
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.numerics.reference import Reference, relative_rms
from unitouch_gen.numerics.targets import Configuration, PipelineTarget, world_inputs
from unitouch_gen.numerics.work_precision import measure
from unitouch_gen.pipelines import TactileStylizationPipeline, TouchToImagePipeline, XToTouchPipeline
from unitouch_gen.world import MATERIAL_NAMES

FEW = {"default_num_inference_steps": 3, "default_guidance_scale": 2.0}


@pytest.fixture(scope="module")
def parts() -> dict:
    return make_components()


def make(parts: dict, name: str):
    if name == "x-to-touch":
        shared = {key: parts[key] for key in ("unitouch", "processor", "scheduler")}
        pipe = XToTouchPipeline(**shared, **make_x_to_touch(), **FEW, sensors=["gelsight", "digit"])
    else:
        kind = {"touch-to-image": TouchToImagePipeline, "stylization": TactileStylizationPipeline}[name]
        pipe = kind(**parts, **FEW, default_noise_level=300)
    pipe.set_progress_bar_config(disable=True)
    return pipe


MODALITIES = {"touch-to-image": ("touch",), "stylization": ("image", "touch"), "x-to-touch": ("image",)}


@pytest.fixture(scope="module")
def targets(parts) -> dict[str, PipelineTarget]:
    inputs = world_inputs(("image", "touch"), 2)
    return {
        name: PipelineTarget(
            make(parts, name), {modality: inputs[modality] for modality in modalities}, name=name, seeds=2
        )
        for name, modalities in MODALITIES.items()
    }


@pytest.fixture(scope="module")
def touches(targets) -> PipelineTarget:
    return targets["x-to-touch"]


@pytest.mark.parametrize("guidance_scale", [1.0, 2.0])
@pytest.mark.parametrize("name", MODALITIES)
def test_the_flow_is_the_one_that_is_followed(targets, name, guidance_scale):
    """The denoiser at the first noise level is what a single step of DDIM ends in."""
    target = targets[name]
    latents, report = target.run(Configuration("ddim", 1, guidance_scale=guidance_scale))
    flow = target.flow(guidance_scale, target.parts[0])
    expected = flow.denoise(flow.start(target.noise), flow.schedule.sigma_max)
    assert relative_rms(latents, expected).max() < 1e-4
    assert report.evaluations == 1 and len(report.codes) == 4


def test_solvers_come_to_the_reference(touches):
    target = PipelineTarget(touches.pipe, {"image": touches.inputs["image"][:1]}, seeds=1)
    truth = target.reference(2.0, rtol=1e-2)
    assert truth.latents.shape == target.noise.shape and truth.disagreement.max() < 0.02
    coarse, fine = (
        relative_rms(target.run(Configuration("unipc", steps, guidance_scale=2.0))[0], truth.latents).item()
        for steps in (6, 30)
    )
    assert fine < 0.02 and fine < coarse


def test_a_baseline_is_diffusers_own_scheduler(touches):
    """Its loop written out as in diffusers' pipelines."""
    scheduler = DDIMScheduler(
        beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear", clip_sample=False, set_alpha_to_one=False,
        timestep_spacing="leading", steps_offset=1,
    )  # fmt: skip
    scheduler.set_timesteps(7)
    conditions = touches.network_inputs(2.0, touches.parts[0]).conditions
    latents = touches.noise * scheduler.init_noise_sigma
    for timestep in scheduler.timesteps:
        with torch.no_grad():
            prediction = touches.pipe.unet(torch.cat([latents] * 2), timestep, **conditions, return_dict=False)[0]
        unconditional, conditional = prediction.chunk(2)
        guided = unconditional + 2.0 * (conditional - unconditional)
        latents = scheduler.step(guided, timestep, latents, return_dict=False)[0]
    got, report = touches.run(Configuration("diffusers:ddim", 7, guidance_scale=2.0))
    torch.testing.assert_close(got, latents, rtol=1e-4, atol=1e-5)
    assert report.solver == "DDIMScheduler"


def test_seeds_start_alike_under_every_condition(touches):
    first, second = touches.noise.split(touches.seeds)
    assert torch.equal(first, second) and not torch.equal(first[0], first[1])


def test_batches_give_the_same_samples(parts, targets):
    whole = targets["touch-to-image"]
    parted = PipelineTarget(whole.pipe, whole.inputs, seeds=2, batch_size=3)
    point = Configuration("unipc", 4, guidance_scale=2.0)
    torch.testing.assert_close(parted.run(point)[0], whole.run(point)[0], rtol=1e-3, atol=1e-4)
    assert parted.parts == [[0, 1, 2], [3]] and parted.identity != whole.identity


def test_a_pipeline_is_as_before_after_a_run(touches):
    before = touches.pipe.unet, touches.pipe.scheduler
    touches.run(Configuration("diffusers:ddim", 3, guidance_scale=2.0, dtype="bfloat16"))
    with pytest.raises(InvalidInputError):
        touches.run(Configuration("diffusers:ddim", 1000, guidance_scale=2.0, dtype="bfloat16"))
    assert (touches.pipe.unet, touches.pipe.scheduler) == before
    assert touches.pipe.unet.dtype == torch.float32 and not touches.pipe.unet._forward_pre_hooks


def test_a_low_dtype_is_near(touches):
    point = {"steps": 5, "guidance_scale": 2.0}
    exact, rough = (touches.run(Configuration("unipc", **point, dtype=name))[0] for name in ("float32", "bfloat16"))
    assert 1e-4 < relative_rms(rough, exact).median() < 0.1


def test_the_default_is_a_call_without_options(touches):
    assert touches.default == Configuration("default", 3, guidance_scale=2.0)
    latents, report = touches.run(touches.default)
    output = touches.pipe(**touches.inputs, latents=touches.noise[[0, 2]], output_type="latent")
    torch.testing.assert_close(output.images, latents[[0, 2]], rtol=1e-4, atol=1e-5)
    row = measure(touches, touches.default, Reference(latents.double(), torch.zeros(4), {}, {}), repeats=1)
    assert row.default and row.error < 1e-5 and report.solver == "DDIMScheduler"


def test_other_weights_or_inputs_are_another_target(parts, touches):
    other = make(parts, "x-to-touch")
    same = PipelineTarget(other, touches.inputs, name="x-to-touch", seeds=2)
    assert same.identity == touches.identity
    with torch.no_grad():
        next(other.unet.parameters()).mul_(1.01)
    assert PipelineTarget(other, touches.inputs, seeds=2).identity != touches.identity
    swapped = {"image": touches.inputs["image"].flip(0)}
    assert PipelineTarget(touches.pipe, swapped, seeds=2).identity != touches.identity


def test_options_are_arguments_of_the_call(touches):
    point = Configuration("ddim", 3, guidance_scale=2.0, options={"eta": 0.5})
    plain, drawn = (touches.run(item)[0] for item in (Configuration("ddim", 3, guidance_scale=2.0), point))
    assert relative_rms(drawn, plain).min() > 0.05 and point.series == "ddim, eta=0.5"
    for name, words in (("etta", "`option` is 'etta'"), ("image", "`option` is 'image'"), ("latents", "`option`")):
        with pytest.raises(InvalidInputError, match=words):
            touches.check(Configuration("ddim", 3, options={name: 1}))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"seeds": 0}, "`seeds` is 0"),
        ({"batch_size": 0}, "`batch_size` is 0"),
        ({"inputs": "differ"}, r"hold \[1, 2\]"),
    ],
)
def test_what_cannot_be_measured_is_refused(touches, settings, words):
    image = touches.inputs["image"]
    inputs = {"image": image, "text": ["brick"]} if settings.pop("inputs", None) else {"image": image}
    with pytest.raises(InvalidInputError, match=words):
        PipelineTarget(touches.pipe, inputs, **settings)


def test_inputs_are_contacts_of_different_materials():
    found = world_inputs(("image", "touch"), 3)
    assert {name: tuple(value.shape) for name, value in found.items()} == {
        "image": (3, 3, 128, 128), "touch": (3, 3, 128, 128),
    }  # fmt: skip
    assert torch.equal(world_inputs(("touch",), 3)["touch"], found["touch"])
    with pytest.raises(InvalidInputError, match="`conditions` is 18"):
        world_inputs(("image",), len(MATERIAL_NAMES) + 1)
