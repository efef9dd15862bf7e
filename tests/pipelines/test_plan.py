"""Plans: what they say before anything is loaded, what is loaded by them, and that reports say the same."""

import pytest
import torch

import unitouch_gen
from unitouch_gen import weights
from unitouch_gen.conditioning import EmbeddingBank
from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.models.joint import MODALITIES
from unitouch_gen.pipelines import TactileStylizationPipeline, TouchToImagePipeline, XToTouchPipeline
from unitouch_gen.pipelines.common import UniTouchPipeline

D = 16


def seeded() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def quiet(pipe):
    pipe.set_progress_bar_config(disable=True)
    return pipe


@pytest.fixture
def inputs(photo, sound, touch) -> dict:
    return {"image": photo[:1], "text": "rough brick", "audio": sound, "touch": touch[:1]}


@pytest.fixture
def saved(x_to_touch, tmp_path_factory):
    """The pipeline of the fixture `x_to_touch`, saved once."""
    folder = tmp_path_factory.getbasetemp() / "saved-x-to-touch"
    if not folder.exists():
        x_to_touch.save_pretrained(folder)
    return folder


# What it says ---------------------------------------------------------------------------------------------------------


def test_components_follow_from_the_parts():
    request = {"touch_embeds": 1, "prompt_embeds": 1, "guidance_scale": 1.0, "output_type": "latent", "bridge": False}
    assert TouchToImagePipeline.plan(**request).left_out == [
        "touch encoder", "bank of image embeddings", "prompt encoder", "unconditional branch", "VAE",
    ]  # fmt: skip
    assert not any(TouchToImagePipeline.plan(**request).components.values())
    assert TouchToImagePipeline.plan("touch.png", output_type="latent").components == {
        "unitouch": True, "processor": True, "embedding_bank": True, "tokenizer": True, "text_encoder": True,
        "vae": False,
    }  # fmt: skip


def test_a_plan_needs_more_than_another_where_that_left_weights_out():
    small, large = (XToTouchPipeline.plan(text="x", guidance_scale=scale, **more) for scale, more in
                    ((1.0, {}), (4.0, {"touch": "y"})))  # fmt: skip
    assert large.beyond(small) == ["touch encoder"]  # guidance needs no weights
    assert small.beyond(large) == []


@pytest.mark.parametrize(("scale", "on"), [(None, True), (4.0, True), (1.0, False), (0, False), ("four", True)])
def test_guidance_is_on_above_one(scale, on):
    assert XToTouchPipeline.plan(text="x", guidance_scale=scale).parts["unconditional branch"] is on


@pytest.mark.parametrize("modality", MODALITIES)
def test_the_plan_has_the_modality_that_came(modality):
    assert XToTouchPipeline.plan(**{modality: "something"}).modalities == (modality,)


def test_a_modality_that_weighs_nothing_is_not_in_it():
    assert XToTouchPipeline.plan(text="x", image="y", weights={"text": 1, "image": 0}).modalities == ("text",)


def test_candidates_need_the_touch_encoder_and_pictures():
    plan = XToTouchPipeline.plan(text="x", num_candidates=2, output_type="latent")
    assert plan.modalities == ("text", "touch") and plan.parts["VAE"]


@pytest.mark.parametrize(("request_", "needed"), [({"text": "x"}, True), ({"image": "y"}, False)])
def test_the_bank_is_for_what_is_no_picture(request_, needed):
    assert XToTouchPipeline.plan(**request_).parts["bank of image embeddings"] is needed
    assert not XToTouchPipeline.plan(**request_, bridge=False).parts["bank of image embeddings"]


@pytest.mark.parametrize(
    ("request_", "needed"),
    [
        ({}, True),
        ({"prompt_embeds": 1}, True),
        ({"prompt_embeds": 1, "guidance_scale": 1.0}, False),
        ({"prompt_embeds": 1, "negative_prompt_embeds": 1, "guidance_scale": 4.0}, False),
        ({"negative_prompt_embeds": 1}, True),
    ],
)
def test_prompts_are_encoded_where_a_branch_has_none(request_, needed):
    assert TouchToImagePipeline.plan("touch.png", **request_).parts["prompt encoder"] is needed


def test_what_attention_processors_take_needs_no_part():
    plain = TouchToImagePipeline.plan("touch.png")
    assert TouchToImagePipeline.plan("touch.png", cross_attention_kwargs={"scale": 0.5}) == plain


