"""Conditions that cannot be used: an error that names the argument and what came, before any network runs.

And what is unusual, but can be: long texts, other scripts, sounds of all kinds of files.
"""

import numpy as np
import pytest
import soundfile
import torch

from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.pipelines import XToTouchPipeline

NAN, INF = float("nan"), float("inf")
RATE = 16_000
TONE = np.sin(2 * np.pi * 440 * np.arange(8_000) / RATE)


def fail(module: torch.nn.Module, *args: object) -> None:
    raise AssertionError(f"{type(module).__name__} ran on input that cannot be used")


def guard(pipe):
    joint = pipe.unitouch
    for network in (
        pipe.unet,
        pipe.vae.encoder,
        joint.touch_model,
        joint.vision_model,
        joint.text_model,
        joint.audio_model,
    ):
        network.register_forward_pre_hook(fail)
    return pipe


def refuses(call, *words: str) -> None:
    with pytest.raises((InvalidInputError, InvalidTypeError)) as caught:
        call()
    message = str(caught.value)
    assert [word for word in words if word not in message] == [], message
    assert "\n" not in message


# X to touch -----------------------------------------------------------------------------------------------------------

X_MISTAKES = {
    "nothing": ({}, "Nothing to make a touch of came"),
    "blank text": ({"text": "  \n"}, "`text` is blank"),
    "a blank among texts": ({"text": ["brick", ""]}, "`text[1]` is blank"),
    "no texts": ({"text": []}, "`text` is an empty list"),
    "text that is none": ({"text": 3}, "`text` is 3"),
    "silence": ({"audio": (np.zeros(8_000, np.float32), RATE)}, "`audio` is silent"),
    "a constant": ({"audio": (np.full(8_000, 0.3, np.float32), RATE)}, "`audio` is silent"),
    "silence among sounds": (
        {"audio": [(TONE, RATE), (np.zeros(8_000), RATE)]},
        "`audio[1]` is silent",
    ),
    "one sample": ({"audio": (np.ones(1, np.float32), RATE)}, "`audio` holds 1 samples"),
    "no rate": ({"audio": TONE}, "`audio`", "without a sampling rate"),
    "a rate without sound": ({"text": "brick", "sampling_rate": RATE}, "`sampling_rate` came without `audio`"),
    "NaN in a sound": ({"audio": (np.where(TONE > 0.9, NAN, TONE), RATE)}, "`audio`", "NaN"),
    "a missing photo": ({"image": "none.jpg"}, "'none.jpg'", "does not exist"),
    "a sensor of no touch": ({"text": "brick", "source_sensor": "digit"}, "`source_sensor` came without `touch`"),
    "an unknown sensor": ({"text": "brick", "sensor": "gelsite"}, "`sensor` is 'gelsite'", "Did you mean 'gelsight'"),
    "too many sensors": ({"text": ["a", "b"], "sensor": ["digit"] * 3}, "`sensor` is a list of 3 for 2 inputs"),
    "all among sensors": ({"text": "brick", "sensor": ["all", "digit"]}, "`sensor` is 'all'", "in place of a name"),
    "an unknown bridge": ({"text": "brick", "bridge": "london"}, "`bridge` is 'london'", "True or False"),
    "a bridge of a number": ({"text": "brick", "bridge": 1}, "`bridge` is 1", "True or False"),
    "weights of nothing": ({"text": "brick", "weights": {"text": 0}}, "`weights` sums to 0"),
    "a negative weight": ({"text": "brick", "weights": {"text": -1}}, "`weights` is -1"),
    "a weight that is NaN": ({"text": "brick", "weights": {"text": NAN}}, "`weights` is nan"),
    "a weight of what did not come": (
        {"text": "brick", "weights": {"image": 1}},
        "`weights` names 'image', but no `image` came, only `text`",
        "leave its weight out",
    ),
    "a weight of no modality": (
        {"text": "brick", "audio": (TONE, RATE), "weights": {"smell": 1}},
        "`weights` names 'smell', which is no modality",
        "`text`, `audio` came",
    ),
    "a modality without a weight": (
        {"text": "brick", "audio": (TONE, RATE), "weights": {"text": 1}},
        "`weights` says nothing of `audio`",
        "give it a weight",
    ),
    "a misspelled weight": ({"text": "brick", "weights": {"txt": 1}}, "`weights` names 'txt'", "Did you mean 'text'?"),
    "a weight of a number": ({"text": "brick", "weights": {3: 1}}, "`weights` names 3, which is no modality"),
    "weights that are a list": ({"text": "brick", "weights": [1.0]}, "`weights` is a list of 1"),
    "two against three": ({"text": ["a", "b"], "audio": [(TONE, RATE)] * 3}, "`text` holds 2 inputs"),
    "no candidates": ({"text": "brick", "num_candidates": 0}, "`num_candidates` is 0"),
    "guidance NaN": ({"text": "brick", "guidance_scale": NAN}, "`guidance_scale` is nan"),
    "no steps": ({"text": "brick", "num_inference_steps": 0}, "`num_inference_steps` is 0"),
    "a scale alone": ({"text": "brick", "cross_attention_kwargs": 0.5}, "`cross_attention_kwargs` is 0.5", "dict"),
    "a size between": ({"text": "brick", "height": 17}, "`height` is 17"),
    "embeddings without a token": ({"condition_embeds": torch.zeros(1, 16)}, "`condition_embeds`", "(B, 1, 16)"),
    "embeddings without rows": ({"condition_embeds": torch.zeros(0, 1, 16)}, "`condition_embeds`"),
    "embeddings of another width": ({"condition_embeds": torch.zeros(1, 1, 32)}, "`condition_embeds`", "(1, 1, 32)"),
    "embeddings in a list": ({"condition_embeds": [[[0.0]]]}, "`condition_embeds`", "a list of 1"),
    "embeddings of integers": ({"condition_embeds": torch.zeros(1, 1, 16).long()}, "`condition_embeds`"),
    "embeddings without end": ({"condition_embeds": torch.full((1, 1, 16), INF)}, "`condition_embeds`", "infinite"),
    "embeddings that are NaN": ({"condition_embeds": torch.full((1, 1, 16), NAN)}, "`condition_embeds`", "NaN"),
    "embeddings and a modality": ({"condition_embeds": torch.ones(1, 1, 16), "text": "brick"}, "`text` is 'brick'"),
}


