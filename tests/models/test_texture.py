"""Texture: the trunk against the published network, and what heads add to a joint space."""

from pathlib import Path

import pytest
import torch
from efficientnet_lite_pytorch import EfficientNet
from safetensors.torch import save_file
from texture_trunk import folded, published_weights

from tests.helpers.components import clip_tokenizer, joint_config
from unitouch_gen.models import UniTouchModel
from unitouch_gen.models.images import denormalise_pixels
from unitouch_gen.models.texture import TAPPED, TextureTrunk
from unitouch_gen.training.texture import TRUNK, TextureLosses, TextureObjective, read_trunk
from unitouch_gen.training.touch import LossWeights, TouchEncoder


@pytest.mark.parametrize("size", [32, 128])
def test_the_trunk_is_the_published_network(size: int) -> None:
    published = EfficientNet.from_name("efficientnet-lite0").eval()
    published.load_state_dict(published_weights())
    trunk = TextureTrunk()
    trunk.load_state_dict(folded(published_weights()))
    images = torch.rand(2, 3, size, size)
    with torch.no_grad():
        x = published._swish(published._bn0(published._conv_stem((images * 255 - 127) / 128)))
        expected = []
        for number, block in enumerate(published._blocks[: TAPPED[-1] + 1]):
            x = block(x)
            expected += [x] if number in TAPPED else []
        layers = trunk.layers(images)
        statistics = trunk(images)
    for ours, theirs in zip(layers, expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-3)
    described = [values for layer in expected for values in (layer.mean(dim=(2, 3)), layer.std(dim=(2, 3)))]
    torch.testing.assert_close(statistics, torch.cat(described, dim=1), rtol=1e-3, atol=1e-3)


def with_texture() -> UniTouchModel:
    config = joint_config(clip_tokenizer())
    config = joint_config(
        clip_tokenizer(),
        vision_config={**config.vision_config.to_dict(), "stem": "residual", "texture_width": 8},
        touch_config={**config.touch_config.to_dict(), "texture_width": 8},
    )
    return UniTouchModel(config).eval()


def test_texture_is_added_to_embeddings(tmp_path: Path) -> None:
    pixels = torch.randn(2, 3, 32, 32)
    ids = torch.tensor([-1, -1])
    model = with_texture()
    image = model.vision_model.texture
    touch = model.touch_model.texture
    model.vision_model.texture = model.touch_model.texture = None
    plain = model.get_image_features(pixels), model.get_touch_features(pixels, ids)
    model.vision_model.texture, model.touch_model.texture = image, touch
    assert torch.equal(model.get_image_features(pixels), plain[0])  # the last layer begins at zero
    torch.nn.init.normal_(image.head.project.weight)
    found = model.get_image_features(pixels), model.get_touch_features(pixels, ids)
    statistics = image.trunk(denormalise_pixels(pixels))
    torch.testing.assert_close(found[0] - plain[0], image.head(statistics), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(found[1] - plain[1], touch(pixels), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(model.touch_model(pixels), found[1], rtol=1e-4, atol=1e-4)
    trained, _ = TouchEncoder(model, LossWeights())(pixels, ids)
    torch.testing.assert_close(trained, found[1], rtol=1e-4, atol=1e-4)

    model.save_pretrained(tmp_path)
    again = UniTouchModel.from_pretrained(tmp_path)
    assert torch.equal(again.get_image_features(pixels), found[0])
    assert torch.equal(again.get_touch_features(pixels, ids), found[1])


def test_the_trunk_of_texture_is_frozen() -> None:
    model = with_texture()
    for encoder in (model.vision_model, model.touch_model):
        assert not any(weight.requires_grad for weight in encoder.texture.trunk.parameters())
        assert all(weight.requires_grad for weight in encoder.texture.head.parameters())


def test_the_trunk_of_a_joint_space_is_read_where_it_has_one(tmp_path: Path) -> None:
    trunk = TextureTrunk()
    save_file(
        {TRUNK + name: values.half() for name, values in trunk.state_dict().items()}, tmp_path / "model.safetensors"
    )
    images = torch.rand(1, 3, 32, 32)
    read = read_trunk(tmp_path)
    assert read is not None
    torch.testing.assert_close(read(images), trunk.half().float()(images))
    save_file({"touch_model.proj": torch.ones(1)}, tmp_path / "model.safetensors")
    assert read_trunk(tmp_path) is None


def test_only_changes_of_drawn_contacts_are_penalised() -> None:
    weights = dict.fromkeys(("image", "touch", "text", "image_name", "touch_name", "drawn", "drawn_touch"), 1.0)
    objective = TextureObjective(with_texture(), TextureLosses(**weights), torch.eye(3, 32))
    embeds = torch.eye(4, 32)
    batch = {"touch_embeds": embeds, "drawn": torch.tensor([1.0, 1.0, 0.0, 0.0])}
    turned = torch.stack([embeds[0], embeds[0], -embeds[2], -embeds[3]])  # by 0, 90, 180 and 180 degrees
    torch.testing.assert_close(objective.change(turned, batch, "touch"), torch.tensor(0.5))
    batch["drawn"] = torch.zeros(4)
    assert objective.change(turned, batch, "touch") == 0.0
