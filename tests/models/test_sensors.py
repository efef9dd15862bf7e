"""The sensor bank: retrieval by L1 distance against numpy, names, and a bank of none."""

import numpy as np
import pytest
import torch

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.models import SensorBank, SensorMatch

NAMES = ("gelsight", "digit", "taxim")


def filled(size: int = 8) -> SensorBank:
    torch.manual_seed(0)
    bank = SensorBank(NAMES, 5, 16, size)
    for name in NAMES:
        bank.set_prototype(name, torch.rand(3, size, size))
    return bank


def test_retrieval_is_the_smallest_mean_absolute_difference() -> None:
    bank, images = filled(), torch.rand(20, 3, 8, 8)
    gaps = np.abs(images.numpy()[:, None] - torch.stack([bank.prototype(name) for name in NAMES]).numpy()[None])
    distances = gaps.reshape(20, 3, -1).mean(axis=2)
    matches = bank.match(images)
    assert [match.name for match in matches] == [NAMES[index] for index in distances.argmin(axis=1)]
    np.testing.assert_allclose([match.distance for match in matches], distances.min(axis=1), rtol=1e-5)


def test_distances_are_to_every_prototype() -> None:
    bank, images = filled(), torch.rand(4, 3, 8, 8)
    expected = [[(image - bank.prototype(name)).abs().mean().item() for name in NAMES] for image in images]
    torch.testing.assert_close(bank.distances(images), torch.tensor(expected))


def test_a_prototype_is_found_by_itself() -> None:
    bank = filled()
    matches = bank.match(torch.stack([bank.prototype(name) for name in NAMES]))
    assert matches == [SensorMatch(name, 0.0) for name in NAMES]


def test_a_named_sensor_is_taken_whatever_is_nearest() -> None:
    bank = filled()
    match = bank.match(bank.prototype("digit")[None], "taxim")[0]
    assert match.name == "taxim"
    assert match.distance > 0.1


def test_each_image_may_name_its_own_sensor() -> None:
    bank = filled()
    matches = bank.match(bank.prototype("digit").expand(3, -1, -1, -1), ["gelsight", None, "taxim"])
    assert [match.name for match in matches] == ["gelsight", "digit", "taxim"]


def test_a_list_of_another_length_is_refused_by_name() -> None:
    with pytest.raises(InvalidInputError, match="`sensor` is a list of 2 for 3"):
        filled().match(torch.rand(3, 3, 8, 8), ["digit", "digit"])


def test_an_unknown_sensor_is_refused_with_the_names() -> None:
    with pytest.raises(
        InvalidInputError, match=r"`sensor` is 'digits'.*'gelsight', 'digit', 'taxim'.*Did you mean 'digit'"
    ):
        filled().match(torch.rand(1, 3, 8, 8), "digits")


def test_a_sensor_that_is_another_is_refused_with_what_to_do_for_its_touches() -> None:
    with pytest.raises(InvalidInputError, match=r"'gelsight', 'digit', 'taxim'\. For .* leave `sensor` out") as caught:
        filled().match(torch.rand(1, 3, 8, 8), "gelslim")
    assert "Did you mean" not in str(caught.value)


def test_retrieval_is_no_advice_where_there_is_nothing_to_retrieve_by() -> None:
    with pytest.raises(InvalidInputError, match="'taxim'") as caught:
        SensorBank(NAMES, 5, 16, 8).match(torch.rand(1, 3, 8, 8), "gelslim")
    assert "leave" not in str(caught.value)


def test_an_image_beyond_the_reach_of_its_sensor_is_unfamiliar() -> None:
    bank, steps = filled(), torch.tensor([-0.3, -0.19, 0.0, 0.19, 0.21])
    bank.set_prototype("digit", torch.full((3, 8, 8), 0.5))
    images = 0.5 + steps[:, None, None, None].expand(5, 3, 8, 8)  # the distances are the steps
    distances = [match.distance for match in bank.match(images, "digit")]
    assert bank.unfamiliar(distances) == [0, 4]


def test_nothing_is_unfamiliar_where_nothing_was_compared() -> None:
    assert filled().unfamiliar([None, None]) == []


def test_the_reach_is_the_banks_own() -> None:
    assert SensorBank(NAMES, 5, 16, 8, reach=0.4).unfamiliar([0.39, 0.41]) == [1]


def test_a_sensor_without_a_prototype_is_never_retrieved() -> None:
    bank = SensorBank(NAMES, 5, 16, 8)
    bank.set_prototype("taxim", torch.ones(3, 8, 8))
    match = bank.match(torch.zeros(1, 3, 8, 8))[0]  # the unset prototypes are zeros: nearer, but unknown
    assert match == SensorMatch("taxim", 1.0)


