"""`XToTouchPipeline`: its conditions, its sensors and its choice of candidates."""

import numpy as np
import pytest
import soundfile
import torch
from diffusers import DDIMScheduler, UNet2DConditionModel
from torch.testing import assert_close

from tests.helpers.calls import quiet, seeded, watched
from unitouch_gen.conditioning import SensorBackgrounds, bridge_nearest
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.pipelines import XToTouchPipeline

D, NORM = 16, 3.0


def draw(pipe: XToTouchPipeline, **inputs: object) -> torch.Tensor:
    """Latents (B, C, h, w), from one seed."""
    return pipe(**{"generator": seeded(), "output_type": "latent", **inputs}).images


@pytest.fixture
def inputs(photo, sound, touch) -> dict:
    return {"image": photo[0], "text": "rough brick", "audio": sound, "touch": touch[0]}


# Conditions -----------------------------------------------------------------------------------------------------------


@torch.no_grad()
@pytest.mark.parametrize("modality", ["image", "text", "audio", "touch"])
def test_a_condition_is_the_modalitys_embedding_at_the_norm_of_images(x_to_touch, inputs, modality):
    model, processor = x_to_touch.unitouch, x_to_touch.processor
    embeds = {
        "image": lambda: model.get_image_features(processor.images(inputs["image"])),
        "text": lambda: model.get_text_features(**processor.text(inputs["text"])),
        "audio": lambda: model.get_audio_features(processor.sounds(inputs["audio"])),
        "touch": lambda: model.get_touch_features(processor.touch(inputs["touch"]), torch.tensor([0])),
    }[modality]()
    found = x_to_touch.encode_condition(**{modality: inputs[modality]}, bridge=False)
    assert_close(found, NORM * (embeds / embeds.norm(dim=1, keepdim=True))[:, None])
    ran = watched(x_to_touch)
    output = x_to_touch(**{modality: inputs[modality]}, output_type="pt", bridge=False)
    assert output.images.shape == (1, 3, 16, 16) and torch.equal(output.embeds, found)
    assert {name for name, _ in ran} == {f"{modality} encoder", "UNet", "VAE decoder"}
    others = {f"{name} encoder" for name in inputs if name != modality}
    assert others <= set(output.report.left_out) and f"{modality} encoder" not in output.report.left_out


def test_several_modalities_are_mixed_by_weight(x_to_touch, inputs):
    both = {name: inputs[name] for name in ("image", "text")}
    parts = {name: x_to_touch.encode_condition(**{name: value}) for name, value in both.items()}
    for weights, share in (({"image": 3, "text": 1}, 0.75), (None, 0.5), ({"image": 2, "text": 2}, 0.5)):
        mixed = share * parts["image"] + (1 - share) * parts["text"]
        found = x_to_touch.encode_condition(**both, weights=weights)
        assert_close(found, NORM * mixed / mixed.norm(dim=-1, keepdim=True))
    ran = watched(x_to_touch)
    assert_close(x_to_touch.encode_condition(**both, weights={"text": 1, "image": 0}), parts["text"])
    assert [name for name, _ in ran] == ["text encoder"]
    assert len(x_to_touch.encode_condition(text=inputs["text"], audio=[inputs["audio"]] * 3)) == 3


def test_the_bridge_leads_to_the_stored_images(x_to_touch, inputs):
    """Of what is no image; where there is a bank, unless a call says otherwise."""
    bank, text, image = x_to_touch.embedding_bank, inputs["text"], inputs["image"]
    raw = x_to_touch.encode_condition(text=text, bridge=False)
    settings = {key: bank.config[key] for key in ("neighbours", "temperature", "share")}
    moved = bridge_nearest(raw[:, 0], bank.embeds, **settings)[:, None]
    for bridge in (None, True):
        assert_close(x_to_touch.encode_condition(text=text, bridge=bridge), moved)
        assert_close(x_to_touch(text=text, bridge=bridge).embeds, moved)
    photos = [x_to_touch.encode_condition(image=image, bridge=bridge) for bridge in (True, False)]
    assert torch.equal(*photos)
    x_to_touch.register_modules(embedding_bank=None)
    assert torch.equal(x_to_touch.encode_condition(text=text), raw)


def test_given_embeddings_are_taken_as_they_come(x_to_touch, inputs):
    embeds = x_to_touch.encode_condition(text=inputs["text"])
    expected = draw(x_to_touch, text=inputs["text"])
    assert torch.equal(draw(x_to_touch, condition_embeds=embeds), expected)
    assert not torch.allclose(draw(x_to_touch, condition_embeds=2 * embeds), expected, atol=1e-3)


