"""The world of wide objects: names of contacts in, the modalities asked for out."""

from typing import Any

import torch
from torch import Tensor

from unitouch_gen.errors import check_kind
from unitouch_gen.world.captions import described
from unitouch_gen.world.recordings import recorded
from unitouch_gen.world.scene import World
from unitouch_gen.world.sounds import impact_sounds
from unitouch_gen.world.surfaces import Surfaces
from unitouch_gen.world.textures import TextureLibrary
from unitouch_gen.world.wide import WideDraws, draw_wide, wide_surfaces

YIELD = 0.75
"""Share of an overlap that an object as compliant as the gel takes up: it is flattened where it is touched."""


class WideWorld(World):
    """A world of wide objects, of scanned materials as well where there are some.

    Args:
        seed: Names the whole world.
        textures: Scanned materials; 45 % of the objects whose class has some are of one.
        options: `image_size`, `resolution` and `gel` of `World`.

    Raises:
        InvalidInputError, InvalidTypeError: As `World`, and on textures that are no library.
    """

    def __init__(self, seed: int = 0, *, textures: TextureLibrary | None = None, **options: Any):
        super().__init__(seed, **options)
        self.textures = None if textures is None else check_kind("textures", textures, TextureLibrary)

    def draw(self, material: Tensor, object_: Tensor, contact: Tensor) -> WideDraws:
        return draw_wide(self.seed, material, object_, contact, self.textures)

    def _surfaces(self, draws: Any, *, coloured: bool) -> Surfaces:
        return wide_surfaces(self.seed, draws, self.resolution, self.textures, coloured=coloured)

    def _pressed(self, draws: Any, height: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Soft objects yield as two springs in a row do: all of their overlap with the gel shrinks alike."""
        stiff = 1.0 - YIELD * draws.compliance
        depth = torch.where(draws.touched, draws.indentation_depth * stiff, -1.0)
        return height * stiff[:, None, None], depth, torch.zeros_like(depth)

    def _look(self, draws: Any) -> tuple[Tensor, Tensor, Tensor | None]:
        return draws.gloss, draws.white, draws.camera

    def _sounds(self, draws: Any) -> Tensor:
        return recorded(self.seed, draws.names(), impact_sounds(self.seed, draws))

    def _captions(self, draws: Any) -> list[str]:
        return described(draws, self.textures)