@pytest.mark.parametrize("name", X_MISTAKES)
def test_a_condition_that_cannot_be_used_is_refused(x_to_touch, name):
    options, *words = X_MISTAKES[name]
    refuses(lambda: guard(x_to_touch)(**options), *words)


@pytest.mark.parametrize("name", ["audio", "text"])
def test_encoding_refuses_the_same(x_to_touch, name):
    value = {"audio": (np.zeros(8_000), RATE), "text": ""}[name]
    refuses(lambda: guard(x_to_touch).encode_condition(**{name: value}), f"`{name}`")


def test_a_file_that_is_no_sound(x_to_touch, tmp_path):
    file = tmp_path / "hit.wav"
    file.write_text("This is no sound.")
    refuses(lambda: guard(x_to_touch)(audio=str(file)), "`audio`", "cannot be read as a sound")


def test_a_bridge_needs_a_bank(x_components):
    x_components["embedding_bank"] = None
    pipe = guard(XToTouchPipeline(**x_components, sensors=["gelsight", "digit"]))
    refuses(
        lambda: pipe(text="brick", bridge=True), "`bridge` is True", "the `embedding_bank`, which this pipeline has not"
    )


def test_candidates_need_a_touch_encoder(x_components):
    x_components |= {"unitouch": None, "processor": None}
    pipe = XToTouchPipeline(**x_components, sensors=["gelsight", "digit"])
    embeds = torch.ones(1, 1, 16)
    refuses(lambda: pipe(condition_embeds=embeds, num_candidates=2), "`num_candidates` is 2", "leave it out")
    refuses(lambda: pipe(text="brick"), "`text` came", "`condition_embeds`")


def test_sensors_have_to_be_those_of_the_network(x_components):
    refuses(lambda: XToTouchPipeline(**x_components, sensors=["gelsight"]), "`sensors` names 1", "2 class labels")


# ... and what can be used ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", ["rauer Ziegel", "粗いレンガ", "خشن", "🧱", "brick " * 10_000])
def test_any_text_that_says_something_is_taken(x_to_touch, text):
    assert torch.isfinite(x_to_touch.encode_condition(text=text)).all()


def test_a_long_text_is_cut_to_the_tokenizers_length(x_to_touch):
    length = x_to_touch.processor.tokenizer.model_max_length
    long, longer = ("brick " * (10 * length), "brick " * (20 * length))
    torch.testing.assert_close(x_to_touch.encode_condition(text=long), x_to_touch.encode_condition(text=longer))


