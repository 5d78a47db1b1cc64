"""An emulated serial line: baud pacing, delays and seeded fragments between a driver and an emulator."""

from microdrivers.fakes.wire.bridge import Cable, serve_wire
from microdrivers.fakes.wire.wire import (
    NetworkEmulator,
    Reply,
    Temper,
    Wire,
    WireEmulator,
    forget_wire,
    register_wire,
    wire_named,
)

__all__ = [
    "Cable",
    "NetworkEmulator",
    "Reply",
    "Temper",
    "Wire",
    "WireEmulator",
    "forget_wire",
    "register_wire",
    "serve_wire",
    "wire_named",
]
