"""Full-size models on the meta device: the published numbers of parameters, names, shapes, and what comes out."""

import pytest
import torch
from diffusers import DDIMScheduler, DDPMScheduler, PNDMScheduler
from torch import nn

from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.models.config import TEXT, VISION
from unitouch_gen.models.presets import embedding_noise, unclip_scheduler
from unitouch_gen.pipelines.presets import PRESETS, made_in, preset


def parameters(module: nn.Module) -> int:
    return sum(weight.numel() for weight in module.parameters())


def shapes(module: nn.Module) -> dict[str, tuple[int, ...]]:
    return {name: tuple(tensor.shape) for name, tensor in module.state_dict().items()}


def empty(*shape: int) -> torch.Tensor:
    return torch.empty(shape, device="meta")


@pytest.fixture(scope="module")
def models() -> dict:
    return {name: preset(name, device="meta") for name in PRESETS}


@pytest.mark.parametrize("name", PRESETS)
def test_nothing_is_in_memory(models: dict, name: str) -> None:
    model = models[name]
    networks = [model] if isinstance(model, nn.Module) else model.components.values()
    weights = [tensor for part in networks if isinstance(part, nn.Module) for tensor in part.state_dict().values()]
    assert weights and all(tensor.is_meta for tensor in weights)


# Encoders: the numbers of the published files, in millions -------------------------------------------------------


def test_encoders_have_the_published_sizes(models: dict) -> None:
    joint = models["imagebind-huge"]
    second_frame = 3 * 14 * 14  # the published stems see two frames, and their still images are one repeated
    assert round((parameters(joint.vision_model) + 1280 * second_frame) / 1e6, 1) == 632.8
    assert round((parameters(joint.text_model) - 1024 * 1024) / 1e6, 1) == 353.0  # without the projection
    assert round(parameters(joint.audio_model) / 1e6, 1) == 86.2
    for model in (joint, models["unitouch-vit-l"]):
        assert round((parameters(model.touch_model) + 1024 * second_frame) / 1e6, 1) == 304.9


def test_the_papers_touch_encoder_has_five_tokens_for_each_of_three_sensors(models: dict) -> None:
    model = models["unitouch-vit-l"]
    assert model.loaded_modalities == ("touch",)
    assert shapes(model.sensor_bank)["tokens"] == (3, 5, 1024)
    assert model.touch_model(empty(2, 3, 224, 224), empty(2, 5, 1024)).shape == (2, 1024)


def test_the_joint_space_has_the_published_shapes(models: dict) -> None:
    joint = models["imagebind-huge"]
    assert joint.loaded_modalities == ("image", "text", "audio", "touch")
    assert len(joint.sensor_bank) == 0
    found = shapes(joint)
    for name, shape in {
        "touch_model.class_token": (1, 1, 1024),
        "touch_model.position": (1, 257, 1024),
        "touch_model.stem.weight": (1024, 3, 14, 14),
        "touch_model.blocks.23.attention.bias_k": (1, 1, 1024),
        "audio_model.class_token": (1, 1, 768),
        "audio_model.position": (1, 229, 768),
        "audio_model.stem.weight": (768, 1, 16, 16),
        "audio_model.stem_norm.weight": (768,),
        "audio_model.blocks.11.attention.bias_v": (1, 1, 768),
    }.items():
        assert found[name] == shape
    by_shape = list(found.values())
    assert (49_408, 1024) in by_shape and (77, 1024) in by_shape and (257, 1280) in by_shape
    assert VISION["num_hidden_layers"] == 32 and TEXT["num_hidden_layers"] == 24


def test_audio_of_the_paper_goes_in_and_embeddings_of_one_width_come_out(models: dict) -> None:
    joint = models["imagebind-huge"]
    assert joint.get_audio_features(empty(2, 3, 1, 128, 204)).shape == (2, 1024)
    assert joint.get_image_features(empty(2, 3, 224, 224)).shape == (2, 1024)


# Stable Diffusion 2.1 unCLIP ------------------------------------------------------------------------------------------


def test_unclips_unet_is_sd_15s_with_wider_prompts_and_class_labels(models: dict) -> None:
    """SD 1.5's has 859,520,964 parameters (https://forums.fast.ai/t/101515) and attends to prompts of width 768."""
    unet = models["sd21-unclip"].unet
    attending = 5 * 320 + 5 * 640 + 6 * 1280  # widths of the 16 blocks that attend: 2 down, 3 up a level, 1 between
    wider_prompts = 2 * (1024 - 768) * attending  # of keys and values
    class_labels = (2048 * 1280 + 1280) + (1280 * 1280 + 1280)
    assert parameters(unet) == 859_520_964 + wider_prompts + class_labels == 870_173_124


def test_unclips_other_networks_have_the_published_sizes(models: dict) -> None:
    pipe = models["sd21-unclip"]
    assert parameters(pipe.vae) == 83_653_863  # ibid.
    # Layers of OpenCLIP's ViT-H text encoder: two norms, attention and MLP; token and position tables, a last norm.
    layer = 2 * 2 * 1024 + 4 * (1024**2 + 1024) + (4096 * 1024 + 4096) + (1024 * 4096 + 1024)
    assert parameters(pipe.text_encoder) == 23 * layer + (49_408 + 77) * 1024 + 2 * 1024
    assert shapes(pipe.image_normalizer) == {"mean": (1, 1024), "std": (1, 1024)}