SOUNDS = {
    "8-bit": {"subtype": "PCM_U8"},
    "24-bit": {"subtype": "PCM_24"},
    "float": {"subtype": "FLOAT"},
}


@pytest.mark.parametrize("kind", SOUNDS)
def test_sample_formats_are_one_sound(x_to_touch, tmp_path, kind):
    soundfile.write(tmp_path / "hit.wav", 0.5 * TONE, RATE, **SOUNDS[kind])
    found = x_to_touch.encode_condition(audio=str(tmp_path / "hit.wav"))
    expected = x_to_touch.encode_condition(audio=(0.5 * TONE, RATE))
    assert torch.cosine_similarity(found, expected, dim=-1).item() > 0.9  # eight bits leave noise between the harmonics


def test_two_channels_are_their_mean(x_to_touch):
    both = np.stack([TONE, 0 * TONE])
    torch.testing.assert_close(
        x_to_touch.encode_condition(audio=(both, RATE)), x_to_touch.encode_condition(audio=(0.5 * TONE, RATE))
    )


@pytest.mark.parametrize("rate", [8_000, 44_100, 96_000])
def test_other_rates_are_resampled(x_to_touch, rate):
    samples = np.sin(2 * np.pi * 440 * np.arange(rate // 2) / rate)
    assert torch.isfinite(x_to_touch.encode_condition(audio=(samples, rate))).all()


def test_a_clipped_sound_is_taken(x_to_touch):
    assert torch.isfinite(x_to_touch.encode_condition(audio=(np.clip(9 * TONE, -1, 1), RATE))).all()


def test_ten_minutes_are_taken(x_to_touch):
    samples = np.random.default_rng(0).standard_normal(600 * RATE).astype(np.float32)
    assert torch.isfinite(x_to_touch.encode_condition(audio=(samples, RATE))).all()


# Stylisation ----------------------------------------------------------------------------------------------------------

MIX_MISTAKES = {
    "no touch": ({"touch": None}, "`touch` is missing"),
    "no photo": ({"image": None}, "`image` is missing"),
    "a weight above one": ({"touch_weight": 1.2}, "`touch_weight` sums to 1.2", "`image_weight`"),
    "a negative weight": ({"touch_weight": -0.1}, "`touch_weight` is -0.1"),
    "weights of nothing": ({"touch_weight": 0, "image_weight": 0}, "sums to 0"),
    "a weight that is NaN": ({"image_weight": NAN}, "`image_weight` is nan"),
    "a weight that is infinite": ({"image_weight": INF}, "`image_weight` is inf"),
    "a weight of text": ({"touch_weight": "much"}, "`touch_weight` is 'much'"),
    "too many weights": ({"touch_weight": [0.1, 0.1, 0.1]}, "`touch_weight` is a list of 3 for 2 inputs"),
    "an unknown mix": ({"mix": "slurp"}, "`mix` is 'slurp'", "Did you mean 'slerp'"),
    "an init strength above one": ({"init_strength": 1.5}, "`init_strength` is 1.5"),
    "a negative init strength": ({"init_strength": -0.1}, "`init_strength` is -0.1"),
    "an init strength that is NaN": ({"init_strength": NAN}, "`init_strength` is nan"),
    "a negative strength": ({"strength": -1}, "`strength` is -1"),
    "no single layout": (
        {"image_weight": [0.3, 0.4], "touch_weight": [0.1, 0.2], "init_strength": 0.5},
        "`init_strength` is 0.5",
        "2 photos are mixed",
    ),
    "no steps": ({"num_inference_steps": -1}, "`num_inference_steps` is -1"),
    "a mask": ({"cross_attention_kwargs": {"attention_mask": None}}, "`cross_attention_kwargs`", "leave it out"),
    "an unknown sensor": ({"sensor": "gelsite"}, "Did you mean 'gelsight'"),
}


@pytest.mark.parametrize("name", MIX_MISTAKES)
def test_a_mix_that_cannot_be_made_is_refused(stylize, photo, touch, name):
    options, *words = MIX_MISTAKES[name]
    refuses(lambda: guard(stylize)(**{"image": photo, "touch": touch, **options}), *words)


def test_three_photos_and_two_touches(stylize, photo, touch):
    three = torch.cat([photo, photo[:1]])
    refuses(lambda: guard(stylize)(three, touch), "`image` holds 3 photos and `touch` 2 touches")
