"""Rig files, and the life of a rig."""

from microdrivers.rig.rig import Rig, build_rig, open_rig
from microdrivers.rig.rig_file import RigDescription, RigFile, load_rig_file

__all__ = ["Rig", "RigDescription", "RigFile", "build_rig", "load_rig_file", "open_rig"]
