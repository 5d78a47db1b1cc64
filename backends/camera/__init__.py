"""Cameras fed by a frame source."""

from __future__ import annotations

from typing import TYPE_CHECKING

from microdrivers.backends.camera.settings import CameraDeviceSettings
from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock
from microdrivers.devices.camera import Camera, FrameSource
from microdrivers.devices.drivers import Driver
from microdrivers.devices.frame_sources import register_frame_source

if TYPE_CHECKING:
    from microdrivers.backends.camera.source_camera import SourceCamera

__all__ = ["DRIVER", "CameraDeviceSettings"]


def _create(name: str, settings: CameraDeviceSettings, clock: Clock, bus: Bus) -> SourceCamera:
    from microdrivers.backends.camera.source_camera import SourceCamera

    return SourceCamera(name, settings, clock=clock, bus=bus)


# OpenCV is slow to import: each source is imported when a camera with it is opened.


def _open_v4l2(rest: str, clock: Clock) -> FrameSource:
    from microdrivers.backends.camera.opencv_source import V4l2Source

    return V4l2Source(rest, clock=clock)


def _open_images(rest: str, clock: Clock) -> FrameSource:
    from microdrivers.backends.camera.file_source import FileSource, ImageFiles

    return FileSource(ImageFiles(rest), clock=clock)


def _open_video(rest: str, clock: Clock) -> FrameSource:
    from microdrivers.backends.camera.file_source import FileSource, VideoFile

    return FileSource(VideoFile(rest), clock=clock)


def _open_mjpeg(rest: str, clock: Clock) -> FrameSource:
    from microdrivers.backends.camera.mjpeg_source import MjpegSource

    return MjpegSource(rest, clock=clock)


register_frame_source("v4l2", _open_v4l2)
register_frame_source("images", _open_images)
register_frame_source("video", _open_video)
register_frame_source("mjpeg+http", _open_mjpeg)

DRIVER = Driver(kind=Camera, settings=CameraDeviceSettings, create=_create)
