"""What goes into a call and what comes out: touches, sizes, random numbers, solvers, callbacks, networks' dtypes."""

import copy
import numpy as np
import pytest
import torch
from diffusers import DPMSolverMultistepScheduler, PNDMScheduler
from diffusers.callbacks import SDCFGCutoffCallback
from diffusers.models.attention_processor import AttnProcessor2_0
from PIL import Image

from unitouch_gen.conditioning import EmbeddingBank, noise_embeddings
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.pipelines import UniTouchPipelineOutput
from unitouch_gen.sampling import SOLVERS, ReturnCode

# numpy 2 on diffusers' DEIS.
pytestmark = pytest.mark.filterwarnings("ignore:__array_wrap__ must accept context:DeprecationWarning")

SIDE = 16  # of a picture: 8 latents, each of 2 pixels


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def pictures(pipe, *args, **kwargs) -> torch.Tensor:
    """(B, 3, H, W), from one seed unless the call says otherwise."""
    return pipe(*args, **{"generator": seeded(), "output_type": "pt", **kwargs}).images


@pytest.fixture
def bank(pipe) -> EmbeddingBank:
    """A bank of image embeddings that the pipeline has, too."""
    bank = EmbeddingBank.of(torch.randn(20, pipe.embedding_dim, generator=seeded(1)))
    pipe.register_modules(embedding_bank=bank)
    return bank


# Touches --------------------------------------------------------------------------------------------------------------


def test_touches_are_moved_towards_pictures_where_there_is_a_bank(pipe, touch, bank):
    plain, moved = pipe.encode_touch(touch, bridge=False), pipe.encode_touch(touch)
    assert torch.equal(moved, bank.bridge(plain)) and not torch.allclose(moved, plain)
    output = pipe(touch, generator=seeded(), output_type="pt")
    assert torch.equal(output.embeds, moved) and torch.equal(output.encoded, plain)
    assert not torch.allclose(pictures(pipe, touch, bridge=False), output.images)


def test_embeddings_that_are_passed_are_used_as_they_are(pipe, touch, bank):
    plain = pipe.encode_touch(touch, bridge=False)
    given = pictures(pipe, touch_embeds=plain)
    assert torch.equal(given, pictures(pipe, touch, bridge=False))
    pipe.register_modules(embedding_bank=None)
    assert torch.equal(given, pictures(pipe, touch_embeds=plain))


@pytest.fixture
def pixels() -> np.ndarray:
    """A touch as a camera gives it, uint8 (32, 32, 3)."""
    return np.random.default_rng(0).integers(0, 128, (32, 32, 3), dtype=np.uint8)  # dark, as GelSights are here


@pytest.mark.parametrize("kind", ["path", "name", "PIL", "array", "float array", "tensor", "float tensor", "list"])
def test_every_kind_of_touch_gives_the_same_picture(pipe, pixels, tmp_path, kind):
    file = tmp_path / "touch.png"
    Image.fromarray(pixels).save(file)
    channels_first = torch.from_numpy(pixels).permute(2, 0, 1)
    touch = {
        "path": file,
        "name": str(file),
        "PIL": Image.fromarray(pixels),
        "array": pixels,
        "float array": pixels.astype(np.float32) / 255.0,
        "tensor": channels_first,
        "float tensor": channels_first / 255.0,
        "list": [file],
    }[kind]
    expected = pictures(pipe, channels_first[None])
    torch.testing.assert_close(pictures(pipe, touch), expected, atol=1e-6, rtol=0)


def test_a_list_and_a_batch_are_the_same(pipe, touch):
    assert torch.equal(pictures(pipe, [touch[0], touch[1]]), pictures(pipe, touch))


def test_each_touch_has_its_own_picture(pipe, touch):
    latents = torch.randn(1, 4, 8, 8, generator=seeded()).expand(2, -1, -1, -1)
    first, second = pictures(pipe, touch, latents=latents, prompt_embeds=torch.zeros(1, 12, 16))
    assert (first - second).abs().max() > 1e-3


# Sizes and output types -----------------------------------------------------------------------------------------------


def test_the_size_is_the_unets_when_left_out(pipe, touch):
    assert pictures(pipe, touch).shape == (2, 3, SIDE, SIDE)


def test_height_and_width_are_those_asked_for(pipe, touch):
    assert pictures(pipe, touch, height=24, width=8).shape == (2, 3, 24, 8)


