"""What a picture of `TouchToImagePipeline` is conditioned on: the touch and its sensor, strength, noise, prompts."""

import warnings

import pytest
import torch
from torch.testing import assert_close

from tests.helpers.calls import Call, quiet, seeded, watched
from unitouch_gen.conditioning import EmbeddingBank
from unitouch_gen.errors import UnfamiliarInputWarning
from unitouch_gen.models.joint import Gaussians, RelativeDistance, touch_statistics
from unitouch_gen.pipelines import TouchToImagePipeline
from unitouch_gen.training.touch import fit_gaussians

NORM = 3.0  # `embedding_norm` of the joint space


@pytest.fixture
def draw(pipe, touch):
    """Two pictures, from one seed."""
    return lambda **options: Call(pipe, {"touch": touch})(**options).images


def test_strength_is_a_gain_on_the_norm_of_images(pipe, touch):
    once = pipe.encode_touch(touch, strength=1.0)
    assert_close(once.norm(dim=1), torch.full((2,), NORM))
    assert_close(pipe.encode_touch(touch, strength=2.0), 2.0 * once)
    assert_close(pipe.encode_touch(touch), 0.75 * once)  # the checkpoint's own
    assert not pipe.encode_touch(touch, strength=0.0).any()


def test_touches_are_moved_towards_pictures_where_there_is_a_bank(pipe, touch):
    bank = EmbeddingBank.of(torch.randn(20, pipe.embedding_dim, generator=seeded(1)))
    pipe.register_modules(embedding_bank=bank)
    plain = pipe.encode_touch(touch, bridge=False)
    output = pipe(touch)
    assert_close(output.embeds, bank.bridge(plain))
    assert torch.equal(pipe.encode_touch(touch), output.embeds)
    assert not torch.allclose(output.embeds, plain)
    assert torch.equal(pipe(touch, bridge=False).embeds, plain)
    assert torch.equal(pipe(touch_embeds=plain).embeds, plain)


