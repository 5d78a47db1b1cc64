"""Closed, connected, open, lost: what a device may be asked in each state."""

import pytest

from microdrivers.core.bus import Bus
from microdrivers.core.clock import SimulatedClock
from microdrivers.core.errors import LinkLost, LinkTimeout, ProtocolError
from microdrivers.core.samples import ZoomSample
from microdrivers.devices.base import Device, DeviceInfo


class Recorder(Device[ZoomSample]):
    """A device that writes down what is done to it."""

    sample_type = ZoomSample

    def __init__(self, *, answers: bool = True) -> None:
        super().__init__("motor", clock=SimulatedClock(), bus=Bus())
        self.serial_number = ""
        self.answers = answers
        self.calls: list[str] = []

    def _connect(self) -> None:
        self.calls.append("connect")

    def _identify(self) -> DeviceInfo:
        self.calls.append("identify")
        if not self.answers:
            raise LinkTimeout("no answer", moved="no")
        return DeviceInfo(driver="recorder", serial_number=self.serial_number)

    def _close(self) -> None:
        self.calls.append("close")

    def _stop(self) -> None:
        self.calls.append("stop")

    def _read(self) -> ZoomSample:
        raise LinkTimeout("no answer")


def test_a_stop_can_be_sent_before_anybody_has_answered():
    device = Recorder(answers=False)
    device.connect()
    device.stop()
    with pytest.raises(LinkTimeout, match="motor"):
        device.open()
    assert device.calls == ["connect", "stop", "identify", "close"]
    assert device.link == "closed"


def test_a_connected_device_is_not_yet_open():
    device = Recorder()
    device.connect()
    device.connect()
    assert device.link == "connected"
    with pytest.raises(LinkLost, match="the device is connected"):
        device.read()
    device.open()
    assert device.link == "open"
    assert device.calls == ["connect", "identify"]


def test_what_could_not_be_identified_can_be_opened_again():
    device = Recorder(answers=False)
    with pytest.raises(LinkTimeout):
        device.open()
    device.answers = True
    device.open()
    assert device.calls == ["connect", "identify", "close", "connect", "identify"]


def test_a_lost_device_is_released_before_it_is_connected_again():
    device = Recorder()
    device.open()
    device.link = "lost"
    device.open()
    assert device.calls == ["connect", "identify", "close", "connect", "identify"]
    assert device.link == "open"


def test_nothing_is_sent_to_a_closed_device():
    device = Recorder()
    device.stop()
    device.close()
    assert device.calls == []


@pytest.mark.parametrize("other", ["2", ""])
def test_another_device_in_the_place_of_the_first_is_refused(other):
    device = Recorder()
    device.serial_number = "1"
    device.open()
    device.close()
    device.serial_number = other
    with pytest.raises(ProtocolError, match="answers in the place of 1") as caught:
        device.open()
    assert caught.value.moved == "no"
    assert device.link == "closed"
    device.serial_number = "1"
    device.open()
    assert device.link == "open"