def test_arguments_go_by_place_as_in_a_call():
    assert TouchToImagePipeline.plan("touch.png") == TouchToImagePipeline.plan(touch="touch.png")


@pytest.mark.parametrize(
    ("weights_", "modalities"),
    [
        ({}, ("image", "touch")),
        ({"touch_weight": 1.0}, ("touch",)),
        ({"touch_weight": [0.5, 0.5]}, ("touch",)),
        ({"touch_weight": 0.4, "image_weight": 0.0}, ("touch",)),
        ({"touch_weight": 0.4, "image_weight": [0.0, 0.1]}, ("image", "touch")),
    ],
)
def test_a_photo_that_weighs_nothing_is_not_encoded(weights_, modalities):
    assert TactileStylizationPipeline.plan("photo.png", ["a.png", "b.png"], **weights_).modalities == modalities


def test_a_photos_own_latents_need_the_vae():
    request = {"image": "photo.png", "touch": "a.png", "output_type": "latent"}
    assert not TactileStylizationPipeline.plan(**request, init_strength=1.0).parts["VAE"]
    assert TactileStylizationPipeline.plan(**request).parts["VAE"]


@pytest.mark.parametrize(
    ("kind", "request_", "message"),
    [
        (XToTouchPipeline, {}, "Nothing to make a touch of came"),
        (XToTouchPipeline, {"txt": "x"}, "'txt'.*arguments of a call of XToTouchPipeline"),
        (TouchToImagePipeline, {}, "neither came"),
        (TactileStylizationPipeline, {"image": "x"}, "`touch` is missing"),
    ],
)
def test_a_plan_of_nothing_is_refused(kind, request_, message):
    with pytest.raises(InvalidInputError, match=message):
        kind.plan(**request_)


# What reports say -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"guidance_scale": 1.0},
        {"output_type": "latent"},
        {"bridge": False},
        {"num_candidates": 2},
        {"guidance_scale": 0.0, "output_type": "latent", "num_candidates": 2, "bridge": False},
    ],
    ids=str,
)
@pytest.mark.parametrize("modalities", [("text",), ("image", "audio"), ("touch",)])
def test_the_report_leaves_out_what_the_plan_does(x_to_touch, inputs, modalities, options):
    request = {**{modality: inputs[modality] for modality in modalities}, **options}
    x_to_touch.unet.register_forward_hook(lambda *_: None)  # so that within the UNet nothing is left out
    assert x_to_touch(**request).report.left_out == XToTouchPipeline.plan(**request).left_out


@pytest.mark.parametrize("interval", [(0.0, 0.5), (0.3, 0.6), (0.5, 1.0)])
def test_the_unconditional_branch_runs_within_the_interval_with_its_ends(x_to_touch, inputs, interval):
    request = {"text": inputs["text"], "guidance_interval": interval, "num_inference_steps": 10}
    x_to_touch.scheduler.set_timesteps(10)
    low, high = (999 * share for share in interval)
    guided = sum(low <= float(timestep) <= high for timestep in x_to_touch.scheduler.timesteps)
    report = x_to_touch(**request).report
    assert (report.guided, report.evaluations) == (guided, 10)
    assert f"unconditional branch in {10 - guided} of 10 evaluations" in report.left_out


# What is loaded -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [{}, {"bridge": False}, {"output_type": "latent"}], ids=str)
def test_a_pipeline_of_a_plan_makes_the_same(x_to_touch, saved, inputs, options):
    request = {"text": inputs["text"], **options}
    part = quiet(XToTouchPipeline.from_pretrained(saved, plan=XToTouchPipeline.plan(**request)))
    expected, found = (pipe(**request, generator=seeded()) for pipe in (x_to_touch, part))
    if options.get("output_type") == "latent":
        torch.testing.assert_close(found.images, expected.images)  # to rounding, which grows with values: up to 7 here
    torch.testing.assert_close(found.embeds, expected.embeds)
    assert found.report.left_out == expected.report.left_out
    assert part.unitouch.loaded_modalities == ("text",)
    assert (part.embedding_bank is None) == ("bridge" in options)
    assert (part.vae is None) == ("output_type" in options)


