"""The held-out contacts, and the shares that are told of what is generated."""

import pytest
import torch

from tests.benchmarks.quality import CONTACTS, held_out, some_of_each, touch_to_image_figures
from unitouch_gen.world import COLLECTION_MATERIALS


@pytest.mark.parametrize(("split", "objects"), [("val", 8), ("test", 16)])
def test_held_out_contacts_come_by_material(split: str, objects: int) -> None:
    material = held_out("world_digit_unseen", split, ("text",)).material
    expected = torch.arange(len(COLLECTION_MATERIALS)).repeat_interleave(objects * CONTACTS)
    assert torch.equal(torch.as_tensor(material), expected)


@pytest.mark.parametrize("per_material", [1, 3, 8])
@pytest.mark.parametrize("each", [8, 32, 64])
def test_some_of_each_material_are_taken_once(per_material: int, each: int) -> None:
    material = torch.arange(len(COLLECTION_MATERIALS)).repeat_interleave(each)
    rows = some_of_each(material, per_material)
    assert len(set(rows.tolist())) == len(rows)
    assert torch.bincount(material[rows]).tolist() == [per_material] * len(COLLECTION_MATERIALS)


def test_figures_of_generation_are_shares_of_as_many_pictures_as_they_say() -> None:
    figures = touch_to_image_figures("val", 1, 1, ["world_taxim"], num_inference_steps=2)
    assert figures["pictures_each"] == len(COLLECTION_MATERIALS)
    for key in ("consistency", "ceiling", "floor"):
        for share in figures[key].values():
            assert (share * figures["pictures_each"]) % 1 == pytest.approx(0, abs=1e-4) or share == pytest.approx(1)
    assert figures["ceiling_mean"] > 0.8 > figures["floor_mean"] and figures["spread"] == dict.fromkeys(
        figures["spread"], 0.0
    )
