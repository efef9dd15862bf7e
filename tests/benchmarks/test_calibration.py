"""Fits of sensors to tables and frames, on ones whose answer is known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from tests.benchmarks.calibration import (
    BALL_RADIUS,
    Changes,
    Source,
    ball_heights,
    check_folder,
    fit_backdrop,
    fit_lights,
    press_residual,
    read_presses,
    read_table,
    rms,
    sensor_changes,
    table_changes,
    table_residual,
)
from tests.helpers.plain_sensor import PLAIN
from unitouch_gen.errors import InvalidInputError
from unitouch_gen.world.grids import PATCH_MM, pixel_axis

UPRIGHT = Source("table.npz", (120, 160))


def write_table(folder: Path, *, constant=(0.0, 0.0, 0.0), along_column=0.0, bins: int = 61) -> np.ndarray:
    """A table of red, green and blue that do not depend on the slope, as it is published."""
    grids = np.zeros((3, bins, bins, 6))
    grids[..., 5], grids[..., 3] = np.array(constant)[:, None, None], along_column
    np.savez(folder / "table.npz", bins=bins, grad_r=grids[2], grad_g=grids[1], grad_b=grids[0])
    return read_table(folder / "table.npz")


def test_a_folder_without_its_files_is_refused(tmp_path: Path) -> None:
    write_table(tmp_path)
    with pytest.raises(InvalidInputError, match=r"lacks objectfolder_dataPack\.npz, .*, taxim_gelsight_"):
        check_folder(tmp_path)


def test_a_table_is_blue_green_red_in_grey_levels(tmp_path: Path) -> None:
    changes = table_changes(write_table(tmp_path, constant=(51.0, 0.0, -25.5)), UPRIGHT)
    torch.testing.assert_close(changes.values[7, :, 2, 3], torch.tensor([0.2, 0.0, -0.1]))
    assert 0.3 < changes.held_out.float().mean() < 0.6


def test_what_was_at_the_left_of_a_turned_frame_is_below(tmp_path: Path) -> None:
    table = write_table(tmp_path, along_column=1.0)
    plain, turned = (table_changes(table, replace(UPRIGHT, turns=turns)) for turns in (0, 1))
    assert (plain.values.diff(dim=3) > 0).all() and (plain.values.diff(dim=2) == 0).all()
    assert (turned.values.diff(dim=2) < 0).all() and turned.values.diff(dim=3).abs().max() < 1e-6
    torch.testing.assert_close(turned.slope_x, plain.slope_y)  # what rose downward rises to the right
    torch.testing.assert_close(turned.slope_y, -plain.slope_x)


def test_residuals_are_shares_of_the_tables_own() -> None:
    values = torch.full((2, 3, 2, 2), 0.1)
    held_out = torch.zeros(2, 2, 2, dtype=torch.bool)
    held_out[0] = True
    real = Changes(*torch.zeros(3, 2), values, held_out)
    assert rms(values) == pytest.approx(25.5)
    found = torch.stack([1.5 * values[0], values[1]])
    left = table_residual(found, real)
    assert left["fitted"] == {"grey_levels": 0.0, "share": 0.0}
    assert left["held_out"] == {"grey_levels": pytest.approx(12.75), "share": pytest.approx(0.5)}


def test_lights_that_made_a_table_are_found_again() -> None:
    lit = replace(
        PLAIN, azimuths=(20.0, 150.0, 265.0), elevation=(35.0, 50.0, 42.0), falloff=0.0, gain=0.4,
        colours=((1.0, 0.1, 0.2), (0.1, 0.8, 0.0), (0.3, 0.2, 0.9)), gradients=((0.2, -0.1), (0.0, 0.3), (-0.3, 0.1)),
        backdrop=(((0.5, 0.5), (0.5, 0.5)),) * 3, tint=(-0.03, 0.0, 0.02),
    )  # fmt: skip
    angle = torch.linspace(0.1, 1.0, 6)[:, None]
    direction = torch.linspace(-3.0, 3.0, 19)[None]
    slope_x, slope_y = (torch.tan(angle) * part(direction) for part in (torch.cos, torch.sin))
    slope_x, slope_y = slope_x.flatten(), slope_y.flatten()
    depth = 2.0 * torch.cos(angle).expand(-1, direction.shape[1]).flatten()
    held_out = torch.zeros(len(depth), 6, 6, dtype=torch.bool)
    held_out[::4] = True
    unlit = Changes(slope_x, slope_y, depth, torch.empty(0), held_out)
    real = replace(unlit, values=sensor_changes(lit, unlit))
    found = fit_lights(real, replace(lit, colours=(), azimuths=()), lights=3, starts=2)
    assert table_residual(sensor_changes(found, real), real)["held_out"]["share"] < 0.02
    torch.testing.assert_close(torch.tensor(found.tint), torch.tensor(lit.tint), rtol=0.0, atol=5e-3)
    torch.testing.assert_close(
        torch.tensor(found.azimuths).sort().values, torch.tensor(lit.azimuths), rtol=0.0, atol=2.0
    )


def test_a_backdrop_gives_the_picture_that_was_made_of_one_also_where_it_is_hidden() -> None:
    ramp = torch.arange(8) / 8.0
    grid = torch.stack([ramp.expand(8, 8), ramp[:, None].expand(8, 8), 0.5 * (ramp + ramp[:, None])])
    picture = F.interpolate(grid[None], (48, 48), mode="bicubic", align_corners=False)[0]
    seen = np.ones((48, 48), bool)
    seen[16:32, 16:32] = False
    found = fit_backdrop(picture.movedim(0, -1).double().numpy(), seen)
    torch.testing.assert_close(torch.tensor(found), grid, rtol=0.0, atol=2e-3)


def test_a_ball_lies_where_its_frame_says() -> None:
    heights = ball_heights(torch.tensor([[0.25, -0.1]]), view=12.0)[0]
    row, column = divmod(int(heights.argmax()), heights.shape[1])
    axis = pixel_axis(heights.shape[0], PATCH_MM)
    assert axis[column].item() == pytest.approx(3.0, abs=0.1) and axis[row].item() == pytest.approx(-1.2, abs=0.1)
    assert heights.max().item() == pytest.approx(BALL_RADIUS, abs=0.01)
    area = (heights > BALL_RADIUS - 0.5).sum().item() * (PATCH_MM / heights.shape[0]) ** 2
    assert area == pytest.approx(np.pi * (2 * BALL_RADIUS * 0.5 - 0.25), rel=0.02)  # a cap 0.5 mm high


def test_frames_are_cut_to_their_middle_and_read_as_red_green_blue(tmp_path: Path) -> None:
    frames = np.full((2, 120, 160, 3), 100, np.uint8)
    frames[:, 60, 100] = (100, 100, 151)  # blue, green, red
    np.savez(
        tmp_path / "pack.npz", imgs=frames, f0=np.full((120, 160, 3), 100, np.uint8), touch_center=[[100.0, 60.0]] * 2
    )
    presses = read_presses(tmp_path / "pack.npz")
    assert presses.change.shape == (2, 3, 120, 120)
    torch.testing.assert_close(presses.change[0, :, 60, 80], torch.tensor([0.2, 0.0, 0.0]))
    torch.testing.assert_close(presses.centres[0] * 120 + 59.5, torch.tensor([80.0, 60.0]))
    same = press_residual(presses.change, presses)
    assert same["grey_levels"] == 0.0 and same["correlation"] == pytest.approx(1.0, abs=1e-4)
    assert press_residual(2.0 * presses.change, presses)["share"] == pytest.approx(1.0)
