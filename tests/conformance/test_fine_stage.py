"""The fine-stage suite in process, and over drivers with planted faults."""

import msgspec
import pytest

from microdrivers.backends.cia402.fine_stage import Cia402FineStage
from microdrivers.core.errors import MicrodriversError
from tests.conformance.fine_stage_suite import SUITE
from tests.conformance.tool_bench import fine_stage_bench


@pytest.mark.parametrize("name", SUITE.checks)
def test_cia402_fine_stage_in_process(name):
    with fine_stage_bench() as bench:
        SUITE.checks[name](bench)


class WrongSign(Cia402FineStage):
    def _start_move(self, targets, speeds):
        super()._start_move({axis: -goal for axis, goal in targets.items()}, speeds)


class SwappedAxes(Cia402FineStage):
    def _start_move(self, targets, speeds):
        other = {"x": "y", "y": "x", "z": "z"}
        super()._start_move(
            {other[axis]: goal for axis, goal in targets.items()},
            {other[axis]: speed for axis, speed in speeds.items()},
        )


class EarlyOnTarget(Cia402FineStage):
    def _read(self):
        return msgspec.structs.replace(super()._read(), on_target=True, moving=False)


class EachAxisAtFullSpeed(Cia402FineStage):
    def _start_move(self, targets, speeds):
        super()._start_move(targets, dict.fromkeys(speeds, max(speeds.values())))


class SilentClip(Cia402FineStage):
    def start_move_to(self, **targets):
        def clipped(key, value):
            axis = key.removesuffix("_um")
            if axis not in self.limits or value is None:
                return value
            return min(max(value, self.limits[axis].min), self.limits[axis].max)

        return super().start_move_to(**{key: clipped(key, value) for key, value in targets.items()})


class LostReferenceIgnored(Cia402FineStage):
    @property
    def referenced(self):
        return {"x": True, "y": True, "z": True}


class RetractsTheOtherWay(Cia402FineStage):
    def retract(self):
        self.retract_um = tuple(-length for length in self.retract_um)
        return super().retract()


FOUND_BY = {
    WrongSign: "moves_each_axis_its_own_way",
    SwappedAxes: "moves_each_axis_its_own_way",
    EarlyOnTarget: "is_on_target_only_when_it_is_there",
    EachAxisAtFullSpeed: "keeps_to_the_straight_line_between_start_and_target",
    SilentClip: "refuses_what_is_out_of_range_or_not_finite_and_moves_nothing",
    LostReferenceIgnored: "an_unreferenced_axis_refuses_absolute_moves",
    RetractsTheOtherWay: "retracts_along_the_way_that_the_rig_file_states",
}


@pytest.mark.parametrize("fault", FOUND_BY, ids=lambda fault: fault.__name__)
def test_a_planted_fault_is_found_by_name(fault):
    with pytest.raises((AssertionError, pytest.fail.Exception, MicrodriversError)), fine_stage_bench(fault) as bench:
        SUITE.checks[FOUND_BY[fault]](bench)
