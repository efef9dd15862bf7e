"""Touches that the encoder does not know, on the built-in weights; untouched gels; and what is said of them."""

import numpy as np
import pytest
import torch

from unitouch_gen import weights
from unitouch_gen.errors import UnfamiliarInputWarning
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.models.joint import UNLIKE, UNTOUCHED, touch_statistics, warn_of_unknown
from unitouch_gen.models.videos import is_untouched
from unitouch_gen.world import FIRST_OBJECT, MATERIAL_NAMES, World, draw_sensor


@pytest.fixture(scope="module")
def scene():
    """Held-out objects of all materials."""
    material = torch.arange(len(MATERIAL_NAMES))
    names = material, torch.full_like(material, FIRST_OBJECT["test"]), torch.zeros_like(material)
    return World().render(*names, modalities=("touch", "image"), sensors=("gelsight", "digit", draw_sensor(5, 0)))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16])
def test_pictures_are_unknown_and_touches_are_not(scene, dtype, tmp_path) -> None:
    """Of sensors that the encoder was not trained on, too; and as saved again."""
    UniTouchModel.from_pretrained(weights.JOINT, dtype=dtype).save_pretrained(tmp_path)
    model = UniTouchModel.from_pretrained(tmp_path)
    processor = UniTouchProcessor.from_pretrained(weights.JOINT)
    for pictures, low, high in ((scene.image, 0.7, 1.0), *((touch, 0.0, 0.15) for touch in scene.touch.values())):
        reasons = model.encode_touches(processor.touch(pictures))[1]
        assert set(reasons) <= {None, "unlike anything known"}
        assert low <= sum(map(bool, reasons)) / len(reasons) <= high


def test_a_model_without_a_distance_says_nothing(model: UniTouchModel, inputs: dict) -> None:
    assert model.encode_touches(**inputs["touch"])[1] == [None] * len(inputs["touch"]["pixel_values"])


def test_a_touch_is_compared_with_its_gel_at_rest() -> None:
    rest = torch.rand(1, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    noise = rest + 0.01 * torch.randn(1, 3, 64, 64, generator=torch.Generator().manual_seed(1))
    pressed = rest.clone()
    pressed[..., 20:30, 20:30] += 0.05
    assert is_untouched(torch.cat([rest, noise, pressed]), rest).tolist() == [True, True, False]


def test_pixels_correlate_as_numpy_has_it_and_grey_ones_have_one_axis() -> None:
    noise = torch.rand(1, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    mixed = torch.stack([noise[:, 0], 0.5 * noise[:, 0] + 0.5 * noise[:, 1], noise[:, 2]], dim=1)
    grey = noise[:, :1].expand(-1, 3, -1, -1)
    pixels = normalise_pixels(torch.cat([mixed, grey, torch.full_like(grey, 0.3)]))
    statistics = touch_statistics(torch.ones(3, 2, 4, 4), pixels)
    assert (statistics[:, :2] == 1.0).all()
    assert bool(torch.isfinite(statistics).all())
    statistics = statistics[:, 2:]
    expected = np.corrcoef(mixed.flatten(2)[0].numpy())[[0, 0, 1], [1, 2, 2]]
    np.testing.assert_allclose(statistics[0, 6:9], expected, atol=0.03)  # noise is detail, all but a little
    torch.testing.assert_close(statistics[1, 6:9], torch.ones(3), rtol=0.0, atol=1e-4)
    assert (statistics[1, 11] - statistics[1, 10]) > 10.0 > (statistics[0, 11] - statistics[0, 10])
    torch.testing.assert_close(statistics[2, :6], torch.tensor([0.3] * 3 + [0.0] * 3))


def test_unknown_touches_are_told_by_their_places_in_one_line() -> None:
    with pytest.warns(UnfamiliarInputWarning, match="^`touch`: unlike anything known. The result"):
        warn_of_unknown([UNLIKE], 2)
    many = "^`touch.1.`: nothing is touched; `touch.2.`: unlike anything known; .* and 3 more. The result"
    with pytest.warns(UnfamiliarInputWarning, match=many):
        warn_of_unknown([None, UNTOUCHED, *5 * [UNLIKE]], 2)
