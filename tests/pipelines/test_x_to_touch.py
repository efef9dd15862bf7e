"""`XToTouchPipeline`: its conditions, its sensors and its choice of candidates."""

import pytest
import torch
from diffusers import DDIMScheduler, UNet2DConditionModel

from unitouch_gen.conditioning import SensorBackgrounds, bridge_nearest
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.pipelines import XToTouchPipeline
from unitouch_gen.sampling import Guidance

D, NORM = 16, 3.0


def images(pipe: XToTouchPipeline, seed: int = 0, **inputs: object) -> torch.Tensor:
    """(B, 3, H, W), from one seed."""
    return pipe(generator=torch.Generator().manual_seed(seed), output_type="pt", **inputs).images


@pytest.fixture
def inputs(photo, sound, touch) -> dict:
    return {"image": photo[0], "text": "rough brick", "audio": sound, "touch": touch[0]}


# Conditions -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("modality", ["image", "text", "audio", "touch"])
def test_every_modality_gives_a_touch_image(x_to_touch, inputs, modality):
    made = images(x_to_touch, **{modality: inputs[modality]})
    assert made.shape == (1, 3, 16, 16) and bool(torch.isfinite(made).all())


@torch.no_grad()
def test_a_condition_is_the_modalities_embedding_at_the_norm_of_images(x_to_touch, inputs):
    model, processor = x_to_touch.unitouch, x_to_touch.processor
    expected = {
        "image": model.get_image_features(processor.images(inputs["image"])),
        "text": model.get_text_features(**processor.text(inputs["text"])),
        "audio": model.get_audio_features(processor.sounds(inputs["audio"])),
        "touch": model.get_touch_features(processor.touch(inputs["touch"]), torch.tensor([0])),
    }
    for modality, embeds in expected.items():
        found = x_to_touch.encode_condition(**{modality: inputs[modality]}, bridge=False)
        assert found.shape == (1, 1, D)
        torch.testing.assert_close(found[:, 0], NORM * embeds / embeds.norm(dim=1, keepdim=True))


def test_several_modalities_are_mixed_by_weight(x_to_touch, inputs):
    parts = {modality: x_to_touch.encode_condition(**{modality: inputs[modality]}) for modality in ("image", "text")}
    found = x_to_touch.encode_condition(image=inputs["image"], text=inputs["text"], weights={"image": 3, "text": 1})
    mixed = 0.75 * parts["image"] + 0.25 * parts["text"]
    torch.testing.assert_close(found, NORM * mixed / mixed.norm(dim=-1, keepdim=True))


def test_modalities_weigh_the_same_unless_told(x_to_touch, inputs):
    both = {"image": inputs["image"], "text": inputs["text"]}
    torch.testing.assert_close(
        x_to_touch.encode_condition(**both), x_to_touch.encode_condition(**both, weights={"image": 2, "text": 2})
    )


def test_a_modality_that_weighs_nothing_is_left_out(x_to_touch, inputs):
    x_to_touch.unitouch.vision_model.register_forward_pre_hook(lambda *_: pytest.fail("the image encoder ran"))
    both = {"image": inputs["image"], "text": inputs["text"]}
    found = x_to_touch.encode_condition(**both, weights={"text": 1, "image": 0})
    torch.testing.assert_close(found, x_to_touch.encode_condition(text=inputs["text"]))


def test_the_bridge_leads_to_the_stored_images(x_to_touch, inputs):
    raw = x_to_touch.encode_condition(text=inputs["text"], bridge=False)[:, 0]
    bank = x_to_touch.embedding_bank
    settings = {key: bank.config[key] for key in ("neighbours", "temperature", "share")}
    found = x_to_touch.encode_condition(text=inputs["text"])[:, 0]
    torch.testing.assert_close(found, bridge_nearest(raw, bank.embeds, **settings))


@pytest.mark.parametrize("banked", [True, False])
def test_a_bank_is_a_bridge_unless_a_call_says_otherwise(x_to_touch, inputs, banked):
    if not banked:
        x_to_touch.register_modules(embedding_bank=None)
    found, expected = (x_to_touch(text=inputs["text"], bridge=bridge).embeds for bridge in (None, banked))
    assert torch.equal(found, expected)
    assert torch.equal(x_to_touch.encode_condition(text=inputs["text"]), expected)
    if banked:
        assert not torch.equal(x_to_touch.encode_condition(text=inputs["text"], bridge=False), expected)