def test_unclips_names_are_diffusers(models: dict) -> None:
    found = shapes(models["sd21-unclip"].unet)
    assert found["class_embedding.linear_1.weight"] == (1280, 2048)
    assert found["down_blocks.0.attentions.0.transformer_blocks.0.attn2.to_k.weight"] == (320, 1024)
    assert found["down_blocks.0.attentions.0.proj_in.weight"] == (320, 320)  # linear, not a convolution
    assert found["mid_block.attentions.0.transformer_blocks.0.attn2.to_v.weight"] == (1280, 1024)


def test_unclip_makes_pictures_of_768_pixels(models: dict) -> None:
    pipe = models["sd21-unclip"]
    latents = pipe.unet(
        empty(2, 4, 96, 96), torch.tensor(1), empty(2, 77, 1024), class_labels=empty(2, 2048)
    ).sample  # fmt: skip
    assert latents.shape == (2, 4, 96, 96)
    assert pipe.vae.decode(latents).sample.shape == (2, 3, 768, 768)
    assert pipe.text_encoder(torch.zeros(2, 77, dtype=torch.long, device="meta"))[0].shape == (2, 77, 1024)
    assert pipe.embedding_dim == 1024


@pytest.mark.parametrize(
    ("kind", "scheduler"), [("ddim", DDIMScheduler), ("pndm", PNDMScheduler), ("ddpm", DDPMScheduler)]
)
def test_unclips_schedulers_share_its_noise(kind: str, scheduler: type) -> None:
    made = unclip_scheduler(kind)
    assert type(made) is scheduler
    assert made.config.prediction_type == "v_prediction"
    betas = torch.linspace(0.00085**0.5, 0.012**0.5, 1000, dtype=torch.float64).square()
    torch.testing.assert_close(made.alphas_cumprod.double(), (1 - betas).cumprod(0), rtol=1e-4, atol=0)


def test_noise_on_embeddings_is_that_of_the_published_levels() -> None:
    alphas = embedding_noise().alphas_cumprod
    for level, signal, noise in [(0, 1.0, 0.0064), (100, 0.986, 0.169), (500, 0.702, 0.713)]:
        assert alphas[level].sqrt().item() == pytest.approx(signal, abs=6e-4)
        assert (1 - alphas[level]).sqrt().item() == pytest.approx(noise, abs=6e-4)


def test_an_unknown_scheduler_is_refused() -> None:
    with pytest.raises(InvalidInputError, match=r"`kind` is 'pdnm'.*Did you mean 'pndm'"):
        unclip_scheduler("pdnm")


# Latent diffusion of touch --------------------------------------------------------------------------------------------


def test_the_touch_ldm_is_that_of_imagenet_with_a_wider_condition(models: dict) -> None:
    """LDM-4 of ImageNet classes has 400 million (Rombach et al., 2022) and a condition of width 512."""
    unet = models["touch-ldm-f4"].unet
    attending = 5 * 384 + 5 * 576 + 6 * 960
    assert parameters(unet) - 2 * (1024 - 512) * attending == pytest.approx(400e6, rel=3e-3)


def test_the_touch_ldm_makes_touches_of_256_pixels_from_one_token(models: dict) -> None:
    pipe = models["touch-ldm-f4"]
    latents = pipe.unet(empty(2, 3, 64, 64), torch.tensor(1), empty(2, 1, 1024)).sample
    assert latents.shape == (2, 3, 64, 64)
    assert pipe.vae.decode(latents).sample.shape == (2, 3, 256, 256)
    assert pipe.embedding_dim == 1024
    assert pipe.vae_scale_factor == 4
    assert shapes(pipe.vae)["quantize.embedding.weight"] == (8192, 3)


# How they are made ----------------------------------------------------------------------------------------------------


def test_weights_are_those_of_the_seed_in_the_dtype_and_torch_is_left_as_it_was() -> None:
    def made(seed: int) -> torch.Tensor:
        with made_in("cpu", torch.bfloat16, seed):
            return nn.Linear(8, 8).weight

    state = torch.get_rng_state()
    first, second, other = made(0), made(0), made(1)
    assert first.dtype == torch.bfloat16
    assert torch.equal(first, second) and not torch.equal(first, other)
    assert torch.equal(torch.get_rng_state(), state)
    assert torch.get_default_dtype() == torch.float32


def test_weights_may_be_in_half_precision() -> None:
    model = preset("unitouch-vit-l", device="meta", dtype=torch.bfloat16)
    assert model.dtype == model.touch_model.projection.weight.dtype == torch.bfloat16


def test_an_unknown_name_is_refused() -> None:
    with pytest.raises(InvalidInputError, match=r"`name` is 'sd21_unclip'.*Did you mean 'sd21-unclip'"):
        preset("sd21_unclip")


@pytest.mark.parametrize(
    ("setting", "value", "error"),
    [
        ("device", "nowhere", InvalidInputError),
        ("device", 1.5, InvalidInputError),
        ("dtype", torch.int8, InvalidTypeError),
        ("dtype", "float3", InvalidInputError),
        ("seed", -1, InvalidInputError),
        ("seed", 0.5, InvalidTypeError),
    ],
)
def test_settings_that_cannot_be_used_are_refused_by_name(setting: str, value: object, error: type[Exception]) -> None:
    with pytest.raises(error, match=f"`{setting}`"):
        preset("touch-ldm-f4", **{"device": "meta", setting: value})
