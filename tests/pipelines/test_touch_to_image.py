"""What a picture of `TouchToImagePipeline` is conditioned on: the touch and its sensor, strength, noise, prompts."""

import copy
import warnings

import numpy as np
import pytest
import torch
from PIL import Image
from torch.testing import assert_close

from tests.helpers.calls import Call, quiet, seeded, watched
from unitouch_gen.conditioning import EmbeddingBank
from unitouch_gen.errors import UnfamiliarInputWarning
from unitouch_gen.models import UniTouchModel
from unitouch_gen.pipelines import TouchToImagePipeline

NORM = 3.0  # `embedding_norm` of the joint space


@pytest.fixture
def draw(pipe, touch):
    """Two pictures, from one seed."""
    return lambda **options: Call(pipe, {"touch": touch})(**options).images


# Touches --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["path", "name", "PIL", "array", "float array", "tensor", "float tensor", "list"])
def test_every_kind_of_touch_gives_the_same_embedding(pipe, tmp_path, kind):
    pixels = np.random.default_rng(0).integers(0, 128, (32, 32, 3), dtype=np.uint8)
    file = tmp_path / "touch.png"
    Image.fromarray(pixels).save(file)
    channels_first = torch.from_numpy(pixels).permute(2, 0, 1)
    kinds = {"path": file, "name": str(file), "PIL": Image.fromarray(pixels), "array": pixels, "list": [file],
             "float array": pixels / 255.0, "tensor": channels_first,
             "float tensor": channels_first / 255.0}  # fmt: skip
    assert_close(pipe.encode_touch(kinds[kind]), pipe.encode_touch(channels_first[None]), atol=1e-6, rtol=0)


def test_strength_is_a_gain_on_the_norm_of_images(pipe, components, touch):
    once = pipe.encode_touch(touch, strength=1.0)
    assert_close(once.norm(dim=1), torch.full((2,), NORM))
    assert_close(pipe.encode_touch(touch, strength=2.0), 2.0 * once)
    assert_close(pipe.encode_touch(touch), 0.75 * once)  # the checkpoint's own
    assert not pipe.encode_touch(touch, strength=0.0).any()


@pytest.mark.parametrize("options", [{}, {"strength": 0.3}, {"sensor": "digit"}, {"sensor": ["digit", None]}])
def test_the_output_has_the_embeddings_for_another_call(pipe, touch, options):
    output = pipe(touch, generator=seeded(), output_type="pt", **options)
    assert torch.equal(output.embeds, pipe.encode_touch(touch, **options))
    assert torch.equal(pipe(touch_embeds=output.embeds, generator=seeded(), output_type="pt").images, output.images)


def test_touches_are_moved_towards_pictures_where_there_is_a_bank(pipe, touch):
    bank = EmbeddingBank.of(torch.randn(20, pipe.embedding_dim, generator=seeded(1)))
    pipe.register_modules(embedding_bank=bank)
    plain, output = pipe.encode_touch(touch, bridge=False), pipe(touch)
    assert torch.equal(output.embeds, bank.bridge(plain)) and torch.equal(output.encoded, plain)
    assert torch.equal(pipe.encode_touch(touch), output.embeds) and not torch.allclose(output.embeds, plain)
    assert torch.equal(pipe(touch, bridge=False).embeds, plain)
    assert torch.equal(pipe(touch_embeds=plain).embeds, plain)


# Sensors --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sensor", "expected"),
    [
        (None, ["gelsight", "digit"]),
        ("digit", ["digit", "digit"]),
        ([None, "gelsight"], ["gelsight", "gelsight"]),
        ((None, None), ["gelsight", "digit"]),
    ],
)
def test_sensors_are_those_named_or_retrieved_by_their_prototypes(pipe, touch, sensor, expected):
    """One touch is dark as the prototype of GelSight, the other bright as that of DIGIT."""
    report = pipe(touch, sensor=sensor).report
    assert report.sensors == expected
    if sensor is None:
        distances = (touch - torch.tensor([0.2, 0.8]).view(2, 1, 1, 1)).abs().mean(dim=(1, 2, 3))
        assert report.sensor_distances == pytest.approx(distances.tolist(), abs=1e-5)
    named = pipe.encode_touch(touch, sensor=expected)
    assert torch.equal(pipe.encode_touch(touch, sensor=sensor), named)
    other = ["digit" if name == "gelsight" else "gelsight" for name in expected]
    assert not torch.allclose(pipe.encode_touch(touch, sensor=other), named, atol=1e-4)


def test_a_model_without_sensor_tokens_reports_none(components, touch):
    config = copy.deepcopy(components["unitouch"].config)
    config.sensors = []
    components["unitouch"] = UniTouchModel(config).eval()
    report = quiet(TouchToImagePipeline(**components))(touch, num_inference_steps=2).report
    assert (report.sensors, report.sensor_distances) == ([None, None], [None, None])


