"""What is learned of contacts under two sensors: touches and pictures, by the objectives of their stages."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from pydantic import ValidationError
from scipy.stats import zscore

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import UniTouchModel, UniTouchProcessor
from unitouch_gen.models.images import normalise_pixels
from unitouch_gen.training.batches import FARTHEST, jitter_colours, shift_pixels
from unitouch_gen.training.data import DataConfig, DrawnConfig, columns_of, sensor_numbers
from unitouch_gen.training.image_text import ImageTextObjective, attributes_of
from unitouch_gen.training.losses import symmetric_info_nce
from unitouch_gen.training.picture_classifier import SHOWN
from unitouch_gen.training.touch import LossWeights, TouchAugmentation, TouchObjective, pairs_of
from unitouch_gen.world import ATTRIBUTES

CONFIG = DataConfig(drawn=DrawnConfig(sensors=[None, "digit"], objects=1, contacts_per_object=1))
PLAIN = TouchAugmentation(turn=0.0, permute=0.0, blur=0.0)


@pytest.fixture(scope="module")
def splits(tmp_path_factory, _processor: UniTouchProcessor):
    cache = tmp_path_factory.mktemp("drawn")
    return columns_of(CONFIG.sources(), cache, CONFIG, _processor, ("image", "touch", "sensor"))


def batch_of(splits, processor: UniTouchProcessor) -> dict[str, torch.Tensor]:
    columns = pairs_of(splits, LossWeights(touch=1.0, attributes=1.0))
    stacked = {
        name: torch.from_numpy(np.concatenate([getattr(s, name) for s in splits])) for name in ("touch", "second")
    }
    sensor = torch.from_numpy(sensor_numbers(splits, ["gelsight", "digit"]))
    embeds = torch.randn(len(sensor), 16, generator=torch.Generator().manual_seed(0))
    return {**stacked, "sensor": sensor, "image_embeds": embeds, "attributes": torch.from_numpy(columns["attributes"]),
            "maps": torch.from_numpy(columns["maps"]), "shown": torch.tensor([1.0] * 17 + [0.0] * 17)}  # fmt: skip


def test_a_drawn_sensor_has_no_tokens_and_a_named_one_its_own(splits, model: UniTouchModel, processor) -> None:
    encoder = TouchObjective(model, PLAIN).eval().trained
    batch = batch_of(splits, processor)
    pixels = torch.rand(34, 3, 32, 32, generator=torch.Generator().manual_seed(1))
    mixed = torch.randperm(34, generator=torch.Generator().manual_seed(2))
    found = encoder(pixels[mixed], batch["sensor"][mixed])
    expected = torch.empty_like(found)
    for row, index in enumerate(mixed.tolist()):
        number = batch["sensor"][index : index + 1]
        tokens = model.sensor_bank(number) if number >= 0 else None
        expected[row] = model.touch_model(pixels[index : index + 1], tokens)[0]
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-5)


def test_the_loss_is_the_weighted_sum_of_its_parts(splits, model: UniTouchModel, processor, monkeypatch) -> None:
    weights = LossWeights(image=0.5, cosine=4.0, touch=0.25, attributes=2.0, maps=3.0)
    objective, batch = TouchObjective(model, PLAIN, weights).eval(), batch_of(splits, processor)
    monkeypatch.setattr(objective, "augmented", lambda touch: touch.float() / 255 - 0.5)
    found = objective(batch)
    first = objective.trained(batch["touch"].float() / 255 - 0.5, batch["sensor"])
    second = objective.trained(batch["second"].float() / 255 - 0.5, torch.full((34,), -1))
    tau = model.config.temperature
    mapped = []
    for name, sensor in (("touch", batch["sensor"]), ("second", torch.full((34,), -1))):
        _, patches = objective.trained.features(batch[name].float() / 255 - 0.5, sensor)
        mapped.append(objective.trained.mapper(patches.movedim(1, -1)).movedim(-1, 1))
    read = torch.stack([objective.trained.reader(first), objective.trained.reader(second)], dim=1)
    near = slice(17)  # what follows are grasps here
    pictures = F.normalize(batch["image_embeds"][near], dim=1)
    apart = 2.0 - sum((F.normalize(one[near], dim=1) * pictures).sum(dim=1) for one in (first, second))
    parts = {
        "image": symmetric_info_nce(first, batch["image_embeds"], tau),
        "cosine": apart.sum() / 34,
        "touch": symmetric_info_nce(first, second, tau),
        "attributes": F.mse_loss(read, batch["attributes"]),
        "maps": F.mse_loss(torch.stack(mapped, dim=1), batch["maps"].float()),
    }
    for name, part in parts.items():
        torch.testing.assert_close(found[name], part.detach())
    weighed = [getattr(weights, name) * part for name, part in parts.items()]
    expected = torch.stack(weighed).sum()
    torch.testing.assert_close(found["loss"], expected)


def test_attributes_are_learned_in_units_of_their_deviation(splits) -> None:
    attributes = pairs_of(splits, LossWeights(attributes=1.0))["attributes"]
    raw = np.concatenate([split.attributes for split in splits])
    assert attributes.shape == (34, 2, len(ATTRIBUTES)) and np.abs(attributes).max() <= 5.0
    for column, values in zip(attributes.reshape(68, -1).T, raw.reshape(68, -1).T, strict=True):
        kept = np.abs(column) < 5.0
        slope, _ = np.polyfit(values[kept], column[kept], 1)
        assert slope == pytest.approx(1 / max(values.std(), 1e-3), rel=1e-3)


def test_pictures_learn_what_a_touch_would_measure(splits, model: UniTouchModel, processor) -> None:
    names = SHOWN["image"]
    attributes = torch.from_numpy(attributes_of(splits, names)["attributes"])
    both = np.concatenate([split.attributes for split in splits]).mean(axis=1)[:, [ATTRIBUTES.index(n) for n in names]]
    expected = zscore(both, axis=0).clip(-FARTHEST, FARTHEST)
    np.testing.assert_allclose(attributes, expected, atol=1e-3)
    torch.manual_seed(0)
    objective = ImageTextObjective(model, 0.07, 2.0).eval()
    texts = [caption for split in splits for caption in split.text]
    pixels = torch.from_numpy(np.concatenate([split.image for split in splits]))
    input_ids = processor.text(texts)["input_ids"][:, None]
    batch = {"image": pixels, "input_ids": input_ids, "attributes": attributes, "shown": torch.ones(len(pixels))}
    found = objective(batch)
    torch.testing.assert_close(found["loss"], found["text"] + 2.0 * found["attributes"])
    optimizer = torch.optim.Adam(objective.reader.parameters(), lr=0.1)
    for _ in range(60):
        optimizer.zero_grad()
        objective(batch)["loss"].backward()
        optimizer.step()
    assert objective(batch)["attributes"] < 0.8 * found["attributes"]


def test_pictures_are_kept_where_they_were_but_those_of_grasps(splits, model: UniTouchModel, processor) -> None:
    objective = ImageTextObjective(model, 0.07, kept=3.0).eval()
    pixels = torch.from_numpy(np.concatenate([split.image for split in splits]))
    texts = processor.text([caption for split in splits for caption in split.text])["input_ids"][:, None]
    batch = {"image": pixels, "input_ids": texts, "shown": torch.tensor([1.0] * 17 + [0.0] * 17)}

    def found(before: torch.Tensor) -> dict[str, torch.Tensor]:
        torch.manual_seed(0)  # of shifts and colours
        return objective({**batch, "before": before})

    with torch.no_grad():
        torch.manual_seed(0)
        raw = jitter_colours(shift_pixels(pixels.float() / 255, 4), gain=0.08, offset=0.03)
        embeds = model.get_image_features(normalise_pixels(raw))
    assert found(embeds)["kept"] < 1e-9
    moved = embeds.clone()
    moved[17:] += 1.0
    assert found(moved)["kept"] < 1e-9
    doubled = found(2.0 * embeds)
    share = (embeds[:17] ** 2).sum() / (embeds**2).sum()
    torch.testing.assert_close(doubled["kept"], share / 4.0)
    torch.testing.assert_close(doubled["loss"].detach(), doubled["text"] + 3.0 * doubled["kept"])


def test_pairs_with_a_weight_are_needed(splits) -> None:
    assert pairs_of([replace(split, second=None) for split in splits], LossWeights()) == {}
    with pytest.raises(InvalidInputError, match=r"`objective` weighs pairs .*`data.drawn`"):
        pairs_of([splits[0], replace(splits[1], second=None)], LossWeights(touch=1.0))


def test_weights_of_nothing_are_refused() -> None:
    with pytest.raises((ValidationError, InvalidInputError), match="`objective` weighs nothing"):
        LossWeights(image=0.0)
