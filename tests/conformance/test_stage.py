"""The stage suite over its implementations, and over drivers with planted faults."""

from functools import partial

import msgspec
import pytest

from microdrivers.backends.pi_gcs.stage import GcsXYThetaStage
from microdrivers.core.errors import MicrodriversError
from microdrivers.fakes.pi_gcs.codes import ErrorCode
from microdrivers.fakes.wire import wire_named
from tests.conformance.bench import CHAINED, stage_bench
from tests.conformance.stage_suite import SUITE


@pytest.mark.parametrize("name", SUITE.checks)
def test_gcs_stage_in_process(name):
    with stage_bench() as bench:
        SUITE.checks[name](bench)


@pytest.mark.parametrize("name", SUITE.checks)
def test_a_chain_of_three_controllers_in_process(name):
    with stage_bench(file=CHAINED) as bench:
        SUITE.checks[name](bench)


def test_opening_moves_nothing():
    with stage_bench(referenced=False) as bench:
        start = [bench.truth(axis, 0) for axis in ("x", "y", "theta")]
        bench.clock.sleep(1.0)
        assert [bench.truth(axis, bench.clock.now_ns()) for axis in ("x", "y", "theta")] == start


def test_closing_leaves_no_error_for_the_next_program():
    with stage_bench() as bench:
        controller = wire_named(bench.stage.name).emulator
        bench.stage.stop()
        assert controller.state.error is ErrorCode.STOPPED_BY_COMMAND
    assert controller.state.error is ErrorCode.NONE


class WrongSign(GcsXYThetaStage):
    def _start_move(self, targets, speeds):
        super()._start_move(
            {axis: -goal if axis == "theta" else 15_000 - goal for axis, goal in targets.items()}, speeds
        )


class SwappedAxes(GcsXYThetaStage):
    def _start_move(self, targets, speeds):
        other = {"x": "y", "y": "x", "theta": "theta"}
        super()._start_move(
            {other[axis]: goal for axis, goal in targets.items()},
            {other[axis]: speed for axis, speed in speeds.items()},
        )


class MillimetresForMicrometres(GcsXYThetaStage):
    def _start_move(self, targets, speeds):
        super()._start_move({axis: goal / 1000 for axis, goal in targets.items()}, speeds)


class SilentClip(GcsXYThetaStage):
    def start_move_to(self, **targets):
        axis_of = {"x_um": "x", "y_um": "y", "theta_deg": "theta"}
        clipped = {
            key: min(max(value, self.limits[axis_of[key]].min), self.limits[axis_of[key]].max)
            if key in axis_of and value is not None
            else value
            for key, value in targets.items()
        }
        return super().start_move_to(**clipped)


class EarlyOnTarget(GcsXYThetaStage):
    def _read(self):
        return msgspec.structs.replace(super()._read(), on_target=True, moving=False)


class NanAccepted(GcsXYThetaStage):
    def start_move_to(self, **targets):
        return super().start_move_to(**{key: 7500.0 if value != value else value for key, value in targets.items()})


class ArrivalStamp(GcsXYThetaStage):
    def _read(self):
        sample = super()._read()
        return msgspec.structs.replace(sample, t_ns=self.clock.now_ns(), t_source="arrival")


class LostReferenceIgnored(GcsXYThetaStage):
    @property
    def referenced(self):
        return {"x": True, "y": True, "theta": True}


class StopsOneAxisOnly(GcsXYThetaStage):
    def _stop(self):
        self._line.send_now(b"HLT 1\n")


class NumbersNothing(GcsXYThetaStage):
    def _next_seq(self):
        return 0


FOUND_BY = {
    StopsOneAxisOnly: "a_stop_ends_the_motion_and_the_move",
    NumbersNothing: "stamps_the_instant_of_the_pose",
    WrongSign: "moves_each_axis_its_own_way",
    SwappedAxes: "moves_each_axis_its_own_way",
    MillimetresForMicrometres: "moves_each_axis_its_own_way",
    SilentClip: "refuses_what_is_out_of_range_and_moves_nothing",
    EarlyOnTarget: "is_on_target_only_when_it_is_there",
    NanAccepted: "refuses_what_is_not_finite",
    ArrivalStamp: "stamps_the_instant_of_the_pose",
    LostReferenceIgnored: "an_unreferenced_axis_refuses_absolute_moves",
}


@pytest.mark.parametrize("fault", FOUND_BY, ids=lambda fault: fault.__name__)
def test_a_planted_fault_is_found_by_name(fault):
    found = (AssertionError, pytest.fail.Exception, MicrodriversError)
    with stage_bench(fault) as bench, pytest.raises(found):
        SUITE.checks[FOUND_BY[fault]](bench)


def test_the_sound_driver_has_no_fault():
    assert SUITE.failing(partial(stage_bench)) == {}
