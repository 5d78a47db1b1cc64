from __future__ import annotations

import itertools
import math
import subprocess
import sys
from typing import Any

import pydantic
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.core.errors import (
    DeviceFault,
    LinkLost,
    LinkTimeout,
    OutOfRange,
)
from microdrivers.core.units import NS_PER_S, Range
from microdrivers.devices.zoom_motor import ZoomCurve
from tests.backends.oriental_az_bench import INPUTS_OFF, Bench, at_steps, sheet
from tests.backends.oriental_az_peer import SheetDrive

# ---------------------------------------------------------------------- settings and curve


def test_importing_the_driver_does_not_import_pymodbus() -> None:
    code = "import sys, microdrivers.backends.oriental_az; sys.exit('pymodbus' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"curve": ((0, 1.0), (0, 2.0))}, "rising steps"),
        ({"curve": ((0, 2.0), (10, 1.0))}, "rising steps"),
        ({"curve": ((0, 1.0), (1 << 31, 2.0))}, "32 bits"),
        ({"zoom_range": Range(12.0, 13.0)}, "nothing in common"),
        ({"zoom_range": Range(3.0, 1.0)}, "backwards"),
        ({"connection": {"baudrate": 921600}}, "baudrate"),
        ({"speed_hz": 3}, "speed_hz"),
    ],
)
def test_wrong_settings_are_refused(changes: dict[str, Any], complaint: str) -> None:
    with pytest.raises(pydantic.ValidationError, match=complaint):
        Bench(**changes)


def test_the_zoom_range_is_what_rig_and_curve_share() -> None:
    motor = Bench(zoom_range=Range(0.5, 3.0)).motor
    assert motor.zoom_range == Range(0.75, 3.0)
    assert (motor.axis.min_position, motor.axis.max_position, motor.axis.unit) == (-500, 4000, "steps")


curves = st.lists(
    st.tuples(st.integers(1, 5000), st.floats(1.001, 3.0)), min_size=1, max_size=6
).map(lambda rises: ZoomCurve.from_points(
    list(zip(
        itertools.accumulate((step for step, _ in rises), initial=-700),
        itertools.accumulate((ratio for _, ratio in rises), lambda zoom, ratio: zoom * ratio, initial=0.75),
        strict=True,
    ))
))  # fmt: skip


