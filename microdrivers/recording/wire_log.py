"""Writes what passes on the wires of a rig to a file, as it passes."""

from __future__ import annotations

import logging
import shlex
import sys
import threading
from collections.abc import Iterable, Mapping
from importlib.metadata import version
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Literal, TextIO

from microdrivers.core.bus import Bus, Subscription
from microdrivers.core.clock import utc_now
from microdrivers.core.errors import ConfigError
from microdrivers.core.samples import DeviceEvent, WireTraffic
from microdrivers.devices.wire_log_format import LoggedSample, WireLogHeader, header_line, record_line
from microdrivers.devices.wire_tap import WIRE_SUFFIX

_log = logging.getLogger(__name__)


def describe_source(
    rig: Mapping[str, Any], *, source: Literal["live", "fake", "served"], seed: int | None
) -> WireLogHeader:
    """The header of a log that begins now; `rig` is the rig file as plain data."""
    return WireLogHeader(
        microdrivers=version("microdrivers"),
        created_utc=utc_now().isoformat(timespec="seconds"),
        command=shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        source=source,
        seed=seed,
        rig=dict(rig),
    )


class WireLogWriter:
    """Listens to a rig's wires and the events of its devices and writes each record as it comes, until it is closed.

    Buses that devices share are listened to if they are known by then; see `listen_to_buses`.

    Publishers only put their samples in a queue: a slow disk delays no exchange and no stop. A log that cannot be
    written any further says so once and lets the rig go on. A log without a record is removed again.

    Raises:
        ConfigError: the file exists, or cannot be made.
    """

    def __init__(self, file: Path, header: WireLogHeader, *, bus: Bus, devices: Iterable[str], start_ns: int) -> None:
        self.file = file
        self.records = 0
        self._start_ns = start_ns
        self._stream = _create(file, header)
        self._queue: SimpleQueue[LoggedSample | None] = SimpleQueue()
        self._bus = bus
        self._subscriptions: dict[str, Subscription] = {}
        for name in devices:
            self._listen(f"{name}{WIRE_SUFFIX}", WireTraffic)
            self._listen(f"{name}/event", DeviceEvent)
        self.listen_to_buses()
        self._thread = threading.Thread(target=self._write_all, name="wire log", daemon=True)
        self._thread.start()

    def listen_to_buses(self) -> None:
        """Listen also to the buses that have become known since."""
        for topic in self._bus.topics:
            if topic.endswith(WIRE_SUFFIX):
                self._listen(topic, WireTraffic)

    def _listen(self, topic: str, kind: type[WireTraffic] | type[DeviceEvent]) -> None:
        if topic not in self._subscriptions:
            self._subscriptions[topic] = self._bus.topic(topic, kind).subscribe(self._queue.put)

    def close(self) -> None:
        """Write what is left and close the file; idempotent."""
        if not self._thread.is_alive():
            return
        self._listen_no_more()
        self._queue.put(None)
        self._thread.join()
        if not self.records:
            self.file.unlink(missing_ok=True)
            _log.warning("nothing passed on any wire: there is no %s", self.file)

    def _write_all(self) -> None:
        try:
            with self._stream as stream:
                while (sample := self._queue.get()) is not None:
                    self.records += 1
                    stream.write(record_line(sample, start_ns=self._start_ns))
        except OSError as error:
            self._listen_no_more()
            _log.error("%s ends after %d records: %s", self.file, self.records, error.strerror)

    def _listen_no_more(self) -> None:
        for subscription in self._subscriptions.values():
            subscription.cancel()


def _create(file: Path, header: WireLogHeader) -> TextIO:
    """A new file with a header; every line is handed to the operating system at once."""
    try:
        stream = file.open("x", encoding="utf-8", buffering=1)
        stream.write(header_line(header))
        return stream
    except FileExistsError as error:
        raise ConfigError(
            "the file exists", file=str(file), remedy="choose another name for the wire log, or remove the file"
        ) from error
    except OSError as error:
        raise ConfigError(
            f"the wire log cannot be written there: {error.strerror}", file=str(file),
            remedy="choose another file, in a folder that exists and may be written",
        ) from error  # fmt: skip
