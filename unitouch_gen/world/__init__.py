"""A procedural visuo-tactile world: pictures, touch images, impact sounds, captions, grasps and attributes."""

from unitouch_gen.world.attributes import ATTRIBUTES, CELLS, MAPS, contact_attributes, contact_maps
from unitouch_gen.world.calibrated_sensors import CALIBRATED
from unitouch_gen.world.collections import COLLECTION_MATERIALS, COLLECTIONS, TRAINING_COLLECTIONS, Collection, contacts
from unitouch_gen.world.drawn_sensors import draw_sensor
from unitouch_gen.world.gel import GelGrid
from unitouch_gen.world.materials import MATERIAL_NAMES, MATERIALS, SHAPE_NAMES, Material
from unitouch_gen.world.scene import MODALITIES, Grasp, Scene, Style, World
from unitouch_gen.world.sensors import SENSORS, TRAINING_SENSORS, UNSEEN_SENSORS, Sensor, untouched_gel
from unitouch_gen.world.sounds import DURATION, SAMPLE_RATE
from unitouch_gen.world.textures import Texture, TextureLibrary
from unitouch_gen.world.wide_world import WideWorld

__all__ = [
    "ATTRIBUTES",
    "CALIBRATED",
    "CELLS",
    "COLLECTIONS",
    "COLLECTION_MATERIALS",
    "DURATION",
    "MAPS",
    "MATERIALS",
    "MATERIAL_NAMES",
    "MODALITIES",
    "SAMPLE_RATE",
    "SENSORS",
    "SHAPE_NAMES",
    "TRAINING_COLLECTIONS",
    "TRAINING_SENSORS",
    "UNSEEN_SENSORS",
    "Collection",
    "GelGrid",
    "Grasp",
    "Material",
    "Scene",
    "Sensor",
    "Style",
    "Texture",
    "TextureLibrary",
    "WideWorld",
    "World",
    "contact_attributes",
    "contact_maps",
    "contacts",
    "draw_sensor",
    "untouched_gel",
]
