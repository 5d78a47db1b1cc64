"""The force guard: stops within a reading, takes the tool away, says why, and lets nothing defeat it."""

import logging

import pytest

from microdrivers.backends.cia402 import objects
from microdrivers.core.errors import ErrorTree, LinkLost, MicrodriversError, MoveCancelled, UnsafeError
from microdrivers.core.samples import ForceSample
from microdrivers.devices.force_sensor import SATURATED, UNTARED, Tare
from tests.rig.guarded_rig import (
    AT_LIMIT_UM,
    LIMIT_UN,
    OTHER,
    PERIOD_NS,
    RETRACT_UM,
    SENSOR,
    STAGE,
    STIFFNESS_UN_PER_UM,
    guarded_rig,
    press_too_hard,
)

QUICK_STOP = 2
TO_THE_SWITCH = 17


@pytest.fixture
def guarded(tmp_path):
    with guarded_rig(tmp_path) as rig:
        yield rig


def test_a_move_faster_than_the_guard_allows_is_refused_and_a_retraction_is_not(tmp_path):
    guard = {"sensor": SENSOR, "stage": STAGE, "max_force_uN": LIMIT_UN, "max_speed_um_s": 50.0}
    with guarded_rig(tmp_path, safety={"force_guards": [guard], "keep_out": "none"}) as guarded:
        guarded.stage.move_to(x_um=3.0, y_um=4.0, speed_um_s=50.0)
        for speed_um_s in (51.0, None):
            with pytest.raises(UnsafeError, match="faster than its max_speed_um_s, 50") as refused:
                guarded.stage.move_to(x_um=0.0, speed_um_s=speed_um_s)
            assert "at most 50 µm/s" in refused.value.remedy
        assert guarded.true_x_um() == pytest.approx(3.0, abs=0.1)
        guarded.stage.retract().wait()
        assert guarded.true_x_um() > 300.0


# ---------------------------------------------------------------------- too much force


def test_a_force_over_the_limit_stops_the_stage_before_anybody_sees_it(guarded):
    stops_when_seen = []
    guarded.sensor.topic.subscribe(
        lambda sample: stops_when_seen.append(len(guarded.stops())) if sample.raw_uN > LIMIT_UN else None
    )
    press_too_hard(guarded)
    assert stops_when_seen[0] == 1
    (stop,) = guarded.stops()
    over = next(sample for sample in guarded.forces if sample.raw_uN > LIMIT_UN)
    assert over.order < stop.order == guarded.interventions[0].order - 1
    assert 0 <= stop.t_ns - over.t_ns < PERIOD_NS
    overshoot_um = AT_LIMIT_UM - min(guarded.true_x_um(t_ns) for t_ns in range(over.t_ns, over.t_ns + 10**8, 10**6))
    assert overshoot_um < 50.0 * 2 * PERIOD_NS / 1e9


def test_the_waiting_move_ends_with_the_reason_and_what_to_do(guarded):
    error = press_too_hard(guarded)
    assert error.moved == "yes"
    assert error.device == STAGE
    assert "force guard: probe_force feels 100" in error.what
    assert "over the limit of 1000 µN" in error.what
    assert "look at what the tool touches" in error.remedy
    (stop,) = guarded.stops()
    assert (stop.by, "limit of 1000 µN" in stop.reason) == ("force guard", True)
    intervention = guarded.interventions[0]
    assert (intervention.rule, intervention.stage, intervention.sensor) == ("force limit", STAGE, SENSOR)
    assert intervention.value > intervention.limit == LIMIT_UN


def test_the_tool_is_taken_away_and_that_is_seen_to_its_end(guarded, caplog):
    press_too_hard(guarded)
    guarded.clock.sleep(1.0)
    assert guarded.rules() == ["force limit", "retraction"]
    assert guarded.true_x_um() == pytest.approx(AT_LIMIT_UM + RETRACT_UM, abs=2.0)
    assert f"x {guarded.stage.read().x_um:.2f} µm" in guarded.interventions[1].reason
    assert [record.levelno for record in caplog.records] == [logging.WARNING] * 2
    assert "over the limit of 1000 µN; stopped, and the tool is taken away" in caplog.text


