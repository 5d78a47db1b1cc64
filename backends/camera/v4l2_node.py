"""What a Video4Linux device says of itself (linux/videodev2.h), asked before OpenCV, which only tells yes or no."""

from __future__ import annotations

import errno
import fcntl
import os
import struct
from typing import NamedTuple

from microdrivers.core.errors import BusyError, LinkLost, UnsupportedError

_VIDIOC_QUERYCAP = 0x80685600
_CAPABILITY = struct.Struct("=16s32s32sIII12x")
_CAN_CAPTURE = 0x1
_HAS_DEVICE_CAPS = 0x80000000

_REMEDIES = {
    errno.ENOENT: "check the cable and the device's name (ls /dev/v4l/by-id); without hardware use --fake",
    errno.EACCES: "you may not open it: add yourself to the group that owns it (often video) and log in again",
    errno.ENODEV: "its driver is loaded but the camera is gone: check its cable and power",
    errno.ENXIO: "its driver is loaded but the camera is gone: check its cable and power",
}
_NOT_A_CAMERA = "name the camera's own device: ls /dev/v4l/by-id, or v4l2-ctl --list-devices"


class NodeInfo(NamedTuple):
    """Identity of a capture device; `bus_info` names the port that it is plugged into."""

    driver: str
    card: str
    bus_info: str


def query_node(path: str) -> NodeInfo:
    """Ask a device node who it is.

    Raises:
        LinkLost: it is missing or may not be opened. BusyError: another program has it for itself.
        UnsupportedError: it is no video device, or one that does not capture.
    """
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        if error.errno == errno.EBUSY:
            raise busy(path) from error
        remedy = _REMEDIES.get(error.errno or 0, "check the camera's source in the rig file")
        raise LinkLost(f"cannot open {path}: {error.strerror}", remedy=remedy, moved="no") from error
    answer = bytearray(_CAPABILITY.size)
    try:
        fcntl.ioctl(descriptor, _VIDIOC_QUERYCAP, answer)
    except OSError as error:
        raise UnsupportedError(f"{path} is not a video device: {error.strerror}", remedy=_NOT_A_CAMERA) from error
    finally:
        os.close(descriptor)
    driver, card, bus_info, _, capabilities, device_caps = _CAPABILITY.unpack(answer)
    if not (device_caps if capabilities & _HAS_DEVICE_CAPS else capabilities) & _CAN_CAPTURE:
        raise UnsupportedError(f"{path} ({_text(card)}) does not capture images", remedy=_NOT_A_CAMERA)
    return NodeInfo(_text(driver), _text(card), _text(bus_info))


def busy(path: str) -> BusyError:
    """The error for a device that another program uses."""
    return BusyError(f"another program uses {path}", remedy=f"close it first (fuser -v {path} tells which)")


def _text(raw: bytes) -> str:
    return raw.partition(b"\0")[0].decode("utf-8", "replace")