def test_latents_have_their_size_without_the_vae(x_to_touch, saved):
    part = XToTouchPipeline.from_pretrained(saved, plan=XToTouchPipeline.plan(text="x", output_type="latent"))
    assert part.vae is None and part.vae_scale_factor == x_to_touch.vae_scale_factor


def test_embeddings_and_prompts_that_come_leave_both_encoders_out(pipe, family):
    states = torch.randn(1, 12, 16, generator=seeded())
    request = {"touch_embeds": torch.ones(1, D), "prompt_embeds": states, "guidance_scale": 1.0, "output_type": "pt"}
    part = quiet(TouchToImagePipeline.from_pretrained(family, plan=TouchToImagePipeline.plan(**request)))
    assert [part.unitouch, part.processor, part.text_encoder, part.tokenizer] == [None] * 4
    expected, found = (one(**request, generator=seeded()).images for one in (pipe, part))
    torch.testing.assert_close(found, expected, rtol=0, atol=2e-6)


@pytest.mark.parametrize(
    ("other", "missing"),
    [
        ({"audio": "sound.wav"}, "the audio encoder"),
        ({"text": "x", "num_candidates": 2}, "the touch encoder"),
        ({"text": "x", "bridge": True}, "the bank of image embeddings"),
        ({"text": "x"}, "the VAE"),
    ],
)
def test_a_call_that_needs_more_than_the_plan_is_refused(saved, other, missing):
    plan = XToTouchPipeline.plan(text="x", output_type="latent", bridge=False)
    part = XToTouchPipeline.from_pretrained(saved, plan=plan)
    with pytest.raises(InvalidInputError, match=f"needs .*{missing}.*`plan=XToTouchPipeline.plan"):
        part(**other)


def test_a_pipeline_of_a_plan_serves_other_calls_that_need_no_more(saved, inputs):
    part = quiet(XToTouchPipeline.from_pretrained(saved, plan=XToTouchPipeline.plan(text="x")))
    assert part(text="smooth metal", guidance_scale=1.0, output_type="latent").report.success


@pytest.mark.parametrize("planned", [{"image": "y"}, {"text": "x", "bridge": False}])
def test_a_bank_that_the_plan_left_out_is_not_gone_without(saved, inputs, planned):
    part = XToTouchPipeline.from_pretrained(saved, plan=XToTouchPipeline.plan(**planned, num_candidates=2))
    with pytest.raises(InvalidInputError, match=r"needs .*the bank of image embeddings, which the `plan`"):
        part(touch=inputs["touch"])
    with pytest.raises(InvalidInputError, match="needs the `embedding_bank`, which its `plan` left out"):
        part.encode_condition(touch=inputs["touch"])


@pytest.mark.parametrize("options", [{}, {"bridge": False}])
def test_pictures_of_a_plan_are_moved_by_the_same_bank(pipe, touch, tmp_path, options):
    pipe.register_modules(embedding_bank=EmbeddingBank.of(torch.randn(20, D, generator=seeded())))
    pipe.save_pretrained(tmp_path)
    plan = TouchToImagePipeline.plan(touch, **options)
    part = quiet(TouchToImagePipeline.from_pretrained(tmp_path, plan=plan))
    assert (part.embedding_bank is None) == bool(options)
    expected, found = (one(touch, **options, generator=seeded(), output_type="pt").images for one in (pipe, part))
    torch.testing.assert_close(found, expected, rtol=0, atol=2e-6)


def test_a_part_of_a_pipeline_is_not_saved_as_if_it_were_all(saved, tmp_path):
    part = XToTouchPipeline.from_pretrained(saved, plan=XToTouchPipeline.plan(text="x", bridge=False))
    with pytest.raises(InvalidInputError, match="without a `plan`"):
        part.save_pretrained(tmp_path / "part")


def test_no_other_pipeline_is_built_of_parts_without_a_vae(x_components):
    with pytest.raises(InvalidInputError, match="`vae` is None"):
        XToTouchPipeline(**{**x_components, "vae": None}, sensors=["gelsight", "digit"])


def test_after_a_call_that_failed_the_pipeline_may_move(pipe, touch):
    with pytest.raises(InvalidInputError):
        pipe(touch, guidance_scale=-1.0)
    assert pipe.to(torch.float64).encode_touch(touch).isfinite().all()


# The built-in family --------------------------------------------------------------------------------------------------

