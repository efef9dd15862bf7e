"""Scanned materials: read in the layouts that people download, held apart by material, at any scale."""

import numpy as np
import pytest
import torch
from PIL import Image

from unitouch_gen.errors import InvalidInputError
from unitouch_gen.world.grids import pixel_axis
from unitouch_gen.world.textures import GAMMA, Texture, TextureLibrary

SIZE = 64
ANGLE = torch.arange(SIZE) * (2 * torch.pi / SIZE)
WAVES = torch.sin(2 * ANGLE)[None, :] * torch.cos(3 * ANGLE)[:, None] + 0.5 * torch.sin(ANGLE)[:, None]
"""A periodic surface of a few pixels' height."""


def picture(file, values: np.ndarray) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(values).save(file)


def grey(levels: int, dtype: type) -> np.ndarray:
    scaled = (WAVES - WAVES.min()) / (WAVES.max() - WAVES.min()) * levels
    return scaled.round().numpy().astype(dtype)


@pytest.fixture
def folder(tmp_path):
    colour = np.full((SIZE, SIZE, 3), 128, np.uint8)
    picture(tmp_path / "Wood" / "Wood028_1K-JPG_Color.jpg", colour)
    picture(tmp_path / "Wood" / "Wood028_1K-JPG_Displacement.png", grey(255, np.uint8))
    picture(tmp_path / "rock" / "aerial_rocks_04_diff_1k.jpg", colour)
    picture(tmp_path / "rock" / "aerial_rocks_04_disp_1k.png", grey(255, np.uint8))
    picture(tmp_path / "leather__hide__albedo.png", colour)
    picture(tmp_path / "leather__hide__height.png", grey(65535, np.uint16))
    picture(tmp_path / "alone_Color.jpg", colour)
    picture(tmp_path / "flat_Color.png", colour)
    picture(tmp_path / "flat_Displacement.png", np.zeros((SIZE, SIZE), np.uint8))
    return tmp_path


def test_folders_are_read_as_the_libraries_name_their_files(folder) -> None:
    found = {texture.name: texture for texture in TextureLibrary.from_folder(folder, size=SIZE).textures}
    classes = {name: texture.material for name, texture in found.items()}
    assert classes == {"Wood028_1K-JPG": "wood", "aerial_rocks_04": "rock", "leather__hide": "leather"}
    expected = (WAVES - WAVES.mean()) / WAVES.std()
    assert found["leather__hide"].files == ["leather__hide__albedo.png", "leather__hide__height.png"]
    for texture in found.values():
        torch.testing.assert_close(texture.height.float(), expected, rtol=0, atol=0.06)
        torch.testing.assert_close(texture.colour, torch.full((3,), (128 / 255) ** GAMMA), rtol=0, atol=2e-3)


def test_what_holds_no_material_or_a_broken_picture_is_refused(folder) -> None:
    with pytest.raises(InvalidInputError, match="`textures` is empty"):
        TextureLibrary([])
    with pytest.raises(InvalidInputError, match=r"`textures` is .* holds no material.*_Color"):
        TextureLibrary.from_folder(folder / "gone")
    (folder / "flat").mkdir()
    for file in folder.glob("flat_*"):
        file.rename(folder / "flat" / file.name)
    with pytest.raises(InvalidInputError, match=r"`textures` is .* holds no material"):
        TextureLibrary.from_folder(folder / "flat")
    (folder / "rock" / "aerial_rocks_04_diff_1k.jpg").write_bytes(b"no picture")
    with pytest.raises(InvalidInputError, match=r"`textures` .*aerial_rocks_04_diff_1k.*cannot be read"):
        TextureLibrary.from_folder(folder)


def texture(name: str, material: str = "wood") -> Texture:
    height = (WAVES - WAVES.mean()) / WAVES.std()
    return Texture(name, material, torch.rand(3, SIZE, SIZE).half(), height.half(), [])


def test_materials_are_held_apart_within_their_classes() -> None:
    library = TextureLibrary([texture(f"{kind}{n:02}", kind) for kind in ("wood", "rock") for n in range(13)])
    held = {split: [library.textures[n].name for n in library.by_split[split]["rock"]] for split in ("val", "test")}
    assert held == {"val": ["rock01", "rock07"], "test": ["rock02", "rock08"]}
    assert len(library.by_split["train"]["wood"]) == 9


def test_a_patch_on_the_texture_s_own_grid_is_the_texture() -> None:
    one, axis = texture("a"), pixel_axis(SIZE, 20.0) + 10.0
    x, y = axis[None, None, :].expand(1, SIZE, -1), axis[None, :, None].expand(1, -1, SIZE)
    height, albedo = one.patches(x, y, torch.tensor([20.0]))
    torch.testing.assert_close(height[0], one.height.float(), rtol=0, atol=1e-3)
    torch.testing.assert_close(albedo[0], one.albedo.float(), rtol=0, atol=1e-3)
    again, _ = one.patches(2 * x + 80.0, 2 * y - 40.0, torch.tensor([40.0]))  # it repeats, at any size
    torch.testing.assert_close(again, height, rtol=0, atol=1e-3)


def test_waves_too_short_for_the_patch_do_not_fold_back() -> None:
    fine = torch.where((torch.arange(SIZE)[:, None] + torch.arange(SIZE)[None]) % 2 == 0, 1.0, -1.0)
    one, axis = Texture("a", "", torch.rand(3, SIZE, SIZE).half(), fine.half(), []), pixel_axis(16, 20.0)
    x, y = axis[None, None, :].expand(1, 16, -1), axis[None, :, None].expand(1, -1, 16)
    assert one.patches(x, y, torch.tensor([20.0]))[0].abs().max() < 1e-3