def test_what_the_stop_itself_adds_does_not_keep_the_tool_from_being_taken_away(guarded):
    """From 1000 µm/s a stage needs some 15 µm to stop, which press harder by more than a fifth of the limit."""
    with pytest.raises(MoveCancelled):
        guarded.stage.move_to(x_um=AT_LIMIT_UM - 100.0, speed_um_s=1000.0)
    guarded.clock.sleep(1.0)
    first_uN = next(sample.raw_uN for sample in guarded.forces if sample.raw_uN > LIMIT_UN)
    assert max(sample.raw_uN for sample in guarded.forces) > first_uN + 0.2 * LIMIT_UN
    assert guarded.rules() == ["force limit", "retraction"]
    assert guarded.true_x_um() > AT_LIMIT_UM + RETRACT_UM - 40.0


def test_a_move_does_not_replace_a_retraction_though_the_force_is_gone(guarded):
    press_too_hard(guarded)
    guarded.clock.sleep(0.3)
    assert guarded.stage.retracting
    assert abs(guarded.forces[-1].raw_uN) < 0.5 * LIMIT_UN
    with pytest.raises(UnsafeError, match="refused by the force guard"):
        guarded.stage.start_move_to(x_um=0.0)
    guarded.clock.sleep(0.7)
    guarded.stage.move_to(x_um=0.0)


def test_only_retractions_pass_until_the_tool_is_away(tmp_path):
    with guarded_rig(tmp_path, with_other=True) as guarded:
        press_too_hard(guarded)
        assert SENSOR in guarded.rig.safety.tripped
        for move in (
            lambda: guarded.stage.start_move_to(x_um=0.0),
            lambda: guarded.stage.start_axis_to("z", 10.0, speed=10.0),
            lambda: guarded.stage.reference(["x"]),
            lambda: guarded.other.start_move_to(z_um=10.0),
        ):
            with pytest.raises(UnsafeError, match="refused by the force guard") as caught:
                move()
            assert caught.value.moved == "no"
        guarded.stage.retract().wait()
        guarded.clock.sleep(0.1)
        assert not guarded.rig.safety.tripped
        assert "somebody else's retract() has replaced it" in guarded.interventions[-1].reason
        guarded.stage.move_to(x_um=0.0)
        guarded.other.move_to(z_um=10.0)


def test_other_stages_that_move_are_stopped_too_and_those_at_rest_are_left_alone(tmp_path):
    with guarded_rig(tmp_path, with_other=True) as guarded:
        guarded.stage.move_to(x_um=10.0)
        for moving in (False, True):
            guarded.press(0.0)
            guarded.clock.sleep(0.6)
            move = guarded.other.start_move_to(z_um=200.0, speed_um_s=50.0) if moving else None
            guarded.clock.sleep(0.2)
            guarded.press(1200.0)
            guarded.clock.sleep(0.02)
            assert len(guarded.stops(OTHER)) == moving
            if move is not None:
                with pytest.raises(MoveCancelled, match="force guard: probe_force feels"):
                    move.wait()


def test_forces_of_either_sign_count_and_a_saturated_sensor_always_does(guarded):
    guarded.stage.move_to(x_um=10.0)
    for force_uN in (-1100.0, 2500.0, -2500.0):
        guarded.press(force_uN)
        guarded.clock.sleep(0.02)
        assert guarded.rig.safety.tripped
        assert (SATURATED in guarded.forces[-1].flags) == (abs(force_uN) > 2000)
        guarded.press(0.0)
        guarded.clock.sleep(1.0)
        assert not guarded.rig.safety.tripped
    assert guarded.rules() == ["force limit", "retraction"] * 3


