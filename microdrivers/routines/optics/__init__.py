"""Optical calibration, Bilen et al., section III.B: one routine, several sources of samples."""

from microdrivers.routines.optics.calibration import OpticsRun, calibrate_optics
from microdrivers.routines.optics.circle import CircleExperiment, CircleSettings
from microdrivers.routines.optics.playback import SequencePlayback
from microdrivers.routines.optics.replay import OpticsReplay

__all__ = ["CircleExperiment", "CircleSettings", "OpticsReplay", "OpticsRun", "SequencePlayback", "calibrate_optics"]
