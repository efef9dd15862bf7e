"""Renders `samples/inputs/`, what `unitouch_gen.example` has: of objects of the built-in world that no training saw.

python samples/render_inputs.py
"""

from pathlib import Path

import soundfile
from PIL import Image

from unitouch_gen.world import COLLECTION_MATERIALS, COLLECTIONS, SAMPLE_RATE, Scene, World
from unitouch_gen.world.collections import SPLITS

INPUTS = Path(__file__).parent / "inputs"

# (collection, material, held-out object, contact): one of each sensor at least, two of them never trained on.
TOUCHES = (
    ("world_gelsight", "brick", 3, 0),
    ("world_gelsight", "gravel", 1, 1),
    ("world_digit", "rubber", 2, 0),
    ("world_digit", "wood", 4, 2),
    ("world_taxim", "tile", 0, 1),
    ("world_taxim", "leather", 5, 0),
    ("world_tacto", "tree", 1, 0),
    ("world_gelslim", "grass", 2, 1),
)

PHOTOS = (("brick", 1), ("wood", 2), ("gravel", 4), ("natural fabric", 0))
SOUNDS = (("metal", 1), ("glass", 2), ("wood", 3), ("gravel", 0))


def to_picture(pixels) -> Image.Image:
    """(3, H, W) in [0, 1] -> PIL."""
    return Image.fromarray((pixels.permute(1, 2, 0) * 255).round().byte().numpy())


def contact(name: str, material: str, number: int, contact: int, modality: str) -> Scene:
    """One modality of one contact of a collection with a held-out object."""
    collection = COLLECTIONS[name]
    held_out = collection.first_object + SPLITS["test"][0] + number
    return World().render(
        [COLLECTION_MATERIALS.index(material)], [held_out], [contact],
        modalities=(modality,), sensors=(collection.sensor,), style=collection.style,
    )  # fmt: skip


def main() -> None:
    for folder in (INPUTS, INPUTS / "photos", INPUTS / "sounds"):
        folder.mkdir(exist_ok=True)
    for name, material, number, which in TOUCHES:
        sensor = COLLECTIONS[name].sensor
        file = INPUTS / f"{sensor}_{material.replace(' ', '_')}.png"
        to_picture(contact(name, material, number, which, "touch").touch[sensor][0]).save(file)
        print(file)
    for material, number in PHOTOS:
        file = INPUTS / "photos" / f"{material.replace(' ', '_')}.png"
        to_picture(contact("world_gelsight", material, number, 0, "image").image[0]).save(file)
        print(file)
    for material, number in SOUNDS:
        file = INPUTS / "sounds" / f"{material}.wav"
        soundfile.write(file, contact("world_gelsight", material, number, 0, "audio").audio[0].numpy(), SAMPLE_RATE)
        print(file)


if __name__ == "__main__":
    main()