def test_a_sensor_at_its_end_tells_no_force_and_trips_also_where_the_limit_is_its_end(tmp_path):
    safety = {"force_guards": [{"sensor": SENSOR, "stage": STAGE, "max_force_uN": 2000}], "keep_out": "none"}
    with guarded_rig(tmp_path, safety=safety) as guarded:
        guarded.stage.move_to(x_um=10.0)
        guarded.sensor._tare = Tare(t_ns=0, offset_uN=150.0, sigma_uN=0.1, n=10)
        for force_uN, trips in ((1990.0, False), (2020.0, True)):
            guarded.press(force_uN)
            guarded.clock.sleep(0.02)
            assert bool(guarded.rig.safety.tripped) == trips
        assert "saturated" in guarded.interventions[0].reason


def test_before_the_first_move_nothing_is_retracted(guarded_unmoved):
    """Somebody may have the tool in hand, and there was no move that could have pressed it on anything."""
    guarded = guarded_unmoved
    guarded.press(1500.0)
    with guarded.sensor.stream(100.0):
        guarded.clock.sleep(0.5)
    assert guarded.rules() == ["force limit"]
    assert guarded.true_x_um() == 0.0
    with pytest.raises(UnsafeError, match="refused by the force guard"):
        guarded.stage.reference(guarded.stage.reference_order)


@pytest.fixture
def guarded_unmoved(tmp_path):
    with guarded_rig(tmp_path, referenced=False) as rig:
        yield rig


def test_a_search_for_references_is_guarded_and_what_is_lost_by_its_stop_is_said(guarded, caplog):
    guarded.stage._drives.by_axis["x"].node.sdo.write(objects.HOMING_METHOD, TO_THE_SWITCH)
    guarded.press(lambda t_ns: STIFFNESS_UN_PER_UM * max(0.0, -100.0 - guarded.true_x_um(t_ns)))
    with pytest.raises(MoveCancelled, match=r"reference search of axis x .* was stopped \(force guard: probe_force"):
        guarded.stage.reference(["x"])
    guarded.clock.sleep(0.2)
    assert guarded.rules() == ["force limit", "retraction"]
    assert "reference of axis x is not known" in guarded.interventions[1].reason
    assert "the tool may still press" in caplog.text
    assert caplog.records[-1].levelno == logging.ERROR


def test_a_retraction_that_makes_it_worse_is_stopped(tmp_path):
    with guarded_rig(tmp_path, stage={"retract_um": [-300.0, 0.0, 0.0]}) as guarded:
        press_too_hard(guarded)
        guarded.clock.sleep(2.0)
        assert guarded.rules() == ["force limit", "retraction", "retraction"]
        assert "retracting raises the force" in guarded.interventions[1].reason
        assert "the tool may still press" in guarded.interventions[2].reason
        brake_um = 1000.0**2 / 2 / 10_000
        worst_um = AT_LIMIT_UM - 0.1 * LIMIT_UN / STIFFNESS_UN_PER_UM - brake_um
        assert worst_um - 15.0 < guarded.true_x_um() < AT_LIMIT_UM
        assert guarded.rig.safety.tripped


def test_a_retraction_that_begins_below_the_limit_goes_on_unless_it_makes_it_worse(guarded):
    guarded.stage.move_to(x_um=10.0)
    for force_uN, goes_on in ((1.05 * LIMIT_UN, True), (1.2 * LIMIT_UN, False)):
        guarded.stage.move_to(x_um=0.0)
        begun_ns = guarded.clock.now_ns()
        guarded.press(
            lambda t_ns, begun_ns=begun_ns, force_uN=force_uN: min(
                0.95 * LIMIT_UN + 0.3 * LIMIT_UN * max(0.0, (t_ns - begun_ns) / 2e8), force_uN
            )
        )
        move = guarded.stage.retract()
        if goes_on:
            move.wait()
            assert guarded.rules() == []
        else:
            with pytest.raises(MoveCancelled, match="retracting raises the force"):
                move.wait()
            assert guarded.rules() == ["retraction"]
        guarded.press(0.0)
        guarded.clock.sleep(0.1)


