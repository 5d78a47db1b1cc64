"""Without valid, fresh force data a guarded stage neither moves on nor starts."""

import logging

import pytest

from microdrivers.core.clock import SystemClock
from microdrivers.core.errors import MoveCancelled, UnsafeError
from microdrivers.core.units import NS_PER_MS
from microdrivers.devices.force_sensor import DISCONNECTED
from microdrivers.rig import build_rig
from tests.rig.guarded_rig import LIMIT_UN, STAGE, STALE_NS, GuardedRig, build_guarded, guarded_rig


@pytest.fixture
def guarded(tmp_path):
    with guarded_rig(tmp_path) as rig:
        rig.press(0.0)
        rig.stage.move_to(x_um=100.0)
        yield rig


def test_silence_stops_a_moving_stage_when_the_data_are_stale(guarded, caplog):
    move = guarded.stage.start_move_to(x_um=-300.0, speed_um_s=50.0)
    guarded.clock.sleep(0.3)
    last_ns = guarded.forces[-1].t_ns
    guarded.silence()
    with pytest.raises(
        MoveCancelled, match=r"force guard: no reading has come from probe_force for [56]\d ms"
    ) as caught:
        move.wait()
    assert "stop() and retract() work all the same" in caught.value.remedy
    (stop,) = guarded.stops()
    assert STALE_NS <= stop.t_ns - last_ns <= 1.25 * STALE_NS + 2 * NS_PER_MS
    assert guarded.rules() == ["force data"]
    assert "force data: no reading" in caplog.text
    place_um = guarded.true_x_um()
    guarded.clock.sleep(1.0)
    assert guarded.true_x_um() == pytest.approx(place_um, abs=0.1)


def test_a_sensor_that_falls_off_stops_a_moving_stage_and_nothing_is_retracted(guarded):
    move = guarded.stage.start_move_to(x_um=-300.0, speed_um_s=50.0)
    guarded.clock.sleep(0.3)
    guarded.amplifier.disconnect_sensor(guarded.clock.now_ns())
    with pytest.raises(MoveCancelled, match="probe_force reports DISCONNECTED"):
        move.wait()
    first = next(sample for sample in guarded.forces if DISCONNECTED in sample.flags)
    assert guarded.stops()[0].t_ns - first.t_ns < 5 * NS_PER_MS
    guarded.clock.sleep(1.0)
    assert guarded.rules() == ["force data"]
    assert guarded.true_x_um() > 60.0


def test_a_stage_at_rest_is_left_alone_and_does_not_start_until_forces_come_again(guarded):
    guarded.amplifier.disconnect_sensor(guarded.clock.now_ns())
    guarded.clock.sleep(0.5)
    assert guarded.stops() == []
    before = guarded.true_x_um()
    for start in (
        lambda: guarded.stage.start_move_to(x_um=0.0),
        lambda: guarded.stage.reference(["x"]),
        lambda: guarded.rig.safety.begin(STAGE),
    ):
        with pytest.raises(UnsafeError, match="valid forces come: probe_force reports DISCONNECTED") as caught:
            start()
        assert caught.value.moved == "no"
        assert "retract()" in caught.value.remedy
    assert guarded.true_x_um() == before
    guarded.stage.retract().wait()
    assert guarded.true_x_um() == pytest.approx(before + 400.0, abs=1.0)
    guarded.amplifier.connect_sensor(guarded.clock.now_ns())
    guarded.clock.sleep(0.1)
    guarded.stage.move_to(x_um=0.0)


def test_a_retraction_by_the_user_goes_on_without_data(guarded):
    move = guarded.stage.retract()
    guarded.silence()
    assert move.wait().x_um == pytest.approx(500.0, abs=0.2)
    assert guarded.rules() == []


