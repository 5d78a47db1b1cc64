"""How somebody else runs a suite on a driver of his own: here a stage without any wire, straight on simulated axes."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import pytest

from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock, SimulatedClock
from microdrivers.core.samples import XYThetaSample
from microdrivers.devices.base import DeviceInfo
from microdrivers.devices.motion import AxisSpec
from microdrivers.devices.xytheta_stage import XYThetaStage
from microdrivers.fakes.world.axis import Axis
from tests.conformance import stage_suite
from tests.conformance.bench import StageBench

AXES = {
    "x": AxisSpec(
        unit="µm", min_position=0.0, max_position=15_000.0, max_speed=1500.0, acceleration=20_000.0,
        resolution=0.05, tolerance=0.15,
    ),
    "y": AxisSpec(
        unit="µm", min_position=0.0, max_position=15_000.0, max_speed=1500.0, acceleration=20_000.0,
        resolution=0.05, tolerance=0.15,
    ),
    "theta": AxisSpec(
        unit="deg", min_position=-180.0, max_position=180.0, max_speed=10.0, acceleration=100.0,
        resolution=1e-4, tolerance=3e-4,
    ),
}  # fmt: skip
HOME = {"x": 7500.0, "y": 7500.0, "theta": 0.0}


class DirectStage(XYThetaStage):
    """The least that a driver is."""

    axes = AXES

    def __init__(self, name: str, *, clock: Clock, bus: Bus) -> None:
        super().__init__(name, clock=clock, bus=bus)
        self.table = {axis: Axis(position, lag_s=0.004) for axis, position in HOME.items()}
        self._referenced = dict.fromkeys(AXES, False)
        self._targets = dict.fromkeys(AXES, float("nan"))

    def _connect(self) -> None:
        """There is no line."""

    def _identify(self) -> DeviceInfo:
        return DeviceInfo(driver="direct", model="axes without a wire")

    def _close(self) -> None:
        """There is no line."""

    def _stop(self) -> None:
        for axis, table in self.table.items():
            table.halt(self.clock.now_ns(), deceleration=AXES[axis].acceleration)

    def _start_move(self, targets: Mapping[str, float], speeds: Mapping[str, float]) -> None:
        for axis, target in targets.items():
            self.table[axis].move(self.clock.now_ns(), target, speed=speeds[axis], acceleration=AXES[axis].acceleration)
            self._targets[axis] = target

    def _reference_axis(self, axis: str) -> None:
        self._referenced[axis] = True

    @property
    def referenced(self) -> Mapping[str, bool]:
        return self._referenced

    def _read(self) -> XYThetaSample:
        now_ns = self.clock.now_ns()
        position = {axis: table.position_at(now_ns) for axis, table in self.table.items()}
        return XYThetaSample(
            t_ns=now_ns,
            device=self.name,
            seq=self._next_seq(),
            x_um=position["x"],
            y_um=position["y"],
            theta_deg=position["theta"],
            target_x_um=self._targets["x"],
            target_y_um=self._targets["y"],
            target_theta_deg=self._targets["theta"],
            moving=any(table.moving_at(now_ns) for table in self.table.values()),
            on_target=all(table.within_from_ns(AXES[axis].tolerance) <= now_ns for axis, table in self.table.items()),
            referenced=all(self._referenced.values()),
        )

    def power_cycle(self) -> None:
        """What a test does to it."""
        self._referenced = dict.fromkeys(AXES, False)


@contextmanager
def direct_bench() -> Iterator[StageBench]:
    clock = SimulatedClock()
    stage = DirectStage("stage", clock=clock, bus=Bus())
    stage.open()
    stage.reference(["x", "y", "theta"])
    yield StageBench(
        stage,
        clock,
        truth=lambda axis, t_ns: stage.table[axis].position_at(t_ns),
        home=HOME,
        power_cycle=stage.power_cycle,
    )
    stage.close()


@pytest.mark.parametrize("name", stage_suite.SUITE.checks)
def test_direct_stage(name):
    with direct_bench() as bench:
        stage_suite.SUITE.checks[name](bench)
