"""The published checkpoints of ImageBind and UniTouch: what is read of them is what a plain transcription of their
networks computes, what `convert_published` writes of them, and what it leaves alone when something is wrong.
"""

import errno
import json
import math
import shutil
import weakref
from functools import partial
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from transformers import CLIPTextModelWithProjection, CLIPTokenizer, CLIPVisionModelWithProjection

from tests.helpers.imagebind import ImageBind
from tests.helpers.published_files import features_of, full_width, inputs_of, published, small
from unitouch_gen.convert import unitouch as conversion
from unitouch_gen.convert.checkpoints import open_checkpoint
from unitouch_gen.convert.unitouch import convert_published
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import UniTouchConfig, UniTouchModel, UniTouchProcessor


@pytest.fixture(scope="module")
def small_files(tmp_path_factory) -> tuple[dict[str, Path], dict[str, torch.nn.Module]]:
    return published(tmp_path_factory.mktemp("published"), small())


@pytest.fixture(scope="module")
def files(small_files) -> dict[str, Path]:
    return small_files[0]


@pytest.fixture(scope="module")
def networks(small_files) -> dict[str, torch.nn.Module]:
    """What is in the files, by modality."""
    return small_files[1]


@pytest.fixture(scope="module")
def model(files) -> UniTouchModel:
    return UniTouchModel.from_published(**files, config=small())