def test_pictures_of_one_touch_stand_together(pipe, touch):
    """From one noise, both pictures of a touch and its prompt are the same, and those of the other are others."""
    latents = torch.randn(1, 4, 8, 8, generator=seeded()).expand(4, -1, -1, -1)
    images = pictures(pipe, touch, ["rough brick", "smooth metal"], num_images_per_prompt=2, latents=latents)
    torch.testing.assert_close(images[0], images[1], atol=1e-6, rtol=0)
    torch.testing.assert_close(images[2], images[3], atol=1e-6, rtol=0)
    assert (images[0] - images[2]).abs().max() > 1e-3


def test_pil_pictures_are_the_array_in_256_levels(pipe, touch):
    images = pipe(touch, generator=seeded()).images
    array = pipe(touch, generator=seeded(), output_type="np").images
    assert [(image.mode, image.size) for image in images] == [("RGB", (SIDE, SIDE))] * 2
    np.testing.assert_array_equal(np.stack([np.asarray(image) for image in images]), (array * 255).round())


def test_arrays_are_the_tensor_with_channels_last(pipe, touch):
    array = pipe(touch, generator=seeded(), output_type="np").images
    assert array.dtype == np.float32
    np.testing.assert_array_equal(array, pictures(pipe, touch).permute(0, 2, 3, 1).numpy())


def test_pictures_lie_in_the_unit_range(pipe, touch):
    images = pictures(pipe, touch)
    assert images.min() >= 0.0
    assert images.max() <= 1.0


def test_decoded_latents_are_the_picture(pipe, touch):
    latents = pictures(pipe, touch, output_type="latent")
    assert latents.shape == (2, 4, 8, 8)
    with torch.no_grad():
        decoded = pipe.vae.decode(latents / pipe.vae.config.scaling_factor).sample
    torch.testing.assert_close((decoded / 2 + 0.5).clamp(0, 1), pictures(pipe, touch), atol=1e-6, rtol=0)


def test_the_output_has_the_embeddings_for_another_call(pipe, touch):
    output = pipe(touch, generator=seeded(), output_type="pt", strength=0.4)
    assert torch.equal(output.embeds, pipe.encode_touch(touch, strength=0.4))
    assert torch.equal(pictures(pipe, touch_embeds=output.embeds), output.images)


def test_the_output_is_an_object_or_a_tuple(pipe, touch):
    output = pipe(touch, generator=seeded())
    images, report = pipe(touch, generator=seeded(), return_dict=False)
    assert isinstance(output, UniTouchPipelineOutput)
    assert images == output.images
    assert report.codes == output.report.codes


# Random numbers -------------------------------------------------------------------------------------------------------


def test_a_seed_fixes_the_picture(pipe, touch):
    assert torch.equal(pictures(pipe, touch, generator=seeded(1)), pictures(pipe, touch, generator=seeded(1)))


def test_another_seed_makes_another_picture(pipe, touch):
    difference = pictures(pipe, touch, generator=seeded(1)) - pictures(pipe, touch, generator=seeded(2))
    assert difference.abs().max() > 1e-3


def test_a_generator_leaves_the_global_one_alone(pipe, touch):
    before = torch.random.get_rng_state()
    pictures(pipe, touch, num_inference_steps=3, eta=1.0)
    assert torch.equal(torch.random.get_rng_state(), before)


@pytest.mark.parametrize("options", [{}, {"eta": 1.0}, {"solver": "euler"}, {"solver": "dpm++2m", "noise_level": 500}])
def test_with_a_generator_each_a_picture_is_independent_of_its_neighbours(pipe, touch, options):
    together = pictures(pipe, touch, generator=[seeded(1), seeded(2)], **options)
    alone = [pictures(pipe, one, generator=seeded(seed), **options) for one, seed in zip(touch, (1, 2), strict=True)]
    torch.testing.assert_close(together, torch.cat(alone), atol=1e-4, rtol=0)


def test_with_a_generator_each_so_are_several_pictures_of_one_touch(pipe, touch):
    together = pictures(pipe, touch[0], generator=[seeded(1), seeded(2)], num_images_per_prompt=2, noise_level=500)
    alone = [pictures(pipe, touch[0], generator=seeded(seed), noise_level=500) for seed in (1, 2)]
    torch.testing.assert_close(together, torch.cat(alone), atol=1e-4, rtol=0)


