"""The emulated AZ drive on a port of the operating system, for clients that know nothing of this project."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from microdrivers.core.bus import Bus
from microdrivers.core.clock import SystemClock
from microdrivers.devices.drivers import EmulationRequest, ServeRequest
from microdrivers.fakes.oriental_az import EMULATOR, AzDrive
from tests.fakes.az_bench import ZoomOnlyWorld, drive_behind


@contextmanager
def served_zoom(
    transport: Literal["pty", "tcp"], framing: Literal["rtu", "tcp"] = "rtu"
) -> Iterator[tuple[AzDrive, str]]:
    """The drive, to look behind the scenes, and where clients find it: a device's path or `socket://HOST:PORT`."""
    clock = SystemClock()
    connection = {"framing": framing, "baudrate": 115200, "parity": "N"}
    emulation = EMULATOR.attach(
        EmulationRequest(
            name="zoom", settings={"connection": connection}, world=ZoomOnlyWorld(), seed=1, clock=clock, bus=Bus()
        )
    )
    assert emulation.serve is not None
    with tempfile.TemporaryDirectory() as folder:
        endpoint = emulation.serve(ServeRequest(transport=transport, bind="127.0.0.1", folder=Path(folder)))
        try:
            yield drive_behind("zoom"), endpoint.where
        finally:
            endpoint.close()
            emulation.close()
            clock.close()
