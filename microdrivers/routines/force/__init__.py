"""Force characterisation of a specimen, Bilen et al., sections II.B and III.C."""

from microdrivers.routines.force.characterisation import Characterisation, ForceRun
from microdrivers.routines.force.playback import IndentationPlayback
from microdrivers.routines.force.press import PressExperiment
from microdrivers.routines.force.press_settings import PressSettings
from microdrivers.routines.force.replay import IndentationReplay
from microdrivers.routines.force.result import build_result
from microdrivers.routines.force.sight import Sight
from microdrivers.routines.force.source import IndentationSource

__all__ = [
    "Characterisation", "ForceRun", "IndentationPlayback", "IndentationReplay", "IndentationSource",
    "PressExperiment", "PressSettings", "Sight", "build_result",
]  # fmt: skip