@pytest.fixture(scope="module")
def folder(files, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("converted")
    convert_published(folder, **files, config=small(), told=lambda line: None)
    return folder


@pytest.fixture
def tokenizer_folder(tmp_path) -> Path:
    words = [
        "<|startoftext|>",
        "<|endoftext|>",
        *"abcdefghijklmnopqrstuvwxyz",
        *(f"{letter}</w>" for letter in "abcdefghijklmnopqrstuvwxyz"),
    ]
    (tmp_path / "words").mkdir()
    (tmp_path / "words" / "vocab.json").write_text(json.dumps({word: number for number, word in enumerate(words)}))
    (tmp_path / "words" / "merges.txt").write_text("#version: 0.2\n")
    CLIPTokenizer(str(tmp_path / "words" / "vocab.json"), str(tmp_path / "words" / "merges.txt")).save_pretrained(
        tmp_path / "tokenizer"
    )
    return tmp_path / "tokenizer"


def edited(files: dict[str, Path], folder: Path, change) -> Path:
    """A copy of UniTouch's file whose state dict was changed."""
    state = open_checkpoint("touch", files["touch"])
    change(state)
    torch.save({"state_dict": state}, folder / "edited.ckpt")
    return folder / "edited.ckpt"


def expected(network: torch.nn.Module, modality: str, values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    frames = values[:, :, None].expand(-1, -1, 2, -1, -1) if modality in ("image", "touch") else values
    return network.embed({"image": "vision"}.get(modality, modality), frames)


def relative(found: torch.Tensor, wanted: torch.Tensor) -> float:
    return float((found - wanted).norm() / wanted.norm())


# Embeddings -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("modality", ["image", "text", "audio", "touch"])
def test_embeddings_are_those_of_the_published_networks(networks, model, modality):
    values = inputs_of(small())[modality]
    features, scaled = expected(networks[modality], modality, values)
    found = features_of(model, modality, values)
    assert relative(found, F.normalize(features, dim=-1) if modality == "audio" else features) <= 1e-5
    assert relative(model.scaled(modality, found), scaled) <= 1e-5


@pytest.mark.parametrize(
    "modality", ["touch", *(pytest.param(name, marks=pytest.mark.slow) for name in ("image", "text", "audio"))]
)
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
def test_image_and_text_are_transformers_own_classes(networks, model, ours, modality, network, output):
    sizes = getattr(small(), f"{modality}_config")
    theirs = network(sizes).eval()
    theirs.load_state_dict(clip_state(networks[ours].state_dict(), modality, sizes.num_hidden_layers), strict=True)
    values = inputs_of(small())[ours]
    with torch.no_grad():
        wanted = getattr(theirs(values), output)
    assert relative(features_of(model, ours, values), wanted) <= 1e-6


def test_clips_of_a_sound_are_averaged_as_imagebind_does(networks, model):
    clips = torch.randn(2, 3, 1, 32, 44, generator=torch.Generator().manual_seed(4))
    wanted = networks["audio"].embed("audio", clips.flatten(0, 1))[1].view(2, 3, -1).mean(dim=1)
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
    UniTouchModel.from_published(touch=files["touch"], config=small(), told=lines.append)
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
    touch = UniTouchModel.from_published(touch=files["touch"], config=small())
    assert touch.loaded_modalities == ("touch",) and len(touch.sensor_bank) == 0
    with pytest.raises(InvalidInputError, match="`modalities` left out 'text'"):
        touch.load("text")
    others = UniTouchModel.from_published(imagebind=files["imagebind"], config=small())
    assert others.loaded_modalities == ("image", "text", "audio")


def test_weights_come_in_the_dtype_asked_for(files):
    model = UniTouchModel.from_published(touch=files["touch"], config=small(), dtype=torch.bfloat16)
    assert {weight.dtype for weight in model.parameters()} == {torch.bfloat16} and model.dtype == torch.bfloat16


def test_what_was_read_can_be_saved_and_read_again(files, model, tmp_path):
    model.save_pretrained(tmp_path)
    again = UniTouchModel.from_pretrained(tmp_path)
    for modality, values in inputs_of(small()).items():
        torch.testing.assert_close(features_of(again, modality, values), features_of(model, modality, values))


def test_the_file_is_not_changed_by_training_what_was_read(files):
    before = files["touch"].read_bytes()
    model = UniTouchModel.from_published(touch=files["touch"], config=small())
    with torch.no_grad():
        for weight in model.parameters():
            weight.zero_()
    assert files["touch"].read_bytes() == before


# The folder -----------------------------------------------------------------------------------------------------------


def test_there_is_one_file_for_each_modality(folder):
    assert sorted(path.name for path in folder.iterdir()) == [
        "config.json", "model-audio.safetensors", "model-image.safetensors", "model-text.safetensors",
        "model-touch.safetensors", "model.safetensors.index.json", "preprocessor_config.json",
    ]  # fmt: skip


@pytest.mark.parametrize("modality", ["image", "text", "audio", "touch"])
def test_the_folder_is_the_model_of_the_files(files, folder, modality):
    model = UniTouchModel.from_pretrained(folder)
    direct = UniTouchModel.from_published(**files, config=small())
    values = inputs_of(small())[modality]
    torch.testing.assert_close(
        features_of(model, modality, values), features_of(direct, modality, values), rtol=0, atol=0
    )
    assert model.loaded_modalities == (modality,)
    assert model.config.logit_scales == direct.config.logit_scales


def test_the_processor_prepares_for_it(folder):
    processor = UniTouchProcessor.from_pretrained(folder)
    assert processor.image_size == 28 and processor.tokenizer is None


def test_the_same_input_makes_the_same_bytes(files, folder, tmp_path, contents):
    for _ in range(2):  # the second one writes over the first
        convert_published(tmp_path / "again", **files, config=small(), told=lambda line: None)
        assert contents(tmp_path / "again") == contents(folder)


def test_a_changed_model_saved_into_the_folder_is_the_one_that_is_read(files, tmp_path):
    convert_published(tmp_path / "model", **files, config=small(), told=lambda line: None)
    model = UniTouchModel.from_pretrained(tmp_path / "model", modalities=("touch",))
    with torch.no_grad():
        model.touch_model.projection.weight.mul_(2.0)
    expected = {modality: features_of(model, modality, values) for modality, values in inputs_of(small()).items()}
    model.save_pretrained(tmp_path / "model")
    again = UniTouchModel.from_pretrained(tmp_path / "model")
    for modality, values in inputs_of(small()).items():
        torch.testing.assert_close(features_of(again, modality, values), expected[modality])
    assert not (tmp_path / "model" / "model-touch.safetensors").exists()


@pytest.mark.parametrize(
    "content", [b"{", b"[]", b"\xff\xfe", b'{"weight_map": 3}', b'{"weight_map": {"touch_model.": ".."}}']
)
@pytest.mark.parametrize("name", ["config.json", "model.safetensors.index.json"])
def test_a_folder_with_broken_settings_is_told_in_words(files, folder, tmp_path, contents, name, content):
    shutil.copytree(folder, tmp_path / "model")
    (tmp_path / "model" / name).write_bytes(content)
    before = contents(tmp_path)
    with pytest.raises(InvalidInputError):
        convert_published(tmp_path / "model", touch=files["touch"], config=small())
    assert contents(tmp_path) == before


@pytest.mark.parametrize("name", ["model_index.json", "unet"])
def test_a_pipeline_is_not_mixed_with_a_joint_space(files, tmp_path, name):
    (tmp_path / "pipeline" / name).mkdir(parents=True)
    with pytest.raises(InvalidInputError, match=rf"`output` is .*holds a pipeline \({name}\)"):
        convert_published(tmp_path / "pipeline", **files, config=small())


def test_an_encoder_that_was_not_converted_is_told_by_name(files, tmp_path):
    convert_published(tmp_path / "model", touch=files["touch"], config=small(), told=lambda line: None)
    with pytest.raises(InvalidInputError, match=r"holds no text encoder; it has touch\. .* convert the checkpoint"):
        UniTouchModel.from_pretrained(tmp_path / "model").load("text")


def test_weights_that_are_cut_off_are_told_with_their_file(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "model")
    weights = tmp_path / "model" / "model-touch.safetensors"
    weights.write_bytes(weights.read_bytes()[:-100])
    with pytest.raises(InvalidInputError, match=r"model-touch.safetensors` does not hold what it says"):
        UniTouchModel.from_pretrained(tmp_path / "model").load("touch")


def test_sounds_are_prepared_for_the_encoder(files, tmp_path):
    convert_published(tmp_path / "model", **files, config=small(), told=lambda line: None)
    processor = UniTouchProcessor.from_pretrained(tmp_path / "model")
    model = UniTouchModel.from_pretrained(tmp_path / "model")
    sound = torch.randn(16_000, generator=torch.Generator().manual_seed(0)).numpy()
    assert model.get_audio_features(processor.sounds((sound, 16_000))).shape == (1, 32)


def test_a_file_is_let_go_when_its_modalities_are_written(files, tmp_path, monkeypatch):
    held, alive = [], []

    def open_and_watch(name, path):
        tensors = open_checkpoint(name, path)
        held.extend(weakref.ref(tensors[key]) for key in tensors if key.endswith(("text.token_embedding.weight",
                                                                                  "touch.cls_token")))  # fmt: skip
        return tensors

    monkeypatch.setattr(conversion, "open_checkpoint", open_and_watch)
    convert_published(tmp_path / "model", **files, config=small(), told=lambda line: None,
                      written=lambda done, size: alive.append([tensor() is not None for tensor in held]))  # fmt: skip
    assert alive[0] == [True, True] and alive[-1] == [False, True]


@pytest.mark.parametrize("order", [("touch", "imagebind"), ("imagebind", "touch")])
def test_files_converted_one_after_the_other_join(files, folder, tmp_path, order, contents):
    for name in order:
        convert_published(tmp_path / "joined", **{name: files[name]}, config=small(), told=lambda line: None)
    found = contents(tmp_path / "joined")
    assert {key: value for key, value in found.items() if key.endswith("safetensors")} == {
        key: value for key, value in contents(folder).items() if key.endswith("safetensors")
    }
    assert json.loads(found["model.safetensors.index.json"]) == json.loads(
        contents(folder)["model.safetensors.index.json"]
    )
    assert UniTouchModel.from_pretrained(tmp_path / "joined").config.logit_scales.keys() == {"text", "audio", "touch"}


def test_what_was_used_ignored_and_missed_is_told(files, tmp_path):
    lines: list[str] = []
    convert_published(tmp_path / "model", touch=files["touch"], config=small(), told=lines.append)
    used, ignored, missed = lines
    assert used.startswith("Used of last_new.ckpt: modality_heads.touch (3)") and "modality_trunks.touch (42)" in used
    assert (
        ignored.startswith("Ignored of last_new.ckpt: modality_heads.vision (3)")
        and "modality_heads.touch" not in ignored
    )
    assert missed.startswith("Missed: the image encoder; the text encoder; the audio encoder; sensor tokens")


def test_the_dtype_is_the_one_asked_for(files, tmp_path):
    convert_published(
        tmp_path / "half", touch=files["touch"], config=small(), dtype=torch.float16, told=lambda line: None
    )
    tensors = open_checkpoint("touch", tmp_path / "half" / "model-touch.safetensors")
    assert {tensor.dtype for tensor in tensors.values() if tensor.is_floating_point()} == {torch.float16}


def test_a_tokenizer_comes_along(files, tmp_path, tokenizer_folder):
    convert_published(tmp_path / "model", imagebind=files["imagebind"], tokenizer=tokenizer_folder, config=small(),
                      told=lambda line: None)  # fmt: skip
    known = CLIPTokenizer.from_pretrained(tokenizer_folder)
    found = UniTouchProcessor.from_pretrained(tmp_path / "model").tokenizer
    assert found("rough brick").input_ids == known("rough brick").input_ids


# Refusals -------------------------------------------------------------------------------------------------------------


def nan(state):
    state["model.modality_trunks.touch.blocks.1.mlp.fc1.weight"][3, 5] = torch.nan


def missing(state):
    for number in range(3):
        del state[f"model.modality_trunks.touch.blocks.{number}.attn.bias_k"]


def misshapen(state):
    state["model.modality_heads.touch.2.weight"] = torch.zeros(32, 65)


def integers(state):
    state["model.modality_heads.touch.2.weight"] = torch.zeros(32, 64, dtype=torch.long)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (nan, ["`touch: modality_trunks.touch.blocks.1.mlp.fc1.weight` holds 1 of 16384 values that are NaN"]),
        (missing, ["`touch` names", "misses modality_trunks.touch.blocks.0.attn.bias_k;", "blocks.2.attn.bias_k"]),
        (misshapen, ["modality_heads.touch.2.weight of (32, 65), float32, for (32, 64)"]),
        (integers, ["modality_heads.touch.2.weight of (32, 64), int64, for (32, 64)"]),
        (lambda state: state.clear() or state.update(one=torch.ones(1)), ["and ", " more"]),
    ],
)
def test_files_of_another_network_change_nothing(files, tmp_path, change, words):
    file = edited(files, tmp_path, change)
    with pytest.raises(InvalidInputError) as caught:
        convert_published(tmp_path / "model", touch=file, config=small())
    assert not [word for word in words if word not in str(caught.value)], caught.value
    assert sorted(path.name for path in tmp_path.iterdir()) == ["edited.ckpt"]


