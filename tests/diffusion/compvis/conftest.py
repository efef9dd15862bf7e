"""A checkpoint of each kind, and the folders that they are converted to."""

import runpy
from pathlib import Path

import pytest
from torch import Tensor

from unitouch_gen.diffusion.compvis import convert_ldm

FILES = runpy.run_path(str(Path(__file__).parent / "checkpoints.py"))
KINDS = tuple(FILES["UNETS"])


@pytest.fixture(scope="module", params=KINDS)
def kind(request) -> str:
    return request.param


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> dict[str, dict[str, Path]]:
    folder = tmp_path_factory.mktemp("published")
    return {kind: FILES["write"](folder / kind, FILES["state_of"](kind), FILES["settings_of"](kind)) for kind in KINDS}


@pytest.fixture(scope="module")
def folders(files, tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("converted")
    for kind in KINDS:
        convert_ldm(**files[kind], output=folder / kind, told=lambda line: None)
    return {kind: folder / kind for kind in KINDS}


@pytest.fixture
def state() -> dict[str, Tensor]:
    """Of the VQ model, to be changed."""
    return dict(FILES["state_of"]("vq"))


@pytest.fixture
def settings() -> dict:
    return FILES["settings_of"]("vq")
