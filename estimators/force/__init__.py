"""Force: a specimen identified from one indentation, and its force read from the camera alone."""

from microdrivers.estimators.force.model import (
    SpecimenModel,
    force_uN,
    slip_speed_um_s,
    slipped_um,
    stiffness_uN_per_um,
)

__all__ = [
    "SpecimenModel",
    "force_uN",
    "slip_speed_um_s",
    "slipped_um",
    "stiffness_uN_per_um",
]