def test_pictures_need_no_bank_for_their_bridge(x_to_touch, inputs):
    x_to_touch.register_modules(embedding_bank=None)
    found, expected = (images(x_to_touch, image=inputs["image"], bridge=bridge) for bridge in (True, False))
    assert torch.equal(found, expected)


def test_an_embedding_that_is_not_finite_is_bridged_to_none(x_to_touch):
    embeds = torch.stack([torch.ones(D), torch.full((D,), float("nan")), torch.arange(D) - 3.0])
    found = x_to_touch._towards_pictures(embeds, True)
    assert found[1].isnan().all()
    torch.testing.assert_close(found[[0, 2]], x_to_touch.embedding_bank.bridge(embeds[[0, 2]]))


def test_pictures_need_no_bridge(x_to_touch, inputs):
    torch.testing.assert_close(
        x_to_touch.encode_condition(image=inputs["image"], bridge=True),
        x_to_touch.encode_condition(image=inputs["image"], bridge=False),
    )


def test_given_embeddings_are_taken_as_they_come(x_to_touch, inputs):
    embeds = x_to_touch.encode_condition(text=inputs["text"])
    assert torch.equal(images(x_to_touch, condition_embeds=embeds), images(x_to_touch, text=inputs["text"]))
    assert not torch.equal(images(x_to_touch, condition_embeds=2 * embeds), images(x_to_touch, text=inputs["text"]))


def test_the_output_holds_the_condition(x_to_touch, inputs):
    output = x_to_touch(text=inputs["text"])
    assert torch.equal(output.embeds, x_to_touch.encode_condition(text=inputs["text"]))


def test_one_description_goes_with_many_sounds(x_to_touch, inputs, sound):
    assert images(x_to_touch, text="rough brick", audio=[sound] * 3).shape[0] == 3


# Sampling -------------------------------------------------------------------------------------------------------------


@torch.no_grad()
def test_ddim_by_hand(x_to_touch, inputs):
    """A plain transcription of guided DDIM with a zero token as the unconditional branch."""
    embeds = x_to_touch.encode_condition(text=inputs["text"])
    noise = torch.randn(1, 3, 8, 8, generator=torch.Generator().manual_seed(3))
    scheduler = DDIMScheduler.from_config(x_to_touch.scheduler.config)
    scheduler.set_timesteps(3)
    state, label = noise * scheduler.init_noise_sigma, torch.tensor([1])
    for step in scheduler.timesteps:
        free = x_to_touch.unet(state, step, torch.zeros_like(embeds), class_labels=label).sample
        held = x_to_touch.unet(state, step, embeds, class_labels=label).sample
        state = scheduler.step(free + 4.0 * (held - free), step, state).prev_sample
    found = x_to_touch(
        text=inputs["text"], sensor="digit", latents=noise, num_inference_steps=3, guidance_scale=4.0,
        output_type="latent",
    ).images  # fmt: skip
    torch.testing.assert_close(found, state, atol=1e-5, rtol=1e-5)


def test_without_guidance_there_is_no_second_branch(x_to_touch, inputs):
    report = x_to_touch(text=inputs["text"], guidance_scale=1.0).report
    assert "unconditional branch" in report.left_out and not Guidance(1.0).active


def test_each_sensor_has_its_own_image(x_to_touch, inputs):
    one, other = (images(x_to_touch, text=inputs["text"], sensor=name) for name in ("gelsight", "digit"))
    assert not torch.equal(one, other)
    noise = torch.randn(1, 3, 8, 8, generator=torch.Generator().manual_seed(0)).expand(2, -1, -1, -1)
    made = images(x_to_touch, text=inputs["text"], sensor=["gelsight", "digit"], latents=noise)
    torch.testing.assert_close(made, torch.cat([one, other]))


