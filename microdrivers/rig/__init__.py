"""Rig files, and the life of a rig."""

from microdrivers.rig.rig import Rig, build_rig, open_rig
from microdrivers.rig.rig_file import RigDescription, load_rig_file
from microdrivers.rig.sections import RigFile

__all__ = ["Rig", "RigDescription", "RigFile", "build_rig", "load_rig_file", "open_rig"]
