"""Second pictures of the world's contacts: the same surface under another lamp and white balance."""

from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor
from tqdm.auto import tqdm

from unitouch_gen.training.data.cache import Arrays, mapped
from unitouch_gen.training.data.columns import as_bytes
from unitouch_gen.training.data.drawn import GROUP, DrawnContacts
from unitouch_gen.world import World


class Relit(World):
    """The same contacts, each under the next one's lamp and white balance."""

    def draw(self, material: Tensor, object_: Tensor, contact: Tensor) -> Any:
        draws = super().draw(material, object_, contact)
        return draws.but(light=draws.light.roll(1, 0), white=draws.white.roll(1, 0))


def relit_pictures(source: DrawnContacts, split: str, fingerprint: str, size: int, cache: Path) -> np.ndarray:
    """Pictures of a split, rendered with this fingerprint, under other lamps: uint8 (N, 3, S, S), once into `cache`."""
    contacts, world = source.contacts(split), Relit(source.seed, image_size=size)

    def write(arrays: Arrays, _: Path) -> None:
        starts = range(0, len(contacts[0]), GROUP)
        for start in tqdm(starts, desc=f"{source.name}, relit", mininterval=5.0):
            chunk: Any = [part[start : start + GROUP] for part in contacts]
            picture: Any = world.render(*chunk, modalities=("image",)).image
            arrays["image"][start : start + GROUP] = as_bytes(picture)

    folder = Path(cache) / f"{source.name}-{split}-relit-{fingerprint}"
    return mapped(folder, len(contacts[0]), {"image": (np.uint8, 3, size, size)}, write)["image"]
