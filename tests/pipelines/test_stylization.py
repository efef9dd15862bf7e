"""`TactileStylizationPipeline`: the mix, its ends, and starting from the photo."""

import pytest
import torch
from diffusers import StableUnCLIPImg2ImgPipeline
from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection

from unitouch_gen.conditioning import EmbeddingBank
from unitouch_gen.pipelines import TouchToImagePipeline

NORM = 3.0


def pictures(pipe, *args, seed: int = 0, **options) -> torch.Tensor:
    return pipe(*args, generator=torch.Generator().manual_seed(seed), output_type="pt", **options).images


@pytest.fixture
def embeds(stylize, photo, touch) -> dict[str, torch.Tensor]:
    """Embeddings of both modalities, at the norm of images, (2, D) each."""
    model, processor = stylize.unitouch, stylize.processor
    with torch.no_grad():
        found = {
            "image": model.get_image_features(processor.images(photo)),
            "touch": stylize.encode_touch(touch, strength=1.0),
        }
    return {modality: NORM * values / values.norm(dim=1, keepdim=True) for modality, values in found.items()}


# The mix --------------------------------------------------------------------------------------------------------------


def test_the_papers_mix(stylize, photo, touch, embeds):
    expected = 0.3 * embeds["touch"] + 0.7 * embeds["image"]
    torch.testing.assert_close(stylize.encode_mix(photo, touch, mix="paper"), expected)


def test_a_mix_has_the_norm_of_images_and_the_direction_of_the_papers(stylize, photo, touch):
    mixed, papers = stylize.encode_mix(photo, touch), stylize.encode_mix(photo, touch, mix="paper")
    torch.testing.assert_close(mixed.norm(dim=1), torch.full((2,), NORM))
    torch.testing.assert_close(mixed, NORM * papers / papers.norm(dim=1, keepdim=True))


def test_weights_are_brought_to_a_sum_of_one(stylize, photo, touch):
    found = stylize.encode_mix(photo, touch, touch_weight=6, image_weight=14)
    torch.testing.assert_close(found, stylize.encode_mix(photo, touch))


def test_touches_are_moved_towards_pictures_before_they_are_mixed(stylize, photo, touch, embeds):
    bank = EmbeddingBank.of(torch.randn(20, stylize.embedding_dim, generator=torch.Generator().manual_seed(1)))
    plain = stylize.encode_mix(photo, touch, mix="paper")
    stylize.register_modules(embedding_bank=bank)
    moved = stylize.encode_mix(photo, touch, mix="paper")
    torch.testing.assert_close(moved - plain, 0.3 * (bank.bridge(embeds["touch"]) - embeds["touch"]))
    assert torch.equal(stylize.encode_mix(photo, touch, mix="paper", bridge=False), plain)


def test_slerp_is_the_closed_form(stylize, photo, touch, embeds):
    one, other = embeds["touch"], embeds["image"]
    angle = torch.arccos((one * other).sum(dim=1, keepdim=True) / NORM**2)
    expected = (torch.sin(0.3 * angle) * one + torch.sin(0.7 * angle) * other) / torch.sin(angle)
    torch.testing.assert_close(stylize.encode_mix(photo, touch, mix="slerp"), expected)


def test_strength_is_a_gain(stylize, photo, touch):
    mix = stylize.encode_mix(photo, touch)
    torch.testing.assert_close(stylize.encode_mix(photo, touch, strength=0.5), 0.5 * mix)


def test_several_touches_go_into_one_picture_by_a_list_of_weights(stylize, photo, touch, embeds):
    found = stylize.encode_mix(photo[:1], touch, touch_weight=[0.2, 0.1], mix="paper")
    expected = 0.2 * embeds["touch"][:1] + 0.1 * embeds["touch"][1:] + 0.7 * embeds["image"][:1]
    torch.testing.assert_close(found, expected)


