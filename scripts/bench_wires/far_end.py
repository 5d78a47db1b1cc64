"""Records what an emulator answers, and lets a thin process answer the same on a pseudo-terminal."""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import tty
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from microdrivers.configs import shipped_rig
from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock, SimulatedClock
from microdrivers.core.samples import WireTraffic
from microdrivers.devices.base import Device
from microdrivers.rig import build_rig, load_rig_file

Script = Mapping[bytes, list[bytes]]
"""The replies to each request, sent in turn."""


def record(device: str, *, before: Callable[[Any], object], use: Callable[[Any], object]) -> dict[bytes, list[bytes]]:
    """What the emulator of a device of the workstation answers while the device is opened and used.

    Args:
        device: its name.
        before: is done before it is opened for the record.
        use: what else is to be asked.
    """
    rig = build_rig(shipped_rig(), fake=True, seed=1, clock=SimulatedClock())
    script: dict[bytes, list[bytes]] = {}
    newest = b""

    def listen(traffic: WireTraffic) -> None:
        nonlocal newest
        if traffic.direction == "sent":
            newest = traffic.data
            script.setdefault(newest, []).append(b"")
        else:
            script[newest][-1] += traffic.data

    with rig:
        before(rig.devices[device])
        rig.devices[device].close()
        subscription = rig.bus.topic(f"{device}/wire", WireTraffic).subscribe(listen)
        rig.devices[device].open()
        use(rig.devices[device])
        subscription.cancel()
    answered = {request: [reply for reply in replies if reply] for request, replies in script.items()}
    return {request: replies for request, replies in answered.items() if replies}


def settings_on(port: str, name: str) -> Any:
    """A device's settings in the workstation's rig file, with another port; pseudo-terminals hold no parity."""
    entry = load_rig_file(shipped_rig()).devices[name]
    settings = entry.settings.model_dump(mode="python")
    settings["connection"] |= {"port": port, "parity": "N"}
    return entry.driver.settings.model_validate(settings)


def device_on(port: str, name: str, clock: Clock) -> Device[Any]:
    """A device of the workstation on another port."""
    driver = load_rig_file(shipped_rig()).devices[name].driver
    device: Device[Any] = driver.create(name, settings_on(port, name), clock, Bus())
    return device


class FarEnd:
    """A pseudo-terminal: `port` for a driver, `descriptor` for bare reads and writes.

    Args:
        script: what to answer.
        byte_ns: time of a byte on the line; 0 answers at once.
        silence_ns: between the request's last bit and the reply's first.
    """

    def __init__(self, script: Script, *, byte_ns: int = 0, silence_ns: int = 0) -> None:
        master, self.descriptor = os.openpty()
        tty.setraw(self.descriptor)
        self.port = os.ttyname(self.descriptor)
        program = Path(__file__).with_name("responder.py")
        command = [sys.executable, "-S", str(program), str(master), str(byte_ns), str(silence_ns)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, pass_fds=[master], text=True)
        os.close(master)
        assert self._process.stdin is not None
        with self._process.stdin as pipe:
            json.dump({request.hex(): [reply.hex() for reply in replies] for request, replies in script.items()}, pipe)

    def __enter__(self) -> FarEnd:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self.descriptor)
        self._process.terminate()
        self._process.wait()


class Bare:
    """The same bytes without a driver: one write, then poll and read until the reply is whole."""

    def __init__(self, end: FarEnd, request: bytes, length: int) -> None:
        self._descriptor = end.descriptor
        self._request = request
        self._length = length
        self._poller = select.poll()
        self._poller.register(end.descriptor, select.POLLIN)

    def exchange(self) -> None:
        """Send and wait."""
        os.write(self._descriptor, self._request)
        received = b""
        while len(received) < self._length:
            if not self._poller.poll(1000):
                raise TimeoutError("the far end is silent")
            received += os.read(self._descriptor, 4096)
