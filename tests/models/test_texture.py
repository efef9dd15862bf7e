"""Texture: the trunk against the published network, and what heads add to a joint space."""

from pathlib import Path

import pytest
import torch
from efficientnet_lite_pytorch import EfficientNet
from texture_trunk import folded, published_weights

from tests.helpers.components import clip_tokenizer, joint_config
from unitouch_gen.models import UniTouchModel
from unitouch_gen.models.images import denormalise_pixels
from unitouch_gen.models.texture import DESCRIBED, TextureTrunk
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
        for number, block in enumerate(published._blocks[: DESCRIBED[-1] + 1]):
            x = block(x)
            expected += [x] if number in DESCRIBED else []
        layers = trunk.layers(images)
        statistics = trunk(images)
    for ours, theirs in zip(layers, expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-3)
    described = [values for layer in expected for values in (layer.mean(dim=(2, 3)), layer.std(dim=(2, 3)))]
    torch.testing.assert_close(statistics, torch.cat(described, dim=1), rtol=1e-3, atol=1e-3)


def test_heads_add_nothing_until_they_are_trained(tmp_path: Path) -> None:
    pixels, model = torch.randn(2, 3, 32, 32), UniTouchModel(joint_config(clip_tokenizer(), texture_width=8)).eval()
    transformer = model.vision_model(pixel_values=pixels).image_embeds
    assert torch.equal(model.get_image_features(pixels), transformer)
    torch.nn.init.normal_(model.image_texture.project.weight)
    torch.nn.init.normal_(model.touch_texture.project.weight)
    added = model.get_image_features(pixels) - transformer
    statistics = model.texture_trunk(denormalise_pixels(pixels))
    torch.testing.assert_close(added, model.image_texture(statistics), rtol=1e-4, atol=1e-4)
    ids = torch.tensor([-1, -1])
    plain = model.touch_model(pixels)
    added = model.get_touch_features(pixels, ids) - plain
    torch.testing.assert_close(added, model.touch_texture(statistics), rtol=1e-4, atol=1e-4)

    model.save_pretrained(tmp_path)
    again = UniTouchModel.from_pretrained(tmp_path)
    assert torch.equal(again.get_image_features(pixels), model.get_image_features(pixels))
    assert "touch_model" not in again._modules  # image alone was read
    assert torch.equal(again.get_touch_features(pixels, ids), model.get_touch_features(pixels, ids))


def test_training_sees_the_touches_that_the_model_sees() -> None:
    model = UniTouchModel(joint_config(clip_tokenizer(), texture_width=8)).eval()
    torch.nn.init.normal_(model.touch_texture.project.weight)
    pixels, ids = torch.randn(2, 3, 32, 32), torch.tensor([-1, -1])
    trained, _ = TouchEncoder(model, LossWeights())(pixels, ids)
    torch.testing.assert_close(trained, model.get_touch_features(pixels, ids), rtol=1e-4, atol=1e-4)


def test_a_trunk_learns_nothing() -> None:
    model = UniTouchModel(joint_config(clip_tokenizer(), texture_width=8), modalities=("image",))
    trunk = model.texture_trunk
    model.add("image")
    assert model.texture_trunk is trunk
    assert not any(weight.requires_grad for weight in trunk.parameters())
