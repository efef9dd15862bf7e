"""The stiff and extreme set of the world's physics: what each case has to do, and what it does.

Each case checks an invariant that holds whatever the code is: a displacement is at most load over stiffness, without
contact the camera sees the untouched gel, a struck mode only loses energy, and what cannot be is refused by name.
"""

from unitouch_gen.numerics.physics_stiff_gels import gel_cases, press_cases, refused_gels
from unitouch_gen.numerics.physics_stiff_sounds import mode_cases, refused_sounds, sound_cases
from unitouch_gen.numerics.stability import Case


def physics_suite() -> dict[str, list[Case]]:
    """All cases of the world, by group."""
    return {
        "gels": [*gel_cases(), *press_cases(), *refused_gels()],
        "sounds": [*mode_cases(), *sound_cases(), *refused_sounds()],
    }