@pytest.mark.parametrize("text", ["rauer Ziegel", "粗いレンガ", "🧱", "brick " * 10_000])
def test_any_text_that_says_something_is_taken(x_to_touch, text):
    assert torch.isfinite(x_to_touch.encode_condition(text=text)).all()


@pytest.mark.parametrize("kind", ["PCM_U8", "PCM_24", "FLOAT", "pair", "stereo", "other rate"])
def test_sounds_of_any_format_are_one_sound(x_to_touch, tmp_path, sound, kind):
    samples, rate = 0.5 * sound[0], sound[1]
    given = {"pair": (samples, rate), "stereo": (np.stack([2 * samples, 0 * samples]), rate)}.get(kind)
    if kind == "other rate":
        given = (np.repeat(samples, 3), 3 * rate)
    elif given is None:
        given = str(tmp_path / "hit.wav")
        soundfile.write(given, samples, rate, subtype=kind)
    found, expected = (x_to_touch.encode_condition(audio=one, bridge=False) for one in (given, (samples, rate)))
    assert torch.cosine_similarity(found, expected, dim=-1).item() > 0.9  # eight bits leave noise between harmonics


# Denoising and sensors ------------------------------------------------------------------------------------------------


@torch.no_grad()
def test_ddim_by_hand(x_to_touch, inputs):
    """A plain transcription of guided DDIM with a zero token as the unconditional branch."""
    embeds = x_to_touch.encode_condition(text=inputs["text"])
    noise = torch.randn(1, 3, 8, 8, generator=seeded(3))
    scheduler = DDIMScheduler.from_config(x_to_touch.scheduler.config)
    scheduler.set_timesteps(3)
    state, label = noise * scheduler.init_noise_sigma, torch.tensor([1])
    for step in scheduler.timesteps:
        free = x_to_touch.unet(state, step, torch.zeros_like(embeds), class_labels=label).sample
        held = x_to_touch.unet(state, step, embeds, class_labels=label).sample
        state = scheduler.step(free + 4.0 * (held - free), step, state).prev_sample
    options = {"sensor": "digit", "latents": noise, "num_inference_steps": 3, "guidance_scale": 4.0}
    assert_close(draw(x_to_touch, text=inputs["text"], **options), state, atol=1e-5, rtol=1e-5)


def test_each_sensor_has_its_own_image(x_to_touch):
    """The first where none is named, several of one input, and "all" of each input in turn."""
    texts, sensors = ["rough brick", "smooth metal"], ["gelsight", "digit"]
    noise = torch.randn(4, 3, 8, 8, generator=seeded())
    pairs = [(text, sensor) for text in texts for sensor in sensors]
    each = [draw(x_to_touch, text=t, sensor=s, latents=noise[[row]]) for row, (t, s) in enumerate(pairs)]
    assert not torch.allclose(each[0], draw(x_to_touch, text=texts[0], sensor="digit", latents=noise[:1]), atol=1e-3)
    assert torch.equal(each[0], draw(x_to_touch, text=texts[0], latents=noise[:1]))
    found = draw(x_to_touch, text=texts[0], sensor=sensors, latents=noise[:2])
    assert_close(found, torch.cat(each[:2]), atol=1e-5, rtol=1e-5)
    output = x_to_touch(text=texts, sensor="all", latents=noise, output_type="latent")
    assert_close(output.images, torch.cat(each), atol=1e-5, rtol=1e-5)
    assert len(output.embeds) == 4


def test_all_is_the_only_sensor_of_a_model_that_names_none(x_components):
    config = {**x_components["unet"].config, "num_class_embeds": None, "class_embed_type": None}
    pipe = quiet(XToTouchPipeline(**{**x_components, "unet": UNet2DConditionModel.from_config(config)}))
    assert torch.equal(*(draw(pipe, text="brick", sensor=sensor) for sensor in ("all", None)))
    with pytest.raises(InvalidInputError, match="`sensor` is 'digit'"):
        pipe(text="brick", sensor="digit")


# Sensors by what they see untouched -----------------------------------------------------------------------------------


def shown_gels(pipe: XToTouchPipeline, sensors: tuple[str, ...] = ("gelsight", "digit"), **parts) -> XToTouchPipeline:
    """A pipeline of the same parts whose network is shown untouched gels."""
    torch.manual_seed(2)
    labels = len(sensors) + 1 if sensors else None
    unet = UNet2DConditionModel.from_config(pipe.unet.config, in_channels=6, num_class_embeds=labels).eval()
    stored = SensorBackgrounds.of(torch.randn(len(sensors), 3, 8, 8)) if sensors else None
    return quiet(XToTouchPipeline(**{**pipe.components, "unet": unet, "backgrounds": stored, **parts}, sensors=sensors))


