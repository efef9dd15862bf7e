"""What a picture is conditioned on: the touch and its sensor, strength, noise on the embedding, prompts."""

import copy

import pytest
import torch

from unitouch_gen.models import UniTouchModel
from unitouch_gen.pipelines import TouchToImagePipeline

NORM = 3.0  # `embedding_norm` of the joint space


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def pictures(pipe, *args, **kwargs) -> torch.Tensor:
    """(B, 3, H, W), from one seed."""
    return pipe(*args, generator=seeded(), output_type="pt", **kwargs).images


# Touch embeddings -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [{}, {"strength": 0.3}, {"sensor": "digit"}, {"sensor": ["digit", None]}])
@pytest.mark.filterwarnings("ignore::unitouch_gen.errors.UnfamiliarInputWarning")
def test_embeddings_in_place_of_the_touch_give_the_same_picture(pipe, touch, options):
    embeds = pipe.encode_touch(touch, **options)
    torch.testing.assert_close(pictures(pipe, touch_embeds=embeds), pictures(pipe, touch, **options), atol=1e-5, rtol=0)


@pytest.mark.parametrize("strength", [0.0, 0.75, 2.0])
def test_embeddings_have_the_norm_of_images_times_strength(pipe, touch, strength):
    norms = pipe.encode_touch(touch, strength=strength).norm(dim=1)
    torch.testing.assert_close(norms, torch.full((2,), NORM * strength), rtol=1e-6, atol=0)


def test_strength_is_a_plain_gain(pipe, touch):
    once, twice = pipe.encode_touch(touch, strength=1.0), pipe.encode_touch(touch, strength=2.0)
    torch.testing.assert_close(twice, 2.0 * once)


def test_the_checkpoint_says_the_strength_when_the_call_does_not(components, touch):
    pipe = TouchToImagePipeline(**components, default_strength=0.4)
    torch.testing.assert_close(pipe.encode_touch(touch), pipe.encode_touch(touch, strength=0.4))


def test_strength_changes_the_picture(pipe, touch):
    assert (pictures(pipe, touch, strength=0.1) - pictures(pipe, touch, strength=1.0)).abs().max() > 1e-3


def test_without_strength_all_touches_are_alike(pipe, touch):
    assert torch.equal(pictures(pipe, touch[:1], strength=0.0), pictures(pipe, touch[1:], strength=0.0))


# Sensors --------------------------------------------------------------------------------------------------------------


def test_sensors_are_retrieved_by_their_prototypes(pipe, touch):
    """One touch is dark as the prototype of GelSight, the other bright as that of DIGIT."""
    report = pipe(touch).report
    assert report.sensors == ["gelsight", "digit"]
    expected = (touch - torch.tensor([0.2, 0.8]).view(2, 1, 1, 1)).abs().mean(dim=(1, 2, 3))
    assert report.sensor_distances == pytest.approx(expected.tolist(), abs=1e-5)


@pytest.mark.parametrize(
    ("sensor", "expected"),
    [
        ("digit", ["digit", "digit"]),
        (["digit", "gelsight"], ["digit", "gelsight"]),
        ([None, "gelsight"], ["gelsight", "gelsight"]),
        ((None, None), ["gelsight", "digit"]),
    ],
)
@pytest.mark.filterwarnings("ignore::unitouch_gen.errors.UnfamiliarInputWarning")
def test_named_sensors_are_used_as_named(pipe, touch, sensor, expected):
    assert pipe(touch, sensor=sensor).report.sensors == expected


def test_naming_the_sensor_that_is_retrieved_changes_nothing(pipe, touch):
    assert torch.equal(pipe.encode_touch(touch, sensor=["gelsight", "digit"]), pipe.encode_touch(touch))


@pytest.mark.filterwarnings("ignore::unitouch_gen.errors.UnfamiliarInputWarning")
def test_the_sensor_makes_a_difference_to_the_embedding(pipe, touch):
    first, second = pipe.encode_touch(touch, sensor="gelsight"), pipe.encode_touch(touch, sensor="digit")
    assert (first - second).abs().max() > 1e-4


def test_a_model_without_sensor_tokens_reports_none(components, touch):
    config = copy.deepcopy(components["unitouch"].config)
    config.sensors = []
    components["unitouch"] = UniTouchModel(config).eval()
    report = TouchToImagePipeline(**components)(touch, num_inference_steps=2).report
    assert (report.sensors, report.sensor_distances) == ([None, None], [None, None])


@pytest.mark.filterwarnings("ignore::unitouch_gen.errors.UnfamiliarInputWarning")
def test_a_background_like_the_sensors_prototype_changes_nothing(pipe, touch):
    background = torch.full((3, 32, 32), 0.8)
    got = pipe.encode_touch(touch, sensor="digit", background=background)
    torch.testing.assert_close(got, pipe.encode_touch(touch, sensor="digit"), atol=1e-5, rtol=0)