@settings(deadline=None, max_examples=60)
@given(curve=curves, share=st.floats(0.0, 1.0))
def test_the_curve_is_monotone_and_goes_there_and_back(curve: ZoomCurve, share: float) -> None:
    low, high = curve.steps[0], curve.steps[-1]
    steps = low + share * (high - low)
    zoom = min(max(curve.zoom_at(steps), curve.zoom[0]), curve.zoom[-1])
    assert abs(curve.steps_at(zoom) - steps) <= 0.5 + 1e-6
    positions = range(low, high + 1, max(1, (high - low) // 50))
    zooms = [curve.zoom_at(position) for position in positions]
    assert all(a < b for a, b in itertools.pairwise(zooms))


# ---------------------------------------------------------------------- opening


def test_opening_only_reads() -> None:
    bench = Bench().opened()
    assert {data[1] for data in sheet(bench).requests} == {0x03}
    assert bench.motor.referenced
    assert bench.motor.fault is None
    assert (bench.motor.info.vendor, bench.kinds) == ("Oriental Motor", ["opened"])
    sample = bench.motor.read()
    assert (sample.position_steps, sample.moving, sample.on_target, sample.seq) == (1000, False, True, 0)
    assert sample.zoom == pytest.approx(at_steps(1000))
    assert math.isnan(sample.target_zoom)


@pytest.mark.parametrize(("steps", "zoom"), [((1 << 31) - 1, math.inf), (-(1 << 31), 0.0)])
def test_a_position_far_outside_the_curve_can_be_read(steps: int, zoom: float) -> None:
    sample = Bench(SheetDrive(position=steps)).opened().motor.read()
    assert (sample.position_steps, sample.zoom) == (steps, zoom)


def test_opening_a_silent_drive_releases_the_port() -> None:
    bench = Bench()
    sheet(bench).deaf = True
    with pytest.raises(LinkTimeout, match="zoom: unit 1 on"):
        bench.motor.open()
    assert (bench.motor.link, bench.wire.in_use) == ("closed", False)
    sheet(bench).deaf = False
    bench.motor.open()
    assert bench.motor.link == "open"


def test_with_an_alarm_the_device_opens_and_refuses_to_move() -> None:
    drive = SheetDrive(position=1000)
    drive.alarm = 0x30
    bench = Bench(drive).opened()
    assert (bench.motor.link, bench.kinds) == ("open", ["fault", "opened"])
    assert bench.motor.fault is not None
    assert bench.motor.read().flags == {"ALARM"}
    for move in (lambda: bench.motor.move_to(zoom=2.0), lambda: bench.motor.reference()):
        with pytest.raises(DeviceFault, match="alarm 30h is on: overload") as caught:
            move()
        assert (caught.value.code, caught.value.moved, caught.value.device) == (0x30, "no", "zoom")
        assert "reduce the load" in caught.value.remedy
    assert {data[1] for data in drive.requests} == {0x03}


# ---------------------------------------------------------------------- alarms and the link


def test_an_alarm_ends_a_move_at_once() -> None:
    drive = SheetDrive(position=1000)
    bench = Bench(drive).opened()

    def trip() -> None:
        drive.alarm = 0x10
        drive.halt(bench.clock.now_ns())

    bench.clock.call_at(bench.clock.now_ns() + NS_PER_S // 5, trip)
    began_ns = bench.clock.now_ns()
    with pytest.raises(DeviceFault, match="alarm 10h is on: position deviation"):
        bench.motor.move_to(zoom=9.0)
    assert bench.clock.now_ns() - began_ns < 0.4 * NS_PER_S
    assert bench.kinds == ["opened", "fault"]
    assert "ALARM" in bench.motor.read().flags  # raised once; reading goes on


def test_an_alarm_at_rest_is_noticed_within_half_a_second() -> None:
    bench = Bench().opened()
    with bench.motor.stream(50.0):
        bench.clock.run_for(0.7)
        sheet(bench).alarm = 0x26
        began_ns = bench.clock.now_ns()
        bench.clock.run_for(1.0)
    noticed = next(event for event in bench.events if event.kind == "fault")
    assert "the motor is too hot" in noticed.reason
    assert noticed.t_ns - began_ns <= 0.55 * NS_PER_S
    assert [kind for kind in bench.kinds if kind == "fault"] == ["fault"]


def test_clearing_a_fault() -> None:
    drive = SheetDrive(position=1000)
    drive.alarm = 0x30
    bench = Bench(drive).opened()
    bench.motor.clear_fault()
    resets = [data for data in drive.requests if data[1] == 0x06]
    assert resets == [bytes.fromhex("0106007D00801872"), INPUTS_OFF]
    assert bench.motor.fault is None
    bench.motor.move_to(zoom=2.0)
    bench.motor.clear_fault()  # nothing to clear: nothing is written
    assert [data for data in drive.requests if data[3:6] == b"\x7d\x00\x80"] == resets[:1]


def test_an_alarm_that_only_a_power_cycle_clears() -> None:
    drive = SheetDrive(position=1000)
    drive.alarm, drive.resettable = 0x28, False
    bench = Bench(drive).opened()
    with pytest.raises(DeviceFault, match="could not be reset: alarm 28h") as caught:
        bench.motor.clear_fault()
    assert "switch the drive off and on" in caught.value.remedy
    assert bench.motor.fault is not None


def test_an_unknown_alarm_is_named_by_its_number() -> None:
    drive = SheetDrive(position=1000)
    drive.alarm = 0x9C
    bench = Bench(drive).opened()
    assert bench.motor.fault is not None
    assert "9Ch" in bench.motor.fault.what


def test_a_pulled_cable() -> None:
    bench = Bench().opened()
    bench.wire.unplug()
    with pytest.raises(LinkLost, match="zoom: port"):
        bench.motor.read()
    with pytest.raises(LinkLost):
        bench.motor.stop()
    bench.motor.close()


def test_a_target_outside_the_range_is_refused_before_any_exchange() -> None:
    bench = Bench().opened()
    seen = len(sheet(bench).requests)
    with pytest.raises(OutOfRange, match=r"0\.8 to 10"):
        bench.motor.move_to(zoom=11.0)
    assert len(sheet(bench).requests) == seen