def seen_by_network(pipe: XToTouchPipeline, **inputs) -> tuple[torch.Tensor, torch.Tensor | None]:
    """The channels behind the noise, and the class labels, of a call's first evaluation."""
    seen = []
    hook = pipe.unet.register_forward_pre_hook(
        lambda _, args, kwargs: seen.append((args[0][:, 3:], kwargs["class_labels"])), with_kwargs=True
    )
    draw(pipe, text="rough brick", num_inference_steps=2, guidance_scale=1.0, **inputs)
    hook.remove()
    return seen[0]


@torch.no_grad()
def test_a_sensor_is_known_by_its_name_or_by_its_background(x_to_touch, tmp_path):
    pipe = shown_gels(x_to_touch)
    beside, labels = seen_by_network(pipe, sensor=["digit", "gelsight"])
    assert labels.tolist() == [1, 0] and torch.equal(beside, pipe.backgrounds.latents.flip(0))
    gel = torch.rand(3, 16, 16, generator=seeded(3))
    beside, labels = seen_by_network(pipe, background=gel)
    expected = pipe.vae.encode(2 * gel[None] - 1).latents * pipe.vae.config.scaling_factor
    assert labels.tolist() == [2]
    assert_close(beside, expected)
    pipe.save_pretrained(tmp_path)
    again = quiet(XToTouchPipeline.from_pretrained(tmp_path))
    assert torch.equal(draw(again, text="brick", sensor="digit"), draw(pipe, text="brick", sensor="digit"))


def test_one_input_is_drawn_for_several_backgrounds(x_to_touch):
    pipe, gels = shown_gels(x_to_touch, sensors=()), torch.rand(3, 3, 16, 16)
    assert len(draw(pipe, text="brick", background=list(gels), num_images_per_prompt=2)) == 6
    assert len(draw(pipe, text=["brick", "wood"], background=gels[0], num_images_per_prompt=2)) == 4


def test_backgrounds_that_cannot_be_drawn_for_are_refused(x_to_touch):
    gel = torch.zeros(3, 16, 16)
    for sensors, options in (
        (("gelsight",), {"background": gel, "sensor": "gelsight"}),
        (("gelsight",), {"background": gel.expand(3, -1, -1, -1), "text": ["a", "b"]}),
        ((), {}),
    ):
        with pytest.raises(InvalidInputError, match="`background`"):
            shown_gels(x_to_touch, sensors)(**{"text": "brick", **options})
    with pytest.raises(InvalidInputError, match="`backgrounds` is None"):
        shown_gels(x_to_touch, backgrounds=None)
    unet = UNet2DConditionModel.from_config(x_to_touch.unet.config, in_channels=6)
    with pytest.raises(InvalidInputError, match="`sensors` names 2"):
        XToTouchPipeline(**{**x_to_touch.components, "unet": unet}, sensors=["gelsight", "digit"])


# Candidates -----------------------------------------------------------------------------------------------------------


@torch.no_grad()
def test_the_candidate_nearest_to_the_condition_is_chosen(x_to_touch):
    embeds = x_to_touch.encode_condition(text=["rough brick", "smooth metal"])
    noise = torch.randn(6, 3, 8, 8, generator=seeded(4))
    each = embeds.repeat_interleave(3, dim=0)
    every = x_to_touch(condition_embeds=each, latents=noise, sensor="digit", output_type="pt").images
    values = x_to_touch.processor.touch(every)
    features = x_to_touch.unitouch.get_touch_features(values, torch.ones(6, dtype=torch.long))
    scores = torch.cosine_similarity(features, each[:, 0], dim=1).view(2, 3)
    output = x_to_touch(condition_embeds=embeds, latents=noise, num_candidates=3, sensor="digit", output_type="pt")
    best = scores.argmax(dim=1) + torch.tensor([0, 3])
    assert_close(output.images, every[best])
    assert output.report.chosen == best.tolist()
    assert output.report.scores == pytest.approx(scores.max(dim=1).values.tolist(), abs=1e-4)


def test_candidates_of_each_image_asked_for(x_to_touch):
    options = {"text": ["rough brick", "smooth metal"], "num_candidates": 3}
    assert draw(x_to_touch, **options, num_images_per_prompt=2).shape == (4, 3, 8, 8)
    broken = lambda pipe, step, timestep, tensors: {"latents": tensors["latents"] * float("nan")}  # noqa: E731
    output = x_to_touch(**options, callback_on_step_end=broken, throw=False)
    assert output.images == [] and output.report.chosen == []