def test_all_sensors_draw_each_input_in_turn(x_to_touch):
    texts, sensors = ["rough brick", "smooth metal"], ["gelsight", "digit"]
    noise = torch.randn(4, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    output = x_to_touch(text=texts, sensor="all", latents=noise, output_type="pt")
    each = [
        images(x_to_touch, text=text, sensor=sensor, latents=noise[[row]])
        for row, (text, sensor) in enumerate((text, sensor) for text in texts for sensor in sensors)
    ]
    torch.testing.assert_close(output.images, torch.cat(each))
    assert len(output.embeds) == 4


def test_all_is_the_only_sensor_of_a_model_that_names_none(x_components, inputs):
    config = {**x_components["unet"].config, "num_class_embeds": None, "class_embed_type": None}
    unet = type(x_components["unet"]).from_config(config)
    pipe = XToTouchPipeline(**{**x_components, "unet": unet})
    pipe.set_progress_bar_config(disable=True)
    assert torch.equal(*(images(pipe, text=inputs["text"], sensor=sensor) for sensor in ("all", None)))


def test_the_first_sensor_is_drawn_unless_told(x_to_touch, inputs):
    text = inputs["text"]
    assert torch.equal(images(x_to_touch, text=text), images(x_to_touch, text=text, sensor="gelsight"))


def test_only_the_modalities_that_came_are_encoded(x_to_touch, inputs):
    report = x_to_touch(text=inputs["text"]).report
    assert {"image encoder", "audio encoder", "touch encoder"} <= set(report.left_out)
    assert "text encoder" not in report.left_out


# Candidates -----------------------------------------------------------------------------------------------------------


@torch.no_grad()
def test_the_candidate_nearest_to_the_condition_is_chosen(x_to_touch, inputs):
    embeds = x_to_touch.encode_condition(text=["rough brick", "smooth metal"])
    noise = torch.randn(6, 3, 8, 8, generator=torch.Generator().manual_seed(4))
    each = embeds.repeat_interleave(3, dim=0)
    every = images(x_to_touch, condition_embeds=each, latents=noise, sensor="digit")
    features = x_to_touch.unitouch.get_touch_features(
        x_to_touch.processor.touch(every), torch.ones(6, dtype=torch.long)
    )
    scores = torch.cosine_similarity(features, each[:, 0], dim=1).view(2, 3)
    output = x_to_touch(condition_embeds=embeds, latents=noise, num_candidates=3, sensor="digit", output_type="pt")
    best = scores.argmax(dim=1) + torch.tensor([0, 3])
    torch.testing.assert_close(output.images, every[best])
    assert output.report.chosen == best.tolist()
    assert output.report.scores == pytest.approx(scores.max(dim=1).values.tolist(), abs=1e-4)


def test_candidates_of_each_image_asked_for(x_to_touch, inputs):
    made = images(x_to_touch, text=["rough brick", "smooth metal"], num_images_per_prompt=2, num_candidates=3)
    assert made.shape[0] == 4


def test_latents_of_the_chosen_candidates(x_to_touch, inputs):
    options = {"text": inputs["text"], "num_candidates": 3}
    chosen = x_to_touch(**options, generator=torch.Generator().manual_seed(0), output_type="latent").images
    assert chosen.shape == (1, 3, 8, 8)


# On disk --------------------------------------------------------------------------------------------------------------


def test_a_saved_pipeline_makes_the_same_image(x_to_touch, inputs, tmp_path):
    x_to_touch.save_pretrained(tmp_path)
    again = XToTouchPipeline.from_pretrained(tmp_path)
    options = {"text": inputs["text"], "sensor": "digit"}
    assert torch.equal(images(again, **options), images(x_to_touch, **options))
    assert again.config.sensors == ["gelsight", "digit"]


# Sensors by what they see untouched -----------------------------------------------------------------------------------


def shown_gels(pipe: XToTouchPipeline, sensors: tuple[str, ...] = ("gelsight", "digit"), **parts) -> XToTouchPipeline:
    """A pipeline of the same parts whose network is shown untouched gels."""
    torch.manual_seed(2)
    labels = len(sensors) + 1 if sensors else None
    unet = UNet2DConditionModel.from_config(pipe.unet.config, in_channels=6, num_class_embeds=labels).eval()
    stored = SensorBackgrounds.of(torch.randn(len(sensors), 3, 8, 8)) if sensors else None
    made = XToTouchPipeline(**{**pipe.components, "unet": unet, "backgrounds": stored, **parts}, sensors=sensors)
    made.set_progress_bar_config(disable=True)
    return made


def what_the_network_saw(pipe: XToTouchPipeline, **inputs) -> tuple[torch.Tensor, torch.Tensor | None]:
    """The channels behind the noise, and the class labels, of a call's first evaluation."""
    seen = []
    hook = pipe.unet.register_forward_pre_hook(
        lambda _, args, kwargs: seen.append((args[0][:, 3:], kwargs["class_labels"])), with_kwargs=True
    )
    images(pipe, text="rough brick", num_inference_steps=2, guidance_scale=1.0, **inputs)
    hook.remove()
    return seen[0]


def test_a_sensor_with_a_name_has_its_own_background(x_to_touch):
    pipe = shown_gels(x_to_touch)
    beside, labels = what_the_network_saw(pipe, sensor=["digit", "gelsight"])
    assert labels.tolist() == [1, 0]
    assert torch.equal(beside, pipe.backgrounds.latents.flip(0))


@torch.no_grad()
def test_a_sensor_without_a_name_is_known_by_its_background(x_to_touch, photo):
    pipe = shown_gels(x_to_touch)
    gel = torch.rand(3, 16, 16, generator=torch.Generator().manual_seed(3))
    beside, labels = what_the_network_saw(pipe, background=gel)
    assert labels.tolist() == [2]
    expected = pipe.vae.encode(2 * gel[None] - 1).latents * pipe.vae.config.scaling_factor
    torch.testing.assert_close(beside, expected)
    assert not torch.equal(images(pipe, text="brick", background=gel), images(pipe, text="brick", background=1 - gel))


def test_one_input_is_drawn_for_several_backgrounds(x_to_touch):
    pipe, gels = shown_gels(x_to_touch, sensors=()), torch.rand(3, 3, 16, 16)
    assert images(pipe, text="brick", background=list(gels)).shape == (3, 3, 16, 16)
    assert images(pipe, text=["brick", "wood"], background=gels[0]).shape == (2, 3, 16, 16)


def test_a_pipeline_with_backgrounds_is_read_back(x_to_touch, tmp_path):
    pipe = shown_gels(x_to_touch)
    pipe.save_pretrained(tmp_path / "pipe")
    found = XToTouchPipeline.from_pretrained(tmp_path / "pipe")
    found.set_progress_bar_config(disable=True)
    assert torch.equal(images(found, text="brick", sensor="digit"), images(pipe, text="brick", sensor="digit"))


@pytest.mark.parametrize(
    ("sensors", "inputs", "message"),
    [
        (None, {"background": torch.zeros(3, 16, 16)}, "is shown none, and draws no other sensors than .*'digit'"),
        (
            ("gelsight",),
            {"background": torch.zeros(3, 16, 16), "sensor": "gelsight"},
            "a sensor with a name has its own",
        ),
        (("gelsight",), {"background": torch.zeros(3, 3, 16, 16), "text": ["a", "b"]}, "holds 3 images for 2 inputs"),
        ((), {}, "`background` is missing: this model knows no sensor by name"),
    ],
)
def test_backgrounds_that_cannot_be_drawn_for_are_refused(x_to_touch, sensors, inputs, message):
    pipe = x_to_touch if sensors is None else shown_gels(x_to_touch, sensors)
    with pytest.raises(InvalidInputError, match=message):
        pipe(**{"text": "brick", **inputs})


def test_a_network_and_backgrounds_that_do_not_fit_are_refused(x_to_touch):
    with pytest.raises(InvalidInputError, match=r"`backgrounds` is None.* of \(2, 3\)"):
        shown_gels(x_to_touch, backgrounds=None)
    unet = UNet2DConditionModel.from_config(x_to_touch.unet.config, in_channels=6)
    with pytest.raises(InvalidInputError, match=r"`sensors` names 2, but `unet` has 2 .*but the last"):
        XToTouchPipeline(**{**x_to_touch.components, "unet": unet}, sensors=["gelsight", "digit"])


def test_a_picture_of_a_gel_needs_the_autoencoder_though_nothing_is_decoded():
    assert XToTouchPipeline.plan(text="brick", background="gel.png", output_type="latent").parts["VAE"]
