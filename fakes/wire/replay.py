"""A device that answers from a wire log, and the world that consists of such devices.

What a rig's log holds is replayed byte for byte, with the delays of the log, so that a driver meets again what it met
when the log was taken. See docs/decisions/0012.
"""

from __future__ import annotations

import logging
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import pydantic

from microdrivers.core.errors import ConfigError
from microdrivers.core.samples import WireTraffic
from microdrivers.devices.drivers import (
    DeviceSettings,
    Emulation,
    EmulationRequest,
    Emulator,
    WorldRequest,
    WorldType,
)
from microdrivers.devices.wire_log_format import LoggedSample, bytes_text, read_wire_log
from microdrivers.fakes.wire.wire import Reply, Temper, Wire, forget_wire, register_wire

_MOST_SHOWN = 5
_BUS = "CAN "
"""What the name of a bus begins with in a log; no device is called so."""

_log = logging.getLogger(__name__)


class LoggedRequest(NamedTuple):
    """Bytes that the host sent in one go, and what came after them before it sent again: (delay in ns, bytes)."""

    data: bytes
    replies: list[tuple[int, bytes]]


class ReplayEmulator:
    """Answers requests as a log says.

    A request is looked up as the one that the log has next; else as a later one, what lies between being skipped;
    else as the latest earlier one, for a driver may poll more often than when the log was taken. What the log does not
    know meets silence. A reply comes as long after its request as it did in the log; a request without a reply there
    gets none.

    A host may cut what it sends otherwise than the log does, as long as it keeps to the log's order.

    Attributes:
        skipped: requests of the log that were passed over.
        repeated: answers given from an earlier place of the log.
        unknown: how often each request came that the log does not hold.
    """

    def __init__(self, requests: Sequence[LoggedRequest]) -> None:
        self.skipped = 0
        self.repeated = 0
        self.unknown: Counter[bytes] = Counter()
        self._requests = requests
        self._places: dict[bytes, list[int]] = {}
        for place, request in enumerate(requests):
            self._places.setdefault(request.data, []).append(place)
        self._next = 0
        self._begun = b""

    def receive(self, data: bytes, start_ns: int, end_ns: int) -> Sequence[Reply]:  # noqa: ARG002 - WireEmulator's
        """Look up what the host has sent."""
        replies: list[Reply] = []
        begun, self._begun = self._begun, b""
        heard = begun + data
        while heard:
            found, rest = self._look_up(heard)
            if found:
                replies += self._replies(found, start_ns)
                heard, begun = rest, b""
            elif self._expects(heard):
                self._begun = heard
                break
            elif begun:
                self.unknown[begun] += 1
                heard, begun = heard[len(begun) :], b""
            else:
                self.unknown[heard] += 1
                break
        return replies

    def advance(self, t_ns: int) -> Sequence[Reply]:  # noqa: ARG002 - WireEmulator's
        """Nothing happens by itself."""
        return ()

    def next_event_ns(self) -> int | None:
        """Nothing happens by itself."""
        return None

    def complaints(self) -> Iterator[str]:
        """What the host asked and the log does not know, in words."""
        unknown = self.unknown + Counter([self._begun] if self._begun else [])
        for data, times in unknown.most_common(_MOST_SHOWN):
            yield f"the log has no answer to {bytes_text(data)} ({times}×)"
        if len(unknown) > _MOST_SHOWN:
            yield f"nor to {len(unknown) - _MOST_SHOWN} other requests"

    def _look_up(self, heard: bytes) -> tuple[list[int], bytes]:
        """Places of requests in the log that `heard` consists of, and the rest that belongs to none of them."""
        run, rest = self._run(heard)
        if rest and (places := self._places.get(heard)):
            run, rest = [self._nearest(places)], b""
        if run and run[0] >= self._next:
            self.skipped += run[0] - self._next
            self._next = run[-1] + 1
        elif run:
            self.repeated += 1
        return run, rest

    def _run(self, heard: bytes) -> tuple[list[int], bytes]:
        """As many of the next requests as `heard` begins with."""
        run: list[int] = []
        for place in range(self._next, len(self._requests)):
            data = self._requests[place].data
            if not heard or not heard.startswith(data):
                break
            run.append(place)
            heard = heard[len(data) :]
        return run, heard

    def _nearest(self, places: list[int]) -> int:
        later = bisect_left(places, self._next)
        return places[later] if later < len(places) else places[-1]

    def _expects(self, heard: bytes) -> bool:
        return self._next < len(self._requests) and self._requests[self._next].data.startswith(heard)

    def _replies(self, places: Iterable[int], start_ns: int) -> Iterator[Reply]:
        for place in places:
            for delay_ns, data in self._requests[place].replies:
                yield Reply(start_ns + delay_ns, data)


def logged_requests(traffic: Iterable[WireTraffic]) -> list[LoggedRequest]:
    """One device's traffic as requests and what followed each. What came before the first request is left out."""
    requests: list[LoggedRequest] = []
    sent_ns = 0
    for sample in traffic:
        if not sample.data:
            continue
        if sample.direction == "sent":
            requests.append(LoggedRequest(sample.data, []))
            sent_ns = sample.t_ns
        elif requests:
            requests[-1].replies.append((max(0, sample.t_ns - sent_ns), sample.data))
    return requests