def test_a_background_takes_the_look_of_its_sensor_away(pipe, touch):
    like_digit = torch.full((3, 32, 32), 0.8)
    found = pipe.encode_touch(touch, sensor="digit", background=like_digit)
    assert_close(found, pipe.encode_touch(touch, sensor="digit"), atol=1e-5, rtol=0)
    brighter, background = touch[:1] + 0.1, torch.full((3, 32, 32), 0.3)
    found = pipe.encode_touch(brighter, background=background)
    assert_close(found, pipe.encode_touch(touch[:1]), atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("fixture", "encode"), [("pipe", "encode_touch"), ("stylize", "encode_mix"), ("x_to_touch", "encode_condition")]
)
def test_touches_unlike_any_known_are_warned_of_once_and_reported(request, touch, photo, fixture, encode, monkeypatch):
    pipe, reasons = request.getfixturevalue(fixture), ["unlike anything known", None]
    monkeypatch.setattr(UniTouchModel, "unknown_touches", lambda self, *given: reasons)
    inputs = {"touch": touch, "image": photo} if fixture == "stylize" else {"touch": touch}
    for call in (pipe, getattr(pipe, encode)):
        with pytest.warns(UnfamiliarInputWarning, match=r"^`touch\[0\]`: unlike anything known\. .* a guess") as caught:
            made = call(**inputs)
        assert len(caught) == 1 and caught[0].filename == __file__
        if call is pipe:
            assert made.report.unknown == {"touch": reasons} and made.report.success
    reasons[0] = None
    with warnings.catch_warnings():
        warnings.simplefilter("error", UnfamiliarInputWarning)
        assert pipe(**inputs).report.unknown == {}


# Noise on the embedding -----------------------------------------------------------------------------------------------


def test_the_noise_level_is_the_checkpoints_unless_a_call_says_another(draw, pipe):
    clean, noisy = draw(noise_level=0), draw(noise_level=999)
    assert torch.equal(draw(), clean) and (clean - noisy).abs().max() > 1e-3
    pipe.register_to_config(default_noise_level=999)
    assert torch.equal(draw(), noisy)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_embeddings_of_any_dtype_are_noised_alike(pipe, dtype):
    """torch draws another noise in each dtype from one seed, which diffusers does in that of the embedding."""
    embeds = torch.randn(2, 16, generator=seeded()).to(dtype)
    options = {"noise_level": 500, "output_type": "latent"}
    found, expected = (pipe(touch_embeds=one, generator=seeded(), **options).images for one in (embeds, embeds.float()))
    assert_close(found, expected)


# Prompts --------------------------------------------------------------------------------------------------------------


def test_prompts_are_what_they_are_when_left_out(draw):
    plain = draw(guidance_scale=4.0)
    assert torch.equal(draw(guidance_scale=4.0, prompt=["high quality"], negative_prompt=""), plain)
    for changed in ({"prompt": "rough brick"}, {"negative_prompt": "rough brick"}):
        assert (draw(guidance_scale=4.0, **changed) - plain).abs().max() > 1e-4
    assert torch.equal(draw(guidance_scale=1.0), draw(guidance_scale=1.0, negative_prompt="rough brick"))
    assert torch.isfinite(draw(prompt="rough brick " * 100)).all()  # cut


def test_prompts_go_to_their_touches(pipe, touch):
    prompts = ["rough brick", "smooth grey metal"]
    together = pipe(touch, prompts, generator=[seeded(1), seeded(2)], output_type="pt").images
    alone = [pipe(touch[i], prompts[i], generator=seeded(i + 1), output_type="pt").images for i in range(2)]
    assert_close(together, torch.cat(alone), atol=1e-4, rtol=0)


def test_a_prompt_that_is_its_own_negative_still_leaves_the_touch(draw):
    """The unconditional branch has no touch, so guidance acts on it whatever the prompts."""
    weak, strong = (draw(prompt="metal", negative_prompt="metal", guidance_scale=scale) for scale in (2.0, 6.0))
    assert (weak - strong).abs().max() > 1e-3


@pytest.mark.parametrize("rows", [1, 2])
def test_prompt_embeddings_in_place_of_prompts_give_the_same_picture(pipe, draw, rows):
    with torch.no_grad():
        embeds, negative = pipe.encode_prompt(["rough brick"] * rows), pipe.encode_prompt(["metal"] * rows)
    expected = draw(prompt="rough brick", negative_prompt="metal")
    assert_close(draw(prompt_embeds=embeds, negative_prompt_embeds=negative), expected, atol=1e-6, rtol=0)


def test_a_distinct_prompt_is_encoded_once(pipe, draw):
    ran = watched(pipe)
    draw(prompt="rough brick", num_images_per_prompt=2)
    assert [rows for name, rows in ran if name == "prompt encoder"] == [1, 1]  # the prompt and its negative


def test_embeddings_alone_need_no_encoders(components):
    components |= dict.fromkeys(("unitouch", "processor", "tokenizer", "text_encoder"))
    pipe = quiet(TouchToImagePipeline(**components, default_num_inference_steps=2))
    states, embeds = torch.randn(1, 12, 16, generator=seeded()), torch.ones(1, 16)
    for options in ({"negative_prompt_embeds": 0 * states}, {"guidance_scale": 1.0, "negative_prompt": "metal"}):
        output = pipe(touch_embeds=embeds, prompt_embeds=states, output_type="pt", **options)
        assert torch.isfinite(output.images).all() and "prompt encoder" in output.report.left_out
