"""Objects of the drive profile (CiA 402-2) that the driver uses."""

from __future__ import annotations

from microdrivers.backends.canopen.objects import signed, unsigned

ERROR_CODE = unsigned(0x603F, 0, 16, "error code")
CONTROL_WORD = unsigned(0x6040, 0, 16, "control word")
STATUS_WORD = unsigned(0x6041, 0, 16, "status word")
QUICK_STOP_OPTION = signed(0x605A, 0, 16, "quick stop option code")
MODE = signed(0x6060, 0, 8, "mode of operation")
MODE_DISPLAY = signed(0x6061, 0, 8, "mode of operation display")
POSITION = signed(0x6064, 0, 32, "position actual value")
POSITION_WINDOW = unsigned(0x6067, 0, 32, "position window")
POSITION_WINDOW_TIME = unsigned(0x6068, 0, 16, "position window time")
TARGET_POSITION = signed(0x607A, 0, 32, "target position")
HOME_OFFSET = signed(0x607C, 0, 32, "home offset")
MIN_POSITION_LIMIT = signed(0x607D, 1, 32, "minimum software position limit")
MAX_POSITION_LIMIT = signed(0x607D, 2, 32, "maximum software position limit")
MAX_PROFILE_VELOCITY = unsigned(0x607F, 0, 32, "maximum profile velocity")
PROFILE_VELOCITY = unsigned(0x6081, 0, 32, "profile velocity")
PROFILE_ACCELERATION = unsigned(0x6083, 0, 32, "profile acceleration")
PROFILE_DECELERATION = unsigned(0x6084, 0, 32, "profile deceleration")
HOMING_METHOD = signed(0x6098, 0, 8, "homing method")
HOMING_SPEED_SWITCH = unsigned(0x6099, 1, 32, "homing speed to the switch")
HOMING_SPEED_ZERO = unsigned(0x6099, 2, 32, "homing speed to zero")
SUPPORTED_MODES = unsigned(0x6502, 0, 32, "supported drive modes")

PROFILE_NUMBER = 402

PROFILE_POSITION, HOMING = 1, 6
"""Modes of operation; `SUPPORTED_MODES` has a bit for each, the first for mode 1."""
