"""Published checkpoints: what is read of them is what a plain transcription of their networks computes."""

import runpy
from pathlib import Path

import pytest
import torch
from transformers import CLIPTextModelWithProjection, CLIPVisionModelWithProjection

from unitouch_gen.encoders import UniTouchConfig, UniTouchModel
from unitouch_gen.errors import InvalidInputError

ImageBind = runpy.run_path(str(Path(__file__).parent / "imagebind.py"))["ImageBind"]

VISION = {"hidden_size": 64, "intermediate_size": 256, "num_hidden_layers": 3, "num_attention_heads": 4,
          "image_size": 28, "patch_size": 14, "projection_dim": 32}  # fmt: skip
TEXT = {"hidden_size": 48, "intermediate_size": 192, "num_hidden_layers": 2, "num_attention_heads": 4,
        "vocab_size": 90, "max_position_embeddings": 12, "projection_dim": 32, "eos_token_id": 89,
        "bos_token_id": 88, "pad_token_id": 0}  # fmt: skip
AUDIO = {"hidden_size": 48, "num_hidden_layers": 2, "num_attention_heads": 4, "image_height": 32, "image_width": 44,
         "num_channels": 1, "patch_size": 16, "patch_stride": 10, "stem_norm": True, "projection_dim": 32}  # fmt: skip
TOUCH = {"hidden_size": 64, "num_hidden_layers": 3, "num_attention_heads": 4, "image_height": 28, "image_width": 28,
         "projection_dim": 32}  # fmt: skip
CLIP = {"hidden_act": "gelu", "layer_norm_eps": 1e-6}


def small() -> UniTouchConfig:
    return UniTouchConfig(
        vision_config={**VISION, **CLIP}, text_config={**TEXT, **CLIP}, audio_config=AUDIO, touch_config=TOUCH,
        projection_dim=32, prototype_size=28,
    )  # fmt: skip


def full_width() -> UniTouchConfig:
    """Two blocks of the published widths."""
    few = {"num_hidden_layers": 2}
    whole = UniTouchConfig()
    parts = {name: getattr(whole, name).to_dict() | few
             for name in ("vision_config", "text_config", "audio_config", "touch_config")}  # fmt: skip
    return UniTouchConfig(**parts)


def published(folder: Path, config: UniTouchConfig) -> tuple[dict[str, Path], dict[str, torch.nn.Module]]:
    """ImageBind's and UniTouch's files, and the networks that are in them by modality."""
    torch.manual_seed(0)
    imagebind = ImageBind(config)
    torch.manual_seed(1)
    unitouch = ImageBind(config, ("touch", "vision"))
    files = {"imagebind": folder / "imagebind_huge.pth", "touch": folder / "last_new.ckpt"}
    torch.save(imagebind.state_dict(), files["imagebind"])
    state = {f"model.{key}": value for key, value in unitouch.state_dict().items()}
    torch.save({"epoch": 3, "state_dict": state}, files["touch"])
    return files, {"image": imagebind, "text": imagebind, "audio": imagebind, "touch": unitouch}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return published(tmp_path_factory.mktemp("published"), small())


@pytest.fixture(scope="module")
def model(files) -> UniTouchModel:
    return UniTouchModel.from_published(**files[0], config=small())


def inputs_of(config: UniTouchConfig) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(2)
    side, text, audio = config.vision_config.image_size, config.text_config, config.audio_config
    ids = torch.randint(1, text.vocab_size - 2, (3, text.max_position_embeddings), generator=generator)
    ids[:, 0] = text.vocab_size - 2
    for row, end in enumerate((4, 7, text.max_position_embeddings - 1)):
        ids[row, end], ids[row, end + 1 :] = text.vocab_size - 1, 0
    return {
        "image": torch.randn(3, 3, side, side, generator=generator),
        "text": ids,
        "audio": torch.randn(3, 1, audio.image_height, audio.image_width, generator=generator),
        "touch": torch.randn(3, 3, side, side, generator=generator),
    }


def features_of(model: UniTouchModel, sense: str, values: torch.Tensor) -> torch.Tensor:
    with torch.no_grad():
        if sense == "audio":
            return model.get_audio_features(values[:, None])
        return getattr(model, f"get_{sense}_features")(values)