@pytest.mark.parametrize(
    ("sensor", "expected"),
    [(None, ["gelsight", "digit"]), ("digit", ["digit"] * 2), ([None, "gelsight"], ["gelsight"] * 2)],
)
def test_sensors_are_those_named_or_retrieved_by_their_prototypes(pipe, touch, sensor, expected):
    report = pipe(touch, sensor=sensor).report
    assert report.sensors == expected
    if sensor is None:
        areas = torch.nn.functional.avg_pool2d(touch, touch.shape[-1] // 8)
        distances = (areas - torch.tensor([0.2, 0.8]).view(2, 1, 1, 1)).abs().mean(dim=(1, 2, 3))
        assert report.sensor_distances == pytest.approx(distances.tolist(), abs=1e-5)
    named = pipe.encode_touch(touch, sensor=expected)
    assert torch.equal(pipe.encode_touch(touch, sensor=sensor), named)
    other = ["digit" if name == "gelsight" else "gelsight" for name in expected]
    assert not torch.allclose(pipe.encode_touch(touch, sensor=other), named, atol=1e-4)


def test_a_background_takes_the_look_of_its_sensor_away(pipe, touch):
    like_digit = torch.full((3, 32, 32), 0.8)
    found = pipe.encode_touch(touch, sensor="digit", background=like_digit)
    assert_close(found, pipe.encode_touch(touch, sensor="digit"), atol=1e-5, rtol=0)
    found = pipe.encode_touch(touch[:1] + 0.1, background=torch.full((3, 32, 32), 0.3))
    assert_close(found, pipe.encode_touch(touch[:1]), atol=1e-5, rtol=0)


@pytest.mark.parametrize(("fixture", "encode"), [("pipe", "encode_touch"), ("x_to_touch", "encode_condition")])
def test_touches_unlike_any_known_are_warned_of_once_and_reported(request, touch, fixture, encode):
    """Of a joint space that knows what is like the second touch alone."""
    pipe = request.getfixturevalue(fixture)
    distance = distance_between(pipe, known=touch[1:], foreign=touch[:1])
    pipe.unitouch.out_of_distribution["touch"] = distance
    pipe.unitouch.config.ood_thresholds = {"touch": {"foreign": 0.0}}
    for call in (pipe, getattr(pipe, encode)):
        with pytest.warns(UnfamiliarInputWarning, match=r"^`touch\[0\]`: unlike anything known\. .* a guess") as caught:
            made = call(touch=touch)
        assert len(caught) == 1
        assert caught[0].filename == __file__
        if call is pipe:
            assert made.report.unknown == {"touch": ["unlike anything known", None]}
            assert made.report.success
    with warnings.catch_warnings():
        warnings.simplefilter("error", UnfamiliarInputWarning)
        assert pipe(touch=touch[1:]).report.unknown == {}


@torch.no_grad()
def distance_between(pipe, known: torch.Tensor, foreign: torch.Tensor) -> RelativeDistance:
    """What is positive for touches that are nearer to `foreign` than to `known` ones, under noise."""

    def gaussians(touch: torch.Tensor) -> Gaussians:
        noise = 0.01 * torch.randn(64, *touch.shape[1:], generator=seeded())
        pixels = pipe.processor.touch((touch + noise).clamp(0, 1))
        statistics = touch_statistics(pipe.unitouch.touch_model.stem(pixels), pixels)
        return fit_gaussians(statistics, torch.zeros(64, dtype=torch.int64))

    return RelativeDistance(gaussians(known), gaussians(foreign))


def test_the_noise_level_is_the_checkpoints_unless_a_call_says_another(draw, pipe):
    clean = draw(noise_level=0)
    noisy = draw(noise_level=999)
    assert torch.equal(draw(), clean)
    assert (clean - noisy).abs().max() > 1e-3
    pipe.register_to_config(default_noise_level=999)
    assert torch.equal(draw(), noisy)


def test_prompts_are_what_they_are_when_left_out(draw):
    plain = draw(guidance_scale=4.0)
    assert torch.equal(draw(guidance_scale=4.0, prompt=["high quality"], negative_prompt=""), plain)
    for changed in ({"prompt": "rough brick"}, {"negative_prompt": "rough brick"}):
        assert (draw(guidance_scale=4.0, **changed) - plain).abs().max() > 1e-4
    assert torch.equal(draw(guidance_scale=1.0), draw(guidance_scale=1.0, negative_prompt="rough brick"))
    assert torch.isfinite(draw(prompt="rough brick " * 100)).all()  # cut


def test_prompts_go_to_their_touches_and_are_encoded_once(pipe, touch):
    prompts = ["rough brick", "smooth grey metal"]
    options = {"output_type": "pt"}
    together = pipe(touch, prompts, generator=[seeded(1), seeded(2)], **options).images
    alone = [pipe(touch[i], prompts[i], generator=seeded(i + 1), **options).images for i in range(2)]
    assert_close(together, torch.cat(alone), atol=1e-4, rtol=0)
    ran = watched(pipe)
    pipe(touch, "rough brick", num_images_per_prompt=2)
    assert [rows for name, rows in ran if name == "prompt encoder"] == [1, 1]  # the prompt and its negative


def test_embeddings_alone_need_no_encoders(components, pipe, draw):
    with torch.no_grad():
        embeds = pipe.encode_prompt(["rough brick"])
        negative = pipe.encode_prompt(["metal"] * 2)
    expected = draw(prompt="rough brick", negative_prompt="metal")
    assert_close(draw(prompt_embeds=embeds, negative_prompt_embeds=negative), expected, atol=1e-6, rtol=0)
    components |= dict.fromkeys(("unitouch", "processor", "tokenizer", "text_encoder"))
    pipe = quiet(TouchToImagePipeline(**components, default_num_inference_steps=2))
    states = torch.randn(1, 12, 16, generator=seeded())
    embeds = torch.ones(1, 16)
    for options in ({"negative_prompt_embeds": 0 * states}, {"guidance_scale": 1.0, "negative_prompt": "metal"}):
        output = pipe(touch_embeds=embeds, prompt_embeds=states, output_type="pt", **options)
        assert torch.isfinite(output.images).all()
        assert "prompt encoder" in output.report.left_out