def test_exchanged_files_are_told_by_what_they_lack(files, tmp_path):
    for name, other in (("touch", "imagebind"), ("imagebind", "touch")):
        with pytest.raises(InvalidInputError, match=rf"misses modality_.* It may be the one to pass as `{other}`"):
            convert_published(tmp_path / "model", **{name: files[other]}, config=small())
    assert not (tmp_path / "model").exists()


def test_something_has_to_come(tmp_path):
    with pytest.raises(InvalidInputError, match=r"Pass `touch`, `imagebind` or both"):
        convert_published(tmp_path / "model", config=small())


def test_a_full_disk_leaves_what_was_there(files, tmp_path, monkeypatch, contents):
    convert_published(tmp_path / "model", touch=files["touch"], config=small(), told=lambda line: None)
    before, write = contents(tmp_path), conversion.write_tensors

    def full(folder, files, written):
        write(folder, dict(list(files.items())[:1]), written)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(conversion, "write_tensors", full)
    with pytest.raises(InvalidInputError, match=r"`output` cannot .*: No space left on device. Nothing was changed"):
        convert_published(tmp_path / "model", imagebind=files["imagebind"], config=small())
    assert contents(tmp_path) == before


def test_a_disk_that_is_too_small_is_told_before_anything_is_written(files, tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=1000))
    with pytest.raises(InvalidInputError, match=r"`output` cannot be written to .* MB are needed"):
        convert_published(tmp_path / "model", touch=files["touch"], config=small())
    assert list(tmp_path.iterdir()) == []


def test_another_model_is_not_written_over(files, folder, tmp_path, contents):
    other = small().to_dict()
    other["sensors"] = ["digit"]
    (tmp_path / "model").mkdir()
    UniTouchConfig.from_dict(other).save_pretrained(tmp_path / "model")
    before = contents(tmp_path)
    with pytest.raises(InvalidInputError, match=r"holds another model"):
        convert_published(tmp_path / "model", touch=files["touch"], config=small())
    assert contents(tmp_path) == before


def test_an_index_never_leads_out_of_its_folder(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "model")
    (tmp_path / "model" / "model-touch.safetensors").rename(tmp_path / "outside.safetensors")
    index = tmp_path / "model" / "model.safetensors.index.json"
    index.write_text(index.read_text().replace("model-touch.safetensors", "../outside.safetensors"))
    with pytest.raises(InvalidInputError, match=r"'../outside.safetensors', which is not in its folder"):
        UniTouchModel.from_pretrained(tmp_path / "model", modalities=("touch",))
