"""What the doctor says of guarded motion: the stop is rehearsed at rest, and nothing moves."""

import pytest

from microdrivers.core.clock import SimulatedClock, SystemClock
from microdrivers.core.errors import LinkLost
from microdrivers.routines.findings import DeviceDiagnosis
from microdrivers.routines.guard_check import REHEARSALS, check_guards
from tests.rig.guarded_rig import SENSOR, STAGE, guarded_rig

BOX = {"name": "slide", "min_um": [0, 0, -5000], "max_um": [15000, 15000, -200]}
FAR = {"name": "far", "min_um": [0, 0, -5000], "max_um": [15000, 15000, -700]}
SAFETY = {"force_guards": [{"sensor": SENSOR, "stage": STAGE, "max_force_uN": 1000}], "keep_out": [BOX, FAR]}


def findings(guarded):
    """Of sensor and stage: level, what is said, figures."""
    names = (SENSOR, STAGE)
    found = {name: DeviceDiagnosis(name=name, driver="") for name in names}
    check_guards(guarded.rig, list(found.values()))
    return {name: ([(each.level, each.what) for each in found[name].findings], found[name].figures) for name in names}


@pytest.fixture
def guarded(tmp_path):
    with guarded_rig(tmp_path, clock=SimulatedClock(), safety=SAFETY) as rig:
        rig.stage.read()
        rig.events.clear()
        yield rig


def test_each_guard_is_rehearsed_at_rest_and_boxes_within_reach_are_named(guarded):
    found = findings(guarded)
    ((level, what),), _ = found[SENSOR]
    assert level == "ok"
    assert "its guard stops probe_stage beyond 1000 µN; until it stands, it goes on by up to " in what
    assert "at a speed of 1000 µm/s (its largest; the guard states no max_speed_um_s)" in what
    assert found[STAGE][0] == [("ok", "its tip could reach and is kept out of: slide")]
    assert [event.by for event in guarded.stops()] == ["force guard"] * REHEARSALS
    assert guarded.rules() == []
    assert not guarded.rig.safety.tripped
    assert guarded.true_x_um() == 0.0
    guarded.stage.move_to(x_um=10.0)


def test_the_way_on_is_that_of_the_largest_speed_allowed(tmp_path):
    guard = SAFETY["force_guards"][0] | {"max_speed_um_s": 100.0}
    with guarded_rig(tmp_path, clock=SimulatedClock(), safety=SAFETY | {"force_guards": [guard]}) as guarded:
        guarded.stage.read()
        ((_, what),), _ = findings(guarded)[SENSOR]
        acceleration = min(axis.acceleration for axis in guarded.stage.axes.values())
    way_um = 100.0 / 200.0 + 100.0**2 / (2.0 * acceleration)
    assert f"by up to {way_um:.2g} µm at a speed of 100 µm/s (the guard's max_speed_um_s)" in what


def test_a_tool_without_guard_and_boxes_is_a_warning(tmp_path):
    with guarded_rig(tmp_path, clock=SimulatedClock(), safety="none") as guarded:
        found = findings(guarded)
    (sensor,), (stage,) = found[SENSOR][0], found[STAGE][0]
    assert sensor == ("warning", "no force guard watches it: nothing stops probe_stage if it presses too hard")
    assert stage == ("ok", "no keep_out box limits where its tip may go")


def test_a_stage_in_motion_is_not_stopped_for_a_rehearsal(guarded):
    move = guarded.stage.start_move_to(x_um=100.0, speed_um_s=50.0)
    ((level, what),), _ = findings(guarded)[SENSOR]
    assert level == "warning"
    assert "not rehearsed" in what
    assert move.wait().x_um == pytest.approx(100.0, abs=0.2)


def test_a_stop_that_cannot_be_sent_is_a_problem(guarded, monkeypatch):
    def unplugged():
        raise LinkLost("the adapter is gone")

    with monkeypatch.context() as patch:
        patch.setattr(guarded.stage, "_stop", unplugged)
        ((level, what),), _ = findings(guarded)[SENSOR]
    assert level == "problem"
    assert "rehearsal failed: the adapter is gone" in what


@pytest.mark.xdist_group("real_time")
def test_in_real_time_the_latency_is_measured(tmp_path):
    with guarded_rig(tmp_path, clock=SystemClock(), safety=SAFETY, stage={"heartbeat_ms": 2000}) as guarded:
        guarded.stage.read()
        ((_, what),), figures = findings(guarded)[SENSOR]
    assert "from reading to stop command" in what
    assert 0.0 < figures["stop_median_ms"] <= figures["stop_worst_ms"]