def test_a_named_sensor_without_a_prototype_has_no_distance() -> None:
    assert SensorBank(NAMES, 5, 16, 8).match(torch.zeros(1, 3, 8, 8), "digit") == [SensorMatch("digit", None)]


def test_retrieval_without_any_prototype_is_refused_with_the_names() -> None:
    with pytest.raises(InvalidInputError, match=r"`sensor` is None.*no prototypes.*gelsight"):
        SensorBank(NAMES, 5, 16, 8).match(torch.zeros(1, 3, 8, 8))


def test_a_prototype_of_another_shape_is_refused_by_name() -> None:
    with pytest.raises(InvalidInputError, match=r"`mean_pixels`.*\(3, 8, 8\)"):
        SensorBank(NAMES, 5, 16, 8).set_prototype("digit", torch.zeros(3, 9, 8))


def test_tokens_are_those_of_the_sensor() -> None:
    bank = filled()
    tokens = bank(torch.tensor([2, 0, 2]))
    assert tokens.shape == (3, 5, 16)
    assert torch.equal(tokens, bank.tokens[[2, 0, 2]])


def test_a_bank_of_none_matches_nothing() -> None:
    assert SensorBank((), 5, 16, 8).match(torch.zeros(2, 3, 8, 8)) == [SensorMatch(None, None)] * 2


def test_a_bank_of_none_refuses_names() -> None:
    with pytest.raises(InvalidInputError, match="`sensor` is 'digit'; this model has no sensor tokens"):
        SensorBank((), 5, 16, 8).match(torch.zeros(1, 3, 8, 8), "digit")


def test_prototypes_are_saved_with_the_tokens() -> None:
    bank, other = filled(), SensorBank(NAMES, 5, 16, 8)
    other.load_state_dict(bank.state_dict())
    images = torch.rand(3, 3, 8, 8)
    assert other.match(images) == bank.match(images)


# None of these --------------------------------------------------------------------------------------------------------


def reaching(**reaches: float) -> SensorBank:
    """Sensors of one colour each."""
    bank = SensorBank(("dark", "bright"), 5, 16, 32, reaches=reaches)
    for name, level in {"dark": 0.2, "bright": 0.8}.items():
        bank.set_prototype(name, torch.full((3, 32, 32), level))
    return bank


def levels(*values: float) -> torch.Tensor:
    return torch.tensor(values)[:, None, None, None].expand(-1, 3, 32, 32)


def test_an_image_out_of_reach_of_all_sensors_is_of_none() -> None:
    matches = reaching(dark=0.05, bright=0.1).match(levels(0.24, 0.26, 0.71, 0.69))
    assert [match.name for match in matches] == ["dark", None, "bright", None]
    assert matches[1].distance == pytest.approx(0.06)


def test_the_sensor_whose_own_touches_lie_as_far_is_retrieved() -> None:
    match = reaching(dark=0.05, bright=0.4).match(levels(0.41))[0]  # nearer to the dark one
    assert match.name == "bright"


def test_a_named_sensor_and_the_nearest_are_taken_out_of_reach() -> None:
    bank = reaching(dark=0.05, bright=0.05)
    assert bank.match(levels(0.45), "bright")[0].name == "bright"
    assert bank.match(levels(0.45), nearest=True)[0].name == "dark"


def test_reaches_are_of_areas_and_not_of_pixels() -> None:
    checks = 0.2 + 0.2 * (-1.0) ** (torch.arange(32)[:, None] + torch.arange(32)).expand(1, 3, 32, 32)
    assert reaching(dark=0.01, bright=0.01).match(checks)[0].name == "dark"


def test_an_added_sensor_has_the_widest_reach_unless_it_brings_its_own() -> None:
    bank = reaching(dark=0.05, bright=0.1)
    new = (torch.zeros(5, 16), torch.full((3, 32, 32), 0.5))
    assert bank.extended("new", *new).reaches["new"] == 0.1
    assert bank.extended("new", *new, reach=0.02).without("dark").reaches == {"bright": 0.1, "new": 0.02}


def test_what_is_of_no_sensor_has_no_tokens() -> None:
    bank, encoder = reaching(dark=0.05, bright=0.1), _Recorder()
    pixels = torch.arange(3.0)[:, None]
    out = bank.encode(encoder, pixels, torch.tensor([1, -1, 0]))
    expected = pixels + torch.stack([bank.tokens[1].sum(), torch.zeros(()), bank.tokens[0].sum()])[:, None]
    torch.testing.assert_close(out, expected)


class _Recorder(torch.nn.Module):
    """Adds up what it is given."""

    def forward(self, pixels: torch.Tensor, prefix: torch.Tensor | None = None) -> torch.Tensor:
        return pixels if prefix is None else pixels + prefix.sum(dim=(1, 2))[:, None]
