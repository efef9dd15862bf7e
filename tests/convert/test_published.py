"""Published checkpoints: what is read of them is what a plain transcription of their networks computes."""

import math
from functools import partial

import pytest
import torch
import torch.nn.functional as F
from transformers import CLIPTextModelWithProjection, CLIPVisionModelWithProjection

from tests.helpers.imagebind import ImageBind
from tests.helpers.published_files import features_of, full_width, inputs_of, published, small
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import UniTouchConfig, UniTouchModel


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return published(tmp_path_factory.mktemp("published"), small())


@pytest.fixture(scope="module")
def model(files) -> UniTouchModel:
    return UniTouchModel.from_published(**files[0], config=small())


def expected(network: torch.nn.Module, modality: str, values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    frames = values[:, :, None].expand(-1, -1, 2, -1, -1) if modality in ("image", "touch") else values
    return network.embed({"image": "vision"}.get(modality, modality), frames)


def relative(found: torch.Tensor, wanted: torch.Tensor) -> float:
    return float((found - wanted).norm() / wanted.norm())


# Embeddings -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("modality", ["image", "text", "audio", "touch"])
def test_embeddings_are_those_of_the_published_networks(files, model, modality):
    values = inputs_of(small())[modality]
    features, scaled = expected(files[1][modality], modality, values)
    found = features_of(model, modality, values)
    assert relative(found, F.normalize(features, dim=-1) if modality == "audio" else features) <= 1e-5
    assert relative(model.scaled(modality, found), scaled) <= 1e-5


@pytest.mark.parametrize("modality", ["image", "text", "audio", "touch"])
def test_embeddings_at_full_width(tmp_path, modality):
    config = full_width()
    files, networks = published(tmp_path, config)
    only = {"touch": files["touch"]} if modality == "touch" else {"imagebind": files["imagebind"]}
    model = UniTouchModel.from_published(**only, config=config)
    values = inputs_of(config)[modality][:1]
    _, scaled = expected(networks[modality], modality, values)
    assert relative(model.scaled(modality, features_of(model, modality, values)), scaled) <= 1e-5


def test_a_clip_of_audio_is_as_long_as_imagebinds():
    assert UniTouchConfig().audio_config.grid == (12, 19)  # and one token more: 229 positions


def clip_state(state: dict[str, torch.Tensor], modality: str, depth: int) -> dict[str, torch.Tensor]:
    """ImageBind's tensors by the names of transformers' CLIP classes, written down apart from the package's tables."""
    parts = {name: f"modality_{name}.{modality}." for name in ("preprocessors", "trunks", "heads")}
    found: dict[str, torch.Tensor] = {}

    def take(ours: str, theirs: str) -> None:
        found.update({f"{ours}.{kind}": state[f"{theirs}.{kind}"] for kind in ("weight", "bias")})

    if modality == "vision":
        found["embeddings.class_embedding"] = state[f"{parts['preprocessors']}cls_token"].flatten()
        frames = state[f"{parts['preprocessors']}rgbt_stem.proj.1.weight"]
        found["embeddings.patch_embedding.weight"] = frames[:, :, 0] + frames[:, :, 1]
        positions = state[f"{parts['preprocessors']}pos_embedding_helper.pos_embed"]
        take("pre_layrnorm", f"{parts['trunks']}pre_transformer_layer.0")
        take("post_layernorm", f"{parts['heads']}0")
    else:
        found["embeddings.token_embedding.weight"] = state[f"{parts['preprocessors']}token_embedding.weight"]
        positions = state[f"{parts['preprocessors']}pos_embed"]
        take("final_layer_norm", f"{parts['heads']}proj.0")
    found["embeddings.position_embedding.weight"] = positions.squeeze(0)
    for layer in range(depth):
        block, own = f"{parts['trunks']}blocks.{layer}", f"encoder.layers.{layer}"
        for kind in ("weight", "bias"):
            stacked = state[f"{block}.attn.in_proj_{kind}"]
            width = len(stacked) // 3
            for place, name in enumerate(("q_proj", "k_proj", "v_proj")):
                found[f"{own}.self_attn.{name}.{kind}"] = stacked[place * width : (place + 1) * width]
        take(f"{own}.self_attn.out_proj", f"{block}.attn.out_proj")
        for ours, theirs in (("layer_norm1", "norm_1"), ("layer_norm2", "norm_2"), ("mlp.fc1", "mlp.fc1"),
                             ("mlp.fc2", "mlp.fc2")):  # fmt: skip
            take(f"{own}.{ours}", f"{block}.{theirs}")
    projection = f"{parts['heads']}{'2' if modality == 'vision' else 'proj.1'}.weight"
    names = {"vision": ("vision_model", "visual_projection"), "text": ("text_model", "text_projection")}[modality]
    return {f"{names[0]}.{key}": value for key, value in found.items()} | {f"{names[1]}.weight": state[projection]}


@pytest.mark.parametrize(
    ("ours", "modality", "network", "output"),
    [
        ("image", "vision", CLIPVisionModelWithProjection, "image_embeds"),
        ("text", "text", CLIPTextModelWithProjection, "text_embeds"),
    ],
)
def test_image_and_text_are_transformers_own_classes(files, model, ours, modality, network, output):
    sizes = getattr(small(), f"{modality}_config")
    theirs = network(sizes).eval()
    theirs.load_state_dict(clip_state(files[1][ours].state_dict(), modality, sizes.num_hidden_layers), strict=True)
    values = inputs_of(small())[ours]
    with torch.no_grad():
        wanted = getattr(theirs(values), output)
    assert relative(features_of(model, ours, values), wanted) <= 1e-6


def test_clips_of_a_sound_are_averaged_as_imagebind_does(files, model):
    clips = torch.randn(2, 3, 1, 32, 44, generator=torch.Generator().manual_seed(4))
    wanted = files[1]["audio"].embed("audio", clips.flatten(0, 1))[1].view(2, 3, -1).mean(dim=1)
    with torch.no_grad():
        found = model.get_audio_features(clips)
    assert relative(model.scaled("audio", found), wanted) <= 1e-5


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_scale_that_is_no_number(tmp_path, value):
    state = ImageBind(small()).state_dict()
    state["modality_postprocessors.text.1.log_logit_scale"].fill_(value)
    torch.save(state, tmp_path / "imagebind.pth")
    with pytest.raises(InvalidInputError, match="log_logit_scale` is"):
        UniTouchModel.from_published(imagebind=tmp_path / "imagebind.pth", config=small())


def test_weights_that_overflow_in_the_dtype_asked_for(tmp_path):
    state = ImageBind(small(), ("touch",)).state_dict()
    state["modality_heads.touch.2.weight"][0, 0] = 1e6
    torch.save(state, tmp_path / "last.ckpt")
    read = partial(UniTouchModel.from_published, touch=tmp_path / "last.ckpt", config=small())
    with pytest.raises(InvalidInputError, match=r"`dtype` is torch.float16, in which .*heads.touch.2.weight overflows"):
        read(dtype=torch.float16)
    assert torch.isfinite(read(dtype=torch.bfloat16).touch_model.projection.weight).all()


def test_scales_that_the_file_leaves_out_are_those_of_the_release(tmp_path):
    state = {key: value for key, value in ImageBind(small()).state_dict().items() if "log_logit_scale" not in key}
    torch.save(state, tmp_path / "imagebind.pth")
    model = UniTouchModel.from_published(imagebind=tmp_path / "imagebind.pth", config=small())
    assert model.config.logit_scales == {"audio": 20.0}


def test_it_says_what_was_used_ignored_and_missed(files):
    lines: list[str] = []
    UniTouchModel.from_published(touch=files[0]["touch"], config=small(), told=lines.append)
    assert lines[0].startswith("Used of last_new.ckpt: modality_heads.touch (3)")
    assert lines[1].startswith("Ignored of last_new.ckpt: modality_heads.vision")
    assert lines[2].startswith("Missed: the image encoder; the text encoder; the audio encoder; sensor tokens")


def test_scales_of_logits_are_kept(model):
    assert model.config.logit_scales == pytest.approx({"text": 14.0, "audio": 20.0, "touch": 5.0})


def test_a_learned_scale_is_clipped(tmp_path):
    file = tmp_path / "imagebind.pth"
    torch.save(ImageBind(small(), ("vision", "text", "audio"), text_scale=300.0).state_dict(), file)
    assert UniTouchModel.from_published(imagebind=file, config=small()).config.logit_scales["text"] == 100.0


def test_one_file_brings_its_modalities_alone(files):
    touch = UniTouchModel.from_published(touch=files[0]["touch"], config=small())
    assert touch.loaded_modalities == ("touch",) and len(touch.sensor_bank) == 0
    with pytest.raises(InvalidInputError, match="`modalities` left out 'text'"):
        touch.load("text")
    others = UniTouchModel.from_published(imagebind=files[0]["imagebind"], config=small())
    assert others.loaded_modalities == ("image", "text", "audio")


def test_weights_come_in_the_dtype_asked_for(files):
    model = UniTouchModel.from_published(touch=files[0]["touch"], config=small(), dtype=torch.bfloat16)
    assert {weight.dtype for weight in model.parameters()} == {torch.bfloat16} and model.dtype == torch.bfloat16


def test_what_was_read_can_be_saved_and_read_again(files, model, tmp_path):
    model.save_pretrained(tmp_path)
    again = UniTouchModel.from_pretrained(tmp_path)
    for modality, values in inputs_of(small()).items():
        torch.testing.assert_close(features_of(again, modality, values), features_of(model, modality, values))


def test_the_file_is_not_changed_by_training_what_was_read(files):
    before = files[0]["touch"].read_bytes()
    model = UniTouchModel.from_published(touch=files[0]["touch"], config=small())
    with torch.no_grad():
        for weight in model.parameters():
            weight.zero_()
    assert files[0]["touch"].read_bytes() == before
