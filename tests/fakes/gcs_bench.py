"""Emulated GCS controllers on the bench: requests go in as bytes at given times, on a stage of its own."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

from microdrivers.core.bus import Bus
from microdrivers.core.clock import SystemClock
from microdrivers.core.units import NS_PER_S, seconds_to_ns
from microdrivers.devices.drivers import EmulationRequest, ServeRequest
from microdrivers.fakes.pi_gcs import EMULATOR
from microdrivers.fakes.pi_gcs.controller import GcsController
from microdrivers.fakes.pi_gcs.daisy_chain import DaisyChain
from microdrivers.fakes.pi_gcs.emulator import build_emulator
from microdrivers.fakes.pi_gcs.settings import StageSettings
from microdrivers.fakes.wire import Reply
from microdrivers.fakes.world.axis import Axis

BYTE_NS = round(10 * NS_PER_S / 115200)
READY, NOT_READY = b"\xb1\n", b"\xb0\n"


class BenchWorld:
    """A stage without noise, away from its reference switches; 1500 µm/s and 10 °/s at most."""

    def __init__(
        self,
        *,
        noise_um: float = 0.0,
        latch_delay_s: float = 50e-6,
        lost_motion_um: float = 0.0,
        start: Mapping[str, float] | None = None,
    ) -> None:
        at = {"x": 6000.0, "y": 9000.0, "theta": 5.0, **(start or {})}
        self.stage_axes = {
            key: Axis(at[key], lag_s=0.004, lost_motion=0.0 if key == "theta" else lost_motion_um) for key in at
        }
        self.encoder_noise = {"x": noise_um, "y": noise_um, "theta": 0.0}
        self.power_on_offset = {key: -position for key, position in at.items()}
        self.reference_position = {"x": 7500.0, "y": 7500.0, "theta": 0.0}
        self.pose_latch_delay_s = latch_delay_s

    def close(self) -> None:
        pass


def stage_settings(*, direction: int = 1) -> dict[str, Any]:
    """A stage's section of a rig file, with keys that only the driver knows."""
    linear = {
        "stage": "M-111.1DG",
        "direction": direction,
        "reference": "FRF",
        "travel_um": [0, 15000],
        "max_speed_um_s": 1500,
        "acceleration_um_s2": 20000,
        "resolution_um": 0.05,
        "tolerance_um": 0.15,
    }
    rotary = {
        "travel_deg": [-180, 180],
        "max_speed_deg_s": 10,
        "acceleration_deg_s2": 100,
        "resolution_deg": 4.5e-5,
        "tolerance_deg": 2e-4,
    }
    axes = {"x": linear | {"id": "1"}, "y": linear | {"id": "2"}, "theta": rotary | {"id": "3"}}
    return {
        "driver": "pi-gcs-xytheta",
        "connection": {"port": "/dev/ttyUSB0", "baudrate": 115200, "timeout_s": 0.5},
        "controller": "C-884",
        "axes": axes,
        "settle_s": 0.2,
    }


def chained_settings(*, direction: int = 1) -> dict[str, Any]:
    """The same stage on three controllers of its own axis each; y has the serial number of a real one."""
    settings = stage_settings(direction=direction) | {"controller": "C-863.12"}
    for address, axis in enumerate(settings["axes"].values(), start=1):
        axis |= {"id": "1", "address": address}
    settings["axes"]["y"]["serial_number"] = "0119012345"
    return settings


class Bench:
    """`t_ns` is when the next request begins: when its predecessor has ended, unless a test waits."""

    def __init__(self, settings: Mapping[str, Any], world: BenchWorld | None, *, seed: int) -> None:
        self.world = world or BenchWorld()
        self.emulator = build_emulator(StageSettings.model_validate(settings), self.world, seed=seed)
        self.t_ns = NS_PER_S

    def wait(self, seconds: float) -> None:
        self.t_ns += seconds_to_ns(seconds)

    def put(self, data: bytes) -> list[Reply]:
        """Send bytes from `t_ns` on, and move `t_ns` to their end."""
        end_ns = self.t_ns + len(data) * BYTE_NS
        replies = list(self.emulator.receive(data, self.t_ns, end_ns))
        while (due_ns := self.emulator.next_event_ns()) is not None:
            replies += self.emulator.advance(due_ns)
        self.t_ns = end_ns
        return replies

    def ask(self, request: bytes) -> bytes:
        """Everything that the request is answered with."""
        return b"".join(reply.data for reply in self.put(request))

    def line(self, command: str) -> str:
        """One command line; the reply without its line feed."""
        return self.ask(command.encode() + b"\n").decode("latin-1").removesuffix("\n")

    def true_position(self, key: str) -> float:
        return self.world.stage_axes[key].position_at(self.t_ns)


class GcsBench(Bench):
    """A controller of three axes."""

    def __init__(self, world: BenchWorld | None = None, *, direction: int = 1, seed: int = 1) -> None:
        super().__init__(stage_settings(direction=direction), world, seed=seed)
        assert isinstance(self.emulator, GcsController)
        self.controller = self.emulator

    def error(self) -> int:
        return int(self.line("ERR?"))

    def error_after(self, command: str) -> int:
        assert self.line(command) == ""
        return self.error()

    def reference(self) -> None:
        """Servos on, all axes referenced at full speed, everything at rest and on target."""
        assert self.error_after("SVO 1 1 2 1 3 1") == 0
        assert self.error_after("VEL 1 1.5 2 1.5 3 10") == 0
        assert self.error_after("FRF") == 0
        self.wait(20.0)
        assert self.line("FRF?") == "1=1 \n2=1 \n3=1"
        assert self.line("ONT?") == "1=1 \n2=1 \n3=1"


class ChainBench(Bench):
    """Three controllers of one axis each, at addresses 1, 2 and 3."""

    def __init__(self, world: BenchWorld | None = None, *, direction: int = 1, seed: int = 1) -> None:
        super().__init__(chained_settings(direction=direction), world, seed=seed)
        assert isinstance(self.emulator, DaisyChain)
        self.chain = self.emulator

    def error(self, address: int) -> int:
        return int(self.line(f"{address} ERR?").removeprefix(f"0 {address} "))

    def error_after(self, address: int, command: str) -> int:
        assert self.line(f"{address} {command}") == ""
        return self.error(address)

    def reference(self) -> None:
        """Servos on, all axes referenced at full speed, everything at rest and on target."""
        for address, speed in ((1, 1.5), (2, 1.5), (3, 10)):
            for command in ("SVO 1 1", f"VEL 1 {speed}", "FRF"):
                assert self.error_after(address, command) == 0
        self.wait(20.0)
        for address in (1, 2, 3):
            assert self.line(f"{address} ONT?") == f"0 {address} 1=1"


@contextmanager
def served_emulator(
    settings: Mapping[str, Any], world: BenchWorld, transport: Literal["pty", "tcp"]
) -> Iterator[str | tuple[str, int]]:
    """An emulator on a port of the operating system: the terminal's name, or host and port."""
    clock = SystemClock()
    emulation = EMULATOR.attach(
        EmulationRequest(name="stage", settings=settings, world=world, seed=3, clock=clock, bus=Bus())
    )
    assert emulation.serve is not None
    with tempfile.TemporaryDirectory() as folder:
        endpoint = emulation.serve(ServeRequest(transport=transport, bind="127.0.0.1", folder=Path(folder)))
        host, _, port = endpoint.where.removeprefix("socket://").rpartition(":")
        try:
            yield endpoint.where if transport == "pty" else (host, int(port))
        finally:
            endpoint.close()
            emulation.close()
            clock.close()
