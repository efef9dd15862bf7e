"""Second pictures of the world's contacts: the same surface under another lamp and white balance."""

from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor
from tqdm.auto import tqdm

from unitouch_gen.files import writing_folder
from unitouch_gen.training.data.cache import new_array
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
    contacts = source.contacts(split)
    folder = Path(cache) / f"{source.name}-{split}-relit-{fingerprint}"
    if not folder.is_dir():
        world = Relit(source.seed, image_size=size)
        chunks = list(zip(*(part.split(GROUP) for part in contacts), strict=True))
        with writing_folder("cache", folder) as place:
            array = new_array(place, "image", np.uint8, len(contacts[0]), 3, size, size)
            for number, chunk in enumerate(tqdm(chunks, desc=f"{source.name}, relit", mininterval=5.0)):
                picture = world.render(*chunk, modalities=("image",)).image
                assert picture is not None
                array[number * GROUP : (number + 1) * GROUP] = as_bytes(picture)
            array.flush()
    return np.load(folder / "image.npy", mmap_mode="r")