def expected(network: torch.nn.Module, sense: str, values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    frames = values[:, :, None].expand(-1, -1, 2, -1, -1) if sense in ("image", "touch") else values
    return network.embed({"image": "vision"}.get(sense, sense), frames)


def relative(found: torch.Tensor, wanted: torch.Tensor) -> float:
    return float((found - wanted).norm() / wanted.norm())


# Embeddings -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sense", ["image", "text", "audio", "touch"])
def test_embeddings_are_those_of_the_published_networks(files, model, sense):
    values = inputs_of(small())[sense]
    features, scaled = expected(files[1][sense], sense, values)
    found = features_of(model, sense, values)
    assert relative(found, features) <= 1e-5
    assert relative(model.scaled(sense, found), scaled) <= 1e-5


@pytest.mark.parametrize("sense", ["image", "text", "audio", "touch"])
def test_embeddings_at_full_width(tmp_path, sense):
    config = full_width()
    files, networks = published(tmp_path, config)
    only = {"touch": files["touch"]} if sense == "touch" else {"imagebind": files["imagebind"]}
    model = UniTouchModel.from_published(**only, config=config)
    values = inputs_of(config)[sense][:1]
    assert relative(features_of(model, sense, values), expected(networks[sense], sense, values)[0]) <= 1e-5


def test_a_clip_of_audio_is_as_long_as_imagebinds():
    assert UniTouchConfig().audio_config.grid == (12, 19)  # and one token more: 229 positions


@pytest.mark.parametrize(
    ("sense", "network", "argument", "output"),
    [
        ("image", CLIPVisionModelWithProjection, "pixel_values", "image_embeds"),
        ("text", CLIPTextModelWithProjection, "input_ids", "text_embeds"),
    ],
)
def test_image_and_text_are_transformers_own_classes(model, sense, network, argument, output):
    own = {"image": model.vision_model, "text": model.text_model}[sense]
    other = network(own.config).eval()
    other.load_state_dict(own.state_dict())
    values = inputs_of(small())[sense]
    with torch.no_grad():
        wanted = getattr(other(**{argument: values}), output)
    assert relative(features_of(model, sense, values), wanted) <= 1e-6


def test_scales_of_logits_are_kept(model):
    assert model.config.logit_scales == pytest.approx({"text": 14.0, "audio": 20.0, "touch": 5.0})


def test_a_learned_scale_is_clipped(tmp_path):
    file = tmp_path / "imagebind.pth"
    torch.save(ImageBind(small(), ("vision", "text", "audio"), text_scale=300.0).state_dict(), file)
    assert UniTouchModel.from_published(imagebind=file, config=small()).config.logit_scales["text"] == 100.0


def test_one_file_brings_its_senses_alone(files):
    touch = UniTouchModel.from_published(touch=files[0]["touch"], config=small())
    assert touch.loaded_senses == ("touch",) and len(touch.sensor_bank) == 0
    with pytest.raises(InvalidInputError, match="`senses` left out 'text'"):
        touch.load("text")
    others = UniTouchModel.from_published(imagebind=files[0]["imagebind"], config=small())
    assert others.loaded_senses == ("image", "text", "audio")


def test_weights_come_in_the_dtype_asked_for(files):
    model = UniTouchModel.from_published(touch=files[0]["touch"], config=small(), dtype=torch.bfloat16)
    assert {weight.dtype for weight in model.parameters()} == {torch.bfloat16} and model.dtype == torch.bfloat16


def test_what_was_read_can_be_saved_and_read_again(files, model, tmp_path):
    model.save_pretrained(tmp_path)
    again = UniTouchModel.from_pretrained(tmp_path)
    for sense, values in inputs_of(small()).items():
        torch.testing.assert_close(features_of(again, sense, values), features_of(model, sense, values))


def test_the_file_is_not_changed_by_training_what_was_read(files):
    before = files[0]["touch"].read_bytes()
    model = UniTouchModel.from_published(touch=files[0]["touch"], config=small())
    with torch.no_grad():
        for weight in model.parameters():
            weight.zero_()
    assert files[0]["touch"].read_bytes() == before