built_in = pytest.mark.skipif(
    not (weights.JOINT / "model.safetensors").exists(), reason="built-in weights are not there"
)
REQUEST = {"text": "rough brick", "num_inference_steps": 2, "output_type": "pt"}


@pytest.fixture(scope="module")
def whole():
    return quiet(unitouch_gen.tiny("x-to-touch"))


@built_in
@pytest.mark.parametrize("low_memory", [False, True])
def test_a_touch_is_the_same_by_the_plan_and_in_low_memory(whole, low_memory):
    part = quiet(unitouch_gen.tiny("x-to-touch", plan=XToTouchPipeline.plan(**REQUEST), low_memory=low_memory))
    expected, found = (pipe(**REQUEST, generator=seeded()).images for pipe in (whole, part))
    torch.testing.assert_close(found, expected, rtol=0, atol=2e-6)


@built_in
@pytest.mark.filterwarnings("ignore::unitouch_gen.errors.UnfamiliarInputWarning")
@pytest.mark.parametrize("name", ["touch-to-image", "stylization"])
def test_a_picture_is_the_same_in_low_memory(name, touch, photo):
    request = {"touch": touch[:1], "num_inference_steps": 2, "output_type": "pt"}
    request |= {"image": photo[:1]} if name == "stylization" else {}
    pipes = [quiet(unitouch_gen.tiny(name, low_memory=low_memory)) for low_memory in (False, True)]
    expected, found = (pipe(**request, generator=seeded()).images for pipe in pipes)
    torch.testing.assert_close(found, expected, rtol=0, atol=2e-6)


@built_in
def test_in_low_memory_encoders_are_gone_after_the_call_and_come_back():
    pipe = quiet(unitouch_gen.tiny("x-to-touch", low_memory=True))
    first, second = (pipe(**REQUEST, generator=seeded()).images for _ in range(2))
    assert pipe.unitouch.loaded_modalities == ()
    assert torch.equal(first, second)


class FreedAtOnce:
    """A pipeline whose text encoder another thread frees as soon as it has been looked up."""

    _readers = {"text_encoder": torch.nn.Identity}
    kept: torch.nn.Module | None = torch.nn.Identity()

    @property
    def text_encoder(self):
        found, self.kept = self.kept, None
        return found


def test_a_component_that_others_free_is_held_by_the_call():
    assert UniTouchPipeline._component(FreedAtOnce(), "text_encoder") is FreedAtOnce.kept


# What is none ---------------------------------------------------------------------------------------------------------


PLANS = {
    TouchToImagePipeline: TouchToImagePipeline.plan("touch.png"),
    TactileStylizationPipeline: TactileStylizationPipeline.plan("photo.png", "touch.png"),
    XToTouchPipeline: XToTouchPipeline.plan(text="brick"),
}


@pytest.mark.parametrize("kind", PLANS)
@pytest.mark.parametrize("other", PLANS)
def test_a_plan_of_another_pipeline_is_refused(tmp_path, kind, other):
    """Before anything is read: the folder holds nothing."""
    words = f"`plan` is one of {other.__name__}, and this is {kind.__name__}"
    with pytest.raises(InvalidInputError, match=r"model_index\.json" if kind is other else words):
        kind.from_pretrained(tmp_path, plan=PLANS[other])


def test_a_plan_suits_a_pipeline_of_ones_own():
    class Own(TouchToImagePipeline):
        pass

    Own.check_plan(TouchToImagePipeline.plan("touch.png"))
    TouchToImagePipeline.check_plan(Own.plan("touch.png"))
    with pytest.raises(InvalidInputError, match="`plan` is one of XToTouchPipeline, and this is Own"):
        Own.check_plan(PLANS[XToTouchPipeline])


@pytest.mark.parametrize("plan", ["touch", 3, {"parts": {}}, XToTouchPipeline])
def test_what_is_no_plan_is_refused(plan):
    for make in (lambda: unitouch_gen.tiny("x-to-touch", plan=plan),
                 lambda: XToTouchPipeline.from_pretrained("gone", plan=plan)):  # fmt: skip
        with pytest.raises(InvalidTypeError, match=r"`plan` is .*XToTouchPipeline\.plan"):
            make()


def test_the_built_in_pipelines_refuse_plans_of_others():
    with pytest.raises(InvalidInputError, match="`plan` is one of XToTouchPipeline"):
        unitouch_gen.tiny("touch-to-image", plan=PLANS[XToTouchPipeline])
