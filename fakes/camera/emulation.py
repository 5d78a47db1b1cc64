"""Puts simulated sensors behind cameras' drivers, under the addresses `fake://NAME`."""

from __future__ import annotations

from functools import partial

from microdrivers.core.clock import Clock
from microdrivers.core.errors import LinkLost
from microdrivers.devices.camera import CameraSettings
from microdrivers.devices.drivers import Emulation, EmulationRequest, Endpoint, ServeRequest
from microdrivers.devices.frame_sources import register_frame_source
from microdrivers.fakes.camera.source import FakeFrameSource
from microdrivers.fakes.world.microscope_world import check_world

_sources: dict[str, FakeFrameSource] = {}


def attach(request: EmulationRequest) -> Emulation:
    """Put a simulated sensor behind the camera's driver."""
    width, height = request.settings["sensor_size_px"]
    principal = request.settings.get("principal_point_px") or ((width - 1) / 2, (height - 1) / 2)
    source = FakeFrameSource(
        request.name, check_world(request.world), clock=request.clock, sensor_size_px=(width, height),
        principal_point_px=tuple(principal), seed=request.seed,
    )  # fmt: skip
    _sources[request.name] = source
    register_frame_source("fake", _open)
    settings = CameraSettings(
        exposure_ms=request.settings["exposure_ms"], gain=1.0, rate_hz=request.settings["rate_hz"],
        roi=(0, 0, width, height), binning=1, pixel_format="mono8",
    )  # fmt: skip
    return Emulation(
        overrides={"source": f"fake://{request.name}"},
        close=lambda: _forget(request.name),
        serve=partial(_serve, request.name, source, settings),
    )


def _serve(name: str, source: FakeFrameSource, settings: CameraSettings, request: ServeRequest) -> Endpoint:
    from microdrivers.fakes.camera.mjpeg_server import MjpegServer

    server = MjpegServer(name, source, settings, clock=source.clock, bind=request.bind, host=request.host)
    return Endpoint(overrides={"source": server.url}, where=server.url, close=server.close, control=server)


def _open(name: str, clock: Clock) -> FakeFrameSource:
    source = _sources.get(name)
    if source is None or source.clock is not clock:
        raise LinkLost(f"no emulated camera {name!r} runs", remedy="open the rig with --fake", moved="no")
    return source


def _forget(name: str) -> None:
    _sources.pop(name, None)
