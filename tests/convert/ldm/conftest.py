"""A checkpoint of each kind, and the folders that they are converted to."""

from pathlib import Path

import pytest
from torch import Tensor

from tests.helpers import compvis_checkpoints as checkpoints
from unitouch_gen.convert.ldm import convert_ldm

KINDS = tuple(checkpoints.UNETS)


@pytest.fixture(scope="module", params=KINDS)
def kind(request) -> str:
    return request.param


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> dict[str, dict[str, Path]]:
    folder = tmp_path_factory.mktemp("published")
    return {
        kind: checkpoints.write(folder / kind, checkpoints.state_of(kind), checkpoints.settings_of(kind))
        for kind in KINDS
    }


@pytest.fixture(scope="module")
def folders(files, tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("converted")
    for kind in KINDS:
        convert_ldm(**files[kind], output=folder / kind, told=lambda line: None)
    return {kind: folder / kind for kind in KINDS}


@pytest.fixture
def state() -> dict[str, Tensor]:
    """Of the VQ model, to be changed."""
    return dict(checkpoints.state_of("vq"))


@pytest.fixture
def settings() -> dict:
    return checkpoints.settings_of("vq")
