"""Optical calibration, Bilen et al., section III.B: one routine, several sources of samples."""

from microdrivers.routines.optics.calibration import OpticsRun, calibrate_optics
from microdrivers.routines.optics.circle import CircleExperiment, CircleSettings
from microdrivers.routines.optics.playback import SequencePlayback

__all__ = ["CircleExperiment", "CircleSettings", "OpticsRun", "SequencePlayback", "calibrate_optics"]