def test_several_photos_go_into_one_picture_too(stylize, photo, touch, embeds):
    found = stylize.encode_mix(photo, touch[:1], touch_weight=0.4, image_weight=[0.5, 0.1], mix="paper")
    expected = 0.4 * embeds["touch"][:1] + 0.5 * embeds["image"][:1] + 0.1 * embeds["image"][1:]
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize(("photos", "touches", "count"), [(1, 2, 2), (2, 1, 2), (2, 2, 2), (1, 1, 1)])
def test_one_of_either_goes_with_all_of_the_other(stylize, photo, touch, photos, touches, count):
    assert len(stylize.encode_mix(photo[:photos], touch[:touches])) == count


# Its ends -------------------------------------------------------------------------------------------------------------


def test_touch_alone_is_touch_to_image(stylize, components, photo, touch):
    plain = TouchToImagePipeline(**components, default_num_inference_steps=2, default_guidance_scale=2.0)
    plain.set_progress_bar_config(disable=True)
    expected = pictures(plain, touch, strength=1.0)
    found = pictures(stylize, photo, touch, touch_weight=1, image_weight=0, init_strength=1.0)
    torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)


def test_a_photo_alone_is_diffusers_image_variation(stylize, components, photo, touch, embeds):
    """`StableUnCLIPImg2ImgPipeline` on the photo's embedding at the norm of images."""
    shared = {key: value for key, value in components.items() if key not in ("unitouch", "processor")}
    config = CLIPVisionConfig(
        hidden_size=16, intermediate_size=32, num_hidden_layers=1, num_attention_heads=2, image_size=32, patch_size=8
    )
    unused = CLIPVisionModelWithProjection(config)  # it may not be left out, though embeddings are passed
    theirs = StableUnCLIPImg2ImgPipeline(**shared, feature_extractor=None, image_encoder=unused)
    theirs.set_progress_bar_config(disable=True)
    options = {"num_inference_steps": 2, "guidance_scale": 2.0, "generator": torch.Generator().manual_seed(0)}
    expected = theirs(
        prompt="high quality", image_embeds=embeds["image"][:1], height=16, width=16, output_type="pt", **options
    ).images
    found = pictures(stylize, photo[:1], touch[:1], touch_weight=0, init_strength=1.0)
    torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)


def test_what_weighs_nothing_is_not_encoded(stylize, photo, touch):
    stylize.unitouch.touch_model.register_forward_pre_hook(lambda *_: pytest.fail("the touch encoder ran"))
    pictures(stylize, photo, touch, touch_weight=0)


# The photo's layout ---------------------------------------------------------------------------------------------------


def test_little_init_strength_keeps_the_photo(stylize, photo, touch):
    with torch.no_grad():
        latents = stylize.vae.encode(2 * photo[:1, :, :16, :16] - 1).latent_dist.mode()
        shown = (stylize.vae.decode(latents).sample / 2 + 0.5).clamp(0, 1)
    small = photo[:1, :, :16, :16]
    near = pictures(stylize, small, touch[:1], init_strength=0.05, num_inference_steps=20)
    far = pictures(stylize, small, touch[:1], init_strength=1.0, num_inference_steps=20)
    assert (near - shown).abs().mean() < 0.6 * (far - shown).abs().mean()


def test_init_strength_is_the_share_of_steps_that_are_made(stylize, photo, touch):
    report = stylize(photo, touch, init_strength=0.4, num_inference_steps=10).report
    assert (report.steps, report.evaluations) == (4, 4)


def test_a_photo_of_another_size_is_cut_to_the_picture(stylize, photo, touch):
    made = pictures(stylize, photo, touch, init_strength=0.5, height=32, width=16)
    assert made.shape == (2, 3, 32, 16)


def test_a_callback_is_told_of_the_steps_that_are_left(stylize, photo, touch):
    """From the photo's latents, half of the way is half of the steps."""
    seen = []

    def note(pipeline, step, timestep, tensors):
        seen.append((step, pipeline.num_timesteps))

    stylize(photo[:1], touch[:1], init_strength=0.5, num_inference_steps=6, callback_on_step_end=note)
    assert seen == [(step, 3) for step in range(3)]
