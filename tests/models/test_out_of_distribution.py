"""Out-of-distribution scores against scipy, their thresholds, and how they are kept with a model."""

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from scipy.spatial.distance import mahalanobis

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import UniTouchConfig, UniTouchModel
from unitouch_gen.models.out_of_distribution import (
    Direction,
    Gaussians,
    OutOfDistribution,
    is_untouched,
    pixel_statistics,
    share_of_unseen,
)


def drawn(count: int, shift: float, seed: int) -> torch.Tensor:
    """Correlated features of unlike scales."""
    mixing = torch.randn(6, 6, generator=torch.Generator().manual_seed(0)) * torch.tensor(
        [1.0, 3.0, 0.1, 1.0, 10.0, 1.0]
    )
    return (torch.randn(count, 6, generator=torch.Generator().manual_seed(seed)) + shift) @ mixing


def test_the_distance_is_mahalanobis_to_the_nearest_class() -> None:
    features, labels = torch.cat([drawn(300, 0.0, 1), drawn(300, 4.0, 2)]), torch.arange(2).repeat_interleave(300)
    means = [features[labels == label].double().mean(dim=0).numpy() for label in (0, 1)]
    rest = features.double().numpy() - np.stack(means)[labels]
    inverse = np.linalg.inv(rest.T @ rest / 600)
    found = Gaussians.of(features, labels, shrinkage=0.0)(drawn(20, 2.0, 3))
    expected = [
        min(mahalanobis(row, mean, inverse) for mean in means) ** 2 for row in drawn(20, 2.0, 3).double().numpy()
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-3)


def test_known_inputs_are_kept_but_for_the_share_and_others_are_not() -> None:
    groups = {"known": Gaussians.of(drawn(2000, 0.0, 1)), "foreign": Gaussians.of(drawn(500, 1.5, 2))}
    scores = OutOfDistribution.of(groups, drawn(4000, 0.0, 3), share=0.04)
    assert scores.thresholds.keys() == {"distance", "foreign"}
    abstained = [sum(map(bool, scores.reasons(drawn(4000, shift, 4)))) / 4000 for shift in (0.0, 1.5, 8.0)]
    assert 0.02 < abstained[0] < 0.06 and abstained[1] > 0.6 and abstained[2] == 1.0


def test_a_gel_at_rest_is_told_from_what_is_unlike_anything() -> None:
    towards = drawn(500, 8.0, 2).mean(dim=0)
    groups = {
        "known": Gaussians.of(drawn(2000, 0.0, 1)),
        "untouched": Direction.of(towards / 2, towards / towards.norm()),
    }
    scores = OutOfDistribution.of(groups, drawn(1000, 0.0, 3), share=0.02)
    assert scores.reasons(torch.cat([drawn(2, 8.0, 4), drawn(1, -20.0, 5)])) == [
        "nothing is touched", "nothing is touched", "unlike anything known"
    ]  # fmt: skip


def test_scores_are_read_as_they_were_kept_in_half_precision() -> None:
    direction = Direction.of(drawn(50, 0.5, 6).mean(dim=0), torch.tensor([0.1, 20.0, -3.0, 0.0, 0.5, 1.0]))
    groups = {"known": Gaussians.of(drawn(2000, 0.0, 1)), "foreign": Gaussians.of(drawn(500, 1.5, 2)),
              "untouched": direction}  # fmt: skip
    scores, features = OutOfDistribution.of(groups, drawn(4000, 0.0, 3), share=0.06), drawn(1000, 0.3, 4)
    shares = scores(drawn(4000, 0.0, 3)).gt(torch.tensor(list(scores.thresholds.values()))).float().mean(dim=0)
    torch.testing.assert_close(shares, torch.tensor([0.005, 0.005, 0.05]), atol=1e-3, rtol=0.0)
    kept = {name: tensor.half() for name, tensor in scores.state_dict().items()}
    read = OutOfDistribution.from_tensors(kept, scores.thresholds)
    assert sum(a != b for a, b in zip(read.reasons(features), scores.reasons(features), strict=True)) < 10
    kept.pop("groups.untouched.weight")
    with pytest.raises(InvalidInputError, match="lacks `out_of_distribution` of untouched"):
        OutOfDistribution.from_tensors(kept, scores.thresholds)