def test_a_trip_while_a_move_is_being_prepared_keeps_it_from_starting(guarded):
    guarded.stage.move_to(x_um=10.0)
    now_ns = guarded.clock.now_ns()
    guarded.press(lambda t_ns: 1500.0 * (now_ns + 3_000_000 < t_ns < now_ns + 10**8))
    with pytest.raises(MoveCancelled) as caught:
        guarded.stage.start_move_to(x_um=-100.0, speed_um_s=50.0).wait()
    assert "force guard" in str(caught.value)
    guarded.clock.sleep(1.0)
    assert guarded.true_x_um() == pytest.approx(10.0 + RETRACT_UM, abs=2.0)


# ---------------------------------------------------------------------- tare


def test_without_a_tare_the_raw_force_is_judged(guarded):
    press_too_hard(guarded)
    assert UNTARED in guarded.forces[-1].flags


def test_a_tare_under_load_does_not_defeat_the_guard(guarded, caplog):
    """A tenth of the limit may be a zero that is off; what the tare takes beyond that still counts as load."""
    guarded.press(900.0)
    guarded.stage.move_to(x_um=10.0)
    guarded.sensor.tare()
    guarded.clock.sleep(0.1)
    assert guarded.rules() == ["tare"]
    assert "counts as load" in caplog.text
    for force_uN, trips in ((1050.0, False), (1150.0, True)):
        guarded.press(force_uN)
        guarded.clock.sleep(0.02)
        assert guarded.forces[-1].force_uN < 300.0
        assert bool(guarded.rig.safety.tripped) == trips


def test_a_tare_of_a_free_tip_is_believed(tmp_path):
    safety = {
        "force_guards": [{"sensor": SENSOR, "stage": STAGE, "max_force_uN": LIMIT_UN, "zero_within_uN": 500}],
        "keep_out": "none",
    }  # fmt: skip
    with guarded_rig(tmp_path, safety=safety) as guarded:
        guarded.press(-400.0)
        guarded.stage.move_to(x_um=10.0)
        guarded.sensor.tare()
        for force_uN, trips in ((550.0, False), (650.0, True)):
            guarded.press(force_uN)
            guarded.clock.sleep(0.02)
            assert bool(guarded.rig.safety.tripped) == trips
        assert "tare" not in guarded.rules()


# ---------------------------------------------------------------------- failures and ends


def test_a_stage_that_cannot_be_stopped_is_told_to_the_main_program_and_the_bus_goes_on(guarded, monkeypatch, caplog):
    guarded.stage.move_to(x_um=10.0)
    told = []

    def unplugged():
        told.append(guarded.clock.now_ns())
        raise LinkLost("the adapter is gone")

    monkeypatch.setattr(guarded.stage, "_stop", unplugged)
    monkeypatch.setattr(guarded.stage, "_read", unplugged)
    guarded.press(lambda t_ns: 1200.0)
    with pytest.raises(ErrorTree, match="could not stop every stage") as caught:
        guarded.clock.sleep(0.2)
    assert "use the emergency stop" in str(caught.value)
    assert "probe_stage: the adapter is gone" in str(caught.value)
    assert "NOT STOPPED" in caplog.text
    seen = len(guarded.forces)
    guarded.clock.sleep(0.2)
    assert len(guarded.forces) - seen == pytest.approx(40, abs=2)
    assert len(told) > 1


def test_leaving_the_rig_after_a_trip_takes_the_tool_away_first(tmp_path):
    with pytest.raises(MoveCancelled), guarded_rig(tmp_path) as guarded:
        raise press_too_hard(guarded)
    assert guarded.true_x_um() == pytest.approx(AT_LIMIT_UM + RETRACT_UM, abs=2.0)
    assert guarded.rules()[-1] == "retraction"
    assert not guarded.sensor.streaming


def interrupt_while_retracting(guarded):
    press_too_hard(guarded)
    guarded.clock.sleep(0.15)
    assert guarded.stage.retracting
    raise KeyboardInterrupt