def test_given_latents_are_the_start_and_stay_as_they_were(pipe, touch):
    latents = torch.randn(2, 4, 8, 8, generator=seeded(1))
    kept = latents.clone()
    first = pictures(pipe, touch, latents=latents)
    assert torch.equal(latents, kept)
    assert torch.equal(first, pictures(pipe, touch, latents=latents))
    assert not torch.equal(first, pictures(pipe, touch, latents=-latents))


# Solvers --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("steps", [2, 5])
def test_every_solver_makes_finite_pictures(pipe, touch, solver, steps):
    output = pipe(touch, solver=solver, num_inference_steps=steps, generator=seeded(), output_type="latent")
    assert torch.isfinite(output.images).all()
    assert output.report.solver == solver


@pytest.mark.parametrize("solver", [None, *SOLVERS])
def test_a_call_leaves_the_scheduler_as_it_was(pipe, touch, solver):
    config, timesteps = dict(pipe.scheduler.config), pipe.scheduler.timesteps.clone()
    pictures(pipe, touch, solver=solver)
    assert dict(pipe.scheduler.config) == config
    assert torch.equal(pipe.scheduler.timesteps, timesteps)
    assert pipe.scheduler.num_inference_steps is None


@pytest.mark.parametrize("scheduler", [PNDMScheduler, DPMSolverMultistepScheduler])
def test_schedulers_with_a_memory_start_afresh(pipe, touch, scheduler):
    pipe.scheduler = scheduler.from_config(pipe.scheduler.config)
    first = pictures(pipe, touch, num_inference_steps=4)
    assert torch.equal(pictures(pipe, touch, num_inference_steps=4), first)


# Callbacks ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_embeddings_of_any_dtype_are_noised_alike(pipe, dtype):
    """torch draws another noise in each dtype from one seed, which diffusers does in that of the embedding."""
    embeds = torch.randn(2, 16, generator=seeded()).to(dtype)
    options = {"touch": None, "noise_level": 500, "output_type": "latent"}
    found = pictures(pipe, touch_embeds=embeds, **options)
    torch.testing.assert_close(found, pictures(pipe, touch_embeds=embeds.float(), **options))


def test_a_callback_gets_the_latents_of_every_step(pipe, touch):
    calls = []

    def note(pipeline, step, timestep, tensors):
        calls.append((pipeline.unet, step, int(timestep), tensors["latents"].shape, tensors["latents"].dtype))

    pictures(pipe, touch, num_inference_steps=3, callback_on_step_end=note)
    scheduler = copy.deepcopy(pipe.scheduler)
    scheduler.set_timesteps(3)
    expected = enumerate(scheduler.timesteps.tolist())
    assert calls == [(pipe.unet, step, timestep, (2, 4, 8, 8), torch.float32) for step, timestep in expected]


def test_a_callback_may_put_other_latents_in_their_place(pipe, touch):
    def last_to_zero(pipeline, step, timestep, tensors):
        done = step == pipeline.num_timesteps - 1
        return {"latents": torch.zeros_like(tensors["latents"])} if done else {}

    assert not pictures(pipe, touch, callback_on_step_end=last_to_zero, output_type="latent").any()


def test_a_callback_gets_only_what_was_asked_for(pipe, touch):
    seen = []
    note = lambda pipeline, step, timestep, tensors: seen.append(dict(tensors))  # noqa: E731
    pictures(pipe, touch, callback_on_step_end=note, callback_on_step_end_tensor_inputs=[])
    assert seen == [{}, {}]


def test_a_callback_may_interrupt(pipe, touch):
    def stop(pipeline, step, timestep, tensors):
        pipeline._interrupt = step == 1

    output = pipe(touch, num_inference_steps=5, callback_on_step_end=stop, output_type="latent")
    assert (output.report.steps, output.report.evaluations) == (5, 2)
    assert output.report.codes == [ReturnCode.INTERRUPTED] * 2
    assert torch.isfinite(output.images).all()


def test_an_interrupt_ends_with_its_call(pipe, touch):
    pipe._interrupt = True
    assert pipe(touch, num_inference_steps=3).report.evaluations == 3


def test_latents_of_a_callback_are_brought_to_the_states_dtype(pipe, touch):
    halve = lambda pipeline, step, timestep, tensors: {"latents": tensors["latents"].bfloat16()}  # noqa: E731
    assert pictures(pipe, touch, callback_on_step_end=halve, output_type="latent").dtype == torch.float32