class ReplaySettings(DeviceSettings):
    """A world file, or what stands for one. `log` is the wire log's path, from where the command runs."""

    schema_version: Literal[1] = 1
    world: Literal["wire-log"] = "wire-log"
    log: str = pydantic.Field(min_length=1)


class ReplayWorld:
    """The devices of a wire log, each behind `fake://NAME`; see `WorldWithEmulators`.

    Says by warnings which devices of the rig it leaves out, where the rig file differs from that of the log, and at
    the end which requests it had no answer to. CAN buses are not replayed: their devices are left out.

    Raises:
        ConfigError: there is no such log, it is damaged, or it knows no device of the rig that can be replayed.
    """

    def __init__(self, request: WorldRequest[ReplaySettings]) -> None:
        self.file = Path(request.settings.log)
        log = read_wire_log(self.file)
        devices: Mapping[str, Any] = request.rig["devices"]
        self.starts_anew = log.header.source == "fake"
        traffic = _by_device(log.records)
        self.replays = {
            name: ReplayEmulator(requests)
            for name, sent in traffic.items()
            if name in devices and (requests := logged_requests(sent))
        }
        on_can = [name for name, section in devices.items() if _is_on_can(section)]
        if not self.replays and len(on_can) == len(devices):
            raise ConfigError(
                f"CAN buses are not replayed, and {', '.join(on_can)} {'is' if len(on_can) == 1 else 'are'} on one",
                file=str(self.file),
                remedy="read the log: a frame is a line of its own, in candump's notation; or use --fake",
            )
        if traffic and all(name.startswith(_BUS) for name in traffic):
            raise ConfigError(
                f"the log holds nothing but frames of {', '.join(traffic)}, and CAN buses are not replayed",
                file=str(self.file),
                remedy="give a log of a run in which devices on serial lines were used too; or read this one: a frame "
                "is a line of its own, in candump's notation",
            )
        if not self.replays:
            raise ConfigError(
                "nothing passed on the wire of any device of this rig", file=str(self.file),
                remedy=f"give a log of {', '.join(devices)}, or the rig file that the log was taken with",
            )  # fmt: skip
        self.emulators: Mapping[str, Emulator] = {
            name: Emulator(attach=partial(_attach, replay)) for name, replay in self.replays.items()
        }
        if on_can:
            _log.warning("%s: left out of the rig, for CAN buses are not replayed: %s", self.file, ", ".join(on_can))
        left_out = [name for name in devices if name not in self.replays and name not in on_can]
        if left_out:
            _log.warning(
                "%s: left out of the rig, for the log holds nothing of its wire (images and HTTP are not logged): %s",
                self.file, ", ".join(left_out),
            )  # fmt: skip
        then = log.header.rig.get("devices")
        known = {name: devices[name] for name in self.replays}
        for difference in _differences(then, known):
            _log.warning("%s: the rig file differs from the log's: %s", self.file, difference)

    def close(self) -> None:
        """Tell what could not be answered, once."""
        for name, replay in self.replays.items():
            _log.info("%s: %d requests of the log skipped, %d repeated", name, replay.skipped, replay.repeated)
            for complaint in replay.complaints():
                _log.warning(
                    "%s: %s: %s: the driver now asks something else than when the log was taken",
                    self.file, name, complaint,
                )  # fmt: skip
        self.replays = {}


def _by_device(records: Iterable[LoggedSample]) -> dict[str, list[WireTraffic]]:
    traffic: dict[str, list[WireTraffic]] = {}
    for sample in records:
        if isinstance(sample, WireTraffic):
            traffic.setdefault(sample.device, []).append(sample)
    return traffic


def _is_on_can(section: Mapping[str, Any]) -> bool:
    """Whether a device's section of the rig file names a CAN bus; a serial line has a port."""
    connection = section.get("connection")
    return isinstance(connection, Mapping) and "channel" in connection and "interface" in connection


def _attach(replay: ReplayEmulator, request: EmulationRequest) -> Emulation:
    # The times of the log hold those of the line: here bytes take none, and pieces stay as they came.
    wire = Wire(replay, clock=request.clock, seed=request.seed, baudrate=1, bits_per_byte=0, temper=Temper(1, 0.0))
    url = register_wire(request.name, wire)
    return Emulation(
        overrides={"connection": {"port": url}}, close=partial(forget_wire, request.name, wire), wire_log=wire.log
    )


def _differences(then: Any, now: Mapping[str, Any], where: str = "") -> Iterator[str]:
    """Settings that differ; the port does not matter, nor does what one of the two does not have."""
    for key, value in now.items():
        if key == "port" or not isinstance(then, Mapping) or key not in then:
            continue
        if isinstance(value, Mapping):
            yield from _differences(then[key], value, f"{where}{key}.")
        elif then[key] != value:
            yield f"{where}{key} is {value!r}, it was {then[key]!r}"


WORLD = WorldType(settings=ReplaySettings, build=ReplayWorld)
