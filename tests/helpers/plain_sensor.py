"""A sensor without markers, gradients, tint or a gel that follows, for closed forms, one with printed markers, and
what sensors see of surfaces."""

from dataclasses import replace

from torch import Tensor

from unitouch_gen.world import Sensor
from unitouch_gen.world.gel import gel_displacement, gel_image, gel_indentation

PLAIN = Sensor(
    "plain",
    field_of_view=16.0,
    thickness=2.0,
    correlation=0.18,
    relaxation=0.02,
    azimuths=(60.0, 180.0, 300.0),
    elevation=(34.0,) * 3,
    falloff=0.15,
    gain=0.90,
    blur=0.08,
    noise=0.004,
    colours=((0.95, 0.25, 0.25), (0.25, 0.95, 0.30), (0.25, 0.30, 1.0)),
    backdrop=(((0.56,),), ((0.60,),), ((0.66,),)),
)

MARKED = replace(PLAIN, name="marked", marker_pitch=2.9, marker_radius=0.33)


def touch_images(height: Tensor, indentation_depth: Tensor, dwell: Tensor, sensor: Sensor, size: int) -> Tensor:
    """Touch images (N, 3, S, S) without noise of heights (N, R, R), mm, at depths (mm) and after times (s), (N,)."""
    indentation = gel_indentation(height, indentation_depth, sensor, size)
    return gel_image(gel_displacement(indentation, dwell, sensor, size), sensor, size)
