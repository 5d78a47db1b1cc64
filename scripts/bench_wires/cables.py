"""Pulled cables: how soon a device says so, how soon it is usable again, and whether another one is refused."""

from __future__ import annotations

import random
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from bench_wires.figures import Figure, Times
from bench_wires.serving import Serving
from microdrivers.core.clock import SystemClock
from microdrivers.core.errors import LinkLost, MicrodriversError
from microdrivers.core.units import NS_PER_S
from microdrivers.devices.base import Device
from microdrivers.rig import open_rig

_NOTICED_WITHIN_S = 0.2
_USABLE_WITHIN_S = 2.0
_CYCLES = 15
_TRY_EACH_S = 0.01
_OTHER_SERIAL_NUMBER = "116099999"


def measure(repeat: float) -> list[Figure]:
    """Pull and put back at random moments, while the device is read without pause."""
    figures = []
    for name, port in (("sample_stage", "PTY"), ("zoom", "PTY"), ("camera_fine", "HTTP")):
        clock = SystemClock()
        with Serving(name) as serving, open_rig(serving.rig_file, clock=clock) as rig:
            figures += _cycles(rig.devices[name], serving, clock, port, round(_CYCLES * repeat) + 1)
    return [*figures, _another_one()]


def _cycles(device: Device[Any], serving: Serving, clock: SystemClock, port: str, number: int) -> list[Figure]:
    noticed, usable = [], []
    moments = random.Random(1)
    serial_number = device.info.serial_number
    for _ in range(number):
        pulled = _Later(clock, moments.uniform(0.05, 0.15), lambda: serving.unplug(device.name))
        lost_ns = _read_until_lost(device, clock)
        noticed.append(lost_ns - pulled.result())
        back = _Later(clock, moments.uniform(0.05, 0.15), lambda: serving.plug_in(device.name))
        read_ns = _try_until_read(device, clock)
        usable.append(read_ns - back.result())
        if device.info.serial_number != serial_number:
            raise SystemExit(f"{device.name} came back as {device.info.serial_number}, not {serial_number}")
    return [
        Figure(
            f"{device.name} on {port} unplugged → typed error",
            f"≤ {_NOTICED_WITHIN_S:g} s",
            f"{Times(noticed).in_ms()}, at most {max(noticed) / 1e6:.1f} ms",
            max(noticed) <= _NOTICED_WITHIN_S * NS_PER_S,
        ),
        Figure(
            f"  plugged in again → usable, serial number {serial_number or 'not told by this device'}",
            f"≤ {_USABLE_WITHIN_S:g} s",
            f"{Times(usable).in_ms()}, at most {max(usable) / 1e6:.1f} ms",
            max(usable) <= _USABLE_WITHIN_S * NS_PER_S,
        ),
    ]


def _read_until_lost(device: Device[Any], clock: SystemClock) -> int:
    while True:
        try:
            device.read()
        except LinkLost:
            return clock.now_ns()


def _try_until_read(device: Device[Any], clock: SystemClock) -> int:
    while True:
        try:
            device.close()
            device.open()
            device.read()
        except MicrodriversError:
            clock.sleep(_TRY_EACH_S)
        else:
            return clock.now_ns()


def _another_one() -> Figure:
    """A stage with another serial number behind the same port."""
    name = "sample_stage"
    other = {name: {"serial_number": _OTHER_SERIAL_NUMBER}}
    with (
        Serving(name) as serving,
        Serving(name, changes=other) as elsewhere,
        open_rig(serving.rig_file) as rig,
    ):
        device = rig.devices[name]
        known = device.info.serial_number
        serving.unplug(name)
        device.close()
        port = _port_of(serving.rig_file, name)
        port.symlink_to(_port_of(elsewhere.rig_file, name).readlink())
        try:
            device.open()
            said = f"ACCEPTED as {device.info.serial_number}"
        except MicrodriversError as error:
            said = f"{type(error).__name__}: {error.what}"
        port.unlink()
    refused = not said.startswith("ACCEPTED")
    return Figure(f"  another stage in the place of {known}", "refused", said[:100], refused)


def _port_of(rig_file: Path, name: str) -> Path:
    data = yaml.safe_load(rig_file.read_text(encoding="utf-8"))
    return Path(data["devices"][name]["connection"]["port"])


class _Later:
    """Something that is done by another thread, after a while."""

    def __init__(self, clock: SystemClock, delay_s: float, call: Callable[[], int]) -> None:
        self._value = 0
        self._thread = threading.Thread(target=self._run, args=(clock, delay_s, call))
        self._thread.start()

    def _run(self, clock: SystemClock, delay_s: float, call: Callable[[], int]) -> None:
        clock.sleep(delay_s)
        self._value = call()

    def result(self) -> int:
        """What it returned, once it has."""
        self._thread.join()
        return self._value