def test_half_precision_changes_next_to_nothing() -> None:
    gaussians, features = Gaussians.of(drawn(500, 30.0, 1)), drawn(50, 31.0, 2)
    before = gaussians(features)
    torch.testing.assert_close(gaussians.half()(features), before, rtol=0.05, atol=0.1)


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
    statistics = pixel_statistics(torch.cat([mixed, grey, torch.full_like(grey, 0.3)]))
    expected = np.corrcoef(mixed.flatten(2)[0].numpy())[[0, 0, 1], [1, 2, 2]]
    np.testing.assert_allclose(statistics[0, 6:9], expected, atol=0.03)  # noise is detail, all but a little
    torch.testing.assert_close(statistics[1, 6:9], torch.ones(3), rtol=0.0, atol=1e-4)
    assert (statistics[1, 11] - statistics[1, 10]) > 10.0 > (statistics[0, 11] - statistics[0, 10])
    torch.testing.assert_close(statistics[2, :6], torch.tensor([0.3] * 3 + [0.0] * 3))
    assert bool(torch.isfinite(statistics).all())


def test_new_words_are_counted_without_special_tokens() -> None:
    vocabulary = torch.tensor([True, True, False, False, True, True])
    tokens = torch.tensor([[4, 0, 2, 5, 5], [4, 2, 3, 0, 5], [4, 5, 5, 5, 5]])
    assert share_of_unseen(vocabulary, tokens, special=(4, 5)).tolist() == pytest.approx([1 / 2, 2 / 3, 0.0])


# With a model ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A model of texts alone that knows what lies around one direction."""
    size = {"hidden_size": 6, "intermediate_size": 6, "num_hidden_layers": 1, "num_attention_heads": 1}
    text = {**size, "vocab_size": 10, "max_position_embeddings": 4, "projection_dim": 6}
    others = {name: {"projection_dim": 6} for name in ("vision_config", "touch_config", "audio_config")}
    model = UniTouchModel(UniTouchConfig(projection_dim=6, text_config=text, **others), modalities=("text",))
    known = torch.tensor([1.0, 0, 0, 0, 0, 0]) + 0.1 * torch.randn(99, 6, generator=torch.Generator().manual_seed(0))
    groups = {"known": Gaussians.of(torch.nn.functional.normalize(known, dim=1))}
    scores = OutOfDistribution.of(groups, known, 0.04, vocabulary=torch.arange(10) < 4)
    model.out_of_distribution["text"] = scores
    model.config.ood_thresholds = {"text": scores.thresholds}
    model.save_pretrained(tmp_path)
    return tmp_path


def test_scores_are_kept_with_the_model(folder: Path) -> None:
    model = UniTouchModel.from_pretrained(folder)
    there = torch.tensor([[5.0, 0, 0, 0, 0, 0], [0, 5.0, 0, 0, 0, 0]])
    assert model.abstains("text", there) == [None, "unlike anything known"]
    few, many = torch.tensor([[0, 1, 2, 5, 6], [0, 5, 6, 7, 2]]).split(1)
    assert model.abstains("text", there[:1], input_ids=few) == [None]
    assert model.abstains("text", there[:1], input_ids=many) == ["unlike anything known"]
    assert model.loaded_modalities == ()
    assert model.half().abstains("text", there) == [None, "unlike anything known"]


def test_a_model_without_scores_says_nothing(folder: Path) -> None:
    model = UniTouchModel.from_pretrained(folder)
    assert model.abstains("image", torch.ones(2, 6)) == []


def test_scores_that_are_not_there_are_refused_by_name(folder: Path) -> None:
    tensors = load_file(folder / "model.safetensors")
    kept = {key: tensor for key, tensor in tensors.items() if not key.startswith("out_of_distribution")}
    save_file(kept, folder / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(InvalidInputError, match=r"lacks `out_of_distribution` of known, which config.json names"):
        UniTouchModel.from_pretrained(folder)