def test_re_centring_takes_a_shift_in_brightness_away(pipe, touch):
    """Dark touches of a sensor that is brighter by 0.1 than the one they are re-centred on."""
    shifted, background = touch[:1] + 0.1, torch.full((3, 32, 32), 0.3)
    got = pipe.encode_touch(shifted, background=background)
    torch.testing.assert_close(got, pipe.encode_touch(touch[:1]), atol=1e-5, rtol=0)


# Noise on the embedding -----------------------------------------------------------------------------------------------


def test_the_noise_level_changes_the_picture(pipe, touch):
    assert (pictures(pipe, touch, noise_level=0) - pictures(pipe, touch, noise_level=999)).abs().max() > 1e-3


def test_the_checkpoint_says_the_noise_level_when_the_call_does_not(components, touch):
    pipe = TouchToImagePipeline(**components, default_num_inference_steps=2, default_noise_level=300)
    assert torch.equal(pictures(pipe, touch), pictures(pipe, touch, noise_level=300))


# Prompts --------------------------------------------------------------------------------------------------------------


def test_the_prompt_is_high_quality_when_left_out(pipe, touch):
    assert torch.equal(pictures(pipe, touch), pictures(pipe, touch, prompt="high quality"))


def test_the_prompt_changes_the_picture(pipe, touch):
    assert (pictures(pipe, touch, prompt="rough brick") - pictures(pipe, touch)).abs().max() > 1e-4


def test_prompts_go_to_their_touches(pipe, touch):
    prompts = ["rough brick", "smooth grey metal"]
    options = {"output_type": "pt", "strength": 0.5}
    together = pipe(touch, prompts, generator=[seeded(1), seeded(2)], **options).images
    alone = [pipe(touch[i], prompts[i], generator=seeded(i + 1), **options).images for i in range(2)]
    torch.testing.assert_close(together, torch.cat(alone), atol=1e-4, rtol=0)


def test_a_list_of_one_prompt_is_for_all_touches(pipe, touch):
    assert torch.equal(pictures(pipe, touch, prompt=["rough brick"]), pictures(pipe, touch, prompt="rough brick"))


def test_a_long_prompt_is_cut(pipe, touch):
    assert torch.isfinite(pictures(pipe, touch, prompt="rough brick " * 100)).all()


def test_the_negative_prompt_matters_with_guidance(pipe, touch):
    plain, negative = (pictures(pipe, touch, negative_prompt=text, guidance_scale=4.0) for text in ("", "rough brick"))
    assert (plain - negative).abs().max() > 1e-4


def test_the_negative_prompt_does_not_matter_without_guidance(pipe, touch):
    plain, negative = (pictures(pipe, touch, negative_prompt=text, guidance_scale=1.0) for text in ("", "rough brick"))
    assert torch.equal(plain, negative)


def test_the_negative_prompt_is_empty_when_left_out(pipe, touch):
    assert torch.equal(pictures(pipe, touch), pictures(pipe, touch, negative_prompt=""))


def test_a_prompt_that_is_its_own_negative_still_leaves_the_touch(pipe, touch):
    """The unconditional branch has no touch, so guidance acts on it whatever the prompts."""
    weak, strong = (
        pictures(pipe, touch, prompt="metal", negative_prompt="metal", guidance_scale=scale) for scale in (2.0, 6.0)
    )
    assert (weak - strong).abs().max() > 1e-3


@pytest.mark.parametrize("rows", [1, 2])
def test_prompt_embeddings_in_place_of_prompts_give_the_same_picture(pipe, touch, rows):
    with torch.no_grad():
        embeds, negative = pipe.encode_prompt(["rough brick"] * rows), pipe.encode_prompt(["metal"] * rows)
    got = pictures(pipe, touch, prompt_embeds=embeds, negative_prompt_embeds=negative)
    expected = pictures(pipe, touch, prompt="rough brick", negative_prompt="metal")
    torch.testing.assert_close(got, expected, atol=1e-6, rtol=0)


def test_embeddings_alone_need_no_encoders(components):
    components |= dict.fromkeys(("unitouch", "processor", "tokenizer", "text_encoder"))
    pipe = TouchToImagePipeline(**components, default_num_inference_steps=2)
    states = torch.randn(1, 12, 16, generator=seeded())
    got = pictures(pipe, touch_embeds=torch.ones(1, 16), prompt_embeds=states, negative_prompt_embeds=0 * states)
    assert torch.isfinite(got).all()


def test_without_guidance_no_negative_prompt_needs_a_text_encoder(components):
    pipe = TouchToImagePipeline(**(components | {"text_encoder": None}), default_num_inference_steps=2)
    options = {"touch_embeds": torch.ones(1, 16), "prompt_embeds": torch.zeros(1, 12, 16), "guidance_scale": 1.0}
    assert torch.equal(pictures(pipe, **options), pictures(pipe, **options, negative_prompt="metal"))


def test_a_distinct_prompt_is_encoded_once(pipe, touch):
    batches = []
    pipe.text_encoder.register_forward_hook(lambda module, args, output: batches.append(len(output[0])))
    pictures(pipe, touch, prompt="rough brick", num_images_per_prompt=2)
    assert batches == [1, 1]  # the prompt and its negative
