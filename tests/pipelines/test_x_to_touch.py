"""`XToTouchPipeline`: its conditions and its sensors."""

import numpy as np
import pytest
import torch
from diffusers import DDIMScheduler, UNet2DConditionModel
from torch.testing import assert_close

from tests.helpers.calls import quiet, seeded, shown_gels, watched
from unitouch_gen.conditioning import bridge_nearest
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.pipelines import XToTouchPipeline

NORM = 3.0


def draw(pipe: XToTouchPipeline, **inputs: object) -> torch.Tensor:
    """Latents (B, C, h, w), from one seed."""
    return pipe(**{"generator": seeded(), "output_type": "latent", **inputs}).images


@pytest.fixture
def inputs(photo, touch) -> dict:
    tone = np.sin(np.arange(4000) / 6)
    return {"image": photo[0], "text": "rough brick", "audio": (tone, 16_000), "touch": touch[0]}


@torch.no_grad()
@pytest.mark.parametrize("modality", ["image", "text", "audio", "touch"])
def test_a_condition_is_the_modalitys_embedding_at_the_norm_of_images(x_to_touch, inputs, modality):
    model = x_to_touch.unitouch
    processor = x_to_touch.processor
    given = inputs[modality]
    embeds = {
        "image": lambda: model.get_image_features(processor.images(given)),
        "text": lambda: model.get_text_features(**processor.text(given)),
        "audio": lambda: model.get_audio_features(processor.sounds(given)),
        "touch": lambda: model.get_touch_features(processor.touch(given), torch.tensor([0])),
    }[modality]()
    ran = watched(x_to_touch)
    output = x_to_touch(**{modality: given}, output_type="pt", bridge=False)
    assert_close(output.embeds, NORM * (embeds / embeds.norm(dim=1, keepdim=True))[:, None])
    assert torch.equal(x_to_touch.encode_condition(**{modality: given}, bridge=False), output.embeds)
    assert output.images.shape == (1, 3, 16, 16)
    assert {name for name, _ in ran} == {f"{modality} encoder", "UNet", "VAE decoder"}
    assert set(output.report.left_out) == {f"{name} encoder" for name in inputs if name != modality}


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
    bank = x_to_touch.embedding_bank
    text = inputs["text"]
    raw = x_to_touch.encode_condition(text=text, bridge=False)
    settings = {key: bank.config[key] for key in ("neighbours", "temperature", "share")}
    moved = bridge_nearest(raw[:, 0], bank.embeds, **settings)[:, None]
    assert_close(x_to_touch.encode_condition(text=text, bridge=True), moved)
    assert_close(x_to_touch(text=text).embeds, moved)
    assert torch.equal(*(x_to_touch.encode_condition(image=inputs["image"], bridge=one) for one in (True, False)))
    one, two = (draw(x_to_touch, condition_embeds=embeds) for embeds in (moved, 2 * moved))  # as they come
    assert_close(one, draw(x_to_touch, text=text), atol=1e-5, rtol=1e-5)
    assert not torch.allclose(one, two, atol=1e-3)
    x_to_touch.register_modules(embedding_bank=None)
    assert torch.equal(x_to_touch.encode_condition(text=text), raw)


@torch.no_grad()
def test_x_to_touch_is_ddim_written_by_hand(x_to_touch, inputs):
    """A plain transcription of guided DDIM with a zero token as the unconditional branch."""
    embeds = x_to_touch.encode_condition(text=inputs["text"])
    noise = torch.randn(1, 3, 8, 8, generator=seeded(3))
    label = torch.tensor([1])
    scheduler = DDIMScheduler.from_config(x_to_touch.scheduler.config)
    scheduler.set_timesteps(3)
    state = noise * scheduler.init_noise_sigma
    for step in scheduler.timesteps:
        free = x_to_touch.unet(state, step, torch.zeros_like(embeds), class_labels=label).sample
        held = x_to_touch.unet(state, step, embeds, class_labels=label).sample
        state = scheduler.step(free + 4.0 * (held - free), step, state).prev_sample
    options = {"sensor": "digit", "latents": noise, "num_inference_steps": 3, "guidance_scale": 4.0}
    assert_close(draw(x_to_touch, text=inputs["text"], **options), state, atol=1e-5, rtol=1e-5)


def test_each_sensor_has_its_own_image(x_to_touch):
    """The first where none is named, several of one input, and "all" of each input in turn."""
    texts = ["rough brick", "smooth metal"]
    sensors = ["gelsight", "digit"]
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


def seen_by_network(pipe: XToTouchPipeline, **inputs) -> tuple[torch.Tensor, list[int] | None]:
    """The channels behind the noise, and the class labels, of a call's first evaluation."""
    seen = []
    hook = pipe.unet.register_forward_pre_hook(
        lambda _, args, kwargs: seen.append((args[0][:, 3:], kwargs["class_labels"].tolist())), with_kwargs=True
    )
    draw(pipe, text="rough brick", guidance_scale=1.0, **inputs)
    hook.remove()
    return seen[0]


@torch.no_grad()
def test_a_sensor_is_known_by_its_name_or_by_its_background(x_to_touch, tmp_path):
    pipe = shown_gels(x_to_touch)
    beside, labels = seen_by_network(pipe, sensor=["digit", "gelsight"])
    assert labels == [1, 0]
    assert torch.equal(beside, pipe.backgrounds.latents.flip(0))
    gel = torch.rand(3, 16, 16, generator=seeded(3))
    beside, labels = seen_by_network(pipe, background=gel)
    assert labels == [2]
    assert_close(beside, pipe.vae.encode(2 * gel[None] - 1).latents * pipe.vae.config.scaling_factor)
    nameless = shown_gels(x_to_touch, sensors=())
    for given, made in (({"background": [gel] * 3}, 6), ({"background": gel, "text": ["brick", "wood"]}, 4)):
        assert len(draw(nameless, **{"text": "brick", **given}, num_images_per_prompt=2)) == made
    pipe.save_pretrained(tmp_path)
    again = quiet(XToTouchPipeline.from_pretrained(tmp_path))
    given = {"condition_embeds": pipe.encode_condition(text="brick"), "sensor": "digit"}
    assert torch.equal(draw(again, **given), draw(pipe, **given))
    assert_close(again.encode_condition(text="brick"), given["condition_embeds"], atol=1e-6, rtol=0)


def test_a_network_of_no_sensor_takes_all_and_no_name(x_to_touch):
    unet = UNet2DConditionModel.from_config(x_to_touch.unet.config, num_class_embeds=None)
    pipe = quiet(XToTouchPipeline(**{**x_to_touch.components, "unet": unet}, default_num_inference_steps=2))
    assert torch.equal(draw(pipe, text="brick", sensor="all"), draw(pipe, text="brick"))
    with pytest.raises(InvalidInputError, match="`sensor` is 'digit'"):
        pipe(text="brick", sensor="digit")
