"""Zero-shot classification against numpy, and the names it gives."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.special import softmax

from unitouch_gen.conditioning import EmbeddingBank
from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.evaluation.zero_shot import (
    PROMPTS,
    Named,
    ZeroShotTouchClassifier,
    accuracy,
    calibrated_probabilities,
    expected_calibration_error,
    fit_temperature,
    text_embeddings,
    zero_shot_scores,
)
from unitouch_gen.models import UniTouchConfig, UniTouchModel, UniTouchProcessor
from unitouch_gen.training.tokenizer import train_tokenizer
from unitouch_gen.world import MATERIAL_NAMES

NAMES = ("brick", "glass", "grass", "wood", "leather")


@pytest.fixture(scope="module")
def processor() -> UniTouchProcessor:
    tokenizer = train_tokenizer(
        [f"{start} {name}" for start in ("this feels like", "looks") for name in NAMES], 600, 12
    )
    return UniTouchProcessor(image_size=32, tokenizer=tokenizer)


@pytest.fixture(scope="module")
def model(processor: UniTouchProcessor) -> UniTouchModel:
    clip = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 4}
    vit = {"hidden_size": 32, "num_hidden_layers": 2, "num_attention_heads": 4, "patch_size": 8, "patch_stride": 8}
    tokens = {f"{name}_token_id": getattr(processor.tokenizer, f"{name}_token_id") for name in ("bos", "eos", "pad")}
    size = len(processor.tokenizer)
    config = UniTouchConfig(
        projection_dim=16,
        sensors=["gelsight", "digit"],
        prototype_size=32,
        vision_config={**clip, "image_size": 32, "patch_size": 8, "projection_dim": 16},
        text_config={**clip, **tokens, "vocab_size": size, "max_position_embeddings": 12, "projection_dim": 16},
        touch_config={**vit, "image_height": 32, "image_width": 32, "projection_dim": 16},
        audio_config={**vit, "image_height": 32, "image_width": 32, "num_channels": 1, "projection_dim": 16},
    )
    torch.manual_seed(0)
    model = UniTouchModel(config).eval()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    for level, name in ((0.2, "gelsight"), (0.8, "digit")):
        model.sensor_bank.set_prototype(name, torch.full((3, 32, 32), level))
    return model


@pytest.fixture
def classifier(model: UniTouchModel, processor: UniTouchProcessor) -> ZeroShotTouchClassifier:
    return ZeroShotTouchClassifier(model, processor)


@pytest.fixture
def images() -> torch.Tensor:
    return torch.rand(3, 3, 32, 32, generator=torch.Generator().manual_seed(1))


# Functions ------------------------------------------------------------------------------------------------------------


def test_scores_are_cosines() -> None:
    rng = np.random.default_rng(0)
    features, classes = rng.standard_normal((6, 5)), rng.standard_normal((4, 5))
    classes /= np.linalg.norm(classes, axis=1, keepdims=True)
    expected = features @ classes.T / np.linalg.norm(features, axis=1)[:, None]
    scores = zero_shot_scores(torch.from_numpy(features).float(), torch.from_numpy(classes).float())
    np.testing.assert_allclose(scores, expected, atol=1e-6)


def test_scores_of_a_class_itself_are_one() -> None:
    classes = torch.nn.functional.normalize(torch.randn(4, 8, generator=torch.Generator().manual_seed(0)), dim=1)
    torch.testing.assert_close(zero_shot_scores(30 * classes, classes).diag(), torch.ones(4))


def test_accuracy_is_the_share_of_rows_whose_largest_score_is_at_the_label() -> None:
    scores = torch.tensor([[0.1, 0.9], [0.8, 0.2], [0.4, 0.6], [0.7, 0.3]])
    assert accuracy(scores, torch.tensor([1, 0, 0, 0])) == 0.75


@pytest.mark.parametrize(("labels", "share"), [([0, 1, 2], 1.0), ([1, 2, 0], 0.0)])
def test_accuracy_of_all_and_of_none(labels: list[int], share: float) -> None:
    assert accuracy(torch.eye(3), torch.tensor(labels)) == share


def test_embeddings_of_texts_are_at_unit_length(model: UniTouchModel, processor: UniTouchProcessor) -> None:
    classes = text_embeddings(model, processor, [f"this feels like {name}" for name in NAMES])
    ids = processor.text("this feels like grass")["input_ids"]
    with torch.no_grad():
        text = model.get_text_features(ids)[0]
    torch.testing.assert_close(classes[NAMES.index("grass")], text / text.norm())
    torch.testing.assert_close(classes.norm(dim=1), torch.ones(len(NAMES)))


def test_every_template_has_one_place_for_the_name() -> None:
    assert all(template.count("{}") == 1 for template in PROMPTS.values())


def test_touch_is_asked_for_as_in_the_paper() -> None:
    assert PROMPTS["touch"].format("wood") == "this feels like wood"


@pytest.mark.parametrize("unit", [0.3, 1.0, 100.0])
@pytest.mark.parametrize(("temperature", "exponent"), [(0.2, 0.0), (0.05, 1.2)])
def test_the_temperature_that_labels_were_drawn_at_is_found(temperature: float, exponent: float, unit: float) -> None:
    generator = torch.Generator().manual_seed(0)
    scores = (2.0 * torch.rand(40_000, 8, generator=generator) - 1.0) * torch.rand(40_000, 1, generator=generator)
    scores, temperature = unit * scores, unit ** (1.0 + exponent) * temperature
    drawn_at = (scores * scores.std(dim=1, keepdim=True, correction=0) ** exponent / temperature).softmax(dim=1)
    labels = torch.multinomial(drawn_at, 1, generator=generator)[:, 0]
    found = fit_temperature(scores, labels)
    assert found == (pytest.approx(temperature, rel=0.15), pytest.approx(exponent, abs=0.1))
    assert expected_calibration_error(calibrated_probabilities(scores, *found), labels) < 0.01
    assert expected_calibration_error((50.0 / unit * scores).softmax(dim=1), labels) > 0.2
    if exponent:
        others = [(scores / (other * unit)).softmax(dim=1) for other in (0.1, 0.2, 0.4)]
        assert min(expected_calibration_error(one, labels) for one in others) > 0.02


def test_a_temperature_that_falls_keeps_the_order_and_knows_nothing_of_equal_scores() -> None:
    scores = torch.randn(50, 5, generator=torch.Generator().manual_seed(0))
    shares = calibrated_probabilities(scores, 0.3, 1.5)
    assert torch.equal(shares.argsort(dim=1), scores.argsort(dim=1))
    torch.testing.assert_close(calibrated_probabilities(torch.full((2, 4), 0.7), 0.1, 1.5), torch.full((2, 4), 0.25))
    torch.testing.assert_close(calibrated_probabilities(scores, 0.3), (scores / 0.3).softmax(dim=1))


def test_calibration_error_is_the_mean_gap_between_confidence_and_accuracy() -> None:
    sure = torch.tensor([[0.95, 0.05]] * 4 + [[0.4, 0.6]] * 2)  # right in 3 of 4 at 95 %, in 2 of 2 at 60 %
    found = expected_calibration_error(sure, torch.tensor([0, 0, 0, 1, 1, 1]), bins=10)
    assert found == pytest.approx((4 * (0.95 - 0.75) + 2 * (1.0 - 0.6)) / 6)


def test_a_fitted_exponent_is_taken(
    classifier: ZeroShotTouchClassifier, images: torch.Tensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = classifier.model.config
    monkeypatch.setattr(config, "temperatures", {"audio": 0.2})
    monkeypatch.setattr(config, "temperature_exponents", {"audio": 1.5})
    features = torch.randn(4, 16, generator=torch.Generator().manual_seed(0))
    cosines = classifier.scores(features, "audio", NAMES).double().numpy()
    shares = softmax(cosines * cosines.std(axis=1, keepdims=True) ** 1.5 / 0.2, axis=1)
    found = classifier.probabilities(features, "audio", NAMES)
    torch.testing.assert_close(found.double(), torch.from_numpy(shares), rtol=1e-5, atol=1e-6)
    with pytest.raises(InvalidInputError, match=r"temperature_exponents\.audio"):
        UniTouchConfig(temperature_exponents={"audio": 3.5})


def test_labels_that_are_no_class_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="`labels` go from 0 to 3, but `scores` are of 3 classes"):
        fit_temperature(torch.rand(2, 3), torch.tensor([0, 3]))


def test_labels_that_do_not_fit_are_refused_by_name() -> None:
    for function in (fit_temperature, expected_calibration_error):
        with pytest.raises(InvalidInputError, match="`labels`"):
            function(torch.rand(4, 3), torch.tensor([0, 1]))


# Names ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("template", [None, "looks {}"])
def test_shares_are_a_softmax_at_the_models_temperature(
    template: str | None, classifier: ZeroShotTouchClassifier, images: torch.Tensor
) -> None:
    model, processor = classifier.model, classifier.processor
    with torch.no_grad():
        pixels = processor.touch(images)
        features = model.get_touch_features(pixels, model.sensor_ids(model.match_sensors(pixels))).numpy()
    classes = text_embeddings(model, processor, [(template or PROMPTS["touch"]).format(name) for name in NAMES]).numpy()
    cosines = features @ classes.T / np.linalg.norm(features, axis=1, keepdims=True)
    shares = np.exp(cosines / 0.07) / np.exp(cosines / 0.07).sum(axis=1, keepdims=True)
    for named, row in zip(classifier(images, NAMES, template), shares, strict=True):
        assert named == pytest.approx(dict(zip(NAMES, row.tolist(), strict=True)), abs=1e-5)


def test_a_bank_names_a_touch_as_the_pictures_that_it_is_near_to(
    model: UniTouchModel, processor: UniTouchProcessor, images: torch.Tensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(model.config, "temperatures", {"image": 0.2, "touch": 9.0})  # of touches by cosines alone
    bank = EmbeddingBank.of(torch.randn(5, 16, generator=torch.Generator().manual_seed(3)), temperature=0.1)
    banked = ZeroShotTouchClassifier(model, processor, bank)
    with torch.no_grad():
        pixels = processor.touch(images)
        touches = model.get_touch_features(pixels, model.sensor_ids(model.match_sensors(pixels))).double().numpy()
    classes = text_embeddings(model, processor, [PROMPTS["touch"].format(name) for name in NAMES]).double().numpy()
    pictures = bank.embeds.double().numpy()
    near = softmax(touches @ pictures.T / np.linalg.norm(touches, axis=1, keepdims=True) / 0.1, axis=1)
    shares = near @ softmax(pictures @ classes.T / 0.2, axis=1)
    for named, row in zip(banked(images, NAMES), shares, strict=True):
        assert named == pytest.approx(dict(zip(NAMES, row.tolist(), strict=True)), abs=1e-5)
    assert not banked.calibrated and ZeroShotTouchClassifier(model, processor).calibrated
    monkeypatch.setitem(model.config.temperatures, "touch by pictures", 2.0)
    powers = shares**0.5 / (shares**0.5).sum(axis=1, keepdims=True)
    assert banked.calibrated
    for named, row in zip(banked(images, NAMES), powers, strict=True):
        assert named == pytest.approx(dict(zip(NAMES, row.tolist(), strict=True)), abs=1e-5)
    heard = torch.randn(2, 16, generator=torch.Generator().manual_seed(4))  # what is no touch is named by itself
    assert banked.name(heard, "audio", NAMES) == ZeroShotTouchClassifier(model, processor).name(heard, "audio", NAMES)


def test_a_bank_of_another_width_is_refused(model: UniTouchModel, processor: UniTouchProcessor) -> None:
    with pytest.raises(InvalidInputError, match="`embedding_bank` has embeddings of width 8, the model of 16"):
        ZeroShotTouchClassifier(model, processor, EmbeddingBank.of(torch.eye(8)))


def test_a_fitted_temperature_is_taken_and_ranks_alike(
    classifier: ZeroShotTouchClassifier, images: torch.Tensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = classifier(images, NAMES)
    monkeypatch.setattr(classifier.model.config, "temperatures", {"touch": 10.0})
    for named, sharper in zip(classifier(images, NAMES), before, strict=True):
        assert list(named) == list(sharper) and max(named.values()) < max(sharper.values())


@pytest.mark.parametrize(
    ("unknown", "words"),
    [
        (None, "brick 80%, tile 12%"),
        ("unlike anything known", "unlike anything known (nearest: brick)"),
        ("nothing is touched", "nothing is touched"),
    ],
)
def test_what_is_known_is_said_in_words(unknown: str | None, words: str) -> None:
    assert str(Named({"brick": 0.8, "tile": 0.12}, unknown)) == words


def test_the_best_label_comes_first(classifier: ZeroShotTouchClassifier, images: torch.Tensor) -> None:
    for named in classifier(images, NAMES, top=4):
        assert len(named) == 4 and list(named.values()) == sorted(named.values(), reverse=True)
        assert 4 / len(NAMES) - 1e-6 <= sum(named.values()) < 1.0


def test_shares_of_all_labels_sum_to_one(classifier: ZeroShotTouchClassifier, images: torch.Tensor) -> None:
    for named in classifier(images, NAMES, top=99):
        assert len(named) == len(NAMES) and sum(named.values()) == pytest.approx(1.0, abs=1e-5)


def test_each_touch_is_named_for_itself(classifier: ZeroShotTouchClassifier, images: torch.Tensor) -> None:
    alone = [classifier(image, NAMES)[0] for image in images]
    for together, single in zip(classifier(images, NAMES), alone, strict=True):
        assert together == pytest.approx(single, abs=1e-4)


def test_a_touch_without_a_sensor_is_read_by_the_nearest_one(
    classifier: ZeroShotTouchClassifier, images: torch.Tensor
) -> None:
    dark = 0.4 * images  # 0.2 on average, as gelsight's prototype
    assert classifier(dark) == classifier(dark, sensor="gelsight") != classifier(dark, sensor="digit")


def test_the_worlds_materials_are_the_default(classifier: ZeroShotTouchClassifier, images: torch.Tensor) -> None:
    assert {name for named in classifier(images) for name in named} == set(MATERIAL_NAMES)


def test_the_processor_is_read_from_the_models_folder(
    model: UniTouchModel, processor: UniTouchProcessor, images: torch.Tensor, tmp_path: Path
) -> None:
    model.save_pretrained(tmp_path)
    processor.save_pretrained(tmp_path)
    read = ZeroShotTouchClassifier(UniTouchModel.from_pretrained(tmp_path))
    assert read(images, NAMES) == ZeroShotTouchClassifier(model, processor)(images, NAMES)
    with pytest.raises(InvalidInputError, match="`processor` is None"):
        ZeroShotTouchClassifier(model)
    with pytest.raises(InvalidInputError, match="no tokenizer"):
        ZeroShotTouchClassifier(model, UniTouchProcessor(image_size=32))


@pytest.mark.parametrize(("arguments", "said"), [
    ({"sensor": "skin"}, "`sensor` is 'skin'"),
    ({"labels": "wood"}, "`labels`"),
    ({"labels": ["wood"]}, "`labels` is"),
    ({"labels": ["wood", "wood"]}, "'wood', which is blank or comes twice"),
    ({"labels": ["wood", " "]}, "blank"),
    ({"labels": [1, 2]}, "`labels`"),
    ({"template": "feels like"}, "write {} once"),
    ({"template": "{} and {}"}, "write {} once"),
    ({"template": "{0}"}, "write {} once"),
    ({"template": 3}, "`template`"),
])  # fmt: skip
def test_bad_input_is_refused_by_name(
    arguments: dict[str, Any], said: str, classifier: ZeroShotTouchClassifier, images: torch.Tensor
) -> None:
    with pytest.raises((InvalidInputError, InvalidTypeError), match=said):
        classifier(images, **arguments)
