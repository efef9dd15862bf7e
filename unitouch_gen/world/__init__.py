"""A visuo-tactile world, drawn and scanned: pictures, touch images, impact sounds, captions, grasps and attributes."""

from unitouch_gen.world.attributes import ATTRIBUTES, CELLS, MAPS, contact_attributes, contact_maps
from unitouch_gen.world.draws import FIRST_OBJECT
from unitouch_gen.world.gel import untouched_gel
from unitouch_gen.world.materials import MATERIAL_NAMES, MATERIALS, Material
from unitouch_gen.world.press import Pressed, press
from unitouch_gen.world.scene import SCENE_MODALITIES, Scene, World
from unitouch_gen.world.sensors import SENSORS, Sensor, draw_sensor
from unitouch_gen.world.sounds import DURATION, SAMPLE_RATE

__all__ = [
    "ATTRIBUTES",
    "CELLS",
    "DURATION",
    "FIRST_OBJECT",
    "MAPS",
    "MATERIALS",
    "MATERIAL_NAMES",
    "SAMPLE_RATE",
    "SCENE_MODALITIES",
    "SENSORS",
    "Material",
    "Pressed",
    "Scene",
    "Sensor",
    "World",
    "contact_attributes",
    "contact_maps",
    "draw_sensor",
    "press",
    "untouched_gel",
]
