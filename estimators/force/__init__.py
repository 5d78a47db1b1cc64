"""Force: a specimen identified from one indentation, and its force read from the camera alone.

In one go, from a whole record: `identify`. On line, sample by sample: `matcher`, `recursion`, `vision_force`,
`motion_limit`.
"""

from microdrivers.estimators.force.identify import Identification, IdentificationSettings, identify
from microdrivers.estimators.force.model import (
    SpecimenModel,
    force_uN,
    slip_speed_um_s,
    slipped_um,
    stiffness_uN_per_um,
)
from microdrivers.estimators.force.protocol_fit import ProtocolFit
from microdrivers.estimators.force.record import IndentationRecord, check
from microdrivers.estimators.force.ridge import RidgeFit, ridge_fit

__all__ = [
    "Identification",
    "IdentificationSettings",
    "identify",
    "IndentationRecord",
    "check",
    "ProtocolFit",
    "RidgeFit",
    "ridge_fit",
    "SpecimenModel",
    "force_uN",
    "slip_speed_um_s",
    "slipped_um",
    "stiffness_uN_per_um",
]
