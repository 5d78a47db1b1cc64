"""A tool that cannot be taken away the whole way: the force guard says how far it was."""

import re

import pytest

from microdrivers.core.errors import MoveCancelled
from tests.rig.guarded_rig import AT_LIMIT_UM, LIMIT_UN, PERIOD_NS, SENSOR, STAGE, guarded_rig, press_too_hard


@pytest.mark.parametrize(
    ("retract_um", "said", "failed"),
    [
        ((400.0, 0.0, 0.0), "the tool was taken away, to x [^;]*$", False),
        (
            (10.0, 0.0, 0.0),
            "probe_force feels 80[0-9.]* µN where it stands; the tool may still press: .*zero_within_uN",
            False,
        ),
        ((1000.0, 0.0, 0.0), "the tool was taken away by 7[23] % of retract_um, for no more is free, to x", False),
        ((0.0, 0.0, 500.0), "by 0 % of retract_um, for no more is free, .*; the tool may still press", True),
    ],
)
def test_how_far_it_was_taken_away_is_told(tmp_path, retract_um, said, failed):
    with guarded_rig(tmp_path, stage={"retract_um": retract_um}) as guarded:
        guarded.stage.move_to(z_um=guarded.stage.limits["z"].max)
        with pytest.raises(MoveCancelled):
            guarded.stage.move_to(x_um=AT_LIMIT_UM - 100.0, speed_um_s=20.0)
        guarded.clock.sleep(2.0)
        told = guarded.interventions[-1]
        assert told.rule == "retraction"
        assert re.search(said, told.reason), told.reason
        assert bool(guarded.rig.safety.tripped) is failed


def presses_still(guarded):
    return [told.value for told in guarded.interventions if "may still press" in told.reason]


def test_a_specimen_that_comes_after_a_tool_taken_away_by_too_little_is_told_once(tmp_path):
    with guarded_rig(tmp_path) as guarded:
        press_too_hard(guarded)
        guarded.clock.sleep(1.0)
        guarded.press(0.09 * LIMIT_UN)
        guarded.clock.sleep(1.0)
        assert presses_still(guarded) == []
        guarded.press(0.2 * LIMIT_UN)
        guarded.clock.sleep(1.0)
        [mean_uN] = presses_still(guarded)
        assert 0.1 * LIMIT_UN < mean_uN < 0.21 * LIMIT_UN


@pytest.mark.parametrize("ended_by", ["a command", "time"])
def test_what_presses_later_is_not_what_the_tool_was_taken_away_from(tmp_path, ended_by):
    with guarded_rig(tmp_path) as guarded:
        press_too_hard(guarded)
        guarded.clock.sleep(1.0)
        if ended_by == "time":
            guarded.clock.sleep(25.0)
        else:
            guarded.stage.move_to(y_um=10.0)
        guarded.press(0.3 * LIMIT_UN)
        guarded.clock.sleep(1.0)
        assert presses_still(guarded) == []


def guarding(max_force_uN, stale_after_ms):
    guard = {"sensor": SENSOR, "stage": STAGE, "max_force_uN": max_force_uN, "stale_after_ms": stale_after_ms}
    return {"force_guards": [guard], "keep_out": "none"}


def test_noise_is_no_press(tmp_path):
    """Each reading is beyond a tenth of the limit."""
    with guarded_rig(tmp_path, safety=guarding(200.0, 50)) as guarded:
        with pytest.raises(MoveCancelled):
            guarded.stage.move_to(x_um=AT_LIMIT_UM)
        guarded.clock.sleep(1.0)
        guarded.press(lambda t_ns: 40.0 if t_ns // PERIOD_NS % 2 else -40.0)
        guarded.clock.sleep(5.0)
        assert max(abs(sample.force_uN) for sample in guarded.forces[-100:]) > 20.0
        assert presses_still(guarded) == []


def test_what_a_slow_sensor_still_feels_of_the_way_out_is_no_press(tmp_path):
    with guarded_rig(tmp_path, safety=guarding(200.0, 500), bandwidth_hz=5, rate_hz=10) as guarded:
        press_too_hard(guarded)
        guarded.clock.sleep(5.0)
        assert presses_still(guarded) == []


def test_a_retraction_that_replaces_the_guards_leaves_no_press_unsaid(tmp_path):
    with guarded_rig(tmp_path, stage={"retract_um": (20.0, 0.0, 0.0)}) as guarded:
        with pytest.raises(MoveCancelled):
            guarded.stage.move_to(x_um=AT_LIMIT_UM - 100.0, speed_um_s=20.0)
        guarded.clock.sleep(0.05)
        guarded.stage.retract().wait()
        guarded.clock.sleep(1.0)
        assert any("somebody else's retract()" in told.reason for told in guarded.interventions)
        assert len(presses_still(guarded)) == 1