def test_the_first_move_opens_the_sensor_and_has_it_stream(tmp_path):
    """As in `microdrivers move`, which opens the stage alone."""
    rig = build_guarded(tmp_path)
    try:
        guarded = GuardedRig(rig)
        guarded.stage.open()
        assert guarded.sensor.link == "closed"
        guarded.stage.reference(guarded.stage.reference_order)
        assert (guarded.sensor.link, guarded.sensor.streaming) == ("open", True)
        guarded.clock.sleep(0.1)
        seen = len(guarded.forces)
        with guarded.sensor.stream(20.0):
            guarded.clock.sleep(0.5)
        guarded.clock.sleep(0.5)
        assert len(guarded.forces) - seen == pytest.approx(200, abs=4)
    finally:
        rig.close()
    assert (guarded.sensor.link, guarded.sensor.streaming) == ("closed", False)
    assert not rig.clock._queue


def test_a_sensor_that_cannot_be_opened_keeps_the_stage_where_it_is(tmp_path):
    rig = build_guarded(tmp_path)
    try:
        guarded = GuardedRig(rig)
        guarded.silence()
        guarded.stage.open()
        with pytest.raises(UnsafeError, match="which does not work: node 21") as caught:
            guarded.stage.reference(["z"])
        assert "check power" in caught.value.remedy
    finally:
        guarded.wake()
        rig.close()


def test_a_rig_without_its_sensor_does_not_move_the_stage(tmp_path):
    whole = build_guarded(tmp_path)
    whole.close()
    with build_rig(whole.description.file, fake=True, clock=whole.clock, devices=[STAGE]) as rig:
        with pytest.raises(UnsafeError, match="not among the devices that this rig was built with") as caught:
            rig.devices[STAGE].reference(["z"])
        assert "open the rig with probe_force as well" in caught.value.remedy


def test_refusals_are_on_the_bus_and_in_the_log(guarded, caplog):
    caplog.set_level(logging.INFO)
    guarded.silence()
    guarded.clock.sleep(0.2)
    with pytest.raises(UnsafeError):
        guarded.stage.start_move_to(x_um=0.0)
    (refusal,) = guarded.interventions
    assert (refusal.rule, refusal.stage) == ("refusal", STAGE)
    assert refusal.reason in caplog.text


def test_it_moves_again_after_the_sensor_was_closed_by_somebody(guarded):
    guarded.sensor.close()
    guarded.clock.sleep(0.2)
    guarded.stage.move_to(x_um=0.0)
    assert guarded.sensor.streaming


@pytest.mark.xdist_group("real_time")
def test_in_real_time_the_guard_stops_in_the_receiving_thread_and_retracts_in_another(tmp_path):
    guard = {"sensor": "probe_force", "stage": "probe_stage", "max_force_uN": LIMIT_UN, "stale_after_ms": 1000}
    safety = {"force_guards": [guard], "keep_out": "none"}
    with guarded_rig(tmp_path, clock=SystemClock(), stage={"heartbeat_ms": 2000}, safety=safety) as guarded:
        guarded.press(0.0)
        guarded.stage.move_to(x_um=-10.0)
        move = guarded.stage.start_move_to(x_um=-200.0, speed_um_s=100.0)
        guarded.clock.sleep(0.2)
        guarded.press(1.5 * LIMIT_UN)
        with pytest.raises(MoveCancelled, match="force guard: probe_force feels"):
            move.wait()
        guarded.press(0.0)
        guarded.rig.safety.finish()
        assert guarded.rules() == ["force limit", "retraction"]
        assert guarded.stage.read().x_um > 300.0


def test_a_computer_that_looks_too_late_says_that_it_is_too_busy(guarded):
    flow = guarded.rig.safety.guards["probe_force"]._flow
    guarded.stage.start_move_to(x_um=-300.0, speed_um_s=50.0)
    guarded.clock.sleep(0.3)
    guarded.silence()
    assert "busy" not in flow.complaint
    flow._looked_ns -= 200 * NS_PER_MS  # as if the computer had done something else since
    guarded.clock.sleep(0.1)
    assert "this computer is too busy: it looked 2" in flow.complaint
    assert "this computer is too busy" in guarded.stops()[0].reason
