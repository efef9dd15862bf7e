"""Renders `samples/inputs/`: touches of objects of the built-in world that its training never saw.

python samples/render_inputs.py
"""

from pathlib import Path

from PIL import Image

from unitouch_gen.world import COLLECTIONS, MATERIAL_NAMES, World
from unitouch_gen.world.collections import SPLITS

INPUTS = Path(__file__).parent / "inputs"

# (collection, material, held-out object, contact): one of each sensor at least, two of them never trained on.
TOUCHES = (
    ("touch_and_go", "brick", 3, 0),
    ("touch_and_go", "gravel", 1, 1),
    ("ycb_slide", "rubber", 2, 0),
    ("ycb_slide", "wood", 4, 2),
    ("object_folder_2", "tile", 0, 1),
    ("object_folder_2", "leather", 5, 0),
    ("object_folder_1", "tree", 1, 0),
    ("object_folder_real", "grass", 2, 1),
)


def to_picture(pixels) -> Image.Image:
    """(3, H, W) in [0, 1] -> PIL."""
    return Image.fromarray((pixels.permute(1, 2, 0) * 255).round().byte().numpy())


def main() -> None:
    INPUTS.mkdir(exist_ok=True)
    world = World()
    for name, material, number, contact in TOUCHES:
        collection = COLLECTIONS[name]
        held_out = collection.first_object + SPLITS["test"][0] + number
        scene = world.render(
            [MATERIAL_NAMES.index(material)], [held_out], [contact],
            senses=("touch",), sensors=(collection.sensor,), style=collection.style,
        )  # fmt: skip
        file = INPUTS / f"{collection.sensor}_{material.replace(' ', '_')}.png"
        to_picture(scene.touch[collection.sensor][0]).save(file)
        print(file)


if __name__ == "__main__":
    main()
