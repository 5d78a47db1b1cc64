"""Serves an emulated camera as a stream of images over HTTP, for other programs and other processes.

One sensor, any number of viewers. `GET /NAME` answers with multipart/x-mixed-replace and does not end.

| query | meaning | default |
|---|---|---|
| `rate_hz`, `exposure_ms`, `roi=left,top,width,height` | settings of the sensor | those of the rig file, whole sensor |
| `format` = `png`, `pgm` or `jpeg` | coding of the images | the first that the header Accept names, else `png` |

Settings are those of the first viewer for as long as anybody watches; the response's headers Rate-Hz, Exposure-Ms and
Roi say what is really used, and Model, Serial-Number and Sensor-Size (`640x480`) whose images these are. Each part has
Content-Type, Content-Length, Frame-Id, Timestamp (mid-exposure, ns on this computer's monotonic clock, with the error
of the camera's own stamp) and Timestamp-Uncertainty (ns, half-width of the 95 % interval). PNG and PGM are lossless. A
viewer that is too slow gets the newest frame; Frame-Id tells what it missed.
"""

from __future__ import annotations

import logging
import socket
import threading
import urllib.parse
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from microdrivers.core.clock import Clock, Timer
from microdrivers.core.errors import LinkLost, MicrodriversError, UnsupportedError
from microdrivers.devices.camera import CameraSettings, RawFrame
from microdrivers.fakes.camera.source import FakeFrameSource
from microdrivers.fakes.camera.stream_format import BOUNDARY, CODINGS, Coding, parse_query, write_part

_log = logging.getLogger(__name__)

_IDLE_S = 0.2
_END_S = 1.0
_SEND_BUFFER_BYTES = 128 * 1024


class MjpegServer:
    """A web server around one emulated camera; started when made, ended by `close`.

    Raises:
        UnsupportedError: the clock is simulated. LinkLost: the address cannot be used.
    """

    def __init__(
        self,
        name: str,
        source: FakeFrameSource,
        settings: CameraSettings,
        *,
        clock: Clock,
        bind: str = "127.0.0.1",
        port: int = 0,
        host: str | None = None,
    ) -> None:
        if clock.simulated:
            raise UnsupportedError("a stream for other programs needs real time", remedy="serve on the system clock")
        self._name = name
        self._clock = clock
        self._bind = bind
        self._host = bind if host is None else host
        self._port = port
        self._http: ThreadingHTTPServer | None = None
        self._thread: Timer | None = None
        self._sensor = _Sensor(source, settings, clock)
        self.plug_in()

    @property
    def url(self) -> str:
        """Where a camera's driver finds the stream."""
        host = f"[{self._host}]" if ":" in self._host else self._host
        return f"mjpeg+http://{host}:{self._port}/{self._name}"

    def plug_in(self) -> None:
        """Listen, on the same port as before."""
        if self._http is not None:
            return
        family = socket.AF_INET6 if ":" in self._bind else socket.AF_INET
        listener = type("_Listener", (_Http,), {"address_family": family})
        try:
            self._http = listener((self._bind, self._port), partial(_Handler, self._sensor, f"/{self._name}"))
        except OSError as error:
            raise LinkLost(
                f"cannot listen on {self._bind}:{self._port}: {error}", remedy="choose another address", moved="no"
            ) from error
        self._port = self._http.server_address[1]
        self._sensor.plugged = True
        self._thread = self._clock.call_at(
            self._clock.now_ns(), partial(self._http.serve_forever, poll_interval=0.02), name=f"{self._name} server"
        )

    def unplug(self) -> None:
        """Cut all connections and stop to listen."""
        http, self._http = self._http, None
        if http is None or self._thread is None:
            return
        self._sensor.plugged = False
        self._sensor.cut()
        http.shutdown()
        self._thread.cancel()
        http.server_close()

    def close(self) -> None:
        """End the server, its connections and the sensor; idempotent."""
        self.unplug()


class _Http(ThreadingHTTPServer):
    daemon_threads = True
    allow_reuse_address = True

    def handle_error(self, request: Any, client_address: Any) -> None:  # noqa: ARG002 - socketserver's signature
        _log.exception("a viewer at %s was dropped", client_address)


class _Viewer:
    """One connection, and the newest frame that it has not sent yet."""

    def __init__(self, connection: socket.socket, coding: Coding, clock: Clock) -> None:
        self.connection = connection
        self.coding = coding
        self.news = clock.event()
        self.part: bytes | None = None
        self.frame_id = -1
        self.cut = False
        self.ended = clock.event()

    @property
    def gone(self) -> bool:
        """Whether the other side has closed; viewers send nothing after their request."""
        try:
            return not self.connection.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT)
        except BlockingIOError:
            return False
        except OSError:
            return True