def rows_of(module: torch.nn.Module) -> list[int]:
    """The batch sizes that a network has seen, as they come."""
    rows: list[int] = []
    module.register_forward_pre_hook(lambda module, args: rows.append(len(args[0])))
    return rows


def cut_off(pipeline, step, timestep, tensors):
    """The callback of diffusers' documentation: no guidance after the second step."""
    if step == 1:
        pipeline._guidance_scale = 0.0
        tensors["prompt_embeds"] = tensors["prompt_embeds"].chunk(2)[-1]
    return tensors


def forget(pipeline, step, timestep, tensors):
    """The same without touching the prompt."""
    pipeline._guidance_scale = 0.0 if step == 1 else pipeline._guidance_scale


@pytest.mark.parametrize("inputs", [[], ["prompt_embeds"]])
def test_a_prompt_that_a_callback_returns_counts_from_then_on(pipe, touch, inputs):
    """Whether it asked for the one before or not; against a UNet for which nothing is cached."""
    other = torch.randn(4, 12, 16, generator=seeded())
    change = {"callback_on_step_end": lambda *_: {"prompt_embeds": other}, "callback_on_step_end_tensor_inputs": inputs}
    options = {**change, "num_inference_steps": 3, "guidance_scale": 5.0, "output_type": "latent"}
    found = pictures(pipe, touch, **options)
    pipe.unet.set_attn_processor(AttnProcessor2_0())
    torch.testing.assert_close(found, pictures(pipe, touch, **options), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(
    ("callback", "inputs"), [(cut_off, ["prompt_embeds"]), (cut_off, ["latents", "prompt_embeds"]), (forget, [])]
)
def test_a_callback_may_turn_guidance_off(pipe, touch, callback, inputs):
    rows = rows_of(pipe.unet)
    options = {"num_inference_steps": 4, "guidance_scale": 5.0, "output_type": "latent"}
    states = []
    note = lambda pipeline, step, timestep, tensors: states.append(tensors["latents"])  # noqa: E731
    pictures(pipe, touch, callback_on_step_end=note, **options)
    output = pipe(touch, generator=seeded(), callback_on_step_end=callback, callback_on_step_end_tensor_inputs=inputs,
                  **options)  # fmt: skip
    assert rows == [4] * 4 + [4, 4, 2, 2]
    assert output.report.guidance_scale == 5.0
    scheduler = copy.deepcopy(pipe.scheduler)
    scheduler.set_timesteps(4)
    embeds = pipe.encode_touch(touch)
    noise = torch.randn(embeds.shape, generator=seeded())
    levels = torch.zeros(len(embeds), dtype=torch.long)
    labels = noise_embeddings(embeds, levels, noise, pipe.image_normalizer, pipe.image_noising_scheduler)
    latents = states[1]
    for timestep in scheduler.timesteps[2:]:
        with torch.no_grad():
            hidden = pipe.encode_prompt(["high quality"] * 2)
            noise = pipe.unet(latents, timestep, encoder_hidden_states=hidden, class_labels=labels).sample
        latents = scheduler.step(noise, timestep, latents).prev_sample
    torch.testing.assert_close(output.images, latents, atol=1e-5, rtol=1e-5)


def test_a_callback_may_change_the_scale_of_guidance(pipe, touch):
    """From the start to the scale of another call, the picture is that call's from the second step on."""

    def strengthen(pipeline, step, timestep, tensors):
        pipeline._guidance_scale = 7.0

    options = {"num_inference_steps": 3, "output_type": "latent"}
    states = []
    note = lambda pipeline, step, timestep, tensors: states.append(tensors["latents"])  # noqa: E731
    pictures(pipe, touch, callback_on_step_end=note, guidance_scale=2.0, **options)

    def back_to_first(pipeline, step, timestep, tensors):
        return {"latents": states[0]} if step == 0 else {}

    expected = pictures(pipe, touch, callback_on_step_end=back_to_first, guidance_scale=7.0, **options)
    got = pictures(pipe, touch, callback_on_step_end=strengthen, guidance_scale=2.0, **options)
    torch.testing.assert_close(got, expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("touches", [1, 2])
def test_diffusers_own_cutoff_callback_works(pipe, touch, touches):
    callback = SDCFGCutoffCallback(cutoff_step_ratio=0.5)
    options = {"num_inference_steps": 4, "guidance_scale": 5.0}
    got = pictures(pipe, touch[:touches], callback_on_step_end=callback, **options)
    by_hand = lambda pipeline, step, timestep, tensors: setattr(  # noqa: E731
        pipeline, "_guidance_scale", 0.0 if step >= 2 else 5.0
    )
    torch.testing.assert_close(got, pictures(pipe, touch[:touches], callback_on_step_end=by_hand, **options))


def test_the_scale_of_a_callback_ends_with_its_call(pipe, touch):
    expected = pictures(pipe, touch)
    pictures(pipe, touch, callback_on_step_end=forget)
    assert torch.equal(pictures(pipe, touch), expected)


def test_a_callback_cannot_turn_on_guidance_that_never_was(pipe, touch):
    late = lambda pipeline, step, timestep, tensors: setattr(pipeline, "_guidance_scale", 4.0)  # noqa: E731
    with pytest.raises(InvalidInputError, match=r"`_guidance_scale` to 4, .*start with a `guidance_scale` above 1"):
        pipe(touch, guidance_scale=1.0, callback_on_step_end=late)


def test_prompt_embeddings_of_a_callback_have_to_fit_the_pictures(pipe, touch):
    wrong = lambda pipeline, step, timestep, tensors: {"prompt_embeds": tensors["prompt_embeds"][:3]}  # noqa: E731
    with pytest.raises(InvalidInputError, match=r"`prompt_embeds` .*\(3, 12, 16\).* for 2 pictures"):
        pipe(touch, callback_on_step_end=wrong, callback_on_step_end_tensor_inputs=["prompt_embeds"])


# Components of other shapes -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("size", "shape"), [([8, 4], (16, 8)), ((4, 8), (8, 16)), (6, (12, 12))])
def test_the_size_of_a_unet_may_be_height_and_width(pipe, touch, size, shape):
    pipe.unet.register_to_config(sample_size=size)
    assert pictures(pipe, touch).shape == (2, 3, *shape)
    assert pictures(pipe, touch, height=20).shape == (2, 3, 20, shape[1])


def test_a_unet_without_a_size_needs_one_in_the_call(pipe, touch):
    pipe.unet.register_to_config(sample_size=None)
    with pytest.raises(InvalidInputError, match="`width` has to be passed"):
        pipe(touch, height=16)
    assert pictures(pipe, touch, height=16, width=8).shape == (2, 3, 16, 8)


def test_the_shift_of_a_vae_is_undone(pipe, touch):
    """As in diffusers' Stable Diffusion 3: latents / scaling_factor + shift_factor."""
    latents = pictures(pipe, touch, output_type="latent")
    pipe.vae.register_to_config(shift_factor=0.3)
    with torch.no_grad():
        decoded = pipe.vae.decode(latents / pipe.vae.config.scaling_factor + 0.3).sample
    torch.testing.assert_close((decoded / 2 + 0.5).clamp(0, 1), pictures(pipe, touch), atol=1e-6, rtol=0)


# Networks' dtypes -----------------------------------------------------------------------------------------------------


def test_a_bfloat16_unet_works_on_a_float32_state(pipe, touch):
    states = []
    note = lambda pipeline, step, timestep, tensors: states.append(tensors["latents"].dtype)  # noqa: E731
    latents = torch.randn(2, 4, 8, 8, generator=seeded())
    expected = pictures(pipe, touch, latents=latents, output_type="latent")
    pipe.unet.to(torch.bfloat16)
    got = pictures(pipe, touch, latents=latents, output_type="latent", callback_on_step_end=note)
    assert {*states, got.dtype} == {torch.float32}
    assert (got - expected).norm() / expected.norm() < 0.05


def test_a_pipeline_in_float64_makes_the_same_picture(pipe, touch):
    latents, embeds = torch.randn(2, 4, 8, 8, generator=seeded()), pipe.encode_touch(touch)
    expected = pictures(pipe, touch_embeds=embeds, latents=latents)
    pipe.to(torch.float64)
    torch.testing.assert_close(pictures(pipe, touch_embeds=embeds, latents=latents), expected, atol=1e-4, rtol=0)


def test_a_pipeline_in_bfloat16_makes_pictures(pipe, touch):
    pipe.to(torch.bfloat16)
    images = pictures(pipe, touch)
    assert images.dtype == torch.float32
    assert torch.isfinite(images).all()
