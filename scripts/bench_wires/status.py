"""A status read of the AZ drive (Modbus RTU): what it takes beyond the time of its bytes on the line.

Pseudo-terminals have no byte times, so the far end keeps them: it lets the request's bytes take their time at 115200
baud with parity (11 bits each), waits 3.5 characters, and sends each byte of the reply when its last bit would be
through. Requests begin on a free line: the silence that a drive wants between two of them is not measured. It is passed
awake, as in a program that has something to do; a processor that sleeps between two polls takes longer, bare or not.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from bench_wires.far_end import Bare, FarEnd, record, settings_on
from bench_wires.figures import Figure, Times, in_rounds
from microdrivers.backends.oriental_az.drive import AzDrive
from microdrivers.backends.oriental_az.link import az_link
from microdrivers.core.bus import Bus
from microdrivers.core.clock import SystemClock
from microdrivers.core.units import seconds_to_ns
from microdrivers.devices.wire_tap import WireTap

_ZOOM = "zoom"
_STATUS_REQUEST = bytes.fromhex("01 03 00 7E 00 02")
_BYTE_NS = round(11e9 / 115200)
_SILENCE_NS = round(3.5 * _BYTE_NS)
_ALLOWANCE_MS = 0.3
_ROUNDS = 20
_IN_A_ROUND = 15
_PAUSE_S = 0.004

Calls = dict[str, Callable[[], object]]


def measure(repeat: float) -> list[Figure]:
    """Rounds of bare exchanges and of `read_status()`, in turn."""
    script = record(_ZOOM, before=lambda _: None, use=lambda zoom: zoom.read())
    request = next(candidate for candidate in script if candidate.startswith(_STATUS_REQUEST))
    reply = script[request][-1]
    only = {request: [reply]}
    clock = SystemClock()
    with (
        FarEnd(only, byte_ns=_BYTE_NS, silence_ns=_SILENCE_NS) as bare_end,
        FarEnd(only, byte_ns=_BYTE_NS, silence_ns=_SILENCE_NS) as drive_end,
    ):
        settings = settings_on(drive_end.port, _ZOOM)
        line, modbus = az_link(settings, clock=clock, tap=WireTap(_ZOOM, Bus()))
        line.open()
        drive = AzDrive(modbus, settings.register_order)
        calls: Calls = {"bare": Bare(bare_end, request, len(reply)).exchange, "drive": drive.read_status}
        rounds = round(_ROUNDS * repeat) + 1
        awake = in_rounds(calls, rounds, in_a_round=_IN_A_ROUND, pause=_pass_awake)
        asleep = in_rounds(calls, rounds, in_a_round=_IN_A_ROUND, pause=lambda: clock.sleep(_PAUSE_S))
        line.close()
    clock.close()
    ideal_ns = (len(request) + len(reply)) * _BYTE_NS + _SILENCE_NS
    what = f"AZ status read, RTU on a PTY at 115200: {len(request)} + {len(reply)} bytes"
    return [
        Figure("  bytes' time and 3.5 characters", "", f"{ideal_ns / 1e6:.3f} ms"),
        _beyond("  bare write, poll, read of the same bytes", awake["bare"], ideal_ns),
        _beyond(what, awake["drive"], ideal_ns, reach=True),
        _beyond("  bare, after a sleep", asleep["bare"], ideal_ns),
        _beyond("  status read, after a sleep", asleep["drive"], ideal_ns),
    ]


def _beyond(name: str, times: Times, ideal_ns: int, *, reach: bool = False) -> Figure:
    """What it takes beyond the ideal; the best round decides, for another program's work is not the driver's."""
    beyond_ms = times.median_us / 1e3 - ideal_ns / 1e6
    best_ms = times.best_us / 1e3 - ideal_ns / 1e6
    limit = f"≤ bytes' time + 3.5 characters + {_ALLOWANCE_MS:g} ms" if reach else ""
    reached = best_ms <= _ALLOWANCE_MS if reach else None
    return Figure(
        name, limit, f"+ {best_ms:.3f} ms in the best round, + {beyond_ms:.3f} in all: {times.in_ms()}", reached
    )


def _pass_awake() -> None:
    end_ns = time.perf_counter_ns() + seconds_to_ns(_PAUSE_S)
    while time.perf_counter_ns() < end_ns:
        pass