class _Sensor:
    """Runs the camera while anybody watches, and hands its frames to all viewers."""

    def __init__(self, source: FakeFrameSource, settings: CameraSettings, clock: Clock) -> None:
        self.source = source
        self.defaults = settings
        self.clock = clock
        self.plugged = True
        self._viewers: list[_Viewer] = []
        self._lock = threading.Lock()
        self._run = 0
        self._used = settings

    def join(self, viewer: _Viewer, wanted: CameraSettings) -> CameraSettings:
        """Add a viewer; the settings that it will see.

        Raises:
            MicrodriversError: the sensor refuses the settings, or is disconnected.
        """
        with self._lock:
            if not self.plugged:
                raise LinkLost("the camera is being unplugged", moved="no")
            self._viewers = [other for other in self._viewers if not other.gone]
            if not self._viewers:
                self.source.stop()
                self.source.open()
                self._used = self.source.configure(wanted)
                self._run += 1
                self.source.start(partial(self._show, self._run), self._lost)
            self._viewers.append(viewer)
            return self._used

    def leave(self, viewer: _Viewer) -> None:
        """Remove a viewer; the last one switches the sensor off."""
        with self._lock:
            if viewer in self._viewers:
                self._viewers.remove(viewer)
                if not self._viewers:
                    self.source.stop()

    def cut(self) -> None:
        """Drop all viewers, and wait until they have ended."""
        with self._lock:
            viewers = tuple(self._viewers)
        for viewer in viewers:
            viewer.cut = True
            viewer.news.set()
            try:
                viewer.connection.shutdown(socket.SHUT_RDWR)
            except OSError:  # it had left already
                _log.debug("a viewer had left before it was cut")
        for viewer in viewers:
            viewer.ended.wait(_END_S)

    def _show(self, run: int, raw: RawFrame) -> None:
        with self._lock:
            codings = {viewer.coding for viewer in self._viewers}
        parts = {coding: write_part(raw, coding) for coding in codings}
        with self._lock:
            for viewer in self._viewers:
                # A late frame may have earlier settings, or come after its successor.
                if run == self._run and viewer.coding in parts and raw.frame_id > viewer.frame_id:
                    viewer.part, viewer.frame_id = parts[viewer.coding], raw.frame_id
                    viewer.news.set()

    def _lost(self, error: LinkLost) -> None:
        _log.warning("the emulated camera is disconnected: %s", error.what)
        # Not in this thread, which is the sensor's own: who stops the sensor waits for it.
        self.clock.call_at(self.clock.now_ns(), self.cut, name="cut")


class _Handler(BaseHTTPRequestHandler):
    """Answers one viewer."""

    timeout = 5.0
    """For the request to come, s."""

    def __init__(self, sensor: _Sensor, path: str, *arguments: Any) -> None:
        self._sensor = sensor
        self._stream_path = path
        super().__init__(*arguments)

    def do_GET(self) -> None:
        """Send frames until either side has enough."""
        target = urllib.parse.urlsplit(self.path)
        if target.path != self._stream_path:
            self._refuse(404, f"there is only {self._stream_path} here")
            return
        try:
            wanted, name = parse_query(target.query, self._sensor.defaults, self.headers.get("Accept", ""))
        except ValueError as error:
            self._refuse(400, str(error))
            return
        viewer = _Viewer(self.connection, CODINGS[name], self._sensor.clock)
        try:
            used = self._sensor.join(viewer, wanted)
        except UnsupportedError as error:
            self._refuse(400, error.what)
            return
        except MicrodriversError as error:
            self._refuse(503, error.what)
            return
        try:
            self.connection.settimeout(None)
            self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
            self.connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._greet(used)
            self._send_frames(viewer)
        except ConnectionError:
            _log.debug("a viewer has left")
        finally:
            self._sensor.leave(viewer)
            viewer.ended.set()

    def _greet(self, used: CameraSettings) -> None:
        source = self._sensor.source
        width, height = source.sensor_size_px
        self.send_response_only(200)
        for name, text in (
            ("Content-Type", f"multipart/x-mixed-replace; boundary={BOUNDARY}"),
            ("Cache-Control", "no-store"),
            ("Model", source.model),
            ("Serial-Number", source.serial_number),
            ("Sensor-Size", f"{width}x{height}"),
            ("Rate-Hz", repr(used.rate_hz)),
            ("Exposure-Ms", repr(used.exposure_ms)),
            ("Roi", ",".join(str(number) for number in used.roi)),
        ):
            self.send_header(name, text)
        self.end_headers()

    def _send_frames(self, viewer: _Viewer) -> None:
        while not viewer.cut and not viewer.gone:
            if viewer.news.wait(_IDLE_S):
                viewer.news.clear()
                part, viewer.part = viewer.part, None
                if part is not None:
                    self.connection.sendall(part)

    def _refuse(self, status: int, why: str) -> None:
        body = why.encode()
        self.send_response_only(status)
        self.send_header("Content-Type", "text/plain; charset=utf-8")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """Into the program's own log."""
        _log.debug(format, *args)
