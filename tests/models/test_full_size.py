"""Full-size networks on the meta device: the published numbers of parameters, names, shapes, and what comes out."""

import pytest
import torch
from torch import nn

from tests.helpers.full_size import embedding_noise, made_in, touch_config, unclip_networks, unclip_scheduler
from unitouch_gen.models import UniTouchConfig, UniTouchModel
from unitouch_gen.models.config import TEXT, VISION


def parameters(module: nn.Module) -> int:
    return sum(weight.numel() for weight in module.parameters())


def shapes(module: nn.Module) -> dict[str, tuple[int, ...]]:
    return {name: tuple(tensor.shape) for name, tensor in module.state_dict().items()}


def empty(*shape: int) -> torch.Tensor:
    return torch.empty(shape, device="meta")


@pytest.fixture(scope="module")
def joint() -> UniTouchModel:
    with torch.device("meta"):
        return UniTouchModel(UniTouchConfig()).eval()


@pytest.fixture(scope="module")
def unclip() -> dict[str, nn.Module]:
    with torch.device("meta"):
        return unclip_networks()


# Encoders: the numbers of the published files, in millions -------------------------------------------------------


def test_encoders_have_the_published_sizes(joint: UniTouchModel) -> None:
    second_frame = 3 * 14 * 14  # the published stems see two frames, and their still images are one repeated
    assert round((parameters(joint.vision_model) + 1280 * second_frame) / 1e6, 1) == 632.8
    assert round((parameters(joint.text_model) - 1024 * 1024) / 1e6, 1) == 353.0  # without the projection
    assert round(parameters(joint.audio_model) / 1e6, 1) == 86.2
    assert round((parameters(joint.touch_model) + 1024 * second_frame) / 1e6, 1) == 304.9


def test_the_papers_touch_encoder_has_five_tokens_for_each_of_three_sensors() -> None:
    with torch.device("meta"):
        model = UniTouchModel(touch_config(), modalities=("touch",))
    assert model.loaded_modalities == ("touch",)
    assert shapes(model.sensor_bank)["tokens"] == (3, 5, 1024)
    assert model.touch_model(empty(2, 3, 224, 224), empty(2, 5, 1024)).shape == (2, 1024)


def test_the_joint_space_has_the_published_shapes(joint: UniTouchModel) -> None:
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


def test_audio_of_the_paper_goes_in_and_embeddings_of_one_width_come_out(joint: UniTouchModel) -> None:
    assert joint.get_audio_features(empty(2, 3, 1, 128, 204)).shape == (2, 1024)
    assert joint.get_image_features(empty(2, 3, 224, 224)).shape == (2, 1024)


# Stable Diffusion 2.1 unCLIP ------------------------------------------------------------------------------------------


def test_unclips_unet_is_sd_15s_with_wider_prompts_and_class_labels(unclip: dict[str, nn.Module]) -> None:
    """SD 1.5's has 859,520,964 parameters (https://forums.fast.ai/t/101515) and attends to prompts of width 768."""
    unet = unclip["unet"]
    attending = 5 * 320 + 5 * 640 + 6 * 1280  # widths of the 16 blocks that attend: 2 down, 3 up a level, 1 between
    wider_prompts = 2 * (1024 - 768) * attending  # of keys and values
    class_labels = (2048 * 1280 + 1280) + (1280 * 1280 + 1280)
    assert parameters(unet) == 859_520_964 + wider_prompts + class_labels == 870_173_124


def test_unclips_other_networks_have_the_published_sizes(unclip: dict[str, nn.Module]) -> None:
    assert parameters(unclip["vae"]) == 83_653_863  # ibid.
    # Layers of OpenCLIP's ViT-H text encoder: two norms, attention and MLP; token and position tables, a last norm.
    layer = 2 * 2 * 1024 + 4 * (1024**2 + 1024) + (4096 * 1024 + 4096) + (1024 * 4096 + 1024)
    assert parameters(unclip["text_encoder"]) == 23 * layer + (49_408 + 77) * 1024 + 2 * 1024
    assert shapes(unclip["image_normalizer"]) == {"mean": (1, 1024), "std": (1, 1024)}


def test_unclips_names_are_diffusers(unclip: dict[str, nn.Module]) -> None:
    found = shapes(unclip["unet"])
    assert found["class_embedding.linear_1.weight"] == (1280, 2048)
    assert found["down_blocks.0.attentions.0.transformer_blocks.0.attn2.to_k.weight"] == (320, 1024)
    assert found["down_blocks.0.attentions.0.proj_in.weight"] == (320, 320)  # linear, not a convolution
    assert found["mid_block.attentions.0.transformer_blocks.0.attn2.to_v.weight"] == (1280, 1024)


def test_unclip_makes_pictures_of_768_pixels(unclip: dict[str, nn.Module]) -> None:
    latents = unclip["unet"](
        empty(2, 4, 96, 96), torch.tensor(1), empty(2, 77, 1024), class_labels=empty(2, 2048)
    ).sample  # fmt: skip
    assert latents.shape == (2, 4, 96, 96)
    assert unclip["vae"].decode(latents).sample.shape == (2, 3, 768, 768)
    assert unclip["text_encoder"](torch.zeros(2, 77, dtype=torch.long, device="meta"))[0].shape == (2, 77, 1024)


def test_unclips_scheduler_has_its_noise() -> None:
    made = unclip_scheduler()
    assert made.config.prediction_type == "v_prediction"
    betas = torch.linspace(0.00085**0.5, 0.012**0.5, 1000, dtype=torch.float64).square()
    torch.testing.assert_close(made.alphas_cumprod.double(), (1 - betas).cumprod(0), rtol=1e-4, atol=0)


def test_noise_on_embeddings_is_that_of_the_published_levels() -> None:
    alphas = embedding_noise().alphas_cumprod
    for level, signal, noise in [(0, 1.0, 0.0064), (100, 0.986, 0.169), (500, 0.702, 0.713)]:
        assert alphas[level].sqrt().item() == pytest.approx(signal, abs=6e-4)
        assert (1 - alphas[level]).sqrt().item() == pytest.approx(noise, abs=6e-4)


# How they are made ----------------------------------------------------------------------------------------------------


def test_weights_are_those_of_the_seed_in_the_dtype_and_torch_is_left_as_it_was() -> None:
    def made(seed: int) -> torch.Tensor:
        with made_in(torch.bfloat16, seed):
            return nn.Linear(8, 8).weight

    state = torch.get_rng_state()
    first, second, other = made(0), made(0), made(1)
    assert first.dtype == torch.bfloat16
    assert torch.equal(first, second) and not torch.equal(first, other)
    assert torch.equal(torch.get_rng_state(), state)
    assert torch.get_default_dtype() == torch.float32
