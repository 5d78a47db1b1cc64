"""The physical world that the emulators of a rig share."""

from microdrivers.devices.drivers import WorldType
from microdrivers.fakes.world.axis import Axis, Encoder
from microdrivers.fakes.world.microscope_world import MicroscopeWorld
from microdrivers.fakes.world.settings import WorldSettings

__all__ = ["WORLD", "Axis", "Encoder", "MicroscopeWorld", "WorldSettings"]

WORLD = WorldType(settings=WorldSettings, build=MicroscopeWorld)
