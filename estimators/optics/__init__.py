"""Camera to stage: the projection matrix estimated on line, and what it says about the optics."""

from microdrivers.estimators.optics.intervals import student_factor
from microdrivers.estimators.optics.optical_parameters import (
    OpticalParameters,
    View,
    optical_parameters,
    wrap_deg,
)
from microdrivers.estimators.optics.recursion import ProjectionRecursion
from microdrivers.estimators.optics.sandwich import ProjectionUncertainty

__all__ = [
    "OpticalParameters",
    "ProjectionRecursion",
    "ProjectionUncertainty",
    "View",
    "optical_parameters",
    "student_factor",
    "wrap_deg",
]
