"""What is said of generated images: of real ones the ceiling, of pairs their agreement; and the tables of it."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from tests.helpers.classifiers import classifier
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.evaluation.generated import (
    RELIEF,
    ClassifierEvaluation,
    beside_class_means,
    cvtp,
    inception_features,
    readings,
    touch_to_image_table,
    x_to_touch_table,
)

RANDOM = torch.Generator().manual_seed(0)


def test_means_of_classes_are_as_long_as_embeddings() -> None:
    embeds, labels = torch.randn(6, 1, 4, generator=RANDOM), torch.tensor([0, 0, 0, 1, 1, 1])
    means = beside_class_means(embeds, labels, torch.arange(6))[1]
    torch.testing.assert_close(means.norm(dim=-1), embeds.norm(dim=-1))
    assert torch.cosine_similarity(means[0], means[2]).item() == pytest.approx(1.0)
    own, usual = beside_class_means(embeds, labels, torch.tensor([5, 1]))
    assert torch.equal(own, embeds[[5, 1]]) and torch.equal(usual, means[[5, 1]])


def judged(*attributes: str) -> tuple[ClassifierEvaluation, Tensor]:
    """Thirteen of forty random images that are met again as they are."""
    gallery, rows = torch.rand(40, 3, 32, 32, generator=RANDOM), torch.arange(0, 40, 3)
    one = classifier(*attributes)
    seen = one.observe(gallery)
    truth = seen.attributes if attributes else torch.randn(40, 3, generator=RANDOM)
    return ClassifierEvaluation(one, rows, torch.arange(40) % 2, truth, seen, one.observe(gallery[rows])), gallery[rows]


def test_of_real_images_every_figure_is_its_ceiling() -> None:
    known, images = judged()
    figures = known.figures("picture", images, images.roll(1, 0))
    assert len(figures) == 6 and figures["picture: contact within material"].value == 1.0
    assert {name: figure.value for name, figure in figures.items()} == {
        name: pytest.approx(figure.ceiling, abs=1e-6) for name, figure in figures.items()
    }


def test_real_images_are_named_found_and_read_as_themselves() -> None:
    known, images = judged(*RELIEF)
    measures, other = (known.measures(known.classifier.observe(some)) for some in (images, images.roll(1, 0)))
    assert measures["as real"] == measures["contact"] == 100.0
    assert measures["relief"] == pytest.approx(100.0, abs=1e-3)
    assert other["contact"] < 50.0 and other["relief"] < 90.0
    assert other["distance"] == pytest.approx(measures["distance"], abs=1e-5)  # of the set
    known, images = judged()
    assert "relief" not in known.measures(known.classifier.observe(images))


def test_contacts_that_nobody_measured_are_told_apart_and_no_more() -> None:
    known, images = judged(*RELIEF)
    seen = known.classifier.observe(images)
    assert set(replace(known, truth=None).measures(seen)) == {"as real", "contact", "distance"}
    alone = torch.cat([known.material[:-1], torch.tensor([2])])  # of a material of its own
    assert set(replace(known, truth=None, material=alone).measures(seen)) == {"as real", "distance"}


def test_readings_are_probabilities_and_attributes() -> None:
    one, images = classifier(), torch.rand(5, 3, 32, 32, generator=RANDOM)
    seen = one.observe(images)
    values = readings(one, seen)
    torch.testing.assert_close(values[:, :2].exp().sum(dim=1), torch.ones(5))
    torch.testing.assert_close(values[:, 2:], seen.attributes)  # of mean 0 and deviation 1


def test_pictures_agree_with_their_own_touches_alone() -> None:
    """Two views of five numbers, in turned coordinates and with noise of their own."""
    shared = torch.randn(600, 5, generator=RANDOM)
    touch, image = (shared @ torch.randn(5, 8, generator=RANDOM) + 0.1 * torch.randn(600, 8, generator=RANDOM)
                    for _ in range(2))  # fmt: skip
    known = touch[:400], image[:400]
    found = cvtp(known, touch[400:], {"own": image[400:], "another's": image[400:].roll(1, 0)})
    assert found["own"] > 0.95 and abs(found["another's"]) < 0.15


class Means(nn.Module):
    """Means of channels of bytes, called as the Inception network's file is."""

    def forward(self, images: Tensor, return_features: bool = False) -> Tensor:
        assert return_features and images.dtype == torch.uint8
        return images.float().mean(dim=[2, 3])


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_the_inception_network_comes_from_a_file(tmp_path: Path) -> None:
    torch.jit.script(Means()).save(str(tmp_path / "network.pt"))
    images = torch.full((70, 3, 8, 8), 0.2)
    torch.testing.assert_close(inception_features(tmp_path / "network.pt", images), torch.full((70, 3), 51.0))
    (tmp_path / "other.pt").write_bytes(b"none")
    with pytest.raises(InvalidInputError, match=r"`inception` is .*other\.pt', which is no TorchScript"):
        inception_features(tmp_path / "other.pt", images)


def test_tables_of_seeds_have_a_column_for_each_measure() -> None:
    seeds = [{"drawn": {"cvtp": 10.0 * seed, "distance": 5.0}, "real": {"cvtp": 50.0}} for seed in (1, 2)]
    table = touch_to_image_table(seeds, inception=True)
    assert table.rows == {
        "drawn": {"CVTP, x 100": [10.0, 20.0], "Frechet distance": [5.0, 5.0]}, "real": {"CVTP, x 100": [50.0, 50.0]}
    }  # fmt: skip
    assert "Inception network" in table.notes[0] and table.paper["ours, zero-shot"]["CVTP"] == 0.56
    assert x_to_touch_table([{"caption": {"alike": 50.0}}]).paper["touches of pictures and of their captions"]
    assert "'touches'; what is known" in x_to_touch_table([{"caption": {"alike": 50.0}}], "touches").notes[-1]
