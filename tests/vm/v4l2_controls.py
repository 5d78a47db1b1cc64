"""Controls of a Video4Linux device, by name (linux/videodev2.h): what `v4l2-ctl` sets."""

import contextlib
import fcntl
import os
import struct

_QUERYCTRL, _QUERYMENU = 0xC0445624, 0xC02C5625
_G_CTRL, _S_CTRL = 0xC008561B, 0xC008561C
_NEXT_CTRL = 0x80000000
_DESCRIPTION = struct.Struct("=II32s4iI8x")  # v4l2_queryctrl
_MENU_ITEM = struct.Struct("=II32s4x")  # v4l2_querymenu
_VALUE = struct.Struct("=Ii")  # v4l2_control
_MENU = 3


class Controls:
    """What can be set on a device; a menu's value is the name of its item, a button's anything."""

    def __init__(self, path):
        self._path = path
        self._known = {}
        number = 0
        with self._device() as device, contextlib.suppress(OSError):  # EINVAL ends the list
            while True:
                answer = bytearray(_DESCRIPTION.pack(number | _NEXT_CTRL, 0, b"", 0, 0, 0, 0, 0))
                fcntl.ioctl(device, _QUERYCTRL, answer)
                number, kind, name, lowest, highest, *_ = _DESCRIPTION.unpack(answer)
                self._known[_text(name)] = (number, kind, range(lowest, highest + 1))

    def set(self, name, value):
        number, kind, values = self._known[name]
        with self._device() as device:
            if kind == _MENU:
                value = self._menu(device, number, values)[value]
            fcntl.ioctl(device, _S_CTRL, bytearray(_VALUE.pack(number, value)))

    def get(self, name):
        answer = bytearray(_VALUE.pack(self._known[name][0], 0))
        with self._device() as device:
            fcntl.ioctl(device, _G_CTRL, answer)
        return _VALUE.unpack(answer)[1]

    @contextlib.contextmanager
    def _device(self):
        device = os.open(self._path, os.O_RDWR)
        try:
            yield device
        finally:
            os.close(device)

    def _menu(self, device, number, values):
        items = {}
        for index in values:
            answer = bytearray(_MENU_ITEM.pack(number, index, b""))
            fcntl.ioctl(device, _QUERYMENU, answer)
            items[_text(_MENU_ITEM.unpack(answer)[2])] = index
        return items


def _text(raw):
    return raw.partition(b"\0")[0].decode()
