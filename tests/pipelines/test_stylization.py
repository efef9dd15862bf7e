"""`TactileStylizationPipeline`: the mix, its ends, and starting from the photo."""

import pytest
import torch
from torch.testing import assert_close

from tests.helpers.calls import diffusers_pipeline, quiet, seeded, watched
from tests.helpers.exact import ExactUNet
from unitouch_gen.arguments import SamplingArguments
from unitouch_gen.conditioning import EmbeddingBank
from unitouch_gen.models.autoencoders import encode
from unitouch_gen.numerics.problems import Problem, gaussian, relative_rms
from unitouch_gen.pipelines import TactileStylizationPipeline, TouchToImagePipeline
from unitouch_gen.sampling import prepare_steps

NORM = 3.0


def pictures(pipe, *args, **options) -> torch.Tensor:
    return pipe(*args, **{"generator": seeded(), "output_type": "pt", **options}).images


def mixed(pipe, *args, **options) -> torch.Tensor:
    return pipe(*args, layout=None, **options).embeds


@pytest.fixture
def embeds(stylize, photo, touch) -> dict[str, torch.Tensor]:
    """Embeddings of both modalities, at the norm of images, (2, D) each."""
    with torch.no_grad():
        image = stylize.unitouch.get_image_features(stylize.processor.images(photo))
    return {"image": NORM * image / image.norm(dim=1, keepdim=True), "touch": stylize.encode_touch(touch, strength=1.0)}


def test_mixes_are_their_closed_forms(stylize, photo, touch, embeds):
    one = embeds["touch"]
    other = embeds["image"]
    paper = 0.3 * one + 0.7 * other
    expected = {"paper": paper, "linear": NORM * paper / paper.norm(dim=1, keepdim=True)}
    for mix, embedding in expected.items():
        assert_close(mixed(stylize, photo, touch, mix=mix, strength=0.5), 0.5 * embedding)
    found = mixed(stylize, photo, touch, touch_weight=6, image_weight=14)  # brought to a sum of 1
    assert_close(found, expected["linear"])


def test_one_photo_or_touch_goes_with_all_of_the_other(stylize, photo, touch):
    for photos, touches in ((1, 2), (2, 1), (1, 1)):
        assert len(pictures(stylize, photo[:photos], touch[:touches])) == max(photos, touches)


def test_touches_are_moved_towards_pictures_before_they_are_mixed(stylize, photo, touch, embeds):
    bank = EmbeddingBank.of(torch.randn(20, stylize.embedding_dim, generator=seeded(1)))
    plain = mixed(stylize, photo, touch, mix="paper")
    stylize.register_modules(embedding_bank=bank)
    moved = mixed(stylize, photo, touch, mix="paper")
    assert_close(moved - plain, 0.3 * (bank.bridge(embeds["touch"]) - embeds["touch"]))
    assert torch.equal(mixed(stylize, photo, touch, mix="paper", bridge=False), plain)


def test_touch_alone_is_touch_to_image(stylize, components, photo, touch):
    plain = quiet(TouchToImagePipeline(**components, default_num_inference_steps=2, default_guidance_scale=2.0))
    ran = watched(stylize)
    found = pictures(stylize, photo, touch, touch_weight=1, layout=None)
    assert "image encoder" not in dict(ran)
    assert_close(found, pictures(plain, touch, strength=1.0), atol=1e-6, rtol=0)


def test_a_photo_alone_is_diffusers_image_variation(stylize, components, photo, touch, embeds):
    options = {"image_embeds": embeds["image"][:1], "prompt": "high quality", "height": 16, "width": 16}
    expected = pictures(diffusers_pipeline(components), **options, num_inference_steps=2, guidance_scale=2.0)
    ran = watched(stylize)
    output = stylize(photo[:1], touch[:1], touch_weight=0, layout=None, generator=seeded(), output_type="pt")
    assert "touch encoder" not in dict(ran)
    assert "touch encoder" in output.report.left_out
    assert_close(output.images, expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("how", [{"solver": "ddim"}, {"solver": "heun"}, {"tolerance": 0.1}])
def test_a_layout_as_fine_as_the_latents_is_the_photo(stylize, photo, touch, how):
    """D' is the photo itself, whatever the network predicts; without the colours all but each channel's mean."""
    small = photo[:, :, :16, :16]
    options = {"guidance_scale": 3.0, "output_type": "latent", **how}
    with torch.no_grad():
        latents = encode(stylize.vae, 2 * small - 1)
    assert_close(pictures(stylize, small, touch, layout=100, keep_colours=True, **options), latents, atol=1e-3, rtol=0)
    apart = pictures(stylize, small, touch, layout=100, **options) - latents
    assert_close(apart, apart.mean(dim=(2, 3), keepdim=True).expand_as(apart), atol=1e-3, rtol=0)
    free = pictures(stylize, small, touch, layout=2, **options)
    assert (free - latents).std() > 0.05


def test_little_init_strength_keeps_the_photo(stylize, photo, touch):
    small = photo[:1, :, :16, :16]
    with torch.no_grad():
        shown = encode(stylize.vae, 2 * small - 1)
    for options in ({"num_inference_steps": 20}, {"tolerance": 0.1}):
        near, far = (
            pictures(stylize, small, touch[:1], init_strength=share, layout=None, output_type="latent", **options)
            for share in (0.01, 1.0)
        )
        assert (near - shown).abs().mean() < 0.05 * (far - shown).abs().mean()


@pytest.mark.parametrize("solver", [None, "ddim", "dpm++2m", "unipc"])
def test_from_a_photos_latents_the_exact_flow_goes_on_where_they_lie(components, photo, touch, solver):
    """Of Gaussian data of known variances v, x - m goes as sqrt(v + sigma^2)."""
    problem = Problem("pixels", gaussian(0.01, 64, mean=0.0))
    components |= {"unet": ExactUNet.of(problem), "scheduler": problem.scheduler()}
    pipe = quiet(TactileStylizationPipeline(**components, default_guidance_scale=1.0))
    small = photo[:1, :, :8, :8]
    noise = torch.randn(1, 4, 4, 4, generator=seeded(2))
    options = {"layout": None, "num_inference_steps": 60, "init_strength": 0.5, "output_type": "latent"}
    found = pictures(pipe, small, touch[:1], latents=noise, solver=solver, **options)
    with torch.no_grad():
        init = encode(pipe.vae, 2 * small - 1)
    arguments = SamplingArguments(solver=solver, num_inference_steps=60, init_strength=0.5)
    steps, _ = prepare_steps(pipe.scheduler, arguments)
    sigma = problem.schedule.sigma(steps.timesteps[0]).item() if solver is None else steps[0]
    variances = problem.data.variances[0].view(1, 4, 4, 4)
    exact = (variances / (variances + sigma**2)).sqrt() * (init + sigma * noise)
    assert relative_rms(found, exact).max() < (0.25 if solver in (None, "ddim") else 0.03)


def test_init_strength_is_the_share_of_steps_that_are_made(stylize, photo, touch):
    """As a callback is told, too; a photo of another size is cut to the picture."""
    seen = []
    options = {"init_strength": 0.4, "layout": None, "num_inference_steps": 10, "height": 32, "width": 16}
    note = lambda pipe, step, *_: seen.append((step, pipe.num_timesteps))  # noqa: E731
    output = stylize(photo, touch, callback_on_step_end=note, output_type="pt", **options)
    assert (output.report.steps, output.report.evaluations) == (4, 4)
    assert seen == [(step, 4) for step in range(4)]
    assert output.images.shape == (2, 3, 32, 16)
