"""Renders `samples/inputs/`, the inputs of `unitouch_gen.example`, of held-out objects of the built-in world.

python samples/render_inputs.py
"""

from pathlib import Path

import numpy as np
import soundfile
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import gaussian_filter

from drawing import flat_contacts
from unitouch_gen.world import MATERIAL_NAMES, SAMPLE_RATE, SENSORS, Scene, World, draw_sensor

INPUTS = Path(__file__).parent / "inputs"
WORLD = World()
SCANS = World(scanned=1.0)

# (sensor, material, number of the held-out object): at least one of each sensor, and two of unknown sensors.
TOUCHES = (
    ("gelsight", "brick", 0),
    ("gelsight", "tile", 0),
    ("gelsight_r15", "gravel", 0),
    ("gelsight_objectfolder", "leather", 0),
    ("digit", "rubber", 0),
    ("digit", "wood", 0),
    ("drawn_2", "grass", 0),
    ("drawn_9", "tree", 0),
)

# Of scanned surfaces: (sensor, material, which), a touch and a photo of the same place.
SCANNED = (("gelsight", "rock", 0), ("gelsight_r15", "metal", 0), ("gelsight", "concrete", 1), ("gelsight", "sand", 2))

PHOTOS = (("brick", 1), ("wood", 1), ("gravel", 1), ("natural fabric", 1))
SOUNDS = (("metal", 0), ("glass", 0), ("wood", 0), ("gravel", 0))


def to_picture(pixels) -> Image.Image:
    """(3, H, W) in [0, 1] -> PIL."""
    return Image.fromarray((pixels.permute(1, 2, 0) * 255).round().byte().numpy())


def contact(material: str, number: int, modality: str, sensor: str = "gelsight", world: World = WORLD) -> Scene:
    """One modality of one contact with a held-out object."""
    row = MATERIAL_NAMES.index(material)
    materials, objects, contacts = flat_contacts(world, number)
    model = SENSORS[sensor] if sensor in SENSORS else draw_sensor(0, int(sensor.removeprefix("drawn_")))
    return world.render([materials[row]], [objects[row]], [contacts[row]], modalities=(modality,), sensors=(model,))


def coin(side: int = 256) -> Image.Image:
    """A height map of 16 bits, 24 mm wide, from the ground (black) to letters and rim (white) of a coin."""
    levels = Image.new("F", (side, side), 0.0)
    draw = ImageDraw.Draw(levels)
    draw.circle((side / 2, side / 2), 0.46 * side, fill=0.55)
    draw.circle((side / 2, side / 2), 0.46 * side, outline=1.0, width=side // 22)
    for turn in range(0, 360, 10):
        x = side / 2 + 0.365 * side * np.cos(np.radians(turn))
        y = side / 2 + 0.365 * side * np.sin(np.radians(turn))
        draw.circle((x, y), 0.012 * side, fill=0.85)
    font = ImageFont.load_default(0.17 * side)
    for text, place in (("UNI", 0.4), ("TOUCH", 0.58)):
        draw.text((side / 2, place * side), text, fill=1.0, font=font, anchor="mm")
    smooth = gaussian_filter(np.asarray(levels), 1.5)
    return Image.fromarray((smooth * 65535).round().astype(np.uint16))


def main() -> None:
    (INPUTS / "heights").mkdir(exist_ok=True)
    coin().save(INPUTS / "heights" / "coin.png", optimize=True)
    for folder in (INPUTS, INPUTS / "photos", INPUTS / "sounds"):
        folder.mkdir(exist_ok=True)
    for sensor, material, number in TOUCHES:
        prefix = sensor if sensor in SENSORS else sensor.split("_")[0]
        file = INPUTS / f"{prefix}_{material}.png"
        to_picture(contact(material, number, "touch", sensor).touch[sensor][0]).save(file)
        print(file)
    for sensor, material, number in SCANNED:
        touched = INPUTS / f"{sensor}_{material}.png"
        to_picture(contact(material, number, "touch", sensor, SCANS).touch[sensor][0]).save(touched)
        photographed = INPUTS / "photos" / f"{material}.png"
        to_picture(contact(material, number, "image", world=SCANS).image[0]).save(photographed)
        print(touched, photographed, sep="\n")
    for material, number in PHOTOS:
        file = INPUTS / "photos" / f"{material.replace(' ', '_')}.png"
        to_picture(contact(material, number, "image").image[0]).save(file)
        print(file)
    for material, number in SOUNDS:
        file = INPUTS / "sounds" / f"{material}.wav"
        soundfile.write(file, contact(material, number, "audio").audio[0].numpy(), SAMPLE_RATE)
        print(file)


if __name__ == "__main__":
    main()
