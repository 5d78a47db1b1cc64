"""The zoom suite over its implementations, and over drivers with planted faults."""

import msgspec
import pytest

from microdrivers.backends.oriental_az.zoom import AzZoomMotor
from microdrivers.core.errors import MicrodriversError
from tests.conformance.bench import zoom_bench
from tests.conformance.zoom_suite import SUITE


@pytest.mark.parametrize("name", SUITE.checks)
def test_az_zoom_in_process(name):
    with zoom_bench() as bench:
        SUITE.checks[name](bench)


class WrongSign(AzZoomMotor):
    def _start_move(self, position_steps):
        super()._start_move(2 * round(self.curve.steps_at(1.0)) - position_steps)


class EarlyOnTarget(AzZoomMotor):
    def _read(self):
        return msgspec.structs.replace(super()._read(), on_target=True, moving=False)


class RestsWhileItMoves(AzZoomMotor):
    def _read(self):
        return msgspec.structs.replace(super()._read(), moving=False)


class ArrivalStamp(AzZoomMotor):
    def _read(self):
        return msgspec.structs.replace(super()._read(), t_ns=self.clock.now_ns(), t_source="arrival")


class SilentClip(AzZoomMotor):
    def start_move_to(self, *, zoom):
        return super().start_move_to(zoom=min(max(zoom, self.zoom_range.min), self.zoom_range.max))


class NoApproach(AzZoomMotor):
    def _approach_steps(self, start_steps, target_steps, approach):
        return None


FOUND_BY = {
    WrongSign: "reaches_the_zoom_that_is_asked_for",
    EarlyOnTarget: "is_on_target_only_when_it_is_there",
    RestsWhileItMoves: "never_says_that_it_rests_while_it_moves",
    ArrivalStamp: "stamps_the_instant_of_the_position",
    SilentClip: "refuses_what_is_out_of_range_or_not_finite_and_moves_nothing",
    NoApproach: "approaches_from_below",
}


@pytest.mark.parametrize("fault", FOUND_BY, ids=lambda fault: fault.__name__)
def test_a_planted_fault_is_found_by_name(fault):
    found = (AssertionError, pytest.fail.Exception, MicrodriversError)
    with zoom_bench(fault) as bench, pytest.raises(found):
        SUITE.checks[FOUND_BY[fault]](bench)


def test_the_sound_driver_has_no_fault():
    assert SUITE.failing(zoom_bench) == {}
