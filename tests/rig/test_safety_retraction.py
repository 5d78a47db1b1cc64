"""A tool is taken away although what was in motion still presses harder; only a way out that presses is given up."""

import pytest

from microdrivers.core.samples import ForceSample
from microdrivers.devices.force_sensor import SATURATED
from tests.rig.guarded_rig import (
    AT_LIMIT_UM,
    LIMIT_UN,
    PERIOD_NS,
    RETRACT_UM,
    SENSOR,
    guarded_rig,
    press_too_hard,
)


@pytest.fixture
def guarded(tmp_path):
    with guarded_rig(tmp_path) as rig:
        yield rig


def felt(guarded, force_uN):
    """A reading of this instant, from whoever publishes."""
    sample = ForceSample(t_ns=guarded.clock.now_ns(), device=SENSOR, force_uN=force_uN, raw_uN=force_uN)
    guarded.sensor.topic.publish(sample)


def test_what_is_felt_before_a_retraction_has_been_commanded_does_not_end_it(guarded, monkeypatch):
    """In real time readings come while the stage still brakes and the way out is being worked out."""
    way_out = guarded.stage._way_out

    def meanwhile(retract_um):
        felt(guarded, 1.1 * LIMIT_UN)
        felt(guarded, 1.5 * LIMIT_UN)
        return way_out(retract_um)

    monkeypatch.setattr(guarded.stage, "_way_out", meanwhile)
    press_too_hard(guarded)
    guarded.clock.sleep(1.0)
    assert guarded.rules() == ["force limit", "retraction"]
    assert guarded.true_x_um() == pytest.approx(AT_LIMIT_UM + RETRACT_UM, abs=2.0)


def test_that_it_has_taken_the_tool_away_holds_until_the_next_move(guarded):
    assert not guarded.rig.safety.took_away(guarded.stage.name)
    press_too_hard(guarded)
    assert not guarded.rig.safety.took_away(guarded.stage.name)
    guarded.clock.sleep(1.0)
    assert guarded.rig.safety.took_away(guarded.stage.name)
    guarded.stage.move_to(x_um=0.0)
    assert not guarded.rig.safety.took_away(guarded.stage.name)


def test_a_retraction_in_the_middle_of_a_fast_move_may_press_harder_until_that_has_braked(guarded):
    guarded.stage.move_to(x_um=AT_LIMIT_UM + 40.0)
    guarded.stage.start_move_to(x_um=AT_LIMIT_UM - 200.0, speed_um_s=600.0)
    guarded.clock.sleep(0.085)
    assert guarded.rules() == []
    retraction = guarded.stage.retract()
    retraction.wait()
    assert max(sample.raw_uN for sample in guarded.forces) > 1.2 * LIMIT_UN
    assert guarded.rules() == []
    assert guarded.true_x_um() > AT_LIMIT_UM + 300.0


def test_noise_at_the_end_of_the_range_does_not_end_a_retraction(guarded):
    guarded.stage.move_to(x_um=10.0)
    guarded.press(lambda t_ns: 1995.0 + 10.0 * (t_ns // PERIOD_NS % 2))
    guarded.clock.sleep(0.3)
    assert {SATURATED in sample.flags for sample in guarded.forces[-10:]} == {True, False}
    guarded.press(0.0)
    guarded.clock.sleep(1.0)
    assert guarded.rules() == ["force limit", "retraction"]
    assert guarded.true_x_um() == pytest.approx(10.0 + RETRACT_UM, abs=2.0)
