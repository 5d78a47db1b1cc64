"""A device on a real serial port: its driver and its emulator at two UARTs that are wired to each other.

The port is a 16550A with the kernel's own driver: it holds parity and baud rate, which a pseudo-terminal does not.
"""

import os
import tempfile
import termios
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import serial
import yaml

from microdrivers.configs import shipped_rig
from microdrivers.core.bus import Bus
from microdrivers.core.clock import SystemClock
from microdrivers.fakes.wire import wire_named
from microdrivers.fakes.wire.bridge import Bridge
from microdrivers.rig import load_rig_file
from microdrivers.rig.simulation import Simulation, merge_settings

HOST_PORT, DEVICE_PORT = "/dev/ttyS1", "/dev/ttyS2"
_CONTROL_FLAGS, _CONTROL_CHARACTERS = 2, 6  # places in what tcgetattr returns
_PARITY = termios.PARENB | termios.PARODD


def parity_of(path):
    """`N`, `E` or `O`, as the kernel holds it for a port."""
    port = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        flags = termios.tcgetattr(port)[_CONTROL_FLAGS] & _PARITY
    finally:
        os.close(port)
    return {0: "N", termios.PARENB: "E", _PARITY: "O"}[flags]


class DeviceUart:
    """The port of an emulated device (a `HostPort` of the bridge).

    QEMU's cable carries whole bytes, whatever the parity; this end makes up for it: it loses what the host sends with
    another parity than its own, as a UART does that finds every other byte in error.
    """

    def __init__(self, *, baudrate, parity):
        self._settings = {"baudrate": baudrate, "parity": parity}
        self.open()

    def open(self):
        self._port = serial.Serial(DEVICE_PORT, exclusive=True, **self._settings)
        # The guest may take longer from one byte to the next than Modbus allows. So the kernel hands a request over
        # when nothing has come for 0.1 s, as if it had come in one go.
        attributes = termios.tcgetattr(self._port.fd)
        attributes[_CONTROL_CHARACTERS][termios.VMIN] = 255
        attributes[_CONTROL_CHARACTERS][termios.VTIME] = 1
        termios.tcsetattr(self._port.fd, termios.TCSANOW, attributes)
        os.set_blocking(self._port.fd, True)

    def descriptors(self):
        return [self._port.fd]

    def receive(self, ready):
        if self._port.fd not in ready:
            return b""
        data = os.read(self._port.fd, 4096)
        return data if parity_of(HOST_PORT) == self._settings["parity"] else b""

    def send(self, data):
        return os.write(self._port.fd, data)

    def close(self):
        self._port.close()


@dataclass
class UartBench:
    device: Any
    second: Any  # another driver for the same port
    world: Any
    clock: SystemClock


@contextmanager
def on_the_uart(name, *, seed=3, host_parity=None, timeout_s=10.0, **changes):
    """A device of the workstation, closed.

    `host_parity` is what the driver is set to, if not what the device has; `changes` are settings of the driver.
    """
    data = yaml.safe_load(shipped_rig("microscope").read_text(encoding="utf-8"))
    data.pop("microscope")
    data["devices"] = {name: data["devices"][name]}
    clock, bus = SystemClock(), Bus()
    with tempfile.TemporaryDirectory() as folder:
        rig_file, world_file = Path(folder) / "rig.yaml", Path(folder) / "world.yaml"
        rig_file.write_text(yaml.safe_dump(data), encoding="utf-8")
        world_file.write_text("stage: {power_on_spread_um: 30}\n", encoding="utf-8")  # a short way to the reference
        description = load_rig_file(rig_file)
        simulation = Simulation(description, clock=clock, bus=bus, seed=seed, world_file=world_file)
    entry = description.devices[name]
    line = entry.settings.connection
    uart = DeviceUart(baudrate=line.baudrate, parity=line.parity)
    bridge = Bridge(wire_named(name), clock, uart, name=name)
    connection = {"port": HOST_PORT, "parity": host_parity or line.parity, "timeout_s": timeout_s}
    # Patient, for the guest is slow.
    patient = {"connection": connection, "settle_s": 10.0, "reference_timeout_s": 120.0, **changes}
    settings = entry.driver.settings.model_validate(merge_settings(entry.settings.model_dump(), patient))
    drivers = [entry.driver.create(each, settings, clock, Bus()) for each in (name, "second")]
    try:
        yield UartBench(*drivers, simulation.world, clock)
    finally:
        for driver in drivers:
            driver.close()
        bridge.close()
        simulation.close()
        clock.close()
        clock.check()
