"""The samples' grids, where the samples write, and that they run."""

import argparse
import json
import runpy
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from drawing import MARGIN, draw_grid
from tests.helpers.processes import Child, finished, script
from unitouch_gen import weights
from unitouch_gen.cli.loading import DRAWING

SAMPLES = Path(__file__).resolve().parents[1] / "samples"
pytestmark = pytest.mark.skipif(not SAMPLES.is_dir(), reason="there is no checkout here")

NOT_RUN = {
    "assemble_family": "takes trained stages",
    "build_collection": "takes raw surfaces",
    "drawing": "draws for the others",
    "render_inputs": "writes into the checkout",
    "texture_trunk": "writes weights",
    "watch": "needs a camera",
}


@pytest.mark.parametrize("blocks", [1, 2, 3])
def test_a_grid_covers_no_tile_with_words(blocks):
    labels = ["synthetic fabric", "woven natural fabric", "", "gjpqy", "glass"]
    titles = ["touch", "true picture", "an unusually long title of a column"]
    rows = [[torch.tensor([1.0, 0.0, 0.0]).view(3, 1, 1).expand(3, 4, 4)] * 3] * 5  # red
    for side, size in ((64, 12), (128, 20), (192, 24)):
        grid = draw_grid(rows, labels=labels, titles=titles, side=side, size=size, blocks=blocks)
        assert (np.asarray(grid) == (255, 0, 0)).all(axis=2).sum() == 15 * side**2


def test_a_grid_keeps_the_pixels_of_a_tile():
    pixels = torch.randint(0, 256, (3, 16, 16), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    grid = np.asarray(draw_grid([[pixels / 255]], labels=["a"], titles=["b"], side=64))
    expected = np.kron(pixels.permute(1, 2, 0).numpy(), np.ones((4, 4, 1), dtype=np.uint8))
    bottom, right = (edge - MARGIN for edge in grid.shape[:2])
    np.testing.assert_array_equal(grid[bottom - 64 : bottom, right - 64 : right], expected)


class ParsedError(Exception):
    """Takes a sample's parser out of it, before it draws anything."""


@pytest.mark.parametrize("file", sorted(SAMPLES.glob("*.py")), ids=lambda file: file.stem)
def test_a_sample_writes_into_the_ignored_folder_unless_it_is_told_where(file, monkeypatch):
    if file.stem in NOT_RUN:
        pytest.skip(NOT_RUN[file.stem])

    def stop(parser, *_):
        raise ParsedError(parser)

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", stop)
    with pytest.raises(ParsedError) as parsed:
        runpy.run_path(str(file), run_name="__main__")
    (parser,) = parsed.value.args
    assert parser.get_default("output").parts[0] == "outputs"
    assert "outputs/" in (SAMPLES.parent / ".gitignore").read_text().splitlines()


@pytest.mark.slow
@pytest.mark.parametrize("file", sorted(SAMPLES.glob("*.py")), ids=lambda file: file.stem)
def test_samples_run(file, tmp_path):
    if file.stem in NOT_RUN:
        pytest.skip(NOT_RUN[file.stem])
    finished(Child(script, file, "--output", "picture.png", folder=tmp_path))
    assert (tmp_path / "picture.png").is_file()


@pytest.mark.slow
@pytest.mark.parametrize("name", DRAWING)
def test_model_cards_show_what_the_built_in_weights_draw(name, tmp_path):
    """Within less than another seed makes (1.8 and more): after new weights, they have to be drawn anew."""
    words = ["--pipeline", name, "--output", "drawn.jpg"]
    finished(Child(script, SAMPLES / "card_pictures.py", *words, folder=tmp_path))
    pictures = [Image.open(file) for file in (tmp_path / "drawn.jpg", weights.CARDS / f"{name}.jpg")]
    drawn, shown = (np.asarray(picture, dtype=float) for picture in pictures)
    assert np.abs(drawn - shown).mean() < 1


@pytest.mark.slow
@pytest.mark.parametrize("file", sorted(SAMPLES.glob("*.ipynb")), ids=lambda file: file.stem)
def test_notebooks_run_from_top_to_bottom(file, tmp_path):
    cells = ["".join(cell["source"]) for cell in json.loads(file.read_text())["cells"] if cell["cell_type"] == "code"]
    finished(Child(script, "\n".join(cells), folder=tmp_path))