def test_ctrl_c_stops_at_once_also_while_the_tool_is_being_taken_away(tmp_path):
    with pytest.raises(KeyboardInterrupt), guarded_rig(tmp_path) as guarded:
        interrupt_while_retracting(guarded)
    braked_um = guarded.true_x_um()
    assert AT_LIMIT_UM < braked_um < AT_LIMIT_UM + RETRACT_UM / 2
    assert "given up" in guarded.interventions[-1].reason
    assert guarded.true_x_um(guarded.clock.now_ns() + 10**9) < AT_LIMIT_UM + RETRACT_UM / 2


def test_how_large_the_force_became_is_told_when_the_tool_is_away(guarded):
    press_too_hard(guarded, speed_um_s=500.0)
    guarded.clock.sleep(1.5)
    tripped, ended = guarded.interventions
    most_uN = max(sample.raw_uN for sample in guarded.forces)
    assert most_uN > 1.02 * tripped.value > LIMIT_UN
    assert ended.value == pytest.approx(most_uN)
    assert f"(the largest force was {most_uN:.5g} µN)" in ended.reason


def test_the_users_own_stop_ends_a_retraction_and_nobody_argues(guarded):
    press_too_hard(guarded)
    guarded.clock.sleep(0.15)
    guarded.rig.stop()
    guarded.clock.sleep(1.0)
    assert guarded.rules() == ["force limit", "retraction"]
    assert "stopped before it reached its target" in guarded.interventions[-1].reason
    assert guarded.true_x_um() < AT_LIMIT_UM + RETRACT_UM / 2
    guarded.stage.retract().wait()


def test_another_programs_stop_ends_a_guarded_move_and_the_guard_stays_on_duty(guarded):
    guarded.stage.move_to(x_um=10.0)
    move = guarded.stage.start_move_to(x_um=-40.0, speed_um_s=20.0)
    guarded.clock.sleep(0.5)
    for drive in guarded.stage._drives.all:  # as `microdrivers stop` does: by SDO, past everything
        drive.node.sdo.request_write(objects.CONTROL_WORD, QUICK_STOP)
    with pytest.raises(MicrodriversError):
        move.wait()
    assert 5.0 > guarded.true_x_um() > -10.0
    assert guarded.rules() == []
    guarded.stage.clear_fault()
    press_too_hard(guarded)
    guarded.clock.sleep(1.0)
    assert guarded.rules() == ["force limit", "retraction"]


def test_a_run_repeats_bit_for_bit(tmp_path):
    def run():
        with guarded_rig(tmp_path) as guarded:
            press_too_hard(guarded)
            guarded.clock.sleep(0.6)
            return guarded.interventions, guarded.events, guarded.forces[-1]

    assert run() == run()


def test_samples_of_others_are_none_of_its_business(guarded):
    guarded.stage.move_to(x_um=10.0)
    topic = guarded.rig.bus.topic("other_force", ForceSample)
    topic.publish(ForceSample(t_ns=guarded.clock.now_ns(), device="other_force", force_uN=1e6, raw_uN=1e6))
    assert guarded.rules() == []
    assert guarded.rig.safety.limit_uN(SENSOR) == LIMIT_UN
    assert guarded.rig.safety.limit_uN("other_force") is None


@pytest.mark.parametrize(("tare_uN", "limit_uN"), [(60.0, LIMIT_UN), (300.0, 800.0), (-300.0, LIMIT_UN)])
def test_the_limit_of_a_tared_push_is_where_the_guard_trips(guarded, tare_uN, limit_uN):
    guarded.press(tare_uN)
    guarded.sensor.tare(0.5)
    guarded.press(lambda t_ns: tare_uN + guarded.spring_uN(t_ns))
    press_too_hard(guarded, speed_um_s=20.0)
    assert guarded.rig.safety.limit_uN(SENSOR, tare_uN=tare_uN) == limit_uN
    assert "force limit" in guarded.rules()
    assert max(sample.force_uN for sample in guarded.forces) == pytest.approx(limit_uN, rel=0.02)
